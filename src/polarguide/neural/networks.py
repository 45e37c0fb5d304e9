"""The networks of the publication: distance 8 x 256, radiance 4 x 256 (GNeRP after NeuS; initialization of Gropp et al.
2020). Meant for a GPU: a step differentiates the distance twice.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from polarguide.neural.field import Field, Geometry, direction_width, encoded, encoded_directions, network
from polarguide.neural.recipe import FieldShape
from polarguide.neural.region import Region

DEPTH, WIDTH, SKIP = 8, 256, 4
PLACE_FREQUENCIES = 8
SOFTNESS = 100.0
CHUNK = 1 << 16


class NetworkField(Field):
    """Distances of a network of places with a skip connection, colors of another one.

    Args:
        region: where it lies. shape: of what it is made. generator: first values are drawn from.
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
            given = places.detach().requires_grad_()
            found = self._distance(given)
            (slope,) = torch.autograd.grad(found[:, 0].sum(), given, create_graph=learns, retain_graph=True)
        return Geometry(found[:, 0], slope, found[:, 1:])

    def color(self, places: Tensor, directions: Tensor, normals: Tensor, features: Tensor) -> Tensor:
        """See ``Field``."""
        seen = self.direction_share * encoded_directions(directions)
        given = torch.cat((features, places / self.region.radius, normals, seen), dim=-1)
        color: Tensor = torch.sigmoid(self.head(given))
        return color

    @torch.no_grad()
    def lattice(self, axes: Sequence[Tensor]) -> Tensor:
        """See ``Field``."""
        places = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
        found = [self._distance(part)[:, 0] for part in places.view(-1, 3).split(CHUNK)]
        return torch.cat(found).view(places.shape[:-1])

    def _distance(self, places: Tensor) -> Tensor:
        """Distance and features [N, 1 + WIDTH] at places [N, 3], in the sphere of radius 1 that the network knows."""
        given = encoded(places / self.region.radius, PLACE_FREQUENCIES)
        found = given
        for k, layer in enumerate(self.layers):
            if k == SKIP:
                found = torch.cat((found, given), dim=-1) / math.sqrt(2)
            found = layer(found)
            if k < DEPTH:
                found = softplus(found, SOFTNESS)
        return torch.cat((self.region.radius * found[:, :1], found[:, 1:]), dim=-1)


def _distance_layers(radius: float, generator: torch.Generator) -> nn.ModuleList:
    """Layers that begin as the distance of a sphere (Gropp et al. 2020): positive outside."""
    given = 3 * (1 + 2 * PLACE_FREQUENCIES)
    layers = []
    for k in range(DEPTH + 1):
        inputs = given if k == 0 else WIDTH
        outputs = WIDTH + 1 if k == DEPTH else WIDTH - given if k + 1 == SKIP else WIDTH
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
                    layer.weight[:, -(given - 3) :] = 0
        layers.append(layer)
    return nn.ModuleList(layers)
