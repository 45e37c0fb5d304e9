"""The shading model: all that tells one way of making a picture of Gaussians from another.

A recipe holds one. Training, rendering, the viewer and the exports ask it for everything that depends on how light is
reflected, so that a new model is one new class, and nothing else changes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor

from polarguide import optics
from polarguide.core.errors import PolarguideError
from polarguide.gaussians.gaussians import Gaussians
from polarguide.gaussians.harmonics import evaluate_sh
from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import dot
from polarguide.shading.metal import metal_stokes
from polarguide.shading.result import Layout, MetalPixels, RenderResult

# Brightest light of an environment with the exponential scale: e^5, about 150 times display white.
MAXIMUM_LOG_LIGHT = 5.0
PLAIN_LAYERS = ("final", "normal", "depth", "alpha")

Channels = dict[str, Tensor]
"""Channels [N, C] of Gaussians by name, of a shading model."""
Light = Mapping[str, Tensor]
"""The learned light of a shading model: its parameters by name."""

Model = TypeVar("Model", bound="ShadingModel")


class Parameters(Protocol):
    """Per-Gaussian tensors by name: those in training, or a frozen copy of them."""

    def __getitem__(self, name: str, /) -> Tensor: ...
    def get(self, name: str, /) -> Tensor | None:
        """The tensor, or None if there is none of that name."""


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
        metal: what metals add to the picture, where that is known before; None: not yet.
    """

    features: Tensor
    alpha: Tensor
    layout: Layout
    metal: MetalPixels | None = None

    def __getitem__(self, name: str) -> Tensor:
        return self.features[..., self.layout.channels(name)]


class RadianceCubemap(NamedTuple):
    """A parameter of the light that is radiance from afar: it can be exported, turned and replaced.

    Attributes:
        name: name of the parameter, raw texels [6, R, R, 3].
        radiance: linear radiance of raw values, [..., 3].
        raw: the inverse, as far as raw values can hold the radiance.
    """

    name: str
    radiance: Callable[[Tensor], Tensor]
    raw: Callable[[Tensor], Tensor]


