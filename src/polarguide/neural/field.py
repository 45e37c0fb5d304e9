"""A field: signed distance, color and what lies behind, with what rays through it need."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample, softplus

from polarguide.neural.grids import FeatureGrids, SmoothGrids, spline_matrix
from polarguide.neural.recipe import FieldShape
from polarguide.neural.region import Region

SHARPENING = 10.0
"""The sharpness is exp(10 v) of what is learned, so that it can grow as far as it has to (NeuS, Wang et al. 2021)."""
FREQUENCIES = 4
MAP_SIDE = 129
"""Nodes along a side of the map of distances."""


class Geometry(NamedTuple):
    """Of N places: signed distance [N] (positive outside), its slope [N, 3], and features [N, F]."""

    distance: Tensor
    slope: Tensor
    features: Tensor


class Field(nn.Module):
    """What rays see, in the coordinates of a ``Region``: lengths in its unit, the origin in its middle.

    Attributes:
        region: where it lies. log_sharpness: ln(s) / 10 of the density's logistic function, which is learned.
        first_log_sharpness: what it begins with.
        direction_share: in [0, 1], how much the color may depend on the direction yet.
        distances: map of the distances in the region's cube, which tells rays where to look; of an earlier step.
    """

    map_side = MAP_SIDE

    def __init__(self, region: Region, shape: FieldShape, generator: torch.Generator) -> None:
        super().__init__()
        self.region = region
        self.first_log_sharpness = -math.log(shape.first_spread) / SHARPENING
        self.log_sharpness = nn.Parameter(torch.tensor(self.first_log_sharpness))
        self.background = Background(shape, generator)
        self.register_buffer("direction_share", torch.ones(()))
        self.direction_share: Tensor
        side = self.map_side
        self.register_buffer("distances", torch.zeros(1, 1, side, side, side))
        self.distances: Tensor

    @abstractmethod
    def geometry(self, places: Tensor) -> Geometry:
        """At places [N, 3], differentiable in all that is learned."""

    @abstractmethod
    def color(self, places: Tensor, directions: Tensor, normals: Tensor, features: Tensor) -> Tensor:
        """Shown colors [N, 3] in [0, 1] toward rays of these directions."""

    @abstractmethod
    def lattice(self, axes: Sequence[Tensor]) -> Tensor:
        """Distances [X, Y, Z] at all combinations of coordinates [X], [Y] and [Z], without a gradient."""

    def map_distances(self) -> None:
        """Bring ``distances`` up to date."""
        axis = self.region.places(torch.linspace(-1, 1, self.map_side, device=self.distances.device))
        self.distances.copy_(self.lattice((axis, axis, axis))[None, None])

    @property
    def sharpness(self) -> Tensor:
        """s of the density's logistic function: 1/s is how thick a surface looks, in the region's unit."""
        return (SHARPENING * self.log_sharpness).exp()

    def near_distance(self, places: Tensor) -> Tensor:
        """Distances [...] at places [..., 3] as the map has them."""
        cube, _ = self.region.cube(places)
        # The map's axes are x, y, z; grid_sample counts them from the last.
        grid = cube.reshape(1, 1, 1, -1, 3).flip(-1)
        return grid_sample(self.distances, grid, align_corners=True).view(places.shape[:-1])


class GridField(Field):
    """Distances and features in dense grids over the region's cube, with a small head for the color.

    Args:
        region: where it lies. shape: of what it is made. generator: first values are drawn from.
    """

    def __init__(self, region: Region, shape: FieldShape, generator: torch.Generator) -> None:
        super().__init__(region, shape, generator)
        self.first_radius = region.first_radius(shape.first_radius)
        self.shape_grids = SmoothGrids(shape.resolutions)
        self.features = FeatureGrids(shape.resolutions, shape.channels, 0.1, generator)
        given = self.features.width + 3 + 3 + direction_width()
        self.head = network((given, shape.width, shape.width, 3), generator)
        self.map_distances()

    def geometry(self, places: Tensor) -> Geometry:
        """See ``Field``: the sphere that the surface starts as, and what the grids add to it."""
        cube, scale = self.region.cube(places)
        added, slope = self.shape_grids(cube)
        distance = places.norm(dim=-1)
        outward = places / distance.clamp(min=1e-6)[:, None]
        return Geometry(distance - self.first_radius + added, outward + slope * scale, self.features(cube))

    def color(self, places: Tensor, directions: Tensor, normals: Tensor, features: Tensor) -> Tensor:
        """See ``Field``."""
        given = (
            features,
            places / self.region.radius,
            normals,
            self.direction_share * encoded_directions(directions),
        )
        color: Tensor = torch.sigmoid(self.head(torch.cat(given, dim=-1)))
        return color

    @torch.no_grad()
    def lattice(self, axes: Sequence[Tensor]) -> Tensor:
        """See ``Field``: splines are products along the axes, so a whole grid is three products of matrices."""
        x, y, z = torch.meshgrid(*axes, indexing="ij")
        total = (x * x + y * y + z * z).sqrt() - self.first_radius
        cubes = [self.region.cube(axis)[0] for axis in axes]
        for resolution, table in zip(self.shape_grids.resolutions, self.shape_grids.levels, strict=True):
            grid = table.view(resolution + 2, resolution + 2, resolution + 2)
            for cube in cubes:  # each product takes the first axis, and puts it at the end
                grid = torch.tensordot(grid, spline_matrix(cube, resolution), dims=([0], [1]))
            total += grid
        return total


class Background(nn.Module):
    """What lies behind the cameras' sphere: density and color in grids, by direction and inverse distance.

    Args:
        shape: of what it is made. generator: first values are drawn from.
    """

    def __init__(self, shape: FieldShape, generator: torch.Generator) -> None:
        super().__init__()
        self.grids = FeatureGrids(shape.background, shape.channels, 0.1, generator)
        self.head = network((self.grids.width, shape.width, 4), generator)

    def forward(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Density [N] and shown colors [N, 3] at places in a ball of radius 1 (``Region.surroundings``)."""
        found = self.head(self.grids(places))
        return softplus(found[:, 0]), torch.sigmoid(found[:, 1:])


def network(widths: Sequence[int], generator: torch.Generator) -> nn.Sequential:
    """Linear layers of these widths with ReLUs between them, drawn as He et al. (2015) do."""
    layers: list[nn.Module] = []
    for given, made in pairwise(widths):
        layer = nn.Linear(given, made)
        with torch.no_grad():
            layer.weight.copy_(torch.randn(made, given, generator=generator) * math.sqrt(2 / given))
            layer.bias.zero_()
        layers += [layer, nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def encoded(values: Tensor, frequencies: int) -> Tensor:
    """Values [N, D], and sine and cosine of them times 1, 2, 4, ...: [N, D (1 + 2 F)]."""
    scaled = [2**k * values for k in range(frequencies)]
    return torch.cat((values, *(f(each) for each in scaled for f in (torch.sin, torch.cos))), dim=-1)


def encoded_directions(directions: Tensor) -> Tensor:
    """Directions [N, 3] as the heads read them."""
    return encoded(directions, FREQUENCIES)


def direction_width() -> int:
    """How many numbers ``encoded_directions`` makes of a direction."""
    return 3 * (1 + 2 * FREQUENCIES)
