"""Surface properties: values of each Gaussian that a shading model learns, blends per pixel and exports."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from polarguide.gaussians.gaussians import Parameters, any_nonzero


class Parameter(NamedTuple):
    """Tensor that a shading model trains.

    Attributes:
        shape: shape of the values of one Gaussian, or of the whole tensor for a parameter of the light.
        rate: learning rate of Adam; with 0 the tensor keeps its first values.
        reset_minimum: lower bound of the values after a reset of the opacities; None: no bound.
    """

    shape: tuple[int, ...]
    rate: float
    reset_minimum: float | None = None


@dataclass(frozen=True)
class GltfTexture:
    """Texture of a glTF material that holds a surface property.

    Attributes:
        extension: name of the material extension that has the texture.
        texture: name of the texture in the extension.
        constants: further entries of the extension, such as the factor of the texture.
    """

    extension: str
    texture: str
    constants: Mapping[str, float] = field(default_factory=dict)


def _identity(values: Tensor) -> Tensor:
    return values


@dataclass(frozen=True)
class SurfaceProperty:
    """Property of surfaces, from its parameter to exported files.

    Attributes:
        name: name of the splatted channels, of the layer and of the field in files.
        parameter: name of the per-Gaussian tensor.
        channels: number of values of a Gaussian.
        activation: function from the raw numbers of the parameter to values.
        inverse: function from values to raw numbers.
        initial: value before the first step.
        rate: learning rate of the parameter; with 0 it is not learned.
        reset_minimum: lower bound of the raw numbers after a reset of the opacities; None: no bound.
        gltf: texture of a GLB that holds the property, with values in [0, 1]; None: no texture.
        weight: name of a parameter that is not learned and multiplies the splatted values. If it is 0 everywhere, the
            property is not splatted. The property's own parameter multiplies nothing. "": no weight.
    """

    name: str
    parameter: str
    channels: int = 1
    activation: Callable[[Tensor], Tensor] = _identity
    inverse: Callable[[Tensor], Tensor] = _identity
    initial: float = 0.0
    rate: float = 0.0
    reset_minimum: float | None = None
    gltf: GltfTexture | None = None
    weight: str = ""

    @property
    def learned(self) -> Parameter:
        """Description of the parameter."""
        shape = () if self.channels == 1 else (self.channels,)
        return Parameter(shape, self.rate, self.reset_minimum)

    def first(self, count: int) -> Tensor:
        """Return the raw numbers of ``count`` Gaussians before the first step."""
        return self.inverse(torch.full((count, *self.learned.shape), self.initial))

    def values(self, gaussians: Parameters) -> Tensor:
        """Return the values of the Gaussians, [N] or [N, channels]."""
        return self.activation(gaussians[self.parameter])

    def splatted(self, gaussians: Parameters) -> Tensor | None:
        """Return the splatted values [N, channels]; None if the weight is 0 everywhere."""
        if self.weight and not any_nonzero(gaussians, self.weight):
            return None
        values = self.values(gaussians).reshape(-1, self.channels)
        if self.weight == self.parameter:
            return values.detach()
        return gaussians[self.weight].detach()[:, None] * values if self.weight else values


def surface_channels(properties: Iterable[SurfaceProperty], gaussians: Parameters) -> dict[str, Tensor]:
    """Return the splatted values [N, C] of surface properties by name, without those whose weight is 0 everywhere."""
    channels = {row.name: row.splatted(gaussians) for row in properties}
    return {name: values for name, values in channels.items() if values is not None}
