"""The shading model: all that tells one way of making a picture of Gaussians from another.

A recipe holds one. Training, rendering, the viewer and the exports ask it for everything that depends on how light is
reflected, so that a new model is one new class, and nothing else changes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, TypeVar

import torch
from torch import Tensor

from polarguide import optics
from polarguide.core.errors import PolarguideError
from polarguide.gaussians.gaussians import Parameters as Parameters
from polarguide.gaussians.geometry import mirrored_directions
from polarguide.gaussians.harmonics import evaluate_sh
from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import dot
from polarguide.shading.metal import metal_stokes
from polarguide.shading.result import Layout, MetalPixels, RenderResult
from polarguide.shading.surface import Parameter as Parameter
from polarguide.shading.surface import SurfaceProperty

# Brightest light of an environment with the exponential scale: e^5, about 150 times display white.
MAXIMUM_LOG_LIGHT = 5.0
PLAIN_LAYERS = ("final", "normal", "depth", "alpha")

Channels = dict[str, Tensor]
"""Channels [N, C] of Gaussians by name, of a shading model."""
Light = Mapping[str, Tensor]
"""The learned light of a shading model: its parameters by name."""

Model = TypeVar("Model", bound="ShadingModel")


class ChannelParameters(NamedTuple):
    """The parameters behind a shading model's channels, for the native pass; None ones are absent.

    Attributes:
        strength_logits: [N] raw reflection strength.
        light_dc, light_rest: [N, 3] and [N, 15, 3] harmonics of the mirrored direction: light of the Gaussians' own.
        metalness: [N] 1 of those without color and strength, else 0; without a gradient.
        further: channels behind these by name, each [N, C], as they are.
    """

    strength_logits: Tensor | None = None
    light_dc: Tensor | None = None
    light_rest: Tensor | None = None
    metalness: Tensor | None = None
    further: Mapping[str, Tensor] = MappingProxyType({})

    @property
    def widths(self) -> dict[str, int]:
        """Number of the channels by name, in order."""
        own = {} if self.strength_logits is None else {"strength": 1}
        local = {} if self.light_dc is None else {"local": 3}
        return {**own, **local, **{name: values.shape[1] for name, values in self.further.items()}}


@dataclass(frozen=True, eq=False)
class GBuffer:
    """Splatted channels of a picture that is shaded afterwards; ``splatted["strength"]`` are channels by name.

    Attributes:
        features: [H, W, D] all channels, blended: ``color``, ``normal`` (world axes, not normalized), and others.
        alpha: [H, W].
        layout: which channels are what.
        metal: contribution of metals to the picture, where it was computed before; None: not yet.
        detached: whether ``shade`` returns ``detached_specular`` and ``detached_diffuse`` as well, without a gradient
            on the normals. A model may ignore it; ``gbuffer.shaded`` then shades twice.
    """

    features: Tensor
    alpha: Tensor
    layout: Layout
    metal: MetalPixels | None = None
    detached: bool = False

    def __getitem__(self, name: str) -> Tensor:
        return self.features[..., self.layout.channels(name)]


class RadianceCubemap(NamedTuple):
    """A parameter of the light that is radiance from afar: it can be exported, turned and replaced.

    Attributes:
        name: name of the parameter, raw texels [6, R, R, 3].
        radiance: linear radiance of raw values, [..., 3].
        raw: the inverse, as far as raw values can hold the radiance.
        note: sentences on light that does not follow when this light is turned or replaced; empty: all light does.
    """

    name: str
    radiance: Callable[[Tensor], Tensor]
    raw: Callable[[Tensor], Tensor]
    note: str = ""


@dataclass(frozen=True)
class ShadingModel(ABC):
    """How a recipe shades: what it learns, what it splats, and how it makes the picture of it.

    Subclasses are frozen dataclasses. Their fields are part of the recipe and are recorded in a run's folder; the
    refractive index is the run's own, see ``bind``.

    Attributes:
        refractive_index: refractive index of all surfaces.
    """

    refractive_index: float = field(default=1.5, kw_only=True)

    stream: ClassVar[int] = 6
    """Which of a seed's sequences of random numbers the first values are drawn from."""

    needs_normals: ClassVar[bool] = True
    """Whether shading reads the normals, so that they are always splatted."""

    smooth_dielectric: ClassVar[bool] = True
    """True if ``predicted_stokes`` is that of a smooth dielectric, for which there is a native kernel."""

    def __init_subclass__(cls) -> None:
        """Check that methods and kernels agree: whoever replaces a method states what its kernel is.

        Raises:
            TypeError: ``channels`` was replaced, but not the ``channel_parameters`` that stand for it.
        """
        super().__init_subclass__()
        own = vars(cls)
        if "predicted_stokes" in own and "smooth_dielectric" not in own:
            cls.smooth_dielectric = False
        described = cls.channel_parameters is not ShadingModel.channel_parameters
        if "channels" in own and "channel_parameters" not in own and described:
            raise TypeError(
                f"{cls.__name__}: replace channel_parameters() with channels(); it returns None without kernels"
            )

    def bind(self: Model, refractive_index: float) -> Model:
        """A copy of the model with its refractive index set to ``refractive_index``.

        Raises:
            ValueError: the refractive index is 1 or less.
        """
        if not refractive_index > 1:
            raise ValueError(f"refractive index: expected more than 1, found {refractive_index}")
        return replace(self, refractive_index=refractive_index)

    def data(self) -> dict[str, Any]:
        """The class's name and all fields of the recipe, for a run's folder; plain JSON values."""
        values = asdict(self)
        del values["refractive_index"]
        return {"model": type(self).__name__, **values}

    # What is learned

    @property
    def added_surface(self) -> tuple[SurfaceProperty, ...]:
        """Surface properties of a model derived from another; they need no code of their own, see ``surface``."""
        return ()

    @property
    def surface(self) -> tuple[SurfaceProperty, ...]:
        """Surface properties; their parameters and first values are those of the model."""
        return self.added_surface

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """Per-Gaussian tensors besides those that every recipe trains: those of the surface properties."""
        return {row.parameter: row.learned for row in self.surface}

    @property
    def light_parameters(self) -> Mapping[str, Parameter]:
        """Parameters of the learned light; none: it has no light to learn."""
        return {}

    def initialize(
        self, colors: Tensor, far: Tensor, generator: torch.Generator
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Return the tensors of ``parameters`` [N, ...] and of ``light_parameters`` before the first step.

        Here parameters of the surface have their first values, and others are 0.

        Args:
            colors: [N, 3] linear colors of the first Gaussians.
            far: [N] bool, Gaussians that lie farther away than the cameras (``gaussians.initialize.far_away``).
            generator: generator of random numbers.
        """
        count = len(colors)
        zeros = {name: torch.zeros(count, *own.shape) for name, own in self.parameters.items()}
        return zeros | {row.parameter: row.first(count) for row in self.surface}, {}

    def strength(self, gaussians: Parameters) -> Tensor:
        """Reflection strength [N] in [0, 1], which tells glossy from matte Gaussians: the property "strength".

        Raises:
            PolarguideError: the model has no such property.
        """
        for row in self.surface:
            if row.name == "strength":
                return row.values(gaussians)
        raise PolarguideError(
            "recipe",
            expected="a shading model with a reflection strength",
            found=type(self).__name__,
            remedy='Take the action "propagate_normals" out of the recipe, or define strength().',
        )

    # What it renders

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers in its pictures, as in ``shading.result.LAYERS``; with "specular" if it reflects."""
        return ("final", "base", "specular", "diffuse", "normal", "depth", "alpha")

    @property
    def reflects(self) -> bool:
        """Whether pictures have a specular layer."""
        return "specular" in self.layers

    def channel_parameters(self, gaussians: Parameters) -> ChannelParameters | None:
        """Parameters behind the channels, for which there are native kernels; None: ``channels`` has its own code."""
        return None

    def channels(self, gaussians: Parameters, normals: Tensor, center: Tensor, degree: int) -> Channels:
        """Per Gaussian by name: ``color`` [N, 3], and further blended values [N, C], without ``normal`` and ``depth``.

        Here they are computed from ``channel_parameters``.

        Args:
            normals: [N, 3] unit, world axes. center: [3] of the camera. degree: of the base color's harmonics, 0 to 3.
        """
        described = self.channel_parameters(gaussians)
        if described is None:
            raise NotImplementedError(f"{type(self).__name__}: channels() or channel_parameters()")
        channels = {"color": base_colors(gaussians, center, degree)}
        if described.strength_logits is not None:
            channels["strength"] = torch.sigmoid(described.strength_logits)[:, None]
        if described.metalness is not None:
            body = 1 - described.metalness[:, None]
            channels = {name: values * body for name, values in channels.items()}
        if described.light_dc is not None:
            directions = mirrored_directions(gaussians["means"], center, normals)
            channels["local"] = local_light(gaussians, directions, degree)
        return channels | dict(described.further)

    @abstractmethod
    def shade(self, splatted: GBuffer, light: Light, camera: Camera) -> dict[str, Any]:
        """Return layers by their names in ``RenderResult``, at least ``final``; ``metal`` where there are metals."""

    def predicted_stokes(self, result: RenderResult, camera: Camera) -> Tensor:
        """Stokes vectors [3, H, W, 3] of a rendered picture; here of a smooth dielectric.

        Args:
            result: with the specular and diffuse layers and the normal.
        """
        normal = result.shaded_normal
        own = result.layers.get("index")
        stokes = optics.predicted_stokes(
            2 * result.layers["specular"],
            2 * result.layers["diffuse"],
            camera.to_camera(normal),
            camera.rays(device=normal.device),
            self.refractive_index if own is None else own,
        )
        if result.metal is None:
            return stokes
        index = self.refractive_index if own is None else own.flatten()[result.metal.pixels]
        metal = metal_stokes(
            result.layers["specular"], result.layers["diffuse"], normal, result.metal, camera, index
        )
        return stokes.flatten(1, 2).index_copy(1, result.metal.pixels, metal).view_as(stokes)

    # Colors of single Gaussians, and light that can be exported

    @property
    def radiance_cubemap(self) -> RadianceCubemap | None:
        """The light's radiance from afar; None where the light is not such a cubemap."""
        return None

    @abstractmethod
    def colors(self, gaussians: Parameters, light: Light, rays: Tensor, normals: Tensor) -> Tensor:
        """Linear colors [N, 3] of Gaussians shaded one by one, along unit rays [N, 3] at facing normals [N, 3]."""

    def diffuse_colors(self, gaussians: Parameters, rays: Tensor) -> Tensor:
        """Linear colors [N, 3] without reflections, along unit rays [N, 3]."""
        return harmonic_colors(gaussians, rays)


@dataclass(frozen=True)
class PlainShading(ShadingModel):
    """Plain 3D Gaussian splatting (Kerbl et al. 2023): the blended base color is the picture."""

    needs_normals: ClassVar[bool] = False

    @property
    def layers(self) -> tuple[str, ...]:
        """Without reflection there is one color."""
        return PLAIN_LAYERS

    def channel_parameters(self, gaussians: Parameters) -> ChannelParameters | None:
        """The color alone."""
        return ChannelParameters()

    def shade(self, splatted: GBuffer, light: Light, camera: Camera) -> dict[str, Tensor]:
        """``final`` [H, W, 3]."""
        return {"final": splatted["color"]}

    def colors(self, gaussians: Parameters, light: Light, rays: Tensor, normals: Tensor) -> Tensor:
        """Base colors [N, 3]; see ``ShadingModel``."""
        return self.diffuse_colors(gaussians, rays)


PLAIN = PlainShading()


def base_colors(gaussians: Parameters, center: Tensor, sh_degree: int) -> Tensor:
    """Linear base colors [N, 3] toward a camera center [3], not negative."""
    sh = evaluate_sh(gaussians["means"], center, gaussians["sh_dc"], gaussians["sh_rest"], sh_degree)
    return (sh + 0.5).clamp(min=0)


def harmonic_colors(gaussians: Parameters, rays: Tensor) -> Tensor:
    """Linear base colors [N, 3] along unit rays [N, 3], of degree 3, not negative."""
    origin = rays.new_zeros(3)
    return (evaluate_sh(rays, origin, gaussians["sh_dc"], gaussians["sh_rest"], 3) + 0.5).clamp(min=0)


def local_light(gaussians: Parameters, directions: Tensor, sh_degree: int) -> Tensor:
    """Light [N, 3] that each Gaussian adds from a mirrored direction; can be negative.

    Args:
        gaussians: with ``local_dc`` and ``local_rest``, harmonics of the mirrored direction.
        directions: [N, 3] unit, of the mirrored rays. sh_degree: as for the base color.

    Returns:
        [N, 3], differentiable in the harmonics alone.
    """
    directions = directions.detach()
    origin = directions.new_zeros(3)
    return evaluate_sh(directions, origin, gaussians["local_dc"], gaussians["local_rest"], sh_degree)


def mirrored(rays: Tensor, normals: Tensor) -> Tensor:
    """Directions of rays [..., 3] after reflection at unit normals [..., 3]."""
    return rays - 2 * dot(rays, normals)[..., None] * normals
