"""Export of posed pictures and normal maps for other trainers.

The rules of the readers of normal maps, with their sources, are in ``docs/how-to/normal-maps.md``.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from polarguide.capture import View
from polarguide.capture.presentation import colored
from polarguide.capture.view import listed
from polarguide.capture.write import write_png_file
from polarguide.core.errors import PolarguideError
from polarguide.core.files import holds_files, make_folder, require_inside
from polarguide.core.options import NormalLayout, NormalOptions
from polarguide.core.progress import Reporter
from polarguide.geometry.camera import Camera
from polarguide.geometry.coverage import OPAQUE
from polarguide.geometry.vectors import dot
from polarguide.results.export.mesh import write_points
from polarguide.results.export.placement import IMAGES, SUFFIX, Presented, write_colmap, write_transforms
from polarguide.results.rendering.subject import Subject
from polarguide.runs.opened import OpenedRun
from polarguide.shading.result import RenderResult
from polarguide.visualization import figures
from polarguide.visualization.figures import Picture

MODEL = "sparse/0"
"""Folder of the COLMAP model."""
TRANSFORMS = "transforms.json"


def export_cameras(run: OpenedRun, presented: Presented, folder: Path, reporter: Reporter) -> list[Path]:
    """Write ``sparse/0`` (COLMAP), ``transforms.json`` and the photographs in ``images/``.

    The cameras are pinholes, so the images are undistorted and have the size of the cameras. They show the color of the
    presentation (8 bits, sRGB).

    Raises:
        PolarguideError: the folder contains pictures or a model that were not exported by this program.
    """
    views = {view.name: view for view in run.scene.views}
    require_own(folder, MODEL, IMAGES)
    paths = _write_poses(run, presented, folder, views)
    make_folder(folder / IMAGES)
    with reporter.track("photographs", len(views)) as advance:
        for number, (name, view) in enumerate(views.items(), start=1):
            _write_picture(folder / IMAGES / f"{name}{SUFFIX}", view.photograph(), presented)
            advance(number)
    return [*paths, folder / IMAGES]


def require_own(folder: Path, *names: str) -> None:
    """Check that subfolders contain no files, or files of an earlier export.

    An earlier export is recognized by ``transforms.json``, which is written first.

    Raises:
        PolarguideError: a subfolder contains other files, or leads out of the folder.
    """
    for name in names:
        place = folder / name
        require_inside(folder, place)
        if place.is_dir() and holds_files(place) and not (folder / TRANSFORMS).exists():
            raise PolarguideError(
                place,
                expected="an empty folder or an earlier export",
                found="other files",
                remedy="Choose another --out.",
            )


def _refuse_other_pictures(folder: Path, names: Collection[str]) -> None:
    """Check that a folder contains no pictures with other names, because some trainers read all pictures of a folder.

    Raises:
        PolarguideError: the folder contains other pictures.
    """
    others = sorted(path.name for path in folder.glob(f"*{SUFFIX}") if path.stem not in names)
    if others:
        raise PolarguideError(
            folder,
            expected="pictures of the training views only",
            found=listed(others),
            remedy="Choose another --out.",
        )


def _write_poses(
    run: OpenedRun,
    presented: Presented,
    folder: Path,
    views: Mapping[str, View],
    *,
    masks: str = "",
    points: str = "",
) -> list[Path]:
    """Write ``transforms.json`` and the COLMAP model ``sparse/0``.

    Args:
        run: the run.
        presented: the run's placement and origin.
        folder: the folder to write.
        views: views by the names of their pictures.
        masks: folder of the masks in ``transforms.json``; empty without masks.
        points: name of the PLY file of the scene's points in ``transforms.json``; empty without a file.
    """
    scene = run.scene
    placement = presented.placement
    cameras = {name: placement.camera(view.camera) for name, view in views.items()}
    about = {**presented.origin.record(), **placement.record()}
    if points:
        about["ply_file_path"] = points
    write_transforms(folder / TRANSFORMS, cameras, about, masks=masks)
    places = placement.points(scene.points)
    write_colmap(folder / MODEL, cameras, places, scene.point_colors, comments=presented.comments)
    return [folder / MODEL, folder / TRANSFORMS]


def _write_picture(path: Path, linear: Tensor, presented: Presented) -> None:
    """Write linear radiance [H, W, 3] as an 8-bit sRGB picture in the color of the presentation."""
    figures.write_png(path, figures.radiance_to_rgb(colored(linear, presented.presentation.color)))


@dataclass(frozen=True)
class NormalReader:
    """Rules by which a program reads normal maps.

    Attributes:
        folder: folder of the normal maps.
        axes: signs of the camera axes right, up and toward the viewer in the normal maps.
        numbered: True if the program pairs pictures and normal maps by their order instead of by their names. Two
            different sort orders give equal pairs if names begin with a number of fixed width.
        masks: folder of the masks, for a program that ignores the alpha of normal maps; else empty.
        points: PLY file of the scene's points, for a program that does not read them from COLMAP; else empty.
    """

    folder: str
    axes: tuple[int, int, int]
    numbered: bool = False
    masks: str = ""
    points: str = ""

    def picture_name(self, number: int, view: str) -> str:
        """Return the name of the pictures of a view, without a suffix."""
        return f"{number:05d}_{view}" if self.numbered else view

    def encode(self, colors: Picture) -> Picture:
        """Convert colors of ``figures.normal_to_rgb`` to the axes of the program."""
        flipped = np.array(self.axes) < 0
        return np.where(flipped, 255 - colors, colors).astype(np.uint8)


NORMAL_READERS: dict[NormalLayout, NormalReader] = {
    "brush": NormalReader("normals", (1, 1, 1)),
    "dn-splatter": NormalReader("normals_from_pretrain", (1, -1, -1), True, "masks", "points.ply"),
}
"""Rules of the programs that read normal maps."""


def export_normals(
    run: OpenedRun, presented: Presented, folder: Path, options: NormalOptions, reporter: Reporter
) -> list[Path]:
    """Write poses, pictures and normal maps of the training views for a trainer with a normal loss.

    A normal map has 8 bits per channel, with ``(n + 1) / 2`` in camera axes. Its alpha is 255 for decided pixels and 0
    elsewhere, see ``decided_pixels``.

    Args:
        run: the run.
        presented: the run's placement and origin.
        folder: the folder to write.
        options: layout of the reader, and the kind of pictures.
        reporter: receives the progress.

    Raises:
        PolarguideError: the folder contains other files, or the run lacks the requested pictures.
    """
    _require_pictures(run, options)
    reader = NORMAL_READERS[options.layout]
    places = [name for name in (IMAGES, reader.folder, reader.masks) if name]
    require_own(folder, MODEL, *places)
    views = {reader.picture_name(k, v.name): v for k, v in enumerate(run.scene.train_views, start=1)}
    for name in places:
        _refuse_other_pictures(folder / name, views)
    paths = _write_poses(run, presented, folder, views, masks=reader.masks, points=reader.points)
    for name in places:
        make_folder(folder / name)
    if reader.points:
        points = presented.placement.points(run.scene.points)
        colors = run.scene.point_colors / 255
        write_points(folder / reader.points, points, torch.zeros_like(points), colors, presented.comments)
    with reporter.track("normal maps", len(views)) as advance:
        for number, (name, view) in enumerate(views.items(), start=1):
            result = run.result(view.camera).to("cpu")
            decided = decided_pixels(result, view.camera, presented.subject)
            normal = torch.where(decided[..., None], result.normal, 0.0)
            alpha = 255 * decided.numpy().astype(np.uint8)
            file = f"{name}{SUFFIX}"
            codes = reader.encode(figures.normal_to_rgb(normal, view.camera))
            figures.write_png(folder / reader.folder / file, codes, alpha)
            if reader.masks:
                write_png_file(folder / reader.masks / file, alpha)  # nerfstudio accepts one channel only
            _write_picture(folder / IMAGES / file, training_picture(run, view, result, options), presented)
            advance(number)
    return [*paths, *(folder / name for name in (*places, reader.points) if name)]


def _require_pictures(run: OpenedRun, options: NormalOptions) -> None:
    """Check, before a file is written, that the requested pictures exist.

    Raises:
        PolarguideError: the recipe has no diffuse layer, or the pictures of a view do not determine Stokes vectors.
    """
    views = run.scene.train_views
    if options.picture == "minimum":
        view = next((view for view in views if not view.is_determined), views[0])
        view.stokes()
    elif options.picture == "diffuse":
        run.chosen_layers(run.result(views[0].camera), ["diffuse"])


def decided_pixels(result: RenderResult, camera: Camera, subject: Subject) -> Tensor:
    """Return a mask [H, W] of the pixels with a decided normal.

    Their alpha is above one half, so that the median depth lies on a surface. This surface belongs to the subject: few
    pictures determine the geometry of its surroundings. Its normal points toward the camera, as that of a visible
    surface does.

    Args:
        result: rendering with normals and depth of the surface.
        camera: camera of the rendering.
        subject: the part of the scene that exports contain.
    """
    rays = camera.rays()
    places = camera.to_world(rays / rays[..., 2:] * result.depth[..., None]) + camera.center
    inside = subject.holds(places.reshape(-1, 3)).view(result.alpha.shape)
    toward = dot(result.normal, camera.world_rays()) < 0
    return inside & toward & (result.alpha > OPAQUE)


def training_picture(run: OpenedRun, view: View, result: RenderResult, options: NormalOptions) -> Tensor:
    """Return the picture of a view for a trainer: linear radiance [H, W, 3] on the scale of S0/2.

    Args:
        run: the run.
        view: the view.
        result: rendering of the view.
        options: kind of the picture. ``minimum`` is the least radiance behind a polarizer at any angle,
            ``(S0 - sqrt(S1^2 + S2^2)) / 2`` for each color.

    Raises:
        PolarguideError: the recipe has no diffuse layer, or the pictures do not determine Stokes vectors.
    """
    if options.picture == "diffuse":
        return run.chosen_layers(result, ["diffuse"])["diffuse"]
    if options.picture == "minimum":
        s0, s1, s2 = view.stokes()
        return (s0 - torch.hypot(s1, s2)).clamp(min=0).cpu() / 2
    return view.photograph()
