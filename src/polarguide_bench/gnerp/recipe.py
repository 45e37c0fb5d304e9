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
    """Of what a field is made.

    Attributes:
        kind: dense grids with a small head, or the networks of the publication.
        resolutions: resolutions of the grids, cells along a side. channels: features that each of them has.
        width: width of the two hidden layers of the heads.
        background: resolutions of the grids behind the cameras' sphere.
        first_radius: of the sphere that the surface starts as, in the unit of the region: half of what a picture shows
            across. It is never more than half of the radius of the cameras' sphere.
        first_spread: reciprocal of the sharpness that the surface starts with, over the field's unit.
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
    """The rays and samples of a step.

    Attributes:
        rays: of one view. coarse: samples of a ray, without a gradient, that find the surface; as many again find it
            more precisely. fine: samples with a gradient. background: samples behind the cameras' sphere.
        neighbors: heaviest samples of a ray at whose neighbors the guidance looks.
    """

    rays: int = 512
    coarse: int = 64
    fine: int = 32
    background: int = 16
    neighbors: int = 4

    @property
    def samples(self) -> int:
        """Places that a step asks the field about, with a gradient."""
        return self.rays * (self.fine + self.background + 6 * self.neighbors)


@dataclass(frozen=True)
class FieldWeights:
    """Weights of the loss terms.

    Attributes:
        color: L1 of shown colors, times 1 - DoLP.
        aolp: difference of the angles in radians, times DoLP.
        eikonal: squared difference of the slope's length from 1.
        guidance: L1 of the covariances of normals, from ``guided`` on.
        guided: share of all steps after which the guidance begins.
        circular: angles are compared as 1 - cos of twice their difference over 2, and the guidance doubles them:
            both are the same at 0 and 180 degrees, which the published terms are not.
    """

    color: float = 1.0
    aolp: float = 0.1
    eikonal: float = 0.1
    guidance: float = 0.1
    guided: float = 0.5
    circular: bool = False


@dataclass(frozen=True)
class FieldRates:
    """Learning rates (Adam), which rise over the first steps and fall along a cosine.

    Attributes:
        distances: of the coarsest grid of distances. finer: those of the others go with this power of their cells'
            size: with 1, all of them bend normals as fast.
        features: features of all grids of features. networks: of heads and networks. sharpness: sharpness of its
            logarithm, over 10.
        warmup: share of all steps over which they rise. last: what they end with, over what they rise to.
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
    """A method that learns a field.

    Attributes:
        name: as given to ``--recipe``. about: one line. steps: the default number.
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
        """About how many numbers are learned."""
        shape = self.shape
        if shape.kind == "networks":
            return 1_000_000
        behind = sum((n + 1) ** 3 for n in shape.background)
        return sum((1 + shape.channels) * (n + 2) ** 3 for n in shape.resolutions) + shape.channels * behind

    def data(self) -> dict[str, Any]:
        """All values as plain JSON types, for a run's folder."""
        plain: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return plain

    def differs(self, data: Mapping[str, Any]) -> bool:
        """True where a value differs from the one that a run's folder records."""
        return values_differ(self.data(), data)
