"""Interface of shading models, which compute a picture from Gaussians and learned light.

A recipe has one shading model. All computations that depend on the reflection of light are members of its class.
Training, rendering, the viewer and the exports use these members. A new shading model is therefore a single new class.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from polarguide.gaussians.gaussians import Parameters as Parameters
from polarguide.gaussians.geometry import mirrored_directions
from polarguide.gaussians.harmonics import evaluate_sh
from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import dot
from polarguide.shading.metal import layer_stokes
from polarguide.shading.result import ChannelSlices, MetalPixels, RenderResult
from polarguide.shading.surface import Parameter as Parameter
from polarguide.shading.surface import RadianceCubemap as RadianceCubemap
from polarguide.shading.surface import SurfaceProperty, surface_channels

MAXIMUM_LOG_LIGHT = 5.0
"""Logarithm of the largest radiance of an exponential scale: e^5, about 150 times display white."""
PLAIN_LAYERS = ("final", "normal", "depth", "alpha")
"""Layers of a model without reflection."""

Light = Mapping[str, Tensor]
"""The learned light of a shading model: parameters by name."""


class Channels(NamedTuple):
    """Channels of Gaussians that are splatted to a G-buffer.

    All attributes except ``color`` and ``further`` are parameters, from which a native pass computes the channels.

    Attributes:
        color: [N, 3] linear color. With None, the harmonics of the base color are evaluated. A color requires the
            reference implementation.
        strength_logits: [N] raw reflection strength.
        light_dc, light_rest: [N, 3] and [N, 15, 3] harmonics of the local light, a function of the mirrored direction.
        metalness: [N] in [0, 1], without a gradient. Color and strength are multiplied by 1 - metalness.
        further: additional channels [N, C] by name, which follow the other channels.
    """

    color: Tensor | None = None
    strength_logits: Tensor | None = None
    light_dc: Tensor | None = None
    light_rest: Tensor | None = None
    metalness: Tensor | None = None
    further: Mapping[str, Tensor] = MappingProxyType({})

    @property
    def widths(self) -> dict[str, int]:
        """Number of channels by name, in order, without the color."""
        own = {} if self.strength_logits is None else {"strength": 1}
        local = {} if self.light_dc is None else {"local": 3}
        return {**own, **local, **{name: values.shape[1] for name, values in self.further.items()}}

    def values(
        self, gaussians: Parameters, normals: Tensor, center: Tensor, degree: int
    ) -> dict[str, Tensor]:
        """Return the channels [N, C] by name.

        This is the reference implementation of the native pass.

        Args:
            gaussians: the Gaussians.
            normals: [N, 3] unit normals, world axes.
            center: [3] camera center.
            degree: degree of the harmonics, 0 to 3.
        """
        color = base_colors(gaussians, center, degree) if self.color is None else self.color
        channels = {"color": color}
        if self.strength_logits is not None:
            channels["strength"] = torch.sigmoid(self.strength_logits)[:, None]
        if self.metalness is not None:
            body = 1 - self.metalness[:, None]
            channels = {name: values * body for name, values in channels.items()}
        if self.light_dc is not None and self.light_rest is not None:
            directions = mirrored_directions(gaussians["means"], center, normals).detach()
            origin = torch.zeros_like(center)
            channels["local"] = evaluate_sh(directions, origin, self.light_dc, self.light_rest, degree)
        return channels | dict(self.further)


@dataclass(frozen=True, eq=False)
class GBuffer:
    """Splatted channels of a picture before shading; ``splatted["strength"]`` returns channels by name.

    Attributes:
        features: [H, W, D] blended channels: ``color``, ``normal`` (world axes, not normalized), and others.
        alpha: [H, W].
        layout: channels by name.
        metal: contribution of metals to the picture, if it was computed before.
        detached: True if ``shade`` also returns ``detached_specular`` and ``detached_diffuse``, without a gradient on
            the normals. If the model ignores it, ``gbuffer.shaded`` shades twice.
    """

    features: Tensor
    alpha: Tensor
    layout: ChannelSlices
    metal: MetalPixels | None = None
    detached: bool = False

    def __getitem__(self, name: str) -> Tensor:
        return self.features[..., self.layout[name]]

    def mean(self, name: str) -> Tensor:
        """Return the mean of a channel over the Gaussians of each pixel: [H, W], or [H, W, C] for several channels.

        Pixels without Gaussians are 0.
        """
        mean = self[name] / self.alpha.detach().clamp(min=1e-6)[..., None]
        return mean[..., 0] if mean.shape[-1] == 1 else mean


@dataclass(frozen=True)
class ShadingModel(ABC):
    """Base class of shading models: learned parameters, splatted channels, and the computation of pictures.

    Subclasses are frozen dataclasses. Their fields are part of the recipe and are recorded in the run folder.

    Attributes:
        refractive_index: refractive index of all surfaces. It belongs to the run, not to the recipe.

    Raises:
        ValueError: the refractive index is 1 or less.
    """

    refractive_index: float = field(default=1.5, kw_only=True)

    stream: ClassVar[int] = 6
    """Index of the random stream from which initial values are drawn."""

    def __post_init__(self) -> None:
        if not self.refractive_index > 1:
            raise ValueError(f"refractive index: expected more than 1, found {self.refractive_index}")

    # Parameters

    @property
    def surface(self) -> tuple[SurfaceProperty, ...]:
        """Surface properties. Parameters, first values and channels follow from them."""
        return ()

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """Per-Gaussian tensors in addition to geometry and base color.

        By default, they follow from the surface properties.
        """
        return {row.parameter: row.learned for row in self.surface}

    @property
    def light_parameters(self) -> Mapping[str, Parameter]:
        """Parameters of the learned light; by default no light is learned."""
        return {}

    def initialize(
        self, colors: Tensor, far: Tensor, generator: torch.Generator
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Return the tensors of ``parameters`` [N, ...] and of ``light_parameters`` before the first step.

        By default surface properties have their initial values, and other parameters are 0.

        Args:
            colors: [N, 3] linear colors of the first Gaussians.
            far: [N] bool, Gaussians farther away than the cameras (``gaussians.initialize.far_away``).
            generator: generator of random numbers.
        """
        count = len(colors)
        zeros = {name: torch.zeros(count, *own.shape) for name, own in self.parameters.items()}
        return zeros | {row.parameter: row.first(count) for row in self.surface}, {}

    # Pictures

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers in pictures, from ``shading.result.LAYERS``.

        They contain "specular" if the model reflects. In this case, normals are always splatted.
        """
        return ("final", "base", "specular", "diffuse", "normal", "depth", "alpha")

    def channels(self, gaussians: Parameters, center: Tensor, degree: int) -> Channels:
        """Return the channels to splat, apart from normal and depth.

        By default, these are base color and surface properties.

        Args:
            gaussians: the Gaussians, with the parameters of the model.
            center: [3] camera center.
            degree: degree of the base color's harmonics, 0 to 3.
        """
        return Channels(further=surface_channels(self.surface, gaussians))

    @abstractmethod
    def shade(self, splatted: GBuffer, light: Light, camera: Camera) -> dict[str, Any]:
        """Shade a G-buffer, and return its layers by name.

        The result contains at least ``final``, and ``metal`` if there are metals.
        """

    def predicted_stokes(self, result: RenderResult, camera: Camera) -> Tensor:
        """Predict the Stokes vectors [3, H, W, 3] of a rendered picture.

        By default, surfaces are smooth dielectrics and metals. Only this default has a native kernel.

        Args:
            result: picture with the specular and diffuse layers and the normal.
            camera: camera of the picture.
        """
        return layer_stokes(result, camera, self.refractive_index)


@dataclass(frozen=True)
class PlainShading(ShadingModel):
    """Plain 3D Gaussian splatting (Kerbl et al. 2023): the blended base color is the picture."""

    @property
    def layers(self) -> tuple[str, ...]:
        """The picture, without layers of reflection."""
        return PLAIN_LAYERS

    def shade(self, splatted: GBuffer, light: Light, camera: Camera) -> dict[str, Tensor]:
        """Return ``final`` [H, W, 3]."""
        return {"final": splatted["color"]}


PLAIN = PlainShading()
"""Shading of stages without reflection."""


def radiance_cubemap(shading: ShadingModel) -> RadianceCubemap | None:
    """Return the cubemap of distant light of a model, or None if the model has no such cubemap."""
    cubemaps = (parameter.radiance for parameter in shading.light_parameters.values())
    return next((cubemap for cubemap in cubemaps if cubemap is not None), None)


def base_colors(gaussians: Parameters, center: Tensor, sh_degree: int) -> Tensor:
    """Return linear base colors [N, 3] toward a camera center [3], not negative."""
    sh = evaluate_sh(gaussians["means"], center, gaussians["sh_dc"], gaussians["sh_rest"], sh_degree)
    return (sh + 0.5).clamp(min=0)


def mirrored(rays: Tensor, normals: Tensor) -> Tensor:
    """Return directions of rays [..., 3] after reflection at unit normals [..., 3]."""
    return rays - 2 * dot(rays, normals)[..., None] * normals
