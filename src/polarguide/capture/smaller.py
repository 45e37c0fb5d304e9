"""Downscaled views, made from views that were read."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polarguide.capture.box_filter import agreed, every, maximum, mean_codes
from polarguide.capture.loader import Latest, Loader
from polarguide.capture.view import Scene, View


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
        self._views, self._factor = views, factor
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

    def __iter__(self) -> Iterator[View]:
        return (self[k] for k in range(len(self)))


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
    held = (replace(view, pictures=view.codes, mask=None, subject_only=False) for view in small)
    return replace(scene, views=tuple(held), test_names=())
