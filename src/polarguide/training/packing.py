"""What a training keeps of a view between its visits, in two bytes a value.

Targets are rounded to whole numbers of 1/32767 of the largest one of their picture, as soon as they are computed and
whatever the size of the scene, so that a result does not depend on where they were kept meanwhile. That is a hundredth
of a degree of a normal, and an eighth of a step of an 8-bit picture at full scale.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import torch
from torch import Tensor

from polarguide.camera import Camera
from polarguide.training.losses import Weights
from polarguide.training.recipe import Priors
from polarguide.training.targets import ViewPriors

FULL = 32767


class Packed(NamedTuple):
    """A tensor as it is kept.

    Attributes:
        codes: int16, or of the tensor's own type where that was not coded.
        top: what the code 32767 stands for, a scalar; None: not coded.
    """

    codes: Tensor
    top: Tensor | None = None

    @property
    def bytes(self) -> int:
        """That it takes."""
        return self.codes.numel() * self.codes.element_size()


Entry = dict[str, Packed]
"""What is kept of a view, by name."""


def packed(values: Tensor) -> Packed:
    """Finite float32 values as whole numbers of 1/32767 of the largest absolute one; 0 and the largest stay exact."""
    top = values.abs().amax()
    top = torch.where(top == 0, torch.ones_like(top), top)
    return Packed((values * (FULL / top)).round_().to(torch.int16), top)


def unpacked(kept: Packed) -> Tensor:
    """The values, float32 where they were coded."""
    if kept.top is None:
        return kept.codes
    # A division by 32767 gives back a 1 exactly, a product with its inverse does not.
    values = kept.codes.to(torch.float32).div_(FULL)
    return values if kept.top.device.type == "cpu" and float(kept.top) == 1 else values.mul_(kept.top)


def holds(entry: Entry, fields: frozenset[str]) -> bool:
    """Whether an entry has all that is read; of the normal and its candidates it has one."""
    missing = fields - entry.keys()
    return not missing or (len(missing) == 1 and missing < {"normal", "candidates"})


def pack_priors(priors: ViewPriors, fields: Collection[str]) -> Entry:
    """What terms read of the priors, and whatever no term is known to read."""
    entry = {}
    for name, values in vars(priors).items():
        if isinstance(values, Tensor) and (name in fields or name not in Weights.known_priors()):
            entry[name] = packed(values[1:]) if name == "stokes" else packed(values)  # no term reads S0
    if priors.candidates is not None:
        entry.pop("normal", None)  # each step chooses
    return entry


def unpack_priors(entry: Entry, camera: Camera, settings: Priors) -> ViewPriors:
    """The priors again; what was not kept is not a number, in its shape.

    Args:
        entry: by ``pack_priors``. camera: of the view. settings: that they were computed with.
    """
    values = {name: unpacked(kept) for name, kept in entry.items()}
    device = next(iter(values.values())).device
    nothing = torch.full((), torch.nan, device=device)
    size = (camera.height, camera.width)
    for name in ("specular", "diffuse", "normal", "plane", "chromatic"):
        values.setdefault(name, nothing.expand(*size, 3))
    for name in ("separated", "weight", "chromatic_weight", "stokes_weight", "surface"):
        values.setdefault(name, nothing.expand(size))
    measured = values.pop("stokes", None)
    stokes = (
        nothing.expand(3, *size, 3)
        if measured is None
        else torch.nn.functional.pad(measured, (0, 0, 0, 0, 0, 0, 1, 0), value=torch.nan)
    )
    shares = {"azimuth_share": settings.azimuth_share, "chromatic_share": settings.chromatic_share}
    return ViewPriors(camera=camera, stokes=stokes, **values, **shares)  # type: ignore[arg-type]
