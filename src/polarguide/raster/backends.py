"""The one place where a backend is chosen."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch

from polarguide.errors import PolarguideError
from polarguide.raster.cpu import rasterise_cpu
from polarguide.raster.interface import Rasterise

DeviceName = Literal["auto", "cpu", "cuda"]


class Backend(NamedTuple):
    """A device and the rasteriser that runs on it."""

    device: torch.device
    rasterise: Rasterise


def choose_backend(name: DeviceName) -> Backend:
    """The backend for ``--device``: ``auto`` takes the best one that this version has for this machine.

    Raises:
        PolarguideError: CUDA was asked for, which this version does not drive yet.
    """
    if name == "cuda":
        raise PolarguideError(
            "--device cuda",
            expected="a backend of this version",
            found="that the CUDA rasteriser is not part of it yet",
            remedy="Use --device cpu (or auto).",
        )
    return Backend(torch.device("cpu"), rasterise_cpu)
