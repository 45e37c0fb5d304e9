"""Create variants of a scene: with a black background, with fewer pictures per view, or with smaller pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import label
from torch import Tensor

from polarguide import optics
from polarguide.capture.box_filter import agreed, every, maximum, mean_codes
from polarguide.capture.exposures import FOUR, PLAIN, Exposure
from polarguide.capture.scene import Scene
from polarguide.capture.view import EVEN, FULL_CODE, Latest, Loader, View
from polarguide.core.errors import require
from polarguide.core.options import EXPOSURES, Exposures, check_choice
from polarguide.geometry.camera import seen_at
from polarguide.geometry.polarizer import ANGLES

BLACK = 0.005
"""Linear ``S0 / 2`` below which a pixel counts as black. It is slightly more than one step of 8-bit values."""
BLACK_EDGE = 0.95
"""Smallest share of black pixels at the edge of a picture with a black background."""
BLACK_VIEWS = 0.9
"""Smallest share of views with a black edge in a scene with a black background."""
GROWN = 3
"""Number of pixels by which a subject is dilated before the other pixels count as empty. Its edges are blended."""
INSIDE = 0.8
"""Smallest share of the pictures showing a point in which a point of the subject is inside the mask."""


def black_pixels(view: View) -> Tensor:
    """Return a mask of the black pixels of a view, [H, W] bool on the CPU.

    To suppress noise, the mean over the color channels and 3 x 3 pixels is compared with ``BLACK``.
    """
    picture = view.photograph().cpu().mean(dim=-1).numpy()
    return torch.from_numpy(np.asarray(cv2.blur(picture, (3, 3)) <= BLACK))


def has_black_background(views: Sequence[View]) -> bool:
    """Return True if nearly all pictures have a black edge, see ``BLACK_EDGE``."""
    return bool(views) and sum(_black_edge(view) for view in views) >= BLACK_VIEWS * len(views)


def empty_pixels(view: View) -> Tensor:
    """Return a mask of the pixels that show the black background around a subject, [H, W] bool.

    They are the pixels outside the mask of the view. If the view has no mask, they are the black regions that touch the
    edge of the picture. A dark spot inside the subject is therefore not included. The subject is dilated by ``GROWN``
    pixels.
    """
    if view.mask is not None:
        subject = view.mask.cpu().numpy()
    else:
        regions, _ = label(_black(view))
        outside = np.unique(np.concatenate([regions[0], regions[-1], regions[:, 0], regions[:, -1]]))
        subject = ~np.isin(regions, outside[outside > 0])
    return torch.from_numpy(~_grown(subject, GROWN))


def mask_background(scene: Scene) -> Scene:
    """Return a scene whose pixels outside the masks are black, and which has the points inside the masks only.

    Raises:
        PolarguideError: a view has no mask, or no point is in the masks.
    """
    views = []
    for view in scene.views:
        require(
            view.mask is not None,
            scene.root / "masks",
            expected="a mask of every view for --background masked",
            found=f"no mask for view {view.name}",
            remedy=f"Add masks/{view.name}.png, white where the subject is, or choose another background.",
        )
        views.append(view.masked())
    # Training must not use the masks of held-out views.
    inside = _in_masks(scene.points, [view for view in views if view.name not in scene.test_names])
    require(
        not len(scene.points) or bool(inside.any()),
        scene.root / "masks",
        expected="masks with points of the COLMAP model in them",
        found=f"none of {len(scene.points)} points",
        remedy="White is the subject: invert the masks, or choose another background.",
    )
    return replace(
        scene, views=tuple(views), points=scene.points[inside], point_colors=scene.point_colors[inside]
    )


def _in_masks(points: Tensor, views: Sequence[View]) -> Tensor:
    """Return a mask [M] of the points [M, 3] that are inside the dilated masks of most pictures that show them."""
    counts = torch.zeros(len(points))
    inside = torch.zeros(len(points))
    for view in views:
        assert view.mask is not None
        mask = torch.from_numpy(_grown(view.mask.cpu().numpy(), GROWN))
        pixel, _, within = seen_at(points.double() - view.camera.center, view.camera)
        counts += within
        inside += within & mask[pixel]
    return (counts > 0) & (inside >= INSIDE * counts)


def _black(view: View) -> NDArray[np.bool_]:
    return (black_pixels(view) | view.invalid.cpu()).numpy()


def _black_edge(view: View) -> bool:
    """Return True if the edge of a picture is black and the whole picture is not."""
    black = _black(view)
    edge = np.concatenate([black[0], black[-1], black[1:-1, 0], black[1:-1, -1]])
    return bool(edge.mean() >= BLACK_EDGE) and not bool(black.all())


def _grown(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disk) > 0)


THREE = (0.0, 60.0, 120.0)
"""Polarizer angles in degrees of the choice ``three`` of ``select_exposures``."""
EVERY = 4
"""Distance between views with four pictures for the choices ``mixed`` and ``sparse`` of ``select_exposures``."""

Change = Callable[[View, int], View | None]
"""Function that changes the pictures of a training view. Its arguments are the view and the view's index.

