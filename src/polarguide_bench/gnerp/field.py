"""A field: signed distance, color and background, in the region that the cameras surround.

``GridField`` has dense grids. ``NetworkField`` has the networks of the publication: distance 8 x 256, radiance 4 x 256
(GNeRP after NeuS; initialization of Gropp et al. 2020). It is meant for a GPU: a step differentiates the distance
twice.
"""

from __future__ import annotations

import math
from abc import abstractmethod
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


@dataclass(frozen=True)
class Region:
    """The sphere around what the cameras look at in which they stand, and the unit of lengths in it.

    Attributes:
        center: [3] in the world. unit: half the side of the middle cube, in world units: half of what a picture shows
            across at the center. Within the cube, grids have their full resolution.
        radius: radius of the sphere, in this unit, at least 1.
    """

    center: tuple[float, float, float]
    unit: float
    radius: float

    @classmethod
    def around(cls, cameras: Sequence[Camera]) -> Region:
        """Of the cameras of a training. The unit is the median over them."""
        frame = scene_frame(cameras)
        unit = median(
            float((camera.center - frame.center).norm()) * camera.width / (2 * camera.fx)
            for camera in cameras
        )
        farthest = max(float((camera.center - frame.center).norm()) for camera in cameras)
        x, y, z = frame.center.tolist()
        return cls((x, y, z), unit, max(1.0, MARGIN * farthest / unit))

    def first_radius(self, radius: float) -> float:
        """Radius of the sphere that the field represents before training.

        ``radius``, in the field's unit, is reduced where the sphere would come near a camera.
        """
        return min(radius, 0.5 * self.radius)

    def inner(self, points: Tensor) -> Tensor:
        """World points [..., 3] in the field's own coordinates."""
        return (points - points.new_tensor(self.center)) / self.unit

    def cube(self, inner: Tensor) -> tuple[Tensor, Tensor]:
        """Where the grids hold a place, in [-1, 1]^3, and its derivative along each axis, both [..., 3].

        Each axis goes on as ``2 - 1/x`` beyond 1 (the contraction of Mip-NeRF 360, Barron et al. 2022, axis by axis,
        so that slopes are turned into the field's coordinates axis by axis, too).
        """
        size = inner.abs()
        outside = size.clamp(min=1)
        end = 2 - 1 / self.radius
        place = torch.where(size > 1, inner.sign() * (2 - 1 / outside), inner) / end
        return place, 1 / (outside * outside * end)

    def places(self, cube: Tensor) -> Tensor:
        """The inverse of ``cube``, along each axis by itself: coordinates [...] of places in the grids."""
        along = cube * (2 - 1 / self.radius)
        return torch.where(along.abs() > 1, along.sign() / (2 - along.abs()), along)

    def surroundings(self, inner: Tensor) -> Tensor:
        """Where the grids of the background hold places beyond the sphere [..., 3]: in a ball of radius 1."""
        distance = inner.norm(dim=-1, keepdim=True).clamp(min=self.radius)
        return inner / distance * (1 - 0.5 * self.radius / distance)

    def span(self, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Where rays enter and leave the sphere, [N] each; equal where they miss it.

        Args:
            origin: [N, 3] in the field's own coordinates. direction: [N, 3] unit.
        """
        middle = -(origin * direction).sum(dim=-1)
        half = (self.radius**2 - (origin * origin).sum(dim=-1) + middle**2).clamp(min=0).sqrt()
        begin = (middle - half).clamp(min=0)
        return begin, (middle + half).clamp(min=begin)


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
    """A field that rays sample, in the coordinates of a ``Region``: lengths in its unit, the origin in its middle.

    Attributes:
        region: where it lies. log_sharpness: ln(s) / 10 of the density's logistic function, which is learned.
        first_log_sharpness: its initial value.
        direction_share: in [0, 1], the part of the directional encoding that the color depends on at this step.
        distances: grid of the distances in the region's cube at an earlier step, by which rays skip empty space.
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
        region: where it lies. shape: sizes of its grids and networks. generator: first values are drawn from.
    """

    def __init__(self, region: Region, shape: FieldShape, generator: torch.Generator) -> None:
        super().__init__(region, shape, generator)
        self.first_radius = region.first_radius(shape.first_radius)
        self.shape_grids = SmoothGrids(shape.resolutions)
        self.features = FeatureGrids(shape.resolutions, shape.channels, 0.1, generator)
        inputs = self.features.width + 3 + 3 + direction_width()
        self.head = network((inputs, shape.width, shape.width, 3), generator)
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
        inputs = (
            features,
            places / self.region.radius,
            normals,
            self.direction_share * encoded_directions(directions),
        )
        color: Tensor = torch.sigmoid(self.head(torch.cat(inputs, dim=-1)))
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
    """The background beyond the cameras' sphere: density and color in grids, by direction and inverse distance.

    Args:
        shape: sizes of its grids and networks. generator: first values are drawn from.
    """

    def __init__(self, shape: FieldShape, generator: torch.Generator) -> None:
        super().__init__()
        self.grids = FeatureGrids(shape.background, shape.channels, 0.1, generator)
        self.head = network((self.grids.width, shape.width, 4), generator)

    def forward(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Density [N] and shown colors [N, 3] at places in a ball of radius 1 (``Region.surroundings``)."""
        values = self.head(self.grids(places))
        return softplus(values[:, 0]), torch.sigmoid(values[:, 1:])


def network(widths: Sequence[int], generator: torch.Generator) -> nn.Sequential:
    """Linear layers of these widths with ReLUs between them, drawn as He et al. (2015) do."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layer = nn.Linear(inputs, outputs)
        with torch.no_grad():
            layer.weight.copy_(torch.randn(outputs, inputs, generator=generator) * math.sqrt(2 / inputs))
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


DEPTH = 8
WIDTH = 256
SKIP = 4
PLACE_FREQUENCIES = 8
SOFTNESS = 100.0
CHUNK = 1 << 16


class NetworkField(Field):
    """Distances of a network of places with a skip connection, colors of another one.

    Args:
        region: where it lies. shape: sizes of its grids and networks. generator: first values are drawn from.
    """

    map_side = 65

    def __init__(self, region: Region, shape: FieldShape, generator: torch.Generator) -> None:
        super().__init__(region, shape, generator)
        self.layers = _distance_layers(region.first_radius(shape.first_radius) / region.radius, generator)
        radiance = (WIDTH + 3 + 3 + direction_width(), *[WIDTH] * 4, 3)
        self.head = network(radiance, generator)
        self.map_distances()

    def geometry(self, places: Tensor) -> Geometry:
        """See ``Field``."""
        learns = torch.is_grad_enabled()
        with torch.enable_grad():
            points = places.detach().requires_grad_()
            values = self._distance(points)
            (slope,) = torch.autograd.grad(values[:, 0].sum(), points, create_graph=learns, retain_graph=True)
        return Geometry(values[:, 0], slope, values[:, 1:])

    def color(self, places: Tensor, directions: Tensor, normals: Tensor, features: Tensor) -> Tensor:
        """See ``Field``."""
        encoding = self.direction_share * encoded_directions(directions)
        inputs = torch.cat((features, places / self.region.radius, normals, encoding), dim=-1)
        color: Tensor = torch.sigmoid(self.head(inputs))
        return color

    @torch.no_grad()
    def lattice(self, axes: Sequence[Tensor]) -> Tensor:
        """See ``Field``."""
        places = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
        distances = [self._distance(part)[:, 0] for part in places.view(-1, 3).split(CHUNK)]
        return torch.cat(distances).view(places.shape[:-1])

    def _distance(self, places: Tensor) -> Tensor:
        """Distance and features [N, 1 + WIDTH] at places [N, 3], in the sphere of radius 1 that the network knows."""
        encoding = encoded(places / self.region.radius, PLACE_FREQUENCIES)
        hidden = encoding
        for k, layer in enumerate(self.layers):
            if k == SKIP:
                hidden = torch.cat((hidden, encoding), dim=-1) / math.sqrt(2)
            hidden = layer(hidden)
            if k < DEPTH:
                hidden = softplus(hidden, SOFTNESS)
        return torch.cat((self.region.radius * hidden[:, :1], hidden[:, 1:]), dim=-1)


def _distance_layers(radius: float, generator: torch.Generator) -> nn.ModuleList:
    """Layers that begin as the distance of a sphere (Gropp et al. 2020): positive outside."""
    encoded_width = 3 * (1 + 2 * PLACE_FREQUENCIES)
    layers = []
    for k in range(DEPTH + 1):
        inputs = encoded_width if k == 0 else WIDTH
        outputs = WIDTH + 1 if k == DEPTH else WIDTH - encoded_width if k + 1 == SKIP else WIDTH
        layer = nn.Linear(inputs, outputs)
        with torch.no_grad():
            noise = torch.randn(outputs, inputs, generator=generator)
            if k == DEPTH:
                layer.weight.copy_(math.sqrt(math.pi / inputs) + 1e-4 * noise)
                layer.bias.fill_(-radius)
            else:
                layer.weight.copy_(noise * math.sqrt(2 / outputs))
                layer.bias.zero_()
                if k == 0:
                    layer.weight[:, 3:] = 0
                elif k == SKIP:
                    layer.weight[:, -(encoded_width - 3) :] = 0
        layers.append(layer)
    return nn.ModuleList(layers)
