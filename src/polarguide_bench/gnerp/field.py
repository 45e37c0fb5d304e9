"""Field of signed distance, color and background, in the region that the cameras surround."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample, softplus

from polarguide.geometry.camera import Camera
from polarguide.geometry.scene_frame import scene_frame
from polarguide_bench.gnerp.grids import FeatureGrids, SmoothGrids, spline_matrix
from polarguide_bench.gnerp.recipe import FieldShape

MARGIN = 1.02
"""Ratio of the region's radius to the distance of the farthest camera."""


@dataclass(frozen=True)
class Region:
    """Sphere around the subject that contains the cameras. It defines the coordinates of a field.

    Attributes:
        center: [3] center of the sphere in world coordinates.
        unit: unit of length of the coordinates, in world units. It is half the width of a picture at the center. Grids
            have their full resolution in the cube from -1 to 1 in these coordinates.
        radius: radius of the sphere in this unit of length, at least 1.
    """

    center: tuple[float, float, float]
    unit: float
    radius: float

    @classmethod
    def around(cls, cameras: Sequence[Camera]) -> Region:
        """Create the region around the cameras of a training. Its unit is the median of the units of all cameras."""
        frame = scene_frame(cameras)
        distances = [float((camera.center - frame.center).norm()) for camera in cameras]
        unit = median(
            distance * camera.width / (2 * camera.fx)
            for distance, camera in zip(distances, cameras, strict=True)
        )
        x, y, z = frame.center.tolist()
        return cls((x, y, z), unit, max(1.0, MARGIN * max(distances) / unit))

    def first_radius(self, radius: float) -> float:
        """Return the radius of the initial surface, a sphere, clamped so that it stays away from the cameras.

        Args:
            radius: requested radius in the region's unit.
        """
        return min(radius, 0.5 * self.radius)

    def inner(self, points: Tensor) -> Tensor:
        """Convert world points [..., 3] to coordinates of the field."""
        return (points - points.new_tensor(self.center)) / self.unit

    def cube(self, inner: Tensor) -> tuple[Tensor, Tensor]:
        """Map coordinates [..., 3] of the field to the grids' cube [-1, 1]^3; return also the derivatives [..., 3].

        Coordinates beyond 1 are contracted by ``2 - 1/x``, separately along each axis. Mip-NeRF 360 (Barron et al.
        2022) contracts the radius in this way. Gradients are also converted separately along each axis.
        """
        size = inner.abs()
        outside = size.clamp(min=1)
        end = 2 - 1 / self.radius
        place = torch.where(size > 1, inner.sign() * (2 - 1 / outside), inner) / end
        return place, 1 / (outside * outside * end)

    def places(self, cube: Tensor) -> Tensor:
        """Invert ``cube`` along one axis: convert positions in the grids to coordinates [...] of the field."""
        along = cube * (2 - 1 / self.radius)
        return torch.where(along.abs() > 1, along.sign() / (2 - along.abs()), along)

    def surroundings(self, inner: Tensor) -> Tensor:
        """Map coordinates [..., 3] outside the sphere to a ball of radius 1, the domain of the background's grids."""
        distance = inner.norm(dim=-1, keepdim=True).clamp(min=self.radius)
        return inner / distance * (1 - 0.5 * self.radius / distance)

    def span(self, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distances [N] at which rays enter and leave the sphere. Both are equal if a ray misses it.

        Args:
            origin: [N, 3] in coordinates of the field.
            direction: [N, 3], unit length.
        """
        middle = -(origin * direction).sum(dim=-1)
        half = (self.radius**2 - (origin * origin).sum(dim=-1) + middle**2).clamp(min=0).sqrt()
        begin = (middle - half).clamp(min=0)
        return begin, (middle + half).clamp(min=begin)


SHARPENING = 10.0
"""Factor 10 in the sharpness exp(10 v), in which v is learned (NeuS, Wang et al. 2021)."""
FREQUENCIES = 4
"""Number of frequencies in the encoding of directions."""
DIRECTION_WIDTH = 3 * (1 + 2 * FREQUENCIES)
"""Number of values of an encoded direction."""
MAP_SIDE = 129
"""Number of nodes along a side of the coarse map of distances."""


class Geometry(NamedTuple):
    """Signed distance [N] at N points (positive outside), its gradient [N, 3], and features [N, F]."""

    distance: Tensor
    slope: Tensor
    features: Tensor


class Field(nn.Module):
    """Field of signed distance and color on dense grids, with a small network for the color. Rays sample it.

    Its coordinates are relative to the center of a ``Region`` and in the region's unit of length.

    Args:
        region: the region.
        shape: sizes of grids and networks.
        generator: source of the initial values.

    Attributes:
        region: the region.
        log_sharpness: learned ln(s) / 10. s is the sharpness of the logistic function that defines density.
        first_log_sharpness: initial value of ``log_sharpness``.
        direction_share: weight of the direction in the color network at the current step, in [0, 1].
        distances: coarse map of the distances at an earlier step. Rays use it to skip empty space.
        head: network that computes the color.
    """

    def __init__(self, region: Region, shape: FieldShape, generator: torch.Generator) -> None:
        super().__init__()
        self.region = region
        self.first_log_sharpness = -math.log(shape.first_spread) / SHARPENING
        self.log_sharpness = nn.Parameter(torch.tensor(self.first_log_sharpness))
        self.background = Background(shape, generator)
        self.register_buffer("direction_share", torch.ones(()))
        self.direction_share: Tensor
        self.register_buffer("distances", torch.zeros(1, 1, MAP_SIDE, MAP_SIDE, MAP_SIDE))
        self.distances: Tensor
        self.first_radius = region.first_radius(shape.first_radius)
        self.shape_grids = SmoothGrids(shape.resolutions)
        self.features = FeatureGrids(shape.resolutions, shape.channels, 0.1, generator)
        inputs = self.features.width + 3 + 3 + DIRECTION_WIDTH
        self.head = network((inputs, shape.width, shape.width, 3), generator)
        self.map_distances()

    def color(self, places: Tensor, directions: Tensor, normals: Tensor, features: Tensor) -> Tensor:
        """Return display colors [N, 3] in [0, 1] along rays of these directions."""
        encoding = self.direction_share * encoded(directions, FREQUENCIES)
        inputs = torch.cat((features, places / self.region.radius, normals, encoding), dim=-1)
        return torch.sigmoid(self.head(inputs))

    def map_distances(self) -> None:
        """Update ``distances``."""
        axis = self.region.places(torch.linspace(-1, 1, MAP_SIDE, device=self.distances.device))
        self.distances.copy_(self.lattice((axis, axis, axis))[None, None])

    @property
    def sharpness(self) -> Tensor:
        """Sharpness s of the density's logistic function. 1/s is the apparent thickness of a surface."""
        return (SHARPENING * self.log_sharpness).exp()

    def near_distance(self, places: Tensor) -> Tensor:
        """Interpolate distances [...] at positions [..., 3] from the coarse map."""
        cube, _ = self.region.cube(places)
        # The map's axes are x, y, z. grid_sample counts them from the last.
        grid = cube.reshape(1, 1, 1, -1, 3).flip(-1)
        return grid_sample(self.distances, grid, align_corners=True).view(places.shape[:-1])

    def geometry(self, places: Tensor) -> Geometry:
        """Compute the geometry at positions [N, 3], differentiable in all parameters.

        The distance is the sum of the initial sphere and the grids.
        """
        cube, scale = self.region.cube(places)
        added, slope = self.shape_grids(cube)
        distance = places.norm(dim=-1)
        outward = places / distance.clamp(min=1e-6)[:, None]
        return Geometry(distance - self.first_radius + added, outward + slope * scale, self.features(cube))

    @torch.no_grad()
    def lattice(self, axes: Sequence[Tensor]) -> Tensor:
        """Compute distances [X, Y, Z] at all combinations of coordinates [X], [Y] and [Z], without a gradient.

        Splines are products along the axes, so a grid takes three matrix products.
        """
        x, y, z = torch.meshgrid(*axes, indexing="ij")
        total = (x * x + y * y + z * z).sqrt() - self.first_radius
        cubes = [self.region.cube(axis)[0] for axis in axes]
        for resolution, table in zip(self.shape_grids.resolutions, self.shape_grids.levels, strict=True):
            grid = table.view(resolution + 2, resolution + 2, resolution + 2)
            for cube in cubes:  # each product moves the first axis to the end
                grid = torch.tensordot(grid, spline_matrix(cube, resolution), dims=([0], [1]))
            total += grid
        return total


class Background(nn.Module):
    """Density and color outside the sphere of the cameras, in grids over direction and inverse distance.

    Args:
        shape: sizes of grids and networks.
        generator: source of the initial values.
    """

    def __init__(self, shape: FieldShape, generator: torch.Generator) -> None:
        super().__init__()
        self.grids = FeatureGrids(shape.background, shape.channels, 0.1, generator)
        self.head = network((self.grids.width, shape.width, 4), generator)

    def forward(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Compute density [N] and display colors [N, 3] at positions in the ball of ``Region.surroundings``."""
        values = self.head(self.grids(places))
        return softplus(values[:, 0]), torch.sigmoid(values[:, 1:])


def network(widths: Sequence[int], generator: torch.Generator) -> nn.Sequential:
    """Create linear layers of the given widths with ReLUs between them, initialized as in He et al. (2015)."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layer = nn.Linear(inputs, outputs)
        with torch.no_grad():
            layer.weight.copy_(torch.randn(outputs, inputs, generator=generator) * math.sqrt(2 / inputs))
            layer.bias.zero_()
        layers += [layer, nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def encoded(values: Tensor, frequencies: int) -> Tensor:
    """Encode values [N, D] by themselves and by sine and cosine of F multiples (1, 2, 4, ...), [N, D (1 + 2 F)]."""
    scaled = [2**k * values for k in range(frequencies)]
    return torch.cat((values, *(f(each) for each in scaled for f in (torch.sin, torch.cos))), dim=-1)
