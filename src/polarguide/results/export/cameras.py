"""Export of a run's cameras, with the photographs of their views."""

from __future__ import annotations

from pathlib import Path

from polarguide.capture.presentation import colored
from polarguide.core.errors import PolarguideError
from polarguide.core.files import holds_files, make_folder, require_inside
from polarguide.core.progress import Reporter
from polarguide.results.export.placement import IMAGES, SUFFIX, write_colmap, write_transforms
from polarguide.results.export.presented import Presented
from polarguide.runs.opened import OpenedRun
from polarguide.visualization import figures

TRANSFORMS = "transforms.json"
"""File of the cameras for nerfstudio."""


def export_cameras(run: OpenedRun, presented: Presented, folder: Path, reporter: Reporter) -> list[Path]:
    """Write ``sparse/0`` (COLMAP), ``transforms.json`` and the photographs in ``images/``.

    The cameras are pinholes. So the images are undistorted, have the cameras' size, and show the color of the
    presentation (8 bits, sRGB).

    Raises:
        PolarguideError: the folder contains pictures or a model that no export wrote.
    """
    model = folder / "sparse" / "0"
    images = folder / IMAGES
    for place in (model, images):
        require_inside(folder, place)
        if place.is_dir() and holds_files(place) and not (folder / TRANSFORMS).exists():
            raise PolarguideError(
                place,
                expected="an empty folder or an earlier export",
                found="other files",
                remedy="Choose another --out.",
            )
    scene = run.scene
    placement = presented.placement
    cameras = {name: placement.camera(camera) for name, camera in run.cameras.items()}
    about = {**presented.origin.record(), **placement.record()}
    # This file comes first: a repeated command recognizes an interrupted export by it.
    write_transforms(folder / TRANSFORMS, cameras, about)
    make_folder(images)
    color = presented.presentation.color
    with reporter.track("photographs", len(scene.views)) as advance:
        for number, view in enumerate(scene.views):
            picture = figures.radiance_to_rgb(colored(view.photograph(), color))
            figures.write_png(images / f"{view.name}{SUFFIX}", picture)
            advance(number + 1)
    write_colmap(
        model, cameras, placement.points(scene.points), scene.point_colors, comments=presented.comments
    )
    return [model, folder / TRANSFORMS, images]
