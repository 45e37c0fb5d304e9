"""Surface properties: values of each Gaussian that a shading model learns, blends per pixel and exports."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from polarguide.gaussians.gaussians import Parameters, any_nonzero


class RadianceCubemap(NamedTuple):
    """Parameter of the light that represents radiance from distant surroundings.

    Such light can be exported, rotated and replaced.

    Attributes:
        name: name of the parameter, raw texels [6, R, R, 3].
        radiance: function from raw values to linear radiance, [..., 3].
        raw: inverse of ``radiance``, limited to the range of raw values.
        note: text about light that does not change when this light is rotated or replaced. Empty if all light changes.
    """

    name: str
    radiance: Callable[[Tensor], Tensor]
    raw: Callable[[Tensor], Tensor]
    note: str = ""


class Parameter(NamedTuple):
    """Description of a tensor that a shading model adds to the training.

    Attributes:
        shape: shape of the values of one Gaussian, or of the whole tensor for a parameter of the light.
        rate: learning rate of Adam. With 0 the tensor keeps its first values.
        reset_minimum: lower bound of the values after a reset of the opacities. None means no bound.
        radiance: meaning of a parameter of the light that is a cubemap of distant radiance, for relighting and export.
            None for all other parameters.
    """

    shape: tuple[int, ...]
    rate: float
    reset_minimum: float | None = None
    radiance: RadianceCubemap | None = None


@dataclass(frozen=True)
class GltfTexture:
    """Texture of a glTF material that holds a surface property.

    Attributes:
        extension: name of the glTF extension that defines the texture.
        texture: name of the texture in the extension.
        constants: other entries of the extension, such as the factor of the texture.
    """

    extension: str
    texture: str
    constants: Mapping[str, float] = field(default_factory=dict)


def _identity(values: Tensor) -> Tensor:
    return values


@dataclass(frozen=True)
class SurfaceProperty:
    """Surface property of a shading model, such as its reflection strength.

    It describes how the property is learned, blended per pixel, and exported to files.

    Attributes:
        name: name of the property in splatted channels, layers and files.
        parameter: name of the per-Gaussian tensor.
        channels: number of values of a Gaussian.
        activation: function from the raw numbers of the parameter to values.
        inverse: function from values to raw numbers.
        initial: value before the first step.
        rate: learning rate of the parameter. With 0 it is not learned.
        reset_minimum: lower bound of the raw numbers after a reset of the opacities. None means no bound.
        gltf: texture of a GLB file that holds the property, with values in [0, 1]. None means no texture.
        weight: name of an untrained parameter by which the values are multiplied before they are splatted. If it is 0
            for all Gaussians, the property is not splatted. If it names the property's own parameter, values are not
            multiplied. An empty name means no weight.
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
        """Return the values to splat, [N, channels], or None if the weight is 0 for all Gaussians."""
        if self.weight and not any_nonzero(gaussians, self.weight):
            return None
        values = self.values(gaussians).reshape(-1, self.channels)
        if self.weight == self.parameter:
            return values.detach()
        return gaussians[self.weight].detach()[:, None] * values if self.weight else values


def surface_channels(properties: Iterable[SurfaceProperty], gaussians: Parameters) -> dict[str, Tensor]:
    """Return the values [N, C] to splat for each surface property, by name.

    Properties whose weight is 0 for all Gaussians are left out.
    """
    channels = {row.name: row.splatted(gaussians) for row in properties}
    return {name: values for name, values in channels.items() if values is not None}
