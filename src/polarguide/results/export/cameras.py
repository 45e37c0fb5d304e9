"""The cameras of a run as other programs read them, with the photographs that they belong to."""

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


def export_cameras(run: OpenedRun, presented: Presented, folder: Path, reporter: Reporter) -> list[Path]:
    """Write ``sparse/0`` (COLMAP), ``transforms.json`` and ``images/``: the photographs as the run was trained on them.

    The cameras are pinholes, so that photographs as a lens took them do not belong to them: a picture in ``images/`` is
    without distortion, of the cameras' size, in the color that is shown (8 bits, sRGB).

    Raises:
        PolarguideError: pictures or a model of somebody else lie there.
    """
    model = folder / "sparse" / "0"
    images = folder / IMAGES
    for place in (model, images):
        require_inside(folder, place)
        if place.is_dir() and holds_files(place) and not (folder / TRANSFORMS).exists():
            raise PolarguideError(
                place,
                expected="nothing, or what an earlier export wrote",
                found="other files",
                remedy="Give another --out.",
            )
    scene = run.scene
    placement = presented.placement
    cameras = {name: placement.camera(camera) for name, camera in run.cameras.items()}
    about = {**presented.origin.record(), **placement.record()}
    # First, because it says to a repeated command that the rest is of an export that was stopped.
    write_transforms(folder / TRANSFORMS, cameras, about)
    make_folder(images)
    color = presented.presentation.color
    with reporter.track("photographs", len(scene.views)) as advance:
        for number, view in enumerate(scene.views):
            picture = figures.radiance_to_rgb(colored(view.photograph(), color))
            figures.write_png(images / f"{view.name}{SUFFIX}", picture)
            advance(number + 1)
    points = placement.points(scene.points)
    write_colmap(model, cameras, points, scene.point_colors, comments=presented.comments)
    return [model, folder / TRANSFORMS, images]
