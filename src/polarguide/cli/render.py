"""``polarguide render``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import NDArray
from torch import Tensor

from polarguide.camera import Camera
from polarguide.capture import View
from polarguide.cli.common import OpenRun, console, open_run, select_views, use_threads
from polarguide.errors import PolarguideError
from polarguide.evaluation import figures
from polarguide.raster import DeviceName
from polarguide.shading.result import RenderResult

Picture = NDArray[np.uint8]
LAYERS = ("final", "base", "reflection", "specular", "diffuse", "strength", "normal", "depth", "alpha")
SHEET_VIEWS = 8


def render_views(
    run: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    views: str = "test",
    layers: str = "final,base,reflection,specular,diffuse,strength,normal,depth",
    out: Path | None = None,
    device: DeviceName = "auto",
    threads: int = 0,
) -> None:
    """Render a run's layers to PNG, with a contact sheet beside the ground truth.

    specular and diffuse are the contributions that add up to final; normals are in camera space, blue facing the
    camera.

    Args:
        run: Run folder.
        views: test, train, all, or names separated by commas.
        layers: Any of final, base, reflection, specular, diffuse, strength, normal, depth, alpha.
        out: Folder to write; RUN/render by default.
        device: What to compute on.
        threads: Threads to use; 0 takes all cores.
    """
    use_threads(threads)
    names = [name.strip() for name in layers.split(",") if name.strip()]
    for name in names:
        if name not in LAYERS:
            raise PolarguideError(
                "--layers", expected="any of " + ", ".join(LAYERS), found=name, remedy="Correct the name."
            )
    if not names:
        raise PolarguideError(
            "--layers", expected="any of " + ", ".join(LAYERS), found="none", remedy="Name a layer."
        )
    opened = open_run(run, device=device)
    render_run(opened, select_views(opened.scene, views), names, out or run / "render")


def render_run(opened: OpenRun, views: tuple[View, ...], layers: list[str], out: Path) -> Path:
    """Write the layers of some views and their contact sheet; returns the sheet's path."""
    out.mkdir(parents=True, exist_ok=True)
    rows: list[list[Picture | None]] = []
    labels: list[str] = []
    missing: set[str] = set()
    for view in views:
        result = opened.render(view, depth=True)
        depths = _true_depth_range(view)
        pictures = {name: layer_picture(result, name, view.camera, depths) for name in layers}
        for name, picture in pictures.items():
            if picture is None:
                missing.add(name)
            else:
                figures.write_png(out / f"{view.name}_{name}.png", picture)
        truth = truth_pictures(view)
        if len(rows) < 2 * SHEET_VIEWS:
            rows.append([pictures[name] for name in layers])
            rows.append([truth.get(name) for name in layers])
            labels += [view.name, f"{view.name} true"]
    sheet = out / "contact_sheet.png"
    figures.write_png(sheet, figures.contact_sheet(rows, labels, layers))
    if missing:
        console.print(f"this recipe has no layer {', '.join(sorted(missing))}")
    console.print(f"pictures: {out}   contact sheet: {sheet}")
    return sheet


def layer_picture(
    result: RenderResult, name: str, camera: Camera, depths: tuple[float, float] | None = None
) -> Picture | None:
    """One layer as an 8-bit picture, or None where the recipe has no such layer; ``depths`` sets depth's colours."""
    values: Tensor | None = getattr(result, name)
    if values is None:
        return None
    near, far = depths or (0.0, 1.0)
    if name == "depth" and depths is None:
        near, far = _depth_range(values, result.alpha > 0.5)
    draw: dict[str, Callable[[Tensor], Picture]] = {
        "normal": lambda v: figures.normal_to_rgb(v, camera),
        "depth": lambda v: figures.scalar_to_rgb(v, near, far),
        "strength": lambda v: figures.scalar_to_rgb(v, 0.0, 1.0),
        "alpha": lambda v: figures.scalar_to_rgb(v, 0.0, 1.0),
    }
    return draw.get(name, figures.radiance_to_rgb)(values)


def _depth_range(depth: Tensor, seen: Tensor) -> tuple[float, float]:
    """Nearest and farthest depth [H, W] worth a colour where ``seen`` [H, W]."""
    values = depth[seen]
    if values.numel() == 0:
        return 0.0, 1.0
    near, far = float(values.quantile(0.02)), float(values.quantile(0.9))
    return near, max(far, near + 1e-6)


def _true_depth_range(view: View) -> tuple[float, float] | None:
    """The range of the true depths, so that rendered and true pictures share their colours; None without truth."""
    truth = view.truth
    if truth is None or truth.depth is None or truth.mask is None:
        return None
    return _depth_range(truth.depth, truth.mask)


def truth_pictures(view: View) -> dict[str, Picture]:
    """The photograph as ``final``, and what is known of the other layers, as 8-bit pictures."""
    pictures = {"final": figures.radiance_to_rgb(view.photograph())}
    truth = view.truth
    if truth is None:
        return pictures
    if truth.normal is not None:
        pictures["normal"] = figures.normal_to_rgb(truth.normal, view.camera)
    for name, layer in (("specular", truth.specular), ("diffuse", truth.diffuse)):
        if layer is not None:
            pictures[name] = figures.radiance_to_rgb(layer / 2)
    depths = _true_depth_range(view)
    if truth.depth is not None and depths is not None:
        pictures["depth"] = figures.scalar_to_rgb(truth.depth, *depths)
    return pictures
