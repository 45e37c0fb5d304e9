"""Smaller pictures, made from those that were read: of a whole scene, or of a view whenever they are asked for."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from polarguide.capture.box_filter import agreed, maximum, mean_codes
from polarguide.capture.exposures import Exposure
from polarguide.capture.view import Scene, View


class SmallerView(View):
    """A view averaged over boxes of pixels; its codes are made from the whole view's whenever they are asked for.

    Codes are averaged, which are linear, and with them Stokes vectors, never angles. A pixel is invalid, saturated or
    of the subject where one of its box is, and of a material where all are. Remainders of a box are cut. Ground truth
    stays behind.

    Args:
        view: the whole view. factor: side of the boxes in pixels.
    """

    _whole: View
    _factor: int

    def __init__(self, view: View, factor: int) -> None:
        invalid, saturated = (
            torch.from_numpy(maximum(flags.numpy(), factor)) for flags in (view.invalid, view.saturated)
        )
        materials = None
        if view.materials is not None:
            numbers = agreed(view.materials.numpy().astype(np.int32), factor)
            materials = torch.from_numpy(numbers.astype(np.uint8))
        values = {
            "name": view.name,
            "camera": view.camera.downscaled(factor),
            "invalid": invalid,
            "saturated": saturated,
            "mask": None if view.mask is None else torch.from_numpy(maximum(view.mask.numpy(), factor)),
            "ground_truth": None,
            "exposures": view.exposures,
            "mount": view.mount,
            "materials": materials,
            "_whole": view,
            "_factor": factor,
        }
        vars(self).update(values)

    @property
    def codes(self) -> Tensor:
        """As in ``View``."""
        whole = self._whole.codes.numpy()
        return torch.from_numpy(np.stack([mean_codes(picture, self._factor) for picture in whole]))

    def with_exposures(self, exposures: tuple[Exposure, ...]) -> View:
        """As in ``View``."""
        other = object.__new__(SmallerView)
        vars(other).update({**vars(self), "exposures": exposures})
        return other


class SmallerViews(Sequence[View]):
    """Views averaged over boxes of pixels, each made when it is first asked for."""

    def __init__(self, views: Sequence[View], factor: int) -> None:
        self._views, self._factor = views, factor
        self._made: dict[int, View] = {}

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, place):  # type: ignore[no-untyped-def]
        """The view at a place, or those of a slice."""
        if isinstance(place, slice):
            return [self[k] for k in range(*place.indices(len(self)))]
        place = range(len(self))[place]
        if place not in self._made:
            self._made[place] = SmallerView(self._views[place], self._factor)
        return self._made[place]

    def __iter__(self) -> Iterator[View]:
        return (self[k] for k in range(len(self)))


def smaller(scene: Scene, longest: int) -> Scene:
    """The training views averaged until none has a side longer than ``longest`` pixels, see ``SmallerView``.

    Masks and ground truth stay behind, and so do the views that are held out.

    Returns:
        The scene itself where its pictures are small enough.
    """
    views = scene.train_views
    size = max(max(view.camera.width, view.camera.height) for view in views)
    factor = math.ceil(size / longest)
    if factor == 1:
        return scene
    return replace(scene, views=tuple(_made(SmallerView(view, factor)) for view in views), test_names=())


def _made(view: SmallerView) -> View:
    """The view with its codes, and without what it can do without."""
    return View(
        view.name,
        view.camera,
        view.codes,
        view.invalid,
        view.saturated,
        exposures=view.exposures,
        mount=view.mount,
        materials=view.materials,
    )
