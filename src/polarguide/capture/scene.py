"""The scene: posed views, those held out to be scored on, sparse points and their origin; of a folder, or of arrays."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from polarguide.capture import checks
from polarguide.capture.colmap.model import ColmapModel, fit_camera, read_model, unseen_points, unused_poses
from polarguide.capture.exposures import FOUR, Angle
from polarguide.capture.formats.pictures import TRANSFERS
from polarguide.capture.layout import Layout, check_memory, find_layout, select_views, stated_size
from polarguide.capture.metadata import (
    GroundTruth,
    SceneObject,
    held_out,
    indices_of,
    keeps_gains,
    mount_of,
    objects_of,
    refractive_index_of,
)
from polarguide.capture.point_exposures import ComparedPoints
from polarguide.capture.view import ANGLES, EVEN, View, figure, table
from polarguide.capture.view_reader import (
    Array,
    Files,
    StoredViews,
    ViewData,
    ViewFiles,
    as_numpy,
    by_name,
    check_materials,
    exposures_of,
    in_order,
    kind_of,
    read_view,
    require_factor,
    stored_pictures,
    view_data,
)
from polarguide.core.errors import require, unknown_view
from polarguide.core.options import Split, check_choice, check_count
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.text import canonical, listed
from polarguide.geometry.camera import Camera
from polarguide.optics import Mount

TEST_EVERY = 8
"""One view in so many is held out."""
FAR = 2.5
"""A held-out view is far from training if its nearest training view is this many times as far as views usually are from
each other."""
FEWEST_IN_BAND = 4
"""Views from which on a band of heights counts as one."""
SAME_HEIGHT = 1e-3
"""Heights that differ by less than this share of how far they spread are those of one ring."""
_ROUNDS = 10


def chosen_views(cameras: Mapping[str, Camera], split: Split) -> tuple[str, ...]:
    """The names of the views to hold out, one in ``TEST_EVERY``, sorted; none of a single view.

    Args:
        cameras: of the views, by name. split: "every-8th" takes every 8th in the order of the names, starting with the
            first. "directions" takes the middle one of each of as many groups of neighboring views, so that every
            held-out view has training views around it, and no part of the directions is held out as a whole.
    """
    names = sorted(cameras)
    if len(names) < 2:
        return ()
    if split == "every-8th":
        return tuple(names[::TEST_EVERY])
    apart = _distances([cameras[name] for name in names])
    return tuple(names[k] for k in sorted(_middles(apart, -(-len(names) // TEST_EVERY))))


def far_from_training(cameras: Mapping[str, Camera], tests: Sequence[str]) -> list[str]:
    """The held-out views that are far from all training views, see ``FAR``, sorted."""
    names = sorted(cameras)
    trains = [k for k, name in enumerate(names) if name not in tests]
    if len(names) < 3 or not trains:
        return []
    apart = _distances([cameras[name] for name in names])
    others = apart + np.diag(np.full(len(names), np.inf))
    usual = float(np.median(others.min(axis=1)))
    return [name for k, name in enumerate(names) if name in tests and apart[k, trains].min() > FAR * usual]


def held_out_band(cameras: Mapping[str, Camera], tests: Sequence[str]) -> list[str]:
    """The held-out views of a band of heights in which no view is trained on, such as a whole ring; empty if none.

    Told are bands of at least ``FEWEST_IN_BAND`` views and half of those that are held out. Heights are along the mean
    of what is up in the pictures.
    """
    names = sorted(cameras)
    if not names:
        return []
    up = -np.stack([cameras[name].rotation[1].double().numpy() for name in names]).mean(axis=0)
    heights = np.stack([cameras[name].center.double().numpy() for name in names]) @ up
    apart = max(SAME_HEIGHT * float(np.ptp(heights)), 1e-12)
    rings: list[list[int]] = []
    for k in (int(place) for place in np.argsort(heights, kind="stable")):
        if rings and heights[k] - heights[rings[-1][0]] < apart:
            rings[-1].append(k)
        else:
            rings.append([k])
    bands: list[list[str]] = [[]]
    for ring in rings:
        if all(names[k] in tests for k in ring):
            bands[-1] += [names[k] for k in ring]
        else:
            bands.append([])
    longest = max(bands, key=len)
    enough = len(longest) >= FEWEST_IN_BAND and 2 * len(longest) >= len(tests) and len(tests) < len(names)
    return sorted(longest) if enough else []


def _distances(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """[V, V] distances: of the centers, in units of how far they spread, and of the viewing directions."""
    centers = np.stack([camera.center.double().numpy() for camera in cameras])
    looks = np.stack([camera.rotation[2].double().numpy() for camera in cameras])
    spread = np.linalg.norm(centers - np.median(centers, axis=0), axis=1).max()
    places = np.concatenate([centers / max(spread, 1e-12), looks], axis=1)
    return np.asarray(np.linalg.norm(places[:, None] - places[None], axis=-1))


def _middles(apart: NDArray[np.float64], count: int) -> list[int]:
    """The views in the middle of ``count`` groups: k-medoids from the views that are farthest from each other.

    Groups of one or two views have no middle: in their place views are taken of the largest groups, far from those that
    are taken already.
    """
    middles = [int(apart.sum(axis=1).argmin())]
    while len(middles) < count:
        reach = apart[:, middles].min(axis=1)
        reach[middles] = -1.0  # never twice, also of cameras in one place
        middles.append(int(reach.argmax()))
    for _ in range(_ROUNDS):
        group = apart[:, middles].argmin(axis=1)
        group[middles] = np.arange(count)
        members = [np.flatnonzero(group == k) for k in range(count)]
        medoids = [int(m[apart[np.ix_(m, m)].sum(axis=1).argmin()]) for m in members]
        if medoids == middles:
            break
        middles = medoids
    taken = [middle for middle, m in zip(middles, members, strict=True) if len(m) > 2]
    while len(taken) < count:
        free = [int(k) for m in members if len(m) > 2 for k in m if k not in taken]
        if not free:  # every group is that small
            return middles
        reach = apart[np.ix_(free, taken)].min(axis=1)
        taken.append(free[int(reach.argmax())])
    return taken


IN_MEMORY = Path("(arrays)")
"""The folder of a scene that was made of arrays: there is no such folder."""
_PICTURED = 6
"""Views that a notebook shows of a scene."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A capture: posed views, sparse points and their origin.

    Attributes:
        root: the folder that was read; ``IN_MEMORY`` of ``from_arrays``.
        name: its name.
        views: all views, sorted by name.
        test_names: names of the views held out for evaluation, sorted.
        points: sparse points in the world, [M, 3] float32.
        point_colors: their colors as the COLMAP model gives them (display-encoded), [M, 3] uint8.
        refractive_index: the one index that ``scene.json`` gives, or None if it gives none or several.
        downscale: side of the pixel boxes that were averaged; 1 is full size.
        transfer: the assumed encoding of the files, "linear" or "srgb". The views are always linear.
        digest: SHA-256 over the names and contents of all files that were read, as hexadecimal digits.
        warnings: about possible faults that do not prevent the use of the scene.
        objects: the objects that ``scene.json`` lists, if the ground truth of some view tells objects apart.
        indices: refractive indices of the dielectrics that ``materials/`` names by numbers from 3 on.
    """

    root: Path
    name: str
    views: tuple[View, ...]
    test_names: tuple[str, ...]
    points: Tensor
    point_colors: Tensor
    refractive_index: float | None
    downscale: int
    transfer: str
    digest: str
    warnings: tuple[str, ...]
    objects: tuple[SceneObject, ...] = ()
    indices: Mapping[int, float] = field(default_factory=dict)

    @property
    def train_views(self) -> tuple[View, ...]:
        """The training views, sorted by name."""
        return tuple(view for view in self.views if view.name not in self.test_names)

    @property
    def test_views(self) -> tuple[View, ...]:
        """The views held out for evaluation, sorted by name."""
        return tuple(view for view in self.views if view.name in self.test_names)

    def view(self, name: str) -> View:
        """The view called ``name``.

        Raises:
            PolarguideError: there is none; the message lists the names nearest to it.
        """
        for view in self.views:
            if canonical(view.name) == canonical(name):
                return view
        raise unknown_view(self.root, name, [view.name for view in self.views])

    @staticmethod
    def from_arrays(
        pictures: Mapping[str, Array] | Sequence[Array] | Array,
        cameras: Mapping[str, Camera] | Sequence[Camera],
        angles: Sequence[Angle] | Mapping[str, Sequence[Angle]] = ANGLES,
        *,
        points: ArrayLike | Tensor,
        point_colors: ArrayLike | Tensor | None = None,
        masks: Mapping[str, Array] | Sequence[Array] | Array | None = None,
        invalid: Mapping[str, Array] | Sequence[Array] | Array | None = None,
        test_views: Sequence[str] | None = None,
        split: Split = "directions",
        mount: Mount = "sensor",
        transfer: str = "linear",
        downscale: int = 1,
        refractive_index: float | None = None,
        name: str = "arrays",
    ) -> Scene:
        """A scene of arrays, in memory: it is trained to the same bits as the same pictures in a folder.

        Args:
            pictures: of each view, [K, H, W, 3] RGB or [K, H, W] gray: uint8 or uint16 as a camera stores them, or
                linear floats from 0 to 1, where 1 is full scale. By name, or in an order (then called v000, v001,
                ...); views may differ in size.
            cameras: cameras of each view, at the size of its pictures; ``Camera.from_matrices`` makes one of matrices.
            angles: of the K pictures: degrees counter-clockwise as displayed, ``unknown`` or ``none`` (no filter); of
                all views, or by name.
            points: [M, 3] sparse points of the surfaces in the world, such as those of structure from motion.
            point_colors: [M, 3] uint8, as displayed; None: gray.
            masks: masks of the foreground, [H, W] bool a view. invalid: pixels without use, [H, W] bool a view.
            test_views: names of the views to score on; None: as ``split`` chooses them.
            split, transfer, downscale: as ``load_scene`` takes them. mount: where the polarizer was.
            refractive_index: refractive index of the surfaces, None if it is not known. name: name of the scene.

        Example:
            >>> scene = polarguide.Scene.from_arrays(stack, cameras, points=points)    # doctest: +SKIP
            >>> polarguide.train(scene, "runs/mine")                                    # doctest: +SKIP

        Raises:
            PolarguideError: an array has another shape or type, or they do not fit each other.
        """
        check_count("downscale", downscale)
        check_choice("transfer", transfer, TRANSFERS)
        check_choice("split", split, get_args(Split))
        check_choice("mount", mount, get_args(Mount))
        values = by_name(pictures, "pictures")
        names = list(values)
        posed = by_name(cameras, "cameras", names)
        stated = (
            by_name(angles, "angles", names)
            if isinstance(angles, Mapping)
            else dict.fromkeys(names, tuple(angles))
        )
        beside = {
            what: {} if arrays is None else by_name(arrays, what, names)
            for what, arrays in (("masks", masks), ("invalid", invalid))
        }
        data = [
            _view_of(each, values[each], posed[each], stated[each], beside, transfer, downscale)
            for each in sorted(names)
        ]
        ready = {each: posed[each] if downscale == 1 else posed[each].downscaled(downscale) for each in names}
        stored = StoredViews.of(data, [ready[item.name] for item in data])
        places, shades = _points_of(points, point_colors)
        tests = chosen_views(posed, split) if test_views is None else tuple(sorted(test_views))
        for each in tests:
            if each not in values:
                raise unknown_view("test_views", each, names)
        return Scene(
            root=IN_MEMORY,
            name=name,
            views=tuple(item.view(ready[item.name], stored.full_scale, mount) for item in data),
            test_names=tests,
            points=torch.from_numpy(places),
            point_colors=torch.from_numpy(shades),
            refractive_index=refractive_index,
            downscale=downscale,
            transfer=transfer,
            digest=_digest(data, posed, (places, shades), (mount, transfer, downscale)),
            warnings=tuple(stored.picture_warnings(transfer)),
        )

    def __repr__(self) -> str:
        held_out = listed(list(self.test_names)) or "none"
        first = (
            f"<Scene {self.name}: {len(self.views)} views of {_sizes(self.views)} pixels, "
            f"{len(self.points):,} points, from {self.root}"
        )
        return f"{first}\n held out: {held_out}; {len(self.warnings)} warnings>"

    def _repr_html_(self) -> str:
        step = max(1, -(-len(self.views) // _PICTURED))
        pictures = "".join(
            figure(
                view.photograph().cpu().numpy(),
                f"{view.name}, {'held out' if view.name in self.test_names else 'training'}",
            )
            for view in self.views[::step]
        )
        facts = {
            "folder": str(self.root),
            "views": f"{len(self.views)} of {_sizes(self.views)} pixels, {len(self.test_names)} held out",
            "points": f"{len(self.points):,}",
            "warnings": "\n".join(self.warnings) or "none",
        }
        return f"{pictures}{table(self.name, facts)}"


def _sizes(views: Sequence[View]) -> str:
    """The sizes of views, for people."""
    sizes = sorted({(view.camera.width, view.camera.height) for view in views})
    words = [f"{width}x{height}" for width, height in (sizes[0], sizes[-1])] if sizes else ["no"]
    return " to ".join(dict.fromkeys(words))


def _view_of(
    name: str,
    pictures: Array,
    camera: Camera,
    angles: Sequence[Angle],
    beside: Mapping[str, Mapping[str, Array]],
    transfer: str,
    factor: int,
) -> ViewData:
    """One view, checked.

    Raises:
        PolarguideError: its arrays, its angles and its camera do not fit each other.
    """
    where = f"pictures ({name})"
    floats = np.issubdtype(as_numpy(pictures).dtype, np.floating)
    _require_array(
        not floats or transfer == "linear",
        where,
        f"whole numbers, which transfer {transfer} decodes",
        "floats, which are linear",
    )
    stored = stored_pictures(pictures, where)
    exposures = exposures_of(angles, len(pictures), f"angles ({name})")
    stored, exposures = in_order(stored, exposures)
    height, width = stored.shape[1:3]
    require_factor(factor, height, width)
    _require_array(
        isinstance(camera, Camera), f"cameras ({name})", "a polarguide.Camera", type(camera).__name__
    )
    _require_array(
        (camera.width, camera.height) == (width, height),
        f"cameras ({name})",
        f"the size of the pictures, {width}x{height}",
        f"{camera.width}x{camera.height}",
    )
    masks = {
        what: _mask(of_view.get(name), f"{what} ({name})", (height, width))
        for what, of_view in beside.items()
    }
    return view_data(
        name,
        list(stored),
        exposures,
        factor=factor,
        transfer=transfer,
        mask=masks["masks"],
        invalid=masks["invalid"],
    )


def _mask(values: Array | None, where: str, size: tuple[int, int]) -> NDArray[np.bool_] | None:
    if values is None:
        return None
    mask = as_numpy(values)
    _require_array(
        mask.shape == size and mask.dtype == bool, where, f"bool of shape {list(size)}", kind_of(mask)
    )
    return np.ascontiguousarray(mask)


def _points_of(
    points: ArrayLike | Tensor, point_colors: ArrayLike | Tensor | None
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Points [M, 3] float32 and their colors [M, 3] uint8, gray where there are none."""
    places = _rows(points, "points", np.float32)
    colors = np.full(places.shape, 128, np.uint8) if point_colors is None else point_colors
    shades = _rows(colors, "point_colors", np.uint8)
    _require_array(
        len(shades) == len(places), "point_colors", f"{len(places)} rows, one a point", str(len(shades))
    )
    return places, shades


