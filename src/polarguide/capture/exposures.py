"""The exposures of a view: behind a polarizer at which angle, or without one, and how long."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from polarguide import optics
from polarguide.optics import Mount
from polarguide.polarizer import ANGLES

WELL_CONDITIONED = 0.15
"""Least ``conditioning`` of analyzers from which Stokes vectors are computed; 0/45/90/135 have 0.71."""
BALANCED = 0.05
"""Analyzers whose mean is shorter measure S0 by their mean: a pair at right angles, marked to 1.4 degrees."""


@dataclass(frozen=True)
class Exposure:
    """One picture of a view.

    Attributes:
        angle: of the polarizer in degrees, in [0, 180); None where there is none, or where it is not known.
        filtered: whether there was a polarizer before the lens or the sensor.
        gain: by what its values have to be divided to be on the scale of the scene's other pictures.
    """

    angle: float | None = None
    filtered: bool = True
    gain: float = 1.0

    @property
    def known(self) -> bool:
        """Whether it is known what the picture measures."""
        return self.angle is not None or not self.filtered

    @property
    def words(self) -> str:
        """What messages call it."""
        return "no filter" if not self.filtered else "unknown" if self.angle is None else f"{self.angle:g}"


FOUR = tuple(Exposure(float(angle)) for angle in ANGLES)
"""What a view of a polarization camera has."""
PLAIN = (Exposure(filtered=False),)
"""An ordinary photograph."""


def nominal(exposures: Sequence[Exposure]) -> Tensor:
    """Analyzers [K, 2] float64 of known exposures on the optical axis; (0, 0) of one without a filter."""
    zero = torch.zeros(1, 3, dtype=torch.float64)
    found = [
        torch.zeros(2, dtype=torch.float64)
        if e.angle is None
        else optics.analyzer(math.radians(e.angle), zero)
        for e in exposures
    ]
    return torch.stack(found) if found else torch.zeros(0, 2, dtype=torch.float64)


def analyzers(exposures: Sequence[Exposure], rays: Tensor, mount: Mount) -> Tensor:
    """Analyzers of known exposures: [K, 2], or [K, 2, H, W] of a filter before the lens.

    Args:
        rays: [H, W, 3] unit, camera axes.
    """
    if mount == "sensor":
        return nominal(exposures).to(rays)
    none = torch.zeros_like(rays[..., :2]).movedim(-1, 0)
    return torch.stack(
        [none if e.angle is None else optics.filter_analyzer(math.radians(e.angle), rays) for e in exposures]
    )


def conditioning(analyzers: Tensor) -> float:
    """Smallest over largest singular value of the rows (1, cos 2t, sin 2t): 0.71 for evenly spread angles; 0 where they
    do not determine a Stokes vector.

    Args:
        analyzers: [K, 2].
    """
    if len(analyzers) < 3:
        return 0.0
    rows = torch.cat((torch.ones_like(analyzers[:, :1]), analyzers), dim=1)
    values = torch.linalg.svdvals(rows.double())
    return float(values[-1] / values[0])


def determine_stokes(exposures: Sequence[Exposure]) -> bool:
    """Whether the exposures that are known determine a Stokes vector at every pixel, and well enough."""
    known = [e for e in exposures if e.known]
    return conditioning(nominal(known)) >= WELL_CONDITIONED


def measure_radiance(exposures: Sequence[Exposure]) -> bool:
    """Whether S0 is measured: without a filter, by a pair at right angles, or by what determines the Stokes vector."""
    return determine_stokes(exposures) or bool(radiance_places(exposures))


def radiance_places(exposures: Sequence[Exposure]) -> tuple[int, ...]:
    """The places of the exposures whose mean is S0/2: those without a filter, else all that are known if they balance;
    none where there are no such.
    """
    plain = tuple(k for k, e in enumerate(exposures) if not e.filtered)
    if plain:
        return plain
    known = tuple(k for k, e in enumerate(exposures) if e.known)
    mean = nominal([exposures[k] for k in known]).mean(dim=0) if known else None
    return known if mean is not None and float(mean.norm()) < BALANCED else ()


def normalized(angle: float) -> float:
    """An angle in degrees taken modulo 180."""
    turned = angle % 180.0
    return 0.0 if turned == 180.0 else turned  # what tiny negative angles round to


def found(exposure: Exposure, angle: float, gain: float) -> Exposure:
    """The exposure with an angle (degrees) that was found, and its gain."""
    return replace(exposure, angle=normalized(angle), gain=gain)
