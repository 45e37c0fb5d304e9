"""Surface properties: values of each Gaussian that a shading model learns, blends per pixel, and exports."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from polarguide.gaussians.gaussians import Parameters


class Parameter(NamedTuple):
    """A tensor that a shading model trains.

    Attributes:
        shape: shape of one Gaussian's values; of the whole tensor for a parameter of the light.
        rate: learning rate (Adam); with 0 it keeps its first values.
        reset_minimum: a reset of the opacities raises values to at least this; None: it leaves them.
    """

    shape: tuple[int, ...]
    rate: float
    reset_minimum: float | None = None


@dataclass(frozen=True)
class GltfTexture:
    """A texture of a glTF material that holds a surface property.

    Attributes:
        extension: name of the material extension that has the texture.
        texture: name of the texture in the extension.
        constants: further entries of the extension, such as the factor that readers multiply with the texture.
    """

    extension: str
    texture: str
    constants: Mapping[str, float] = field(default_factory=dict)


def _identity(values: Tensor) -> Tensor:
    return values


@dataclass(frozen=True)
class SurfaceProperty:
    """A property of surfaces, from its parameter to exported files.

    Attributes:
        name: name of the property in files, and of the splatted channels and the layer of a property in
            ``ShadingModel.added_surface``.
        parameter: name of the per-Gaussian tensor.
        channels: number of values of a Gaussian.
        activation: values of the parameter's raw numbers.
        inverse: raw numbers of values.
        initial: value before the first step.
        rate: learning rate of the parameter; with 0 it is not learned.
        reset_minimum: minimum of the raw numbers after a reset of the opacities; None: a reset leaves them.
        unit: unit of the values; "1" for a ratio.
        gltf: texture of a GLB that holds an added property with values in [0, 1]; None: no texture.
        slot: name of the value in an exported page's records, see ``results.export.share.SLOTS``; "": not on pages.
    """

    name: str
    parameter: str
    channels: int = 1
    activation: Callable[[Tensor], Tensor] = _identity
    inverse: Callable[[Tensor], Tensor] = _identity
    initial: float = 0.0
    rate: float = 0.0
    reset_minimum: float | None = None
    unit: str = "1"
    gltf: GltfTexture | None = None
    slot: str = ""

    @property
    def learned(self) -> Parameter:
        """Description of the parameter."""
        shape = () if self.channels == 1 else (self.channels,)
        return Parameter(shape, self.rate, self.reset_minimum)

    def first(self, count: int) -> Tensor:
        """Return the raw numbers of so many Gaussians before the first step."""
        return self.inverse(torch.full((count, *self.learned.shape), self.initial))

    def values(self, gaussians: Parameters) -> Tensor:
        """Return the values of the Gaussians, [N] or [N, channels]."""
        return self.activation(gaussians[self.parameter])
