"""Scenes: posed views, their split, sparse points and their origin, from a folder or from arrays."""

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
from polarguide.capture.colmap.model import ColmapModel, fit_camera, read_model, unseen_points
from polarguide.capture.exposures import FOUR, Angle
from polarguide.capture.formats.pictures import TRANSFERS
from polarguide.capture.layout import CaptureFiles, check_memory, find_layout, select_views, stated_size
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
"""Number of views for each held-out view. One view in eight is held out."""
_ROUNDS = 10


def chosen_views(cameras: Mapping[str, Camera], split: Split) -> tuple[str, ...]:
    """Choose the held-out views and return their names, sorted.

    One view in ``TEST_EVERY`` is held out. A scene with a single view has no held-out view.

    Args:
        cameras: cameras of the views by name.
        split: method of the choice. "every-8th" holds out the first view in the order of the names, and every 8th view
            after it. "directions" divides the views into groups of neighbors, and holds out the view in the middle of
            each group. Each held-out view then has training views around it.
    """
    names = sorted(cameras)
    if len(names) < 2:
        return ()
    if split == "every-8th":
        return tuple(names[::TEST_EVERY])
    apart = _distances([cameras[name] for name in names])
    return tuple(names[k] for k in sorted(_middles(apart, -(-len(names) // TEST_EVERY))))


def _distances(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """Return the distance of each pair of cameras, [V, V].

    The distance combines the centers, relative to their spread, and the viewing directions.
    """
    centers = np.stack([camera.center.double().numpy() for camera in cameras])
    looks = np.stack([camera.rotation[2].double().numpy() for camera in cameras])
    spread = np.linalg.norm(centers - np.median(centers, axis=0), axis=1).max()
    places = np.concatenate([centers / max(spread, 1e-12), looks], axis=1)
    return np.asarray(np.linalg.norm(places[:, None] - places[None], axis=-1))


def _middles(apart: NDArray[np.float64], count: int) -> list[int]:
    """Divide the views into ``count`` groups by k-medoids, and return the view in the middle of each group.

    The groups are initialized with views that are far apart. A group of one or two views has no middle. It is replaced
    by a view of a larger group that is far from all views chosen so far.
    """
    middles = [int(apart.sum(axis=1).argmin())]
    while len(middles) < count:
        reach = apart[:, middles].min(axis=1)
        reach[middles] = -1.0  # chooses no view twice, even if all cameras are in one place
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
        if not free:  # all groups are small
            return middles
        reach = apart[np.ix_(free, taken)].min(axis=1)
        taken.append(free[int(reach.argmax())])
    return taken


IN_MEMORY = Path("(arrays)")
"""Placeholder for the folder of a scene that was created from arrays."""
_PICTURED = 6
"""Largest number of views in the preview of a scene in a notebook."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Input of a training: posed views of a capture, their split into training and held-out views, and sparse points.

    Attributes:
        root: folder of the capture; ``IN_MEMORY`` for a scene of ``from_arrays``.
        name: name of the scene.
        views: all views, sorted by name.
        test_names: names of the held-out views, sorted.
        points: sparse points in the world, [M, 3] float32.
        point_colors: display-encoded colors of the points, [M, 3] uint8.
        refractive_index: refractive index of all surfaces according to ``scene.json``. It is ``None`` if the file
            states no refractive index or several.
        downscale: side of the pixel boxes that were averaged; 1 for pictures at full size.
        transfer: assumed encoding of the files, "linear" or "srgb". The views are always linear.
        digest: SHA-256 of the names and contents of all files, as hexadecimal digits.
        warnings: possible faults that do not prevent the use of the scene.
        objects: objects that ``scene.json`` lists. It is empty if no ground truth distinguishes objects.
        indices: refractive index of each dielectric that has a number in ``materials/``. The numbers start at 3.
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
        """Training views, sorted by name."""
        return tuple(view for view in self.views if view.name not in self.test_names)

    @property
    def test_views(self) -> tuple[View, ...]:
        """Held-out views, sorted by name."""
        return tuple(view for view in self.views if view.name in self.test_names)

    def view(self, name: str) -> View:
        """Return the view with a name.

        Raises:
            PolarguideError: there is no such view; the message lists similar names.
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
        """Create a scene from arrays in memory.

        Training on it gives exactly the same result as training on a folder with the same pictures.

        Args:
            pictures: K pictures of each view, [K, H, W, 3] RGB or [K, H, W] gray. Values are uint8 or uint16 as stored
                by a camera, or linear floats from 0 to 1, where 1 is full scale. Pass a mapping by view name, or a
                sequence, whose views get the names v000, v001, ... Views may differ in size.
            cameras: camera of each view at the size of its pictures; see ``Camera.from_matrices``.
            angles: polarizer angles of the K pictures in degrees, counter-clockwise as displayed. An angle may also be
                ``unknown``, or ``none`` for a picture without a filter. Pass one sequence for all views, or a mapping
                by view name.
            points: sparse points on the surfaces in the world, for example from structure from motion, [M, 3].
            point_colors: display-encoded colors of the points, [M, 3] uint8; default: gray.
            masks: foreground mask of each view, [H, W] bool.
            invalid: mask of the unusable pixels of each view, [H, W] bool.
            test_views: names of the held-out views. By default, ``split`` chooses them.
            split: method that chooses the held-out views, see ``load_scene``.
            mount: place of the polarizer, see ``View.mount``.
            transfer: encoding of the pictures, see ``load_scene``.
            downscale: side of the pixel boxes that are averaged, see ``load_scene``.
            refractive_index: refractive index of the surfaces, if known.
            name: name of the scene.

        Example:
            >>> scene = polarguide.Scene.from_arrays(stack, cameras, points=points)    # doctest: +SKIP
            >>> polarguide.train(scene, "runs/mine")                                    # doctest: +SKIP

        Raises:
            PolarguideError: an array has the wrong shape or type, or two arrays do not match.
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
        masks_of = {
            kind: {} if arrays is None else by_name(arrays, kind, names)
            for kind, arrays in (("masks", masks), ("invalid", invalid))
        }
        data = [
            _view_of(each, values[each], posed[each], stated[each], masks_of, transfer, downscale)
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
    """Return the smallest and the largest picture size as text, such as "640x480 to 800x600"."""
    sizes = sorted({(view.camera.width, view.camera.height) for view in views})
    texts = [f"{width}x{height}" for width, height in (sizes[0], sizes[-1])] if sizes else ["no"]
    return " to ".join(dict.fromkeys(texts))


def _view_of(
    name: str,
    pictures: Array,
    camera: Camera,
    angles: Sequence[Angle],
    masks_of: Mapping[str, Mapping[str, Array]],
    transfer: str,
    factor: int,
) -> ViewData:
    """Check the arrays of a view and average its pictures.

    Raises:
        PolarguideError: arrays, angles and camera do not fit each other.
    """
    where = f"pictures ({name})"
    floats = np.issubdtype(as_numpy(pictures).dtype, np.floating)
    _require_array(
        not floats or transfer == "linear",
        where,
        f"whole numbers, because transfer is {transfer}",
        "floats, which must be linear",
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
        kind: _mask(masks_of_view.get(name), f"{kind} ({name})", (height, width))
        for kind, masks_of_view in masks_of.items()
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
    """Return the points [M, 3] as float32, and their colors [M, 3] as uint8. The default color is gray."""
    places = _rows(points, "points", np.float32)
    shades = _rows(
        np.full(places.shape, 128, np.uint8) if point_colors is None else point_colors,
        "point_colors",
        np.uint8,
    )
    _require_array(
        len(shades) == len(places), "point_colors", f"{len(places)} rows, one per point", str(len(shades))
    )
    return places, shades


def _rows(values: Any, where: str, kind: type[np.generic]) -> NDArray[Any]:
    """Return an array as the type ``kind`` after a check that its rows have three finite numbers."""
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
    """Read a scene from the folder of a capture.

    The pictures of a view are in one of two layouts. In the first, the folder ``polar/`` has the pictures
    ``<view>_000``, ``<view>_045``, ``<view>_090`` and ``<view>_135``. In the second, each angle has a folder (``I-00``,
    ``I-45``, ``I-90``, ``I-135``; also ``0``, ``045``, ``I_90``, ...), and the pictures of a view have the same name in
    all four folders. Pictures are undistorted PNG, TIFF or JPEG files with 8 or 16 bits.

    A COLMAP model in ``sparse/0`` or ``sparse`` is required. The name of its image without the suffix is the name of
    the view. ``masks/<view>.png``, ``invalid/<view>.png``, ``gt/<view>.npz``, ``split.json`` and ``scene.json`` are
    optional.

    Args:
        path: capture folder.
        downscale: side of the pixel boxes over which linear values are averaged. The averaged pixel is foreground if
            all pixels of its box are foreground. It is invalid or saturated if any pixel of the box is.
        transfer: encoding of the files, "linear" or "srgb".
        views: names of the views to read; default: all. The choice does not change which views are held out.
        memory: memory limit of the pictures in GiB; default: 80 % of the free memory.
        split: method that chooses the held-out views of a capture without ``split.json``, see ``chosen_views``.
        test_views: names of the held-out views, which replace ``split.json``. Names without a view are ignored.
        hold: if True, all pictures stay in memory. If False, a view loads its pictures from files when they are used.
        reporter: reporter of the progress.

    Returns:
        The scene. ``Scene.warnings`` lists possible faults that do not prevent its use.

    Raises:
        PolarguideError: a file of the capture is unusable; the message names the file and the remedy.
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
    tests = held_out_names(files, layout, model, split, test_views)
    about = files.read_if_there(root / "scene.json", b"{}")
    index = refractive_index_of(root / "scene.json", about)
    indices = indices_of(root / "scene.json", about)
    mount = mount_of(root / "scene.json", about)
    for name in names:
        # Missing poses and wrong sizes are reported before any picture is decoded.
        camera = model.camera(name)
        size = stated_size(layout.files(name)[0])
        if size is not None:
            fit_camera(camera, *size, folder=model.folder, view=name)
    check_memory(layout, names, factor=downscale, at_once=_THREADS, limit=memory, hold=hold)

    stored = read_views(
        layout, names, model, downscale=downscale, transfer=transfer, hold=hold, reporter=reporter
    )
    for item in stored.data:
        files.digests.update(item.digests)
    without_pixels = [item.name for item in stored.data if item.invalid.all()]
    counted = {item.name for item in stored.data} - (set(tests) if views is None else set())
    require(
        not (counted and counted <= set(without_pixels)),
        root / "invalid",
        expected="at least one valid pixel for training",
        found=f"none in {len(counted)} views",
        remedy="White means invalid: invert the pictures, or remove them.",
    )
    even = stored.exposures is None or keeps_gains(root / "scene.json", about)
    gains = [EVEN] * len(names) if even or stored.exposures is None else stored.exposures.gains()
    loaders = None if hold else ViewFiles(layout, downscale, transfer, files.digests)
    posed_views = tuple(
        item.view(camera, stored.full_scale, mount, loaders, gain)
        for item, camera, gain in zip(stored.data, stored.cameras, gains, strict=True)
        if camera is not None
    )
    check_materials(layout, stored.data, indices)
    has_objects = any(item.ground_truth and item.ground_truth.object_ids is not None for item in stored.data)
    warnings = [
        *layout.warnings,
        *model.warnings,
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
        objects=objects_of(root / "scene.json", about) if has_objects else (),
        indices=indices,
    )


def held_out_names(
    files: Files,
    layout: CaptureFiles,
    model: ColmapModel | None,
    split: Split = "directions",
    test_views: Sequence[str] | None = None,
) -> tuple[str, ...]:
    """Choose the held-out views, and return their names.

    They are ``test_views``, else the views in ``split.json``, else views that ``split`` chooses.
    """
    check_choice("split", split, get_args(Split))
    path = layout.root / "split.json"
    data = files.read_if_there(path, None)
    posed = frozenset(() if model is None else model.names)
    cameras = {name: model.camera(name) for name in layout.names if model is not None and name in posed}
    if test_views is not None:
        return tuple(name for name in sorted(test_views) if name in layout.names)
    return chosen_views(cameras, split) if data is None else held_out(path, data, layout.names)


def read_views(
    layout: CaptureFiles,
    names: Sequence[str],
    model: ColmapModel | None,
    *,
    downscale: int,
    transfer: str,
    hold: bool = True,
    reporter: Reporter = SILENT,
) -> StoredViews:
    """Read the files of views in several threads.

    Args:
        layout: files of the capture.
        names: names of the views, sorted.
        model: COLMAP model of the capture, or None. A view without a pose in the model gets no camera.
        downscale: side of the pixel boxes that are averaged.
        transfer: encoding of the files, "linear" or "srgb".
        hold: if True, keep all pictures and the ground truth in memory. If False, keep a sample of the pixels.
        reporter: reporter of the progress.

    Raises:
        PolarguideError: a file is unusable, a camera does not fit its pictures, or the views differ in bit depth.
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
    """Return a view without its pictures, for scenes whose views load them on demand.

    A sample of the pixels remains for checks of the exposure.
    """
    truth = data.ground_truth
    has_objects = truth is not None and truth.object_ids is not None
    return replace(
        data,
        codes=checks.sampled(data.codes),
        ground_truth=GroundTruth(object_ids=torch.empty(0)) if has_objects else None,
    )


def _content_warnings(layout: CaptureFiles, stored: StoredViews, invalid: list[str]) -> list[str]:
    """Return warnings about views with unusable pictures, and about views with the same pictures.

    Args:
        layout: files of the capture.
        stored: pixels of the views.
        invalid: names of the views without a valid pixel.
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
            if len(digests) > 1 and len(set(digests)) == 1:  # unpolarized light differs by noise
                same_file.append(item.name)
    # If all pictures of a view are black, the warning about its exposure reports it.
    black = [item.name for item in stored.data if len({bool(picture.any()) for picture in item.codes}) > 1]
    gray = [item.name for item in stored.data if any(map(is_gray, item.codes))]
    copies = "; ".join(listed(names) for names in [n for n in views.values() if len(n) > 1][:3])
    table = (
        (invalid, "have no valid pixel ({}) and are useless. White means invalid in invalid/: invert the pictures, or "
         "remove them."),
        (same_file, "have the same file at all angles ({}) and look unpolarized. Copy the files of the other angles."),
        (black, "have pictures that are black throughout ({})."),
        (gray if len(gray) < count else [], "have gray pictures, unlike other views ({})."),
    )  # fmt: skip
    warnings = [f"{len(n)} of {count} views {text.format(listed(n))}" for n, text in table if n]
    if copies:
        warnings.append(
            f"Views have the same pictures ({copies}). Copy the files of the other views, or remove these views."
        )
    return warnings


def _gain_warnings(names: Sequence[str], gains: Sequence[tuple[float, float, float]]) -> list[str]:
    """Return a warning if some views differ in exposure or white balance from the mean of all views."""
    stops = {name: np.log2(gain) for name, gain in zip(names, gains, strict=True) if gain != EVEN}
    if not stops:
        return []
    strongest = sorted(stops, key=lambda name: -float(np.abs(stops[name]).max()))
    texts = [f"{name} {max(stops[name], key=abs):+.2f}" for name in strongest]
    return [
        f"{len(stops)} of {len(names)} views differ from the mean exposure or white balance, measured at common points "
        f"(stops: {listed(texts)}). Their colors are divided by the gains. Fix exposure and white balance in the next "
        "capture."
    ]


def _pose_warnings(model: ColmapModel, all_names: list[str], data: Sequence[ViewData]) -> list[str]:
    """Return warnings about poses without pictures, and about intrinsics that were scaled to the picture size."""
    warnings = []
    unused = sorted(set(model.names) - set(all_names))
    if unused:
        warnings.append(
            f"The COLMAP model has poses for {len(unused)} images without pictures ({listed(unused)})."
        )
    sizes = {item.name: (model.camera(item.name).width, model.camera(item.name).height) for item in data}
    scaled = [item.name for item in data if item.size != sizes[item.name]]
    if scaled:
        resolutions = ", ".join(
            f"{width}x{height}" for width, height in sorted({sizes[name] for name in scaled})
        )
        warnings.append(
            f"The intrinsics are for another resolution ({resolutions}) than the pictures and were scaled in "
            f"{len(scaled)} of {len(data)} views ({listed(scaled)}). This is right for resized pictures, wrong for "
            "cropped pictures."
        )
    return warnings
