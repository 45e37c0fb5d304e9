"""A trained scene as one HTML file: the Gaussians, their learned light, and a program that shades them per pixel."""

from __future__ import annotations

import base64
import gzip
import html
from collections.abc import Mapping, Sequence
from string import Template
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from polarguide import __version__
from polarguide.camera import Camera
from polarguide.export.records import TEXEL, planes, records
from polarguide.gaussians.ply import refit_sh_to_display
from polarguide.presentation import Presentation
from polarguide.runs.model import gaussian_colors
from polarguide.scene_frame import scene_frame
from polarguide.shading.cubemap import ringed_texels
from polarguide.shading.model import PLAIN_LAYERS, Light, PageShading, Parameters, ShadingModel
from polarguide.visualization.embedded import content_policy, page_part, script_json

SCRIPTS = (
    "algebra.js",
    "sorter.js",
    "renderer.js",
    "navigation.js",
    "controls.js",
    "presentation.js",
    "unpack.js",
    "main.js",
)
NOTHING = Presentation()
SHADERS = {
    "records": "records.glsl",
    "derive": "derive.frag",
    "splat_vert": "splat.vert",
    "splat_frag": "splat.frag",
    "full": "full.vert",
    "light": "light.glsl",
    "shade": "shade.frag",
}
LAYERS = ("final", "diffuse", "specular", "base", "strength", "normal", "metalness")
"""Layers that the page can show, in its order."""
BAKED = (
    "This page has no shaders for the reflections of this model. Each Gaussian shows its color toward the eye, with "
    "reflections baked into spherical harmonics of degree 3, which keep broad highlights and no mirror images."
)


def share_page(
    gaussians: Parameters,
    light: Light,
    shading: ShadingModel,
    cameras: Mapping[str, Camera],
    *,
    first: str,
    title: str,
    caption: str = "",
    metrics: Sequence[tuple[str, str]] = (),
    notes: Sequence[str] = (),
    presentation: Presentation = NOTHING,
) -> str:
    """The page.

    Args:
        gaussians: the Gaussians.
        light: parameters of the learned light by name. shading: of the recipe, for the run's refractive index.
        cameras: poses to choose from by name, at least one. first: name of the one to begin with.
        title, caption: any text; it is escaped.
        metrics: labels and values, any text. notes: paragraphs before them, any text.
        presentation: white balance, up axis, scale and credit.

    Returns:
        HTML that asks for nothing from outside; its own policy forbids it to.
    """
    page = shading.page(gaussians, light)
    layers: Sequence[str] = shading.layers
    if page is None:
        page, layers = baked_page(gaussians, light, shading), PLAIN_LAYERS
    quantized = records(gaussians, page.values)
    scene: dict[str, Any] = {
        "kind": page.kind,
        "texels": quantized.itemsize // TEXEL,
        "count": len(quantized),
        "layers": [
            name for name in LAYERS if name in layers and (name != "metalness" or "metal" in page.values)
        ],
        "index": 1.5,
        "resolution": int(page.light[0].shape[1]) if page.light else 1,
        "levels": max(1, len(page.light)),
        **_frame(cameras, first, presentation),
        **page.constants,
    }
    arrays: dict[str, NDArray[np.generic] | None] = {
        "light": light_numbers(page.light) if page.light else None,
        "network": network_numbers(page.network) if page.network else None,
        "viridis": viridis(),
    }
    script = '"use strict";\n' + "\n".join(page_part(__package__, name) for name in SCRIPTS)
    return Template(page_part(__package__, "page.html")).substitute(
        policy=content_policy(script, more=" blob:; worker-src blob:"),
        version=html.escape(__version__),
        title=html.escape(title),
        caption=html.escape(caption),
        notes="".join(f'<p class="note">{html.escape(note)}</p>' for note in (*notes, *page.notes)),
        metrics="".join(
            f"<tr><th>{html.escape(label)}</th><td>{html.escape(value)}</td></tr>" for label, value in metrics
        ),
        credit=_credit(presentation),
        meta=_meta(presentation),
        style=page_part(__package__, "page.css"),
        script=script,
        scene=script_json(scene),
        shaders=script_json({name: page_part(__package__, file) for name, file in SHADERS.items()}),
        records=_packed(planes(quantized)),
        **{name: "" if values is None else _packed(values.tobytes()) for name, values in arrays.items()},
    )


def baked_page(gaussians: Parameters, light: Light, shading: ShadingModel) -> PageShading:
    """The page of a model for which there are no shaders: linear harmonics of its Gaussians' own colors, and a note."""
    count = len(gaussians["means"])
    dc, rest = refit_sh_to_display(
        lambda directions: gaussian_colors(gaussians, light, shading, directions).cpu(), count
    )
    return PageShading("plain", {"color": dc[:, 0], "harmonics": rest}, notes=[BAKED])


def _credit(presentation: Presentation) -> str:
    """A line of whom the scene is owed to, and what machines read of it; empty where nobody is named."""
    shown = presentation
    lines = [text for text in (shown.credit and f"© {shown.credit}", shown.provenance) if text]
    return f'<p class="credit">{html.escape(" · ".join(lines))}</p>' if lines else ""


def _meta(presentation: Presentation) -> str:
    names = {"author": presentation.author, "dcterms.license": presentation.license}
    names["dcterms.provenance"] = presentation.provenance
    return "".join(
        f'<meta name="{name}" content="{html.escape(text)}">\n' for name, text in names.items() if text
    )


def _frame(cameras: Mapping[str, Camera], first: str, presentation: Presentation) -> dict[str, Any]:
    around = presentation.upright(scene_frame(list(cameras.values())))
    return {
        "white": list(presentation.white_balance or (1.0, 1.0, 1.0)),
        "metersPerUnit": presentation.meters_per_unit,
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


def _packed(raw: bytes) -> str:
    return base64.b64encode(gzip.compress(raw, 9, mtime=0)).decode()


@torch.no_grad()
def light_numbers(levels: Sequence[Tensor]) -> NDArray[np.float16]:
    """Cubemaps [6, R, R, C] with their rings, one after the other, channels filled up to a multiple of four."""
    numbers = []
    for texture in levels:
        texels = ringed_texels(texture.detach().clamp(-6e4, 6e4))
        numbers.append(pad(texels, (0, -texels.shape[-1] % 4)).flatten())
    return torch.cat(numbers).numpy().astype("<f2")


@torch.no_grad()
def network_numbers(matrices: Sequence[Tensor]) -> NDArray[np.float32]:
    """Matrices [rows, columns] one after the other, columns filled up to a multiple of four."""
    padded = [pad(matrix.detach(), (0, -matrix.shape[1] % 4)).flatten() for matrix in matrices]
    return torch.cat(padded).numpy().astype("<f4")


def viridis() -> NDArray[np.uint8]:
    """The color map of scalar layers, [256, 3] RGB."""
    colors = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[None], cv2.COLORMAP_VIRIDIS)
    return np.ascontiguousarray(colors[0, :, ::-1], dtype=np.uint8)
