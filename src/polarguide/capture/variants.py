"""A scene with fewer pictures of each view, computed from four: what ``compare --exposures`` trains on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from polarguide import optics
from polarguide.capture.exposures import FOUR, PLAIN, Exposure
from polarguide.capture.view import FULL_CODE, Scene, View
from polarguide.errors import PolarguideError
from polarguide.options import EXPOSURES, Exposures, check_choice
from polarguide.polarizer import ANGLES

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
            expected=f"pictures at 0, 45, 90 and 135 degrees of every view for --exposures {exposures}",
            found=f"others in {len(others)} views, {others[0]} first",
            remedy="Give a scene with four pictures of each view.",
        )
    places = {view.name: place for place, view in enumerate(scene.train_views)}
    change = _CHANGES[exposures]
    views = [change(view, places[view.name]) if view.name in places else view for view in scene.views]
    return replace(scene, views=tuple(view for view in views if view is not None))


def pictures_taken(scene: Scene) -> int:
    """How many pictures the training views have."""
    return sum(len(view.exposures) for view in scene.train_views)


def count_of(exposures: Exposures, views: int) -> int:
    """How many pictures ``select_exposures`` leaves of a number of training views with four each."""
    each = {"three": 3, "two": 2, "one": 1, "unknown": 1, "none": 1}
    fourth = -(-views // EVERY)
    if exposures == "mixed":
        return views + 3 * fourth
    return 4 * fourth if exposures == "sparse" else each.get(exposures, 4) * views


def _some(view: View, *places: int, known: bool = True) -> View:
    chosen = tuple(FOUR[place] if known else Exposure() for place in places)
    return view.changed(lambda codes: torch.stack([codes[place] for place in places]), chosen)


def _computed(view: View, pictures: Callable[[View], list[Tensor]], exposures: tuple[Exposure, ...]) -> View:
    def change(codes: Tensor) -> Tensor:
        made = torch.stack(pictures(replace(view, pictures=codes))).clamp(0, 1) * FULL_CODE
        return made.round().to(torch.int32).to(torch.uint16)

    return view.changed(change, exposures)


def _three(view: View, _place: int) -> View:
    def pictures(view: View) -> list[Tensor]:
        stokes, rays = view.stokes(), view.camera.rays()
        found = []
        for angle in THREE:
            cosine, sine = optics.analyzer(math.radians(angle), rays, view.mount)[..., None].unbind(0)
            found.append((stokes[0] + stokes[1] * cosine + stokes[2] * sine) / 2)
        return found

    return _computed(view, pictures, tuple(Exposure(angle) for angle in THREE))


def _plain(view: View, _place: int) -> View:
    return _computed(view, lambda view: [view.photograph()], PLAIN)


def _pair(view: View, place: int) -> View:
    return _some(view, place % 2, place % 2 + 2)


@dataclass(frozen=True)
class _One:
    known: bool

    def __call__(self, view: View, place: int) -> View:
        return _some(view, place % len(ANGLES), known=self.known)


_CHANGES: dict[str, Change] = {
    "four": lambda view, place: view,
    "three": _three,
    "two": _pair,
    "one": _One(known=True),
    "unknown": _One(known=False),
    "mixed": lambda view, place: view if place % EVERY == 0 else _plain(view, place),
    "sparse": lambda view, place: view if place % EVERY == 0 else None,
    "none": _plain,
}
