"""A trained scene as one HTML file: the Gaussians, their learned light, and a program that shades them per pixel."""

from __future__ import annotations

import base64
import gzip
import hashlib
import html
import json
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from polarguide import __version__
from polarguide.camera import Camera
from polarguide.export.page_light import directional_levels, light_numbers, network_numbers, viridis
from polarguide.export.records import TEXELS, Kind, records, shading_kind
from polarguide.files import atomic
from polarguide.scene_frame import scene_frame
from polarguide.shading.deferred import Shading
from polarguide.shading.model import Parameters, ShadingModel

SCRIPTS = ("algebra.js", "sorter.js", "renderer.js", "navigation.js", "controls.js", "unpack.js", "main.js")
SHADERS = {
    "records": "records.glsl",
    "derive": "derive.frag",
    "splat_vert": "splat.vert",
    "splat_frag": "splat.frag",
    "full": "full.vert",
    "light": "light.glsl",
    "shade": "shade.frag",
}
LAYERS: dict[Kind, tuple[str, ...]] = {
    "plain": ("final", "normal"),
    "reflection": ("final", "diffuse", "specular", "base", "strength", "normal"),
    "local": ("final", "diffuse", "specular", "base", "strength", "normal"),
    "directional": ("final", "diffuse", "specular", "base", "normal"),
}
LEFT_OUT = "The reflections of this model are left out: the page does not know their shading. It shows the base color."
TURNED_LOCALLY = (
    "Turning the environment turns what is reflected from afar. What stands near is reflected by the Gaussians "
    "themselves, which stay as they are."
)


def share_page(
    gaussians: Parameters,
    environment: Mapping[str, Tensor] | None,
    shading: ShadingModel,
    cameras: Mapping[str, Camera],
    *,
    first: str,
    title: str,
    caption: str = "",
    metrics: Sequence[tuple[str, str]] = (),
) -> str:
    """The page.

    Args:
        gaussians: the Gaussians.
        environment: parameters of the learned light, None: no reflection. shading: of the recipe.
        cameras: poses to choose from by name, at least one. first: name of the one to begin with.
        title, caption: any text; it is escaped.
        metrics: labels and values, any text.

    Returns:
        HTML that asks for nothing from outside; its own policy forbids it to.
    """
    kind = shading_kind(shading, lit=environment is not None)
    notes = [LEFT_OUT] if kind is None else [TURNED_LOCALLY] if kind == "local" else []
    kind = kind or "plain"
    quantized = records(gaussians, kind)
    scene: dict[str, Any] = {
        "kind": kind,
        "texels": TEXELS[kind],
        "count": len(quantized.data),
        "layers": LAYERS[kind],
    }
    scene |= _frame(cameras, first) | {"index": 1.5, "resolution": 1, "levels": 1}
    arrays: dict[str, NDArray[np.generic] | None] = {"light": None, "network": None, "viridis": viridis()}
    if kind != "plain" and environment is not None:
        levels = [environment["texels"]]
        if kind == "directional":
            levels = directional_levels(environment)
            arrays["network"] = network_numbers(environment)
            scene["width"] = int(environment["mlp_weight_0"].shape[1])
        arrays["light"] = light_numbers(levels)
        scene |= {"resolution": int(levels[0].shape[1]), "levels": len(levels)}
    if isinstance(shading, Shading):
        scene |= {"blend": shading.blend, "index": shading.index}
    script = "\n".join(
        f'"use strict";\n{_page(name)}' if not i else _page(name) for i, name in enumerate(SCRIPTS)
    )
    return Template(_page("page.html")).substitute(
        policy=_policy(script),
        version=html.escape(__version__),
        title=html.escape(title),
        caption=html.escape(caption),
        notes="".join(f'<p class="note">{html.escape(note)}</p>' for note in notes),
        metrics="".join(
            f"<tr><th>{html.escape(label)}</th><td>{html.escape(value)}</td></tr>" for label, value in metrics
        ),
        style=_page("page.css"),
        script=script,
        scene=_data(scene),
        shaders=_data({name: _page(file) for name, file in SHADERS.items()}),
        records=_packed(quantized.planes()),
        **{name: "" if values is None else _packed(values.tobytes()) for name, values in arrays.items()},
    )


def write_page(path: Path, page: str) -> None:
    """Write a page in one step."""
    with atomic(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _frame(cameras: Mapping[str, Camera], first: str) -> dict[str, Any]:
    around = scene_frame(list(cameras.values()))
    return {
        "up": around.up.tolist(),
        "center": around.center.tolist(),
        "distance": around.distance,
        "first": list(cameras).index(first),
        "cameras": [
            {
                "name": name,
                **{key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")},
                "rotation": camera.rotation.flatten().tolist(),
                "translation": camera.translation.tolist(),
            }
            for name, camera in cameras.items()
        ],
    }


def _policy(script: str) -> str:
    """Only this script may run, and nothing may be asked for; the sorting worker is made of the script's own text."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'sha256-{digest}' blob:; worker-src blob:; style-src 'unsafe-inline'"
    )


def _page(name: str) -> str:
    return (resources.files(__package__) / "page" / name).read_text(encoding="utf-8")


def _data(data: Any) -> str:
    """JSON that cannot end the script element that holds it."""
    text = json.dumps(data, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _packed(raw: bytes) -> str:
    return base64.b64encode(gzip.compress(raw, 9, mtime=0)).decode()
