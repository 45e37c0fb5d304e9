"""Neural recipes as data."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from polarguide.training.recipe import values_differ

Representation = Literal["grids", "networks"]


@dataclass(frozen=True)
class FieldShape:
    """Sizes of a field.

    Attributes:
        kind: dense grids with a small head, or the networks of the publication.
        resolutions: resolutions of the grids in cells along a side.
        channels: features of each grid.
        width: width of the two hidden layers of the heads.
        background: resolutions of the grids behind the cameras' sphere.
        first_radius: radius of the initial spherical surface in the unit of the region, which is half the width of a
            picture at the center. It is clamped to half of the radius of the cameras' sphere.
        first_spread: reciprocal of the initial sharpness, in the unit of the region.
    """

    kind: Representation = "grids"
    resolutions: tuple[int, ...] = (16, 32, 64, 128)
    channels: int = 4
    width: int = 64
    background: tuple[int, ...] = (16, 32, 64)
    first_radius: float = 1.25
    first_spread: float = 0.05


@dataclass(frozen=True)
class Sampling:
    """Rays and samples of a step.

    Attributes:
        rays: rays of one view.
        coarse: samples of a ray in the search for the surface, without a gradient. A second search takes as many.
        fine: samples of a ray with a gradient.
        background: samples of a ray behind the cameras' sphere.
        neighbors: samples of a ray with the largest weights, whose neighbors the guidance evaluates.
    """

    rays: int = 512
    coarse: int = 64
    fine: int = 32
    background: int = 16
    neighbors: int = 4

    @property
    def samples(self) -> int:
        """Number of samples of a step with a gradient."""
        return self.rays * (self.fine + self.background + 6 * self.neighbors)


@dataclass(frozen=True)
class FieldWeights:
    """Weights of the loss terms.

    Attributes:
        color: L1 of display colors, times 1 - DoLP.
        aolp: difference of the angles in radians, times DoLP.
        eikonal: squared difference of the gradient's length from 1.
        guidance: L1 of the covariances of normals, after ``guided``.
        guided: share of all steps before the guidance.
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
    """Learning rates of Adam. They rise over the first steps and fall along a cosine.

    Attributes:
        distances: rate of the coarsest grid of distances.
        finer: exponent of the rates of finer grids over the size of their cells. With 1, all grids bend normals at the
            same rate.
        features: rate of the grids of features.
        networks: rate of heads and networks.
        sharpness: rate of the logarithm of the sharpness, over 10.
        warmup: share of all steps of the rise.
        last: ratio of the last rate to the highest.
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
    """A method that trains a field.

    Attributes:
        name: value of ``--recipe``.
        about: description in one line.
        steps: default number of steps.
        shape: sizes of the field.
        sampling: rays and samples of a step.
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
        """Approximate number of parameters."""
        shape = self.shape
        if shape.kind == "networks":
            return 1_000_000
        background = shape.channels * sum((n + 1) ** 3 for n in shape.background)
        return sum((1 + shape.channels) * (n + 2) ** 3 for n in shape.resolutions) + background

    def data(self) -> dict[str, Any]:
        """Return all values as plain JSON types, for a run folder."""
        return dict(json.loads(json.dumps(asdict(self))))

    def differs(self, data: Mapping[str, Any]) -> bool:
        """Return True if a value differs from the recorded values of a run folder."""
        return values_differ(self.data(), data)