It returns the changed view, or None to remove the view.
"""


def select_exposures(scene: Scene, exposures: Exposures) -> Scene:
    """Return a scene whose training views have fewer pictures or other angles. Held-out views do not change.

    The choices are:

    - ``captured``: all pictures, for any scene.
    - ``four``: all four pictures.
    - ``three``: pictures at 0, 60 and 120 degrees, computed from the Stokes vectors.
    - ``two``: two pictures at a right angle, alternately at 0 and 90 degrees and at 45 and 135 degrees.
    - ``one``: one picture. The angle changes from view to view: 0, 45, 90, 135 degrees, and again.
    - ``unknown``: one picture as for ``one``, but its angle is not known.
    - ``mixed``: all four pictures of every fourth view, and ``S0 / 2`` of the other views.
    - ``sparse``: all four pictures of every fourth view. The other views are removed.
    - ``none``: the picture without a polarizer, ``S0 / 2``.

    Args:
        scene: scene whose training views have pictures at 0, 45, 90 and 135 degrees.
        exposures: name of a choice.

    Raises:
        PolarguideError: the choice is invalid, or a training view has pictures at other angles.
    """
    check_choice("exposures", exposures, EXPOSURES)
    if exposures == "captured":
        return scene
    others = [view.name for view in scene.train_views if view.exposures != FOUR]
    require(
        not others,
        scene.root,
        expected=f"four pictures of every view, at 0, 45, 90 and 135 degrees, for --exposures {exposures}",
        found=f"{len(others)} views without them ({', '.join(others[:4])})",
        remedy="Use a scene with these four pictures of every view.",
    )
    places = {view.name: place for place, view in enumerate(scene.train_views)}
    change = _CHANGES[exposures]
    views = [change(view, places[view.name]) if view.name in places else view for view in scene.views]
    return replace(scene, views=tuple(view for view in views if view is not None))


def _some(view: View, *places: int, known: bool = True) -> View:
    chosen = tuple(FOUR[place] if known else Exposure() for place in places)
    return view.changed(lambda codes: torch.stack([codes[place] for place in places]), chosen)


def _computed(view: View, pictures: Callable[[View], list[Tensor]], exposures: tuple[Exposure, ...]) -> View:

    def change(codes: Tensor) -> Tensor:
        new = torch.stack(pictures(replace(view, pictures=codes, gains=EVEN))).clamp(min=0) * FULL_CODE
        if codes.dtype == torch.float32:
            return new
        return new.clamp(max=FULL_CODE).round().to(torch.int32).to(torch.uint16)

    return view.changed(change, exposures)


def _three(view: View, _place: int) -> View:
    """Return a view with pictures at 0, 60 and 120 degrees."""

    def pictures(view: View) -> list[Tensor]:
        stokes = view.stokes()
        rays = view.camera.rays()
        intensities = []
        for angle in THREE:
            cosine, sine = optics.analyzer(math.radians(angle), rays, view.mount)[..., None].unbind(0)
            intensities.append((stokes[0] + stokes[1] * cosine + stokes[2] * sine) / 2)
        return intensities

    return _computed(view, pictures, tuple(Exposure(angle) for angle in THREE))


def _plain(view: View, _place: int) -> View:
    return _computed(view, lambda view: [view.photograph()], PLAIN)


_CHANGES: dict[str, Change] = {
    "four": lambda view, place: view,
    "three": _three,
    "two": lambda view, place: _some(view, place % 2, place % 2 + 2),
    "one": lambda view, place: _some(view, place % len(ANGLES)),
    "unknown": lambda view, place: _some(view, place % len(ANGLES), known=False),
    "mixed": lambda view, place: view if place % EVERY == 0 else _plain(view, place),
    "sparse": lambda view, place: view if place % EVERY == 0 else None,
    "none": _plain,
}


def smaller_view(view: View, factor: int, latest: Latest) -> View:
    """Return a smaller view, which is averaged over boxes of pixels like in ``load_scene(downscale=factor)``.

    Linear codes are averaged when they are read. A pixel of the result is invalid or saturated if any pixel of its box
    is. It belongs to the mask or to a material if all pixels of its box do. Incomplete boxes at the right and bottom
    are left out. The view has no ground truth.

    Args:
        view: the view at full size.
        factor: side of the boxes in pixels.
        latest: cache that smaller views share. It keeps the codes of one view.
    """
    full = view.pictures

    def averaged(codes: Tensor) -> Tensor:
        return torch.from_numpy(np.stack([mean_codes(picture, factor) for picture in codes.numpy()]))

    def boxed(flags: Tensor, reduce: Callable[[NDArray[Any], int], NDArray[Any]]) -> Tensor:
        return torch.from_numpy(reduce(flags.numpy(), factor))

    return replace(
        view,
        camera=view.camera.downscaled(factor),
        pictures=full.then(averaged) if isinstance(full, Loader) else Loader(lambda: averaged(full), latest),
        invalid=boxed(view.invalid, maximum),
        saturated=boxed(view.saturated, maximum),
        mask=None if view.mask is None else boxed(view.mask, every),
        truth=None,
        materials=None if view.materials is None else boxed(view.materials.int(), agreed).to(torch.uint8),
    )


class SmallerViews(Sequence[View]):
    """Sequence of smaller views, each of which is computed when it is used."""

    def __init__(self, views: Sequence[View], factor: int) -> None:
        self._views = views
        self._factor = factor
        self._made: dict[int, View] = {}
        self._latest = Latest()

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, place):  # type: ignore[no-untyped-def]
        """Return the view at an index, or the views of a slice."""
        if isinstance(place, slice):
            return [self[k] for k in range(*place.indices(len(self)))]
        place = range(len(self))[place]
        if place not in self._made:
            self._made[place] = smaller_view(self._views[place], self._factor, self._latest)
        return self._made[place]


def smaller(scene: Scene, longest: int) -> Scene:
    """Return the training views of a scene, averaged so that no side is longer than ``longest`` pixels.

    The result has no masks, no ground truth and no held-out views. A scene with small pictures is returned unchanged.
    """
    views = scene.train_views
    size = max(max(view.camera.width, view.camera.height) for view in views)
    factor = math.ceil(size / longest)
    if factor == 1:
        return scene
    small = (smaller_view(view, factor, Latest()) for view in views)
    return replace(
        scene,
        views=tuple(replace(view, pictures=view.codes, mask=None, subject_only=False) for view in small),
        test_names=(),
    )