def _rows(values: Any, where: str, kind: type[np.generic]) -> NDArray[Any]:
    """Rows of three finite numbers."""
    array = as_numpy(values)
    _require_array(
        array.ndim == 2 and array.shape[1] == 3 and len(array) and np.isfinite(array).all(),
        where,
        "finite numbers of shape [M, 3], at least one row",
        kind_of(array),
    )
    _require_array(
        kind is not np.uint8 or array.dtype == np.uint8, where, "uint8 of shape [M, 3]", kind_of(array)
    )
    return np.array(array, kind)


def _require_array(condition: object, where: str, expected: str, found: str) -> None:
    require(condition, where, expected=expected, found=found, remedy="Correct the array.")


def _digest(
    data: Sequence[ViewData], cameras: Mapping[str, Camera], more: Sequence[NDArray[Any]], how: object
) -> str:
    """SHA-256 over all that a scene was made of."""
    digest = hashlib.sha256(repr(how).encode())
    for item in data:
        camera = cameras[item.name]
        lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        digest.update(repr((item.name, item.exposures, item.codes.shape, lens)).encode())
        digest.update(camera.world_to_camera.numpy().tobytes())
        for array in (item.codes, item.invalid, item.mask):
            digest.update(b"none" if array is None else np.ascontiguousarray(array).tobytes())
    for array in more:
        digest.update(array.tobytes())
    return digest.hexdigest()


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
    require(
        not (counted and counted <= set(without_pixels)),
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
