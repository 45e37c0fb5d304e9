"""Scenes made of a scene: on black, with fewer pictures of each view, or with smaller ones."""

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
from polarguide.core.errors import PolarguideError, require
from polarguide.core.options import EXPOSURES, Exposures, check_choice
from polarguide.geometry.camera import seen_at
from polarguide.geometry.polarizer import ANGLES

BLACK = 0.005
"""Linear S0/2 up to which a pixel is black: a little over one step of 8 bits, which is what noise and rounding leave of
no light."""
BLACK_EDGE = 0.95
"""Share of a picture's outermost pixels that are black where there is nothing behind the subject."""
BLACK_VIEWS = 0.9
"""Share of the views whose edge has to be black."""
GROWN = 3
"""Pixels by which a subject is grown before what is outside counts as empty: edges are blended."""
INSIDE = 0.8
"""A point belongs to the subject if it is in the mask in this share of the pictures that see it."""


def black_pixels(view: View) -> Tensor:
    """Where the photograph shows no light, [H, W] bool, on the CPU: what *black* means wherever pictures are judged.

    It is the mean over the color channels and 3 x 3 pixels that is compared, so that noise does not lighten a pixel.
    """
    picture = view.photograph().cpu().mean(dim=-1).numpy()
    return torch.from_numpy(np.asarray(cv2.blur(picture, (3, 3)) <= BLACK))


def has_black_background(views: Sequence[View]) -> bool:
    """Whether nothing is behind the subject: the edges of nearly all pictures are black, see ``BLACK_EDGE``."""
    black = sum(_black_edge(view) for view in views)
    return bool(views) and black >= BLACK_VIEWS * len(views)


def empty_pixels(view: View) -> Tensor:
    """Where a picture of a subject before black shows nothing, [H, W] bool.

    That is outside its mask, where it has one; elsewhere the black that reaches the edge of the picture, so that a dark
    spot of the subject is not taken for a hole. The subject is grown by ``GROWN`` pixels.
    """
    if view.mask is not None:
        subject = view.mask.cpu().numpy()
    else:
        regions, _ = label(_black(view))
        outside = np.unique(np.concatenate([regions[0], regions[-1], regions[:, 0], regions[:, -1]]))
        subject = ~np.isin(regions, outside[outside > 0])
    return torch.from_numpy(~_grown(subject, GROWN))


def mask_background(scene: Scene) -> Scene:
    """The scene with black pictures outside the masks, and with the points of the subject only.

    Raises:
        PolarguideError: a view has no mask, or no point lies in the masks.
    """
    views = []
    for view in scene.views:
        if view.mask is None:
            raise PolarguideError(
                scene.root / "masks",
                expected="a mask of every view for --background masked",
                found=f"no mask for view {view.name}",
                remedy=f"Add masks/{view.name}.png, white where the subject is, or choose another background.",
            )
        views.append(view.masked())
    # The masks of test views tell training nothing.
    inside = _in_masks(scene.points, [view for view in views if view.name not in scene.test_names])
    require(
        not len(scene.points) or bool(inside.any()),
        scene.root / "masks",
        expected="masks with points of the COLMAP model in them",
        found=f"none of {len(scene.points)} points",
        remedy="White is the subject there: invert the masks, or choose another background.",
    )
    return replace(
        scene, views=tuple(views), points=scene.points[inside], point_colors=scene.point_colors[inside]
    )


def _in_masks(points: Tensor, views: Sequence[View]) -> Tensor:
    """Which points [M, 3] lie in the grown masks of most of the pictures that they fall into, [M] bool."""
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
    """Where the picture is black, [H, W]; pixels marked as invalid count as black."""
    return (black_pixels(view) | view.invalid.cpu()).numpy()


def _black_edge(view: View) -> bool:
    black = _black(view)
    edge = np.concatenate([black[0], black[-1], black[1:-1, 0], black[1:-1, -1]])
    return bool(edge.mean() >= BLACK_EDGE) and not bool(black.all())


def _grown(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disk) > 0)


THREE = (0.0, 60.0, 120.0)
EVERY = 4
"""``mixed`` and ``sparse`` keep the four pictures of one view in this number."""