@dataclass(frozen=True, eq=False)
class PageShading:
    """Data by which an exported page shades Gaussians as the model does.

    Attributes:
        kind: the page's shaders are compiled with its name, in capitals, defined.
        values: per Gaussian, by the names of ``results.export.share.SLOTS``, [N, ...].
        light: cubemaps [6, R, R, C], the finest first.
        network: matrices [rows, columns] in the order in which the shaders read them.
        constants: further entries of the page's scene, plain JSON values.
        notes: sentences for whoever looks at the page.
    """

    kind: str
    values: Mapping[str, Tensor]
    light: Sequence[Tensor] = ()
    network: Sequence[Tensor] = ()
    constants: Mapping[str, Any] = field(default_factory=dict)
    notes: Sequence[str] = ()


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
    def parameters(self) -> Mapping[str, Parameter]:
        """Per-Gaussian tensors besides those that every recipe trains."""
        return {}

    @property
    def light_parameters(self) -> Mapping[str, Parameter]:
        """Parameters of the learned light; none: it has no light to learn."""
        return {}

    def initial_parameters(self, colors: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
        """The tensors of ``parameters`` before the first step, [N, ...].

        Args:
            colors: [N, 3] linear, of the first Gaussians. generator: of random numbers; the light draws from it next.
        """
        return {}

    def placed_parameters(self, far: Tensor) -> dict[str, Tensor]:
        """Initial parameters that depend on the positions of the first Gaussians; they replace ``initial_parameters``.

        Args:
            far: [N] bool, which of them lie farther away than the cameras (``gaussians.initialize.far_away``).
        """
        return {}

    def initial_light(self, generator: torch.Generator) -> dict[str, Tensor]:
        """The tensors of ``light_parameters`` before the first step."""
        return {}

    def strength(self, gaussians: Parameters) -> Tensor:
        """Reflection strength [N] in [0, 1]: what tells glossy from matte Gaussians (for normal propagation).

        Raises:
            PolarguideError: the model has none.
        """
        raise PolarguideError(
            "recipe",
            expected="a shading model with a reflection strength",
            found=type(self).__name__,
            remedy='Take the action "propagate_normals" out of the recipe, or define strength().',
        )

    @property
    def knows_metals(self) -> bool:
        """Whether Gaussians can be metals; then ``become_metal`` makes them."""
        return False

    @property
    def knows_indices(self) -> bool:
        """Whether Gaussians can have refractive indices of their own: ``index_offset``, what each adds to the run's."""
        return False

    def become_metal(
        self,
        gaussians: Gaussians,
        light: Light,
        metalness: Tensor,
        reflectance: Tensor,
        gain: Callable[[], float],
    ) -> None:
        """Change which Gaussians are metals, of a model that knows them.

        Args:
            metalness: [N], 0 to 1. reflectance: [N, 3] at normal incidence that new ones begin with.
            gain: by how much all light should be brighter, called when the first metals appear.
        """
        raise NotImplementedError

    # What it renders

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers in its pictures, as in ``shading.result.LAYERS``; with "specular" if it reflects."""
        return ("final", "base", "specular", "diffuse", "normal", "depth", "alpha")

    @property
    def reflects(self) -> bool:
        """Whether pictures have a specular layer."""
        return "specular" in self.layers

    @abstractmethod
    def channels(self, gaussians: Parameters, normals: Tensor, center: Tensor, degree: int) -> Channels:
        """Per Gaussian by name: ``color`` [N, 3], and what else is blended, each [N, C]; not ``normal`` or ``depth``.

        Args:
            normals: [N, 3] unit, world axes. center: [3] of the camera. degree: of the base color's harmonics, 0 to 3.
        """

    def channel_parameters(self, gaussians: Parameters) -> ChannelParameters | None:
        """The same as ``channels``, where it is the base color and no more than these; None: it is not."""
        return None

    @abstractmethod
    def shade(self, splatted: GBuffer, light: Light, camera: Camera) -> dict[str, Any]:
        """Layers of a picture by their names in ``RenderResult``; ``final`` at least. And ``metal``, where there is."""

    def shade_detached(
        self, splatted: GBuffer, light: Light, camera: Camera
    ) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """``shade``, and the layers ``specular`` and ``diffuse`` of a model that reflects without a gradient on the
        normals, other than by the light that metals mirror.
        """
        layers = self.shade(splatted, light, camera)
        if "specular" not in layers:
            return layers, {}
        parts = [splatted[name].detach() if name == "normal" else splatted[name] for name in splatted.layout]
        features = torch.cat(parts, dim=-1)
        again = self.shade(replace(splatted, features=features, metal=layers.get("metal")), light, camera)
        return layers, {name: again[name] for name in ("specular", "diffuse")}

    @property
    def smooth_dielectric(self) -> bool:
        """Whether ``predicted_stokes`` is that of a smooth dielectric, as here; False for a class with its own."""
        return type(self).predicted_stokes is ShadingModel.predicted_stokes

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

    # What exports need

    @property
    def radiance_cubemap(self) -> RadianceCubemap | None:
        """The light's radiance from afar; None where the light is not such a cubemap."""
        return None

    @property
    def local_note(self) -> str:
        """Layers that do not follow when the distant light is turned or replaced; empty: all follow."""
        return ""

    @abstractmethod
    def colors(self, gaussians: Parameters, light: Light, rays: Tensor, normals: Tensor) -> Tensor:
        """Linear colors [N, 3] of Gaussians shaded one by one, along unit rays [N, 3] at facing normals [N, 3]."""

    def diffuse_colors(self, gaussians: Parameters, rays: Tensor) -> Tensor:
        """Linear colors [N, 3] without reflections, along unit rays [N, 3]."""
        return harmonic_colors(gaussians, rays)

    def fields(self, gaussians: Parameters) -> dict[str, Tensor]:
        """Fields of a PLY of the Gaussians besides display colors, [N, ...] by name: linear harmonics."""
        return {"linear_dc": gaussians["sh_dc"], "linear_rest": gaussians["sh_rest"].flatten(1)}

    def page(self, gaussians: Parameters, light: Light) -> PageShading | None:
        """Data of an exported page; None where it has no shaders for the model (colors are then baked)."""
        return None


@dataclass(frozen=True)
class PlainShading(ShadingModel):
    """Plain 3D Gaussian splatting (Kerbl et al. 2023): the blended base color is the picture."""

    needs_normals: ClassVar[bool] = False

    @property
    def layers(self) -> tuple[str, ...]:
        """Without reflection there is one color."""
        return PLAIN_LAYERS

    def channels(self, gaussians: Parameters, normals: Tensor, center: Tensor, degree: int) -> Channels:
        """Base color [N, 3]."""
        return {"color": base_colors(gaussians, center, degree)}

    def channel_parameters(self, gaussians: Parameters) -> ChannelParameters | None:
        """Nothing but the color; None for a class with other channels."""
        return ChannelParameters() if type(self).channels is PlainShading.channels else None

    def shade(self, splatted: GBuffer, light: Light, camera: Camera) -> dict[str, Tensor]:
        """``final`` [H, W, 3]."""
        return {"final": splatted["color"]}

    def colors(self, gaussians: Parameters, light: Light, rays: Tensor, normals: Tensor) -> Tensor:
        """Base colors [N, 3]; see ``ShadingModel``."""
        return self.diffuse_colors(gaussians, rays)

    def page(self, gaussians: Parameters, light: Light) -> PageShading | None:
        """Harmonics alone."""
        return PageShading("plain", harmonic_values(gaussians))


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


def harmonic_values(gaussians: Parameters) -> dict[str, Tensor]:
    """The base color's harmonics as values of a page."""
    return {"color": gaussians["sh_dc"], "harmonics": gaussians["sh_rest"]}


def mirrored(rays: Tensor, normals: Tensor) -> Tensor:
    """Directions of rays [..., 3] after reflection at unit normals [..., 3]."""
    return rays - 2 * dot(rays, normals)[..., None] * normals
