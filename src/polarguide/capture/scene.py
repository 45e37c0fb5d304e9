"""The scene: posed views, those held out to be scored on, sparse points and their origin; of a folder, or of arrays."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from polarguide.capture.exposures import Angle
from polarguide.capture.formats.pictures import TRANSFERS
from polarguide.capture.given_arrays import (
    Array,
    as_numpy,
    by_name,
    exposures_of,
    in_order,
    kind_of,
    stored_pictures,
)
from polarguide.capture.ground_truth import SceneObject
from polarguide.capture.view import ANGLES, View, figure, listed, table, unknown_view
from polarguide.capture.view_reader import StoredViews, ViewData, require_factor, view_data
from polarguide.core.errors import PolarguideError
from polarguide.core.options import Split, check_choice, check_count
from polarguide.core.text import canonical
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
    if floats and transfer != "linear":
        raise _unlike(where, f"whole numbers, which transfer {transfer} decodes", "floats, which are linear")
    stored = stored_pictures(pictures, where)
    exposures = exposures_of(angles, len(pictures), f"angles ({name})")
    stored, exposures = in_order(stored, exposures)
    height, width = stored.shape[1:3]
    require_factor(factor, height, width)
    if not isinstance(camera, Camera):
        raise _unlike(f"cameras ({name})", "a polarguide.Camera", type(camera).__name__)
    if (camera.width, camera.height) != (width, height):
        raise _unlike(
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
    if mask.shape != size or mask.dtype != bool:
        raise _unlike(where, f"bool of shape {list(size)}", kind_of(mask))
    return np.ascontiguousarray(mask)


def _points_of(
    points: ArrayLike | Tensor, point_colors: ArrayLike | Tensor | None
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Points [M, 3] float32 and their colors [M, 3] uint8, gray where there are none."""
    places = _rows(points, "points", np.float32)
    colors = np.full(places.shape, 128, np.uint8) if point_colors is None else point_colors
    shades = _rows(colors, "point_colors", np.uint8)
    if len(shades) != len(places):
        raise _unlike("point_colors", f"{len(places)} rows, one a point", str(len(shades)))
    return places, shades


def _rows(values: Any, where: str, kind: type[np.generic]) -> NDArray[Any]:
    """Rows of three finite numbers."""
    array = as_numpy(values)
    if array.ndim != 2 or array.shape[1] != 3 or not len(array) or not np.isfinite(array).all():
        raise _unlike(where, "finite numbers of shape [M, 3], at least one row", kind_of(array))
    if kind is np.uint8 and array.dtype != np.uint8:
        raise _unlike(where, "uint8 of shape [M, 3]", kind_of(array))
    return np.array(array, kind)


def _unlike(where: str, expected: str, found: str) -> PolarguideError:
    return PolarguideError(where, expected=expected, found=found, remedy="Correct the array.")


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
