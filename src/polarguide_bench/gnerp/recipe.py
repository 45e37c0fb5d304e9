"""Recipes for neural fields, defined as data."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from polarguide.training.recipe import values_differ


@dataclass(frozen=True)
class FieldShape:
    """Sizes of a field.

    Attributes:
        kind: kind of field, for records: dense grids with a small network.
        resolutions: number of cells along a side of each grid.
        channels: number of features of each grid.
        width: number of units in both hidden layers of the small networks.
        background: number of cells along a side of each grid of the background.
        first_radius: radius of the initial surface, a sphere, in the unit of the region. The unit is half the width of
            a picture at the center. The radius is clamped to half of the radius of the sphere of cameras.
        first_spread: reciprocal of the initial sharpness, in the unit of the region.
    """

    kind: Literal["grids"] = "grids"
    resolutions: tuple[int, ...] = (16, 32, 64, 128)
    channels: int = 4
    width: int = 64
    background: tuple[int, ...] = (16, 32, 64)
    first_radius: float = 1.25
    first_spread: float = 0.05


@dataclass(frozen=True)
class Sampling:
    """Numbers of rays and samples in a training step.

    Attributes:
        rays: number of rays, all from one view.
        coarse: samples per ray in each of the two searches for the surface. They have no gradient.
        fine: samples per ray from which the loss is computed.
        background: samples per ray outside the sphere of the cameras.
        neighbors: samples per ray at which the guidance loss is computed. They are the samples with the largest
            weights.
    """

    rays: int = 512
    coarse: int = 64
    fine: int = 32
    background: int = 16
    neighbors: int = 4

    @property
    def samples(self) -> int:
        """Number of samples with a gradient in a step."""
        return self.rays * (self.fine + self.background + 6 * self.neighbors)


@dataclass(frozen=True)
class FieldWeights:
    """Weights of the loss terms.

    Attributes:
        color: weight of the L1 difference of display colors, which is multiplied by 1 - DoLP.
        aolp: weight of the difference of angles in radians, which is multiplied by the DoLP.
        eikonal: weight of the squared difference between the length of the gradient and 1.
        guidance: weight of the L1 difference of covariances, which is used after ``guided``.
        guided: share of all steps after which the guidance begins.
        circular: compare angles as (1 - cos of twice their difference) / 2, and double the angles in the guidance. Both
            terms are then equal at 0 and 180 degrees, unlike the published terms.
    """

    color: float = 1.0
    aolp: float = 0.1
    eikonal: float = 0.1
    guidance: float = 0.1
    guided: float = 0.5
    circular: bool = False


@dataclass(frozen=True)
class FieldRates:
    """Learning rates of Adam, which rise over the first steps and then decay along a cosine.

    Attributes:
        distances: learning rate of the coarsest grid of distances.
        finer: exponent with which the rate of a finer grid depends on its cell size. With 1, all grids change normals
            equally fast.
        features: learning rate of the grids of features.
        networks: learning rate of all networks.
        sharpness: learning rate of ln(sharpness) / 10.
        warmup: share of all steps in which the rates rise.
        last: ratio of the last rate to the highest rate.
    """

    distances: float = 3e-2
    finer: float = 2.5
    features: float = 1e-2
    networks: float = 5e-3
    sharpness: float = 5e-4
    warmup: float = 0.05
    last: float = 0.01


@dataclass(frozen=True)
class NeuralRecipe:
    """Recipe that trains a field.

    Attributes:
        name: value of ``--recipe``.
        about: description in one line.
        steps: default number of steps.
        shape: sizes of the field.
        sampling: numbers of rays and samples in a step.
        weights: weights of the loss terms.
        rates: learning rates.
    """

    name: str
    about: str
    steps: int = 10_000
    shape: FieldShape = field(default_factory=FieldShape)
    sampling: Sampling = field(default_factory=Sampling)
    weights: FieldWeights = field(default_factory=FieldWeights)
    rates: FieldRates = field(default_factory=FieldRates)

    @property
    def numbers(self) -> int:
        """Approximate number of learned parameters."""
        shape = self.shape
        background = shape.channels * sum((n + 1) ** 3 for n in shape.background)
        return sum((1 + shape.channels) * (n + 2) ** 3 for n in shape.resolutions) + background

    def data(self) -> dict[str, Any]:
        """Return all values as plain JSON types, for a run folder."""
        return dict(json.loads(json.dumps(asdict(self))))

    def differs(self, data: Mapping[str, Any]) -> bool:
        """Return True if a value differs from the recorded values of a run folder."""
        return values_differ(self.data(), data)
