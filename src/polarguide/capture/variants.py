"""Variants of a scene: with a masked background, with fewer pictures per view, or with smaller pictures."""

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
"""Linear S0/2 of black pixels: a little over one step of 8 bits, because of noise and rounding."""
BLACK_EDGE = 0.95
"""Share of black pixels at the edge of a picture with a black background."""
BLACK_VIEWS = 0.9
"""Share of the views that must have a black edge."""
GROWN = 3
"""Dilation of a subject in pixels before the rest counts as empty, because edges are blended."""
INSIDE = 0.8
"""Share of the pictures with a point in their field of view that must have it in the mask."""


def black_pixels(view: View) -> Tensor:
    """Return a mask of the black pixels of a photograph, [H, W] bool on the CPU.

    The mean over color channels and 3 x 3 pixels is compared, which suppresses noise.
    """
    picture = view.photograph().cpu().mean(dim=-1).numpy()
    return torch.from_numpy(np.asarray(cv2.blur(picture, (3, 3)) <= BLACK))


def has_black_background(views: Sequence[View]) -> bool:
    """Return True if nearly all pictures have a black edge, see ``BLACK_EDGE``."""
    return bool(views) and sum(_black_edge(view) for view in views) >= BLACK_VIEWS * len(views)


def empty_pixels(view: View) -> Tensor:
    """Return a mask of the empty pixels around a subject in front of black, [H, W] bool.

    These are the pixels outside the view's mask. Without a mask, they are the black regions at the edge of the picture,
    so that a dark spot of the subject is no hole. The subject is dilated by ``GROWN`` pixels.
    """
    if view.mask is not None:
        subject = view.mask.cpu().numpy()
    else:
        regions, _ = label(_black(view))
        outside = np.unique(np.concatenate([regions[0], regions[-1], regions[:, 0], regions[:, -1]]))
        subject = ~np.isin(regions, outside[outside > 0])
    return torch.from_numpy(~_grown(subject, GROWN))


def mask_background(scene: Scene) -> Scene:
    """Return the scene with black pixels outside the masks, and with the points of the subject only.

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
    """Return a mask [M] of the points [M, 3] in the dilated masks of most pictures that see them."""
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
    """Return True if the edge of a picture is black, but not the whole picture."""
    black = _black(view)
    edge = np.concatenate([black[0], black[-1], black[1:-1, 0], black[1:-1, -1]])
    return bool(edge.mean() >= BLACK_EDGE) and not bool(black.all())


def _grown(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disk) > 0)


THREE = (0.0, 60.0, 120.0)
"""Angles of ``three`` in degrees."""
EVERY = 4
"""Period of the views with four pictures in ``mixed`` and ``sparse``."""

Change = Callable[[View, int], View | None]
"""Function of a training view and its index that returns the view with other pictures, or None to remove it."""


def select_exposures(scene: Scene, exposures: Exposures) -> Scene:
    """Return the scene with other pictures of its training views. Held-out views do not change.

    Args:
        scene: scene with pictures at 0, 45, 90 and 135 degrees of every training view.
        exposures: ``captured``: no change. ``four``: all four pictures. ``three``: at 0, 60 and 120 degrees, computed
            from the Stokes vectors. ``two``: a pair at right angles, 0 and 90 or 45 and 135 in turn. ``one``: one
            picture, at 0, 45, 90, 135 in turn. ``unknown``: the same with unknown angles. ``mixed``: all four of every
            fourth view, S0/2 of the others. ``sparse``: only every fourth view. ``none``: S0/2.

    Raises:
        PolarguideError: the choice is invalid, or the scene has other pictures.
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
        new = torch.stack(pictures(replace(view, pictures=codes, gains=EVEN))).clamp(0, 1) * FULL_CODE
        return new.round().to(torch.int32).to(torch.uint16)

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
    """Return a view averaged over boxes of pixels, like ``load_scene(downscale=factor)``. Codes are computed on demand.

    Linear codes are averaged, and so are Stokes vectors, but not angles. A pixel is invalid or saturated if any pixel
    of its box is. It belongs to the mask or to a material if all are. Incomplete boxes at the right and bottom are
    dropped. The view has no ground truth.

    Args:
        view: the view at full size.
        factor: side of the boxes in pixels.
        latest: cache of the codes of views in memory.
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
    """Lazy sequence of views averaged over boxes of pixels."""

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
    """Return the training views of a scene, averaged until no side is longer than ``longest`` pixels.

    The result has no masks, ground truth or held-out views. A scene with small pictures is returned as it is.
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
