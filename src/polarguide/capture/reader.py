"""Read a capture folder: ``read_views`` reads its pictures, ``load_scene`` makes a scene with poses of them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from numpy.typing import NDArray

from polarguide.capture import checks
from polarguide.capture.colmap.model import ColmapModel, fit_camera, read_model, unseen_points, unused_poses
from polarguide.capture.exposures import FOUR
from polarguide.capture.formats.pictures import TRANSFERS
from polarguide.capture.ground_truth import GroundTruth, objects_of
from polarguide.capture.layout import Layout, check_memory, find_layout, select_views, stated_size
from polarguide.capture.metadata import held_out, indices_of, keeps_gains, mount_of, refractive_index_of
from polarguide.capture.point_exposures import ComparedPoints
from polarguide.capture.scene import Scene, chosen_views, far_from_training, held_out_band
from polarguide.capture.view import EVEN, listed
from polarguide.capture.view_reader import (
    Files,
    StoredViews,
    ViewData,
    ViewFiles,
    check_materials,
    read_view,
)
from polarguide.core.errors import PolarguideError
from polarguide.core.options import Split, check_choice, check_count
from polarguide.core.progress import SILENT, Reporter
from polarguide.geometry.camera import Camera

_THREADS = 4


def load_scene(
    path: str | os.PathLike[str],
    *,
    downscale: int = 1,
    transfer: str = "linear",
    views: Sequence[str] | None = None,
    memory: float | None = None,
    split: Split = "directions",
    test_views: Sequence[str] | None = None,
    hold: bool = True,
    reporter: Reporter = SILENT,
) -> Scene:
    """Read a capture.

    Two layouts are read: ``polar/<view>_000|_045|_090|_135.<suffix>``, and one folder per angle (``I-00``,
    ``I-45``, ``I-90``, ``I-135``; also ``0``, ``045``, ``I_90``, ...) with equally named pictures. Pictures
    are PNG, TIFF or JPEG with 8 or 16 bits, undistorted. Required is a COLMAP model in ``sparse/0`` or
    ``sparse`` (the image's name without suffix is the view); optional are ``masks/<view>.png``,
    ``invalid/<view>.png``, ``gt/<view>.npz``, ``split.json`` and ``scene.json``.

    Args:
        path: the capture folder.
        downscale: average over boxes of this many pixels each way, on linear values. A pixel stays foreground
            only where all of its box is; it is invalid or saturated where any of it is.
        transfer: how the files are encoded: "linear", or "srgb" for display-encoded pictures.
        views: names of the views to read; all if None. The split is that of the whole capture.
        memory: GiB that the pictures may take; None: 80 % of what is free.
        split: which views are held out where there is no ``split.json``, see ``scene.chosen_views``.
        test_views: names of the views to hold out, whatever else says so, as far as there are such views.
        hold: whether pictures stay in memory; otherwise views load theirs from the files when they are read.
        reporter: receives the progress.

    Returns:
        The scene; ``Scene.warnings`` lists possible faults that do not prevent its use.

    Raises:
        PolarguideError: a file of the capture cannot be used; the message names it and the remedy.
    """
    root = Path(path)
    check_count("downscale", downscale)
    check_choice("transfer", transfer, TRANSFERS)
    layout = find_layout(root)
    names = select_views(layout, views)
    model = read_model(root)
    files = Files()
    for file in (*model.files, *([layout.table] if layout.table is not None else [])):
        files.read(file)
    tests, stray = _held_out(root / "split.json", files, layout, model, split, test_views)
    about = files.read_if_there(root / "scene.json", b"{}")
    index = refractive_index_of(root / "scene.json", about)
    indices = indices_of(root / "scene.json", about)
    mount = mount_of(root / "scene.json", about)
    for name in names:
        # Missing poses and pictures of another size are found before a picture is decoded.
        camera = model.camera(name)
        size = stated_size(layout.files(name)[0])
        if size is not None:
            fit_camera(camera, *size, folder=model.folder, view=name)
    check_memory(layout, names, factor=downscale, at_once=_THREADS, limit=memory, hold=hold)

    how = {"downscale": downscale, "transfer": transfer, "hold": hold, "reporter": reporter}
    stored = read_views(layout, names, model, **how)  # type: ignore[arg-type]
    for item in stored.data:
        files.digests.update(item.digests)
    without_pixels = [item.name for item in stored.data if item.invalid.all()]
    counted = {item.name for item in stored.data} - (set(tests) if views is None else set())
    if counted and counted <= set(without_pixels):
        raise PolarguideError(
            root / "invalid",
            expected="at least one pixel to train on that is not invalid",
            found=f"none in {len(counted)} views",
            remedy="White is invalid there: invert the pictures, or remove them.",
        )
    even = stored.exposures is None or keeps_gains(root / "scene.json", about)
    gains = [EVEN] * len(names) if even or stored.exposures is None else stored.exposures.gains()
    stays = None if hold else ViewFiles(layout, downscale, transfer, files.digests)
    posed_views = tuple(
        item.view(camera, stored.full_scale, mount, stays, gain)
        for item, camera, gain in zip(stored.data, stored.cameras, gains, strict=True)
        if camera is not None
    )
    check_materials(layout, stored.data, indices)
    told_apart = any(item.ground_truth and item.ground_truth.object_ids is not None for item in stored.data)
    warnings = [
        *layout.warnings,
        *model.warnings,
        *stray,
        *_content_warnings(layout, stored, without_pixels),
        *unseen_points(model.points, [camera for camera in stored.cameras if camera is not None]),
        *_pose_warnings(model, layout.names, stored.data),
        *_gain_warnings(names, gains),
    ]
    return Scene(
        root=root,
        name=root.resolve().name,
        views=posed_views,
        test_names=tuple(name for name in tests if name in names),
        points=model.points,
        point_colors=model.point_colors,
        refractive_index=index,
        downscale=downscale,
        transfer=transfer,
        digest=files.digest(root),
        warnings=(*warnings, *stored.picture_warnings(transfer)),
        objects=objects_of(root / "scene.json", about) if told_apart else (),
        indices=indices,
    )


def _held_out(
    path: Path,
    files: Files,
    layout: Layout,
    model: ColmapModel,
    split: Split,
    test_views: Sequence[str] | None,
) -> tuple[tuple[str, ...], list[str]]:
    """The names of the test views, and a warning where some are far from what is trained on, or a ring of them is."""
    check_choice("split", split, get_args(Split))
    data = files.read_if_there(path, None)
    posed = frozenset(model.names)
    cameras = {name: model.camera(name) for name in layout.names if name in posed}
    if test_views is not None:  # whoever asks has been told
        return tuple(name for name in sorted(test_views) if name in layout.names), []
    tests = chosen_views(cameras, split) if data is None else held_out(path, data, layout.names)
    other = (
        "take --split directions" if data is None and split != "directions" else "name others in split.json"
    )
    if far := far_from_training(cameras, tests):
        what = f"{len(far)} of {len(tests)} test views are far from every training view ({listed(far)})"
    elif band := held_out_band(cameras, tests):
        what = f"{len(band)} of {len(tests)} test views are all of a band of heights, such as a ring ({listed(band)})"
    else:
        return tests, []
    return tests, [f"{what}: scores on them measure extrapolation. If that is not meant, {other}."]


def read_views(
    layout: Layout,
    names: Sequence[str],
    model: ColmapModel | None,
    *,
    downscale: int,
    transfer: str,
    hold: bool = True,
    reporter: Reporter = SILENT,
) -> StoredViews:
    """Read the files of some views, in several threads.

    Args:
        layout: the files of the capture.
        names: names of the views to read, sorted.
        model: the capture's COLMAP model, if it has one; views that it lacks are read without a camera.
        downscale: side of the pixel boxes to average.
        transfer: "linear" or "srgb".
        hold: whether to keep all codes and the ground truth; otherwise samples of them.
        reporter: receives the progress.

    Raises:
        PolarguideError: a file cannot be used, a camera does not fit its pictures, or the views differ in depth.
    """

    four = all(layout.exposures(name) == FOUR for name in names)
    points = None
    if model is not None and four:
        points = ComparedPoints.of(model, [name for name in names if name in model.names])

    def read(name: str) -> ViewData:
        view = read_view(layout, name, factor=downscale, transfer=transfer, points=points)
        return view if hold else _without_pictures(view)

    posed = frozenset(() if model is None else model.names)
    data: list[ViewData] = []
    cameras: list[Camera | None] = []
    with (
        reporter.track(f"reading {layout.root.resolve().name}", len(names)) as advance,
        ThreadPoolExecutor(min(_THREADS, os.cpu_count() or 1)) as pool,
    ):
        for item in pool.map(read, names):
            data.append(item)
            camera = None
            if model is not None and item.name in posed:
                camera = fit_camera(model.camera(item.name), *item.size, folder=model.folder, view=item.name)
                camera = camera if downscale == 1 else camera.downscaled(downscale)
            cameras.append(camera)
            advance(len(data))
    return StoredViews.of(data, cameras, points)


def _without_pictures(data: ViewData) -> ViewData:
    """The part of a view that ``read_views`` keeps if its pictures stay in their files."""
    truth = data.ground_truth
    told_apart = truth is not None and truth.object_ids is not None
    stub = GroundTruth(object_ids=torch.empty(0)) if told_apart else None
    return replace(data, codes=checks.sampled(data.codes), ground_truth=stub)


def _content_warnings(layout: Layout, stored: StoredViews, invalid: list[str]) -> list[str]:
    """Warnings about views whose pictures say nothing, or are those of another.

    Args:
        layout: the files. stored: the views. invalid: those without a pixel to use.
    """

    def is_gray(picture: NDArray[np.uint16]) -> bool:
        return bool(picture.any()) and bool((picture == picture[..., :1]).all())

    count = len(stored.data)
    same_file = []
    views: dict[tuple[str, ...], list[str]] = {}
    for item in stored.data:
        digests = tuple(item.digests[path] for path in layout.files(item.name))
        if item.peak.any():
            views.setdefault(digests, []).append(item.name)
            if len(digests) > 1 and len(set(digests)) == 1:  # light without polarization has noise, too
                same_file.append(item.name)
    # Views that are black altogether are counted by their exposure.
    black = [item.name for item in stored.data if len({bool(picture.any()) for picture in item.codes}) > 1]
    gray = [item.name for item in stored.data if any(map(is_gray, item.codes))]
    copies = "; ".join(listed(names) for names in [n for n in views.values() if len(n) > 1][:3])
    table = (
        (invalid, "are invalid at every pixel ({}): they tell nothing. White is invalid in invalid/: invert the "
         "pictures, or remove them."),
        (same_file, "have the same file at all angles ({}): they look unpolarized. Copy those of the other angles."),
        (black, "have pictures that are black throughout ({})."),
        (gray if len(gray) < count else [], "have gray pictures among others in color ({})."),
    )  # fmt: skip
    warnings = [f"{len(n)} of {count} views {text.format(listed(n))}" for n, text in table if n]
    if copies:
        warnings.append(
            f"Views have the same pictures ({copies}). Copy those of the other views, or leave them out."
        )
    return warnings


def _gain_warnings(names: Sequence[str], gains: Sequence[tuple[float, float, float]]) -> list[str]:
    """The warning that views were exposed differently."""
    stops = {name: np.log2(gain) for name, gain in zip(names, gains, strict=True) if gain != EVEN}
    if not stops:
        return []
    strongest = sorted(stops, key=lambda name: -float(np.abs(stops[name]).max()))
    told = [f"{name} {max(stops[name], key=abs):+.2f}" for name in strongest]
    return [
        f"{len(stops)} of {len(names)} views were exposed or white-balanced otherwise than the mean, by points in "
        f"common (stops: {listed(told)}). Each color of theirs is divided by its gain; fix exposure and white balance "
        "next time."
    ]


def _pose_warnings(model: ColmapModel, all_names: list[str], data: Sequence[ViewData]) -> list[str]:
    """Warnings about poses without pictures, and about intrinsics that were scaled to the pictures."""
    warnings = unused_poses(model, all_names)
    sizes = {item.name: (model.camera(item.name).width, model.camera(item.name).height) for item in data}
    scaled = [item.name for item in data if item.size != sizes[item.name]]
    if scaled:
        resolutions = ", ".join(
            f"{width}x{height}" for width, height in sorted({sizes[name] for name in scaled})
        )
        warnings.append(
            f"The intrinsics were made for another resolution ({resolutions}) than that of the pictures and were "
            f"scaled in {len(scaled)} of {len(data)} views ({listed(scaled)}): right if the pictures were "
            "resized, wrong if they were cropped."
        )
    return warnings