Change = Callable[[View, int], View | None]
"""A training view with other pictures, given its place among the training views; None: the view is left out."""


def select_exposures(scene: Scene, exposures: Exposures) -> Scene:
    """The scene with other pictures of its training views; those held out stay as they are.

    Args:
        scene: with pictures at 0, 45, 90 and 135 degrees of every training view.
        exposures: ``captured``: the scene as it is. ``four``: all four pictures. ``three``: at 0, 60 and 120 degrees,
            computed from the Stokes vectors. ``two``: a pair at right angles, 0 and 90 or 45 and 135 in turn. ``one``:
            one picture, at 0, 45, 90, 135 in turn. ``unknown``: the same with unknown angles. ``mixed``: all four of
            every fourth view, S0/2 of the others. ``sparse``: every fourth view alone. ``none``: S0/2.

    Raises:
        PolarguideError: there is no such choice, or the scene has other pictures.
    """
    check_choice("exposures", exposures, EXPOSURES)
    if exposures == "captured":
        return scene
    others = [view.name for view in scene.train_views if view.exposures != FOUR]
    if others:
        raise PolarguideError(
            scene.root,
            expected=f"four pictures of every view, at 0, 45, 90 and 135 degrees, for --exposures {exposures}",
            found=f"{len(others)} views without them ({others[0]} first)",
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
        made = torch.stack(pictures(replace(view, pictures=codes, gains=EVEN))).clamp(0, 1) * FULL_CODE
        return made.round().to(torch.int32).to(torch.uint16)

    return view.changed(change, exposures)


def _three(view: View, _place: int) -> View:
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
    """A view averaged over boxes of pixels, as if it had been read so; its codes are made when they are read.

    Codes are averaged; they are linear, so Stokes vectors are averaged, and angles never are. A pixel is invalid or
    saturated where any pixel of its box is; it belongs to the mask or to a material where all are. Incomplete boxes at
    the right and bottom are dropped. The view has no ground truth.

    Args:
        view: the whole view. factor: side of the boxes in pixels. latest: where the codes of a view in memory stay.
    """
    whole = view.pictures

    def averaged(codes: Tensor) -> Tensor:
        return torch.from_numpy(np.stack([mean_codes(picture, factor) for picture in codes.numpy()]))

    def boxed(flags: Tensor, reduce: Callable[[NDArray[Any], int], NDArray[Any]]) -> Tensor:
        return torch.from_numpy(reduce(flags.numpy(), factor))

    return replace(
        view,
        camera=view.camera.downscaled(factor),
        pictures=whole.then(averaged)
        if isinstance(whole, Loader)
        else Loader(lambda: averaged(whole), latest),
        invalid=boxed(view.invalid, maximum),
        saturated=boxed(view.saturated, maximum),
        mask=None if view.mask is None else boxed(view.mask, every),
        truth=None,
        materials=None if view.materials is None else boxed(view.materials.int(), agreed).to(torch.uint8),
    )


class SmallerViews(Sequence[View]):
    """Views averaged over boxes of pixels, each made at its first use."""

    def __init__(self, views: Sequence[View], factor: int) -> None:
        self._views = views
        self._factor = factor
        self._made: dict[int, View] = {}
        self._latest = Latest()

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, place):  # type: ignore[no-untyped-def]
        """The view at a place, or those of a slice."""
        if isinstance(place, slice):
            return [self[k] for k in range(*place.indices(len(self)))]
        place = range(len(self))[place]
        if place not in self._made:
            self._made[place] = smaller_view(self._views[place], self._factor, self._latest)
        return self._made[place]


def smaller(scene: Scene, longest: int) -> Scene:
    """The training views averaged until none has a side longer than ``longest`` pixels, see ``smaller_view``.

    It has neither masks nor ground truth, nor the views that are held out.

    Returns:
        The scene itself where its pictures are small enough.
    """
    views = scene.train_views
    size = max(max(view.camera.width, view.camera.height) for view in views)
    factor = math.ceil(size / longest)
    if factor == 1:
        return scene
    small = (smaller_view(view, factor, Latest()) for view in views)
    stored = (replace(view, pictures=view.codes, mask=None, subject_only=False) for view in small)
    return replace(scene, views=tuple(stored), test_names=())
