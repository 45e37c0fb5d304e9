"""``polarguide render``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import tyro

from polarguide.capture import View
from polarguide.cli.common import OpenRun, console, open_run, select_views, use_threads
from polarguide.errors import PolarguideError
from polarguide.export.environment import (
    RELIT_RESOLUTION,
    needs_radiance,
    read_panorama,
    texels_of,
    turned_cubemap,
)
from polarguide.raster import DeviceName
from polarguide.rendering.film import film
from polarguide.scene_frame import scene_frame
from polarguide.shading.result import LAYERS
from polarguide.visualization import figures
from polarguide.visualization.layers import Picture, ground_truth_pictures, layer_picture, true_depth_range

SHEET_VIEWS = 8


def render_views(
    run: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    views: str = "test",
    layers: str = "final,base,reflection,specular,diffuse,strength,normal,depth",
    path: str = "",
    frames: int = 120,
    video: Path | None = None,
    environment: Path | None = None,
    rotate_environment: float = 0.0,
    out: Path | None = None,
    device: DeviceName = "auto",
    threads: int = 0,
) -> None:
    """Render a run's layers to PNG, with a contact sheet beside the ground truth; or along a path, as a video.

    specular and diffuse are the contributions that add up to final; normals are in camera space, blue facing the
    camera.

    Args:
        run: Run folder.
        views: test, train, all, or names separated by commas.
        layers: Any of final, base, reflection, specular, diffuse, strength, normal, depth, alpha.
        path: In place of views: orbit, spiral, interpolate (through the photographs), or a JSON file of cameras.
        frames: Pictures along the path (a file has its own).
        video: MP4 file to write of the path, layers side by side; PNG files if not given.
        environment: Panorama of linear radiance (.hdr, .exr) to be reflected in place of the learned environment.
        rotate_environment: Degrees by which to turn the environment, counter-clockwise seen from above.
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
    if video is not None and not path:
        raise PolarguideError("--video", expected="a --path", found="none", remedy="Add --path orbit.")
    opened = open_run(run, device=device)
    relight(opened, environment, rotate_environment)
    if path:
        film(opened, names, path=path, frames=frames, video=video, out=out or run / "render")
    else:
        render_run(opened, select_views(opened.scene, views), names, out or run / "render")


def relight(opened: OpenRun, panorama: Path | None, degrees: float) -> None:
    """Put a panorama in the learned environment's place, or turn it, in the run as it is in memory."""
    if panorama is None and degrees % 360 == 0:
        return
    if not math.isfinite(degrees):
        raise PolarguideError(
            "--rotate-environment", expected="degrees", found=str(degrees), remedy="Give a number."
        )
    what = "--environment" if panorama else "--rotate-environment"
    cubemap = needs_radiance(opened.shading, what=what)
    learned = opened.light
    around = scene_frame(list(opened.cameras.values()))
    if panorama is not None:
        texels = texels_of(read_panorama(panorama), cubemap, around, RELIT_RESOLUTION)
        learned[cubemap.name] = texels.to(learned[cubemap.name].device)
    learned[cubemap.name] = turned_cubemap(
        learned[cubemap.name].detach(), around.turn(degrees), RELIT_RESOLUTION
    )
    if opened.shading.local_note:
        console.print(f"note: {opened.shading.local_note}")


def render_run(opened: OpenRun, views: tuple[View, ...], layers: list[str], out: Path) -> Path:
    """Write the layers of some views and their contact sheet; returns the sheet's path."""
    out.mkdir(parents=True, exist_ok=True)
    rows: list[list[Picture | None]] = []
    labels: list[str] = []
    missing: set[str] = set()
    for view in views:
        result = opened.render(view, depth=True)
        depths = true_depth_range(view)
        pictures = {name: layer_picture(result, name, view.camera, depths) for name in layers}
        for name, picture in pictures.items():
            if picture is None:
                missing.add(name)
            else:
                figures.write_png(out / f"{view.name}_{name}.png", picture)
        ground_truth = ground_truth_pictures(view)
        if len(rows) < 2 * SHEET_VIEWS:
            rows.append([pictures[name] for name in layers])
            rows.append([ground_truth.get(name) for name in layers])
            labels += [view.name, f"{view.name} true"]
    sheet = out / "contact_sheet.png"
    figures.write_png(sheet, figures.contact_sheet(rows, labels, layers))
    if missing:
        console.print(f"this recipe has no layer {', '.join(sorted(missing))}")
    console.print(f"pictures: {out}   contact sheet: {sheet}")
    return sheet
