"""Deferred reflection per pixel of a learned environment (3DGS-DR, Ye et al. 2024), or Fresnel-weighted."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from polarguide import optics
from polarguide.core.native import fits
from polarguide.gaussians.gaussians import Gaussians
from polarguide.gaussians.geometry import mirrored_directions
from polarguide.geometry.camera import Camera
from polarguide.optics import reflectances_from_cosine
from polarguide.shading.cubemap import cubemap_lookup, mip_lookup
from polarguide.shading.metal import (
    FIRST_REFLECTANCE,
    any_nonzero,
    convert,
    metal_channels,
    metal_pixels,
    metalness_picture,
    mirror_base,
    reflectance,
    reflectance_logits,
    scale_light,
    with_metal,
)
from polarguide.shading.model import (
    MAXIMUM_LOG_LIGHT,
    ChannelParameters,
    Channels,
    GBuffer,
    Light,
    PageShading,
    Parameter,
    Parameters,
    RadianceCubemap,
    ShadingModel,
    base_colors,
    harmonic_colors,
    harmonic_values,
    local_light,
    mirrored,
)
from polarguide.shading.native import reflect_arguments, reflect_reference, shade_native
from polarguide.shading.result import LAYERS
from polarguide.shading.roughness import LEVELS, blended_roughness, ggx_alpha, gltf_roughness, light_levels

Blend = Literal["lerp", "fresnel"]
RESET_STRENGTH = 1e-3
_NO_LIGHT = 1e-4  # radiance of black, so that its logarithm is finite
LOCAL_NOTE = (
    "Turning the environment turns what is reflected from afar. What stands near is reflected by the Gaussians "
    "themselves, which stay as they are."
)
INDEX_NOTE = "Surfaces of several refractive indices are drawn with one that reflects as much at 45 degrees."


@dataclass(frozen=True)
class DeferredShading(ShadingModel):
    """How base color and reflection make the picture.

    Attributes:
        blend: "lerp": final = (1 - r) base + r sigmoid(environment), as in 3DGS-DR (Ye et al. 2024, Eq. 5);
            "fresnel": final = base + r F(i) exp(environment), with F the unpolarized power reflectance of a
            dielectric at the angle between ray and normal, so that strength can be a property of the surface.
        local: whether Gaussians add light of their own to the environment's, a function of the mirrored direction:
            what stands near, and what the far environment cannot say.
        first_strength: reflection strength that Gaussians start with.
        strength_rate: learning rate of the strengths.
        local_rate: learning rate of the Gaussians' own light of degree 0; that of higher degrees is a twentieth.
        environment_spread: first raw texels are uniform in plus or minus this.
        environment_rate: learning rate of the texels.
        environment_resolution: texels along a cube face's side.
        rough: whether dielectrics have a roughness, too, or metals alone; with the blend "fresnel".
        first_roughness: that Gaussians begin with, in (0, 1). roughness_rate: its learning rate.
        metal: whether Gaussians can be metals, see ``shading.metal``; with the blend "fresnel".
        indices: whether Gaussians can have refractive indices of their own (never learned); with the blend "fresnel".
        metal_rate: learning rate of their reflectance.

    With the blend "fresnel" light is read from box-filtered levels of the radiance: at that of a
    pixel's roughness, see ``shading.roughness``.
    """

    blend: Blend = "lerp"
    local: bool = False
    first_strength: float = 1e-3
    strength_rate: float = 6e-3
    local_rate: float = 2.5e-3
    environment_spread: float = 5.0
    environment_rate: float = 0.05
    environment_resolution: int = 128
    rough: bool = False
    first_roughness: float = 0.1
    roughness_rate: float = 0.01
    metal: bool = False
    metal_rate: float = 0.01
    indices: bool = False

    stream: ClassVar[int] = 1

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """``strength_logits``; with ``local`` harmonics of the mirrored direction; with ``metal`` its two; with
        ``rough`` or ``metal`` ``roughness_logits``; with ``indices`` what is added to the refractive index.
        """
        minimum = float(torch.logit(torch.tensor(RESET_STRENGTH, dtype=torch.float64)))
        own = {"strength_logits": Parameter((), self.strength_rate, minimum)}
        if self.local:
            own["local_dc"] = Parameter((3,), self.local_rate)
            own["local_rest"] = Parameter((15, 3), self.local_rate / 20)
        if self.metal:
            own["metalness"] = Parameter((), 0.0)
            own["reflectance_logits"] = Parameter((3,), self.metal_rate)
        if self.rough or self.metal:
            own["roughness_logits"] = Parameter((), self.roughness_rate)
        return own | ({"index_offset": Parameter((), 0.0)} if self.indices else {})

    @property
    def light_parameters(self) -> Mapping[str, Parameter]:
        """``texels`` [6, R, R, 3]."""
        side = self.environment_resolution
        return {"texels": Parameter((6, side, side, 3), self.environment_rate)}

    def initial_parameters(self, colors: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
        """The same strength everywhere, no light of the Gaussians' own, and no metal."""
        zeros = {
            name: torch.zeros(len(colors), *parameter.shape) for name, parameter in self.parameters.items()
        }
        logit = torch.logit(torch.tensor(self.first_strength))
        first = {**zeros, "strength_logits": logit.expand(len(colors)).clone()}
        if self.metal:
            first["reflectance_logits"] = reflectance_logits(torch.full((len(colors), 3), FIRST_REFLECTANCE))
        if "roughness_logits" in first:
            first["roughness_logits"] = torch.logit(torch.full((len(colors),), self.first_roughness))
        return first

    def initial_light(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Uniform texels."""
        uniform = torch.rand(self.light_parameters["texels"].shape, generator=generator) * 2 - 1
        return {"texels": uniform * self.environment_spread}

    def strength(self, gaussians: Parameters) -> Tensor:
        """Reflection strength [N] in [0, 1]."""
        return torch.sigmoid(gaussians["strength_logits"])

    @property
    def layers(self) -> tuple[str, ...]:
        """All, ``metalness`` if there can be metals, ``roughness`` if there is some."""
        absent = {"metalness": not self.metal, "roughness": not (self.rough or self.metal)}
        return tuple(name for name in LAYERS if not absent.get(name))

    def radiance(self, texels: Tensor) -> Tensor:
        """Radiance of raw texel values."""
        return (
            torch.sigmoid(texels) if self.blend == "lerp" else torch.exp(texels.clamp(max=MAXIMUM_LOG_LIGHT))
        )

    def raw_texels(self, radiance: Tensor) -> Tensor:
        """The inverse of ``radiance``; "lerp" holds radiance below 1, "fresnel" below e^5."""
        if self.blend == "lerp":
            return torch.logit(radiance.clamp(_NO_LIGHT, 1 - _NO_LIGHT))
        return torch.log(radiance.clamp(min=_NO_LIGHT)).clamp(max=MAXIMUM_LOG_LIGHT)

    @property
    def radiance_cubemap(self) -> RadianceCubemap | None:
        """The texels."""
        return RadianceCubemap("texels", self.radiance, self.raw_texels)

    def far_light(self, texels: Tensor, directions: Tensor, level: Tensor | None) -> Tensor:
        """Radiance [P, 3] from far away along directions [P, 3], read at mip levels [P]; None: not blurred."""
        if self.blend == "lerp":
            return self.radiance(cubemap_lookup(texels, directions))
        if level is None:
            return cubemap_lookup(self.radiance(texels), directions)
        return mip_lookup(light_levels(self.radiance(texels)), directions, level)

    def light_levels(self, texels: Tensor, *, rough: bool) -> list[Tensor]:
        """Radiance from a mirror's level to that of a roughness of 1, or the first alone; of "lerp" the raw texels."""
        if self.blend == "lerp":
            return [texels]
        return light_levels(self.radiance(texels)) if rough else [self.radiance(texels)]

    @property
    def local_note(self) -> str:
        """With ``local``, that the Gaussians' own light stays."""
        return LOCAL_NOTE if self.local else ""

    def contributions(
        self,
        base: Tensor,
        strength: Tensor,
        light: Tensor,
        cosine: Tensor,
        index: float | Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Specular and diffuse contributions [..., 3].

        Args:
            base: [..., 3]. strength: [..., 1] in [0, 1]. light: [..., 3] from the mirrored direction.
            cosine: [..., 1] of the angle between the ray and the normal, in [0, 1].
            index: refractive index, a number or [..., 1]; None: the run's.
        """
        if self.blend == "lerp":
            return strength * light, (1 - strength) * base
        s, p = reflectances_from_cosine(cosine, self.refractive_index if index is None else index)
        return strength * (0.5 * (s + p)) * light, base

    def channels(self, gaussians: Parameters, normals: Tensor, center: Tensor, degree: int) -> Channels:
        """``color`` [N, 3] (the base color), ``strength`` [N, 1], with ``local`` the Gaussians' own light ``local``
        [N, 3], ``roughness`` [N, 1] where there is some; where some are metals ``metal`` [N, 4], and where some have
        refractive indices of their own ``index`` [N, 1], these less the run's.
        """
        strength = self.strength(gaussians)[:, None]
        channels = {"color": base_colors(gaussians, center, degree), "strength": strength}
        if self._has_metal(gaussians):
            body = 1 - gaussians["metalness"].detach()[:, None]
            channels = {name: values * body for name, values in channels.items()}
        if self.local:
            directions = mirrored_directions(gaussians["means"], center, normals)
            channels["local"] = local_light(gaussians, directions, degree)
        return channels | self._further(gaussians)

    def _further(self, gaussians: Parameters) -> dict[str, Tensor]:
        """The channels of roughness, metals and refractive indices, where there are some."""
        further = {}
        if (roughness := self._roughness(gaussians)) is not None:
            further["roughness"] = roughness[:, None]
        if self._has_metal(gaussians):
            metals = gaussians["metalness"].detach(), reflectance(gaussians["reflectance_logits"])
            further["metal"] = metal_channels(*metals)
        if self._has_indices(gaussians):
            further["index"] = gaussians["index_offset"].detach()[:, None]
        return further

    def channel_parameters(self, gaussians: Parameters) -> ChannelParameters | None:
        """The parameters that ``channels`` reads; None for a class with other channels."""
        if type(self).channels is not DeferredShading.channels:
            return None
        return ChannelParameters(
            gaussians["strength_logits"],
            gaussians["local_dc"] if self.local else None,
            gaussians["local_rest"] if self.local else None,
            gaussians["metalness"].detach() if self._has_metal(gaussians) else None,
            self._further(gaussians),
        )

    @property
    def knows_indices(self) -> bool:
        """With ``indices``."""
        return self.indices

    def _has_indices(self, gaussians: Parameters) -> bool:
        """Whether any Gaussian has a refractive index other than the run's."""
        return self.indices and any_nonzero(gaussians["index_offset"])

    @property
    def knows_metals(self) -> bool:
        """With ``metal``."""
        return self.metal

    def become_metal(
        self,
        gaussians: Gaussians,
        light: Light,
        metalness: Tensor,
        reflectance: Tensor,
        gain: Callable[[], float],
    ) -> None:
        """See ``ShadingModel`` and ``shading.metal``."""
        first = not any_nonzero(gaussians["metalness"])
        fresh = convert(gaussians, metalness, reflectance)
        if not any_nonzero(gaussians["metalness"]):
            return
        if first:
            scale_light(gaussians, light["texels"], gain())
        if self.local:
            mirror_base(gaussians, light["texels"], fresh, self.radiance)

    def _has_metal(self, gaussians: Parameters) -> bool:
        """Whether one of the Gaussians is a metal; without, everything is as if there could be none."""
        return self.metal and any_nonzero(gaussians["metalness"])

    def _roughness(self, gaussians: Parameters) -> Tensor | None:
        """Roughness [N] of each Gaussian; None: all are mirrors."""
        if self.rough:
            return torch.sigmoid(gaussians["roughness_logits"])
        if self._has_metal(gaussians):
            return gaussians["metalness"].detach() * torch.sigmoid(gaussians["roughness_logits"])
        return None

    def shade(self, splatted: GBuffer, light: Light, camera: Camera) -> dict[str, Any]:
        """``final``, ``specular``, ``diffuse`` and ``reflection`` [H, W, 3], ``strength`` and ``roughness`` [H, W].

        With ``metal`` also ``metalness`` [H, W] and, where there is some, ``metal``. Where there are several refractive
        indices, ``index`` [H, W].
        """
        texels = light["texels"]
        if splatted.metal is None and fits(splatted.features, texels):
            return self._shade_native(splatted, texels, camera, detached=False)
        strength = splatted["strength"][..., 0]
        local = splatted["local"] if self.local else None
        index = self._index_picture(splatted)
        rough = blended_roughness(splatted)
        level = None if rough is None else LEVELS * rough
        layers: dict[str, Any] = reflect_reference(
            splatted["color"], splatted["normal"], strength, texels, camera, self, local, index, level
        )
        layers |= {"strength": strength, "index": index, **self._shown_roughness(splatted)}
        return self._with_metals(layers, splatted, camera)

    def shade_detached(
        self, splatted: GBuffer, light: Light, camera: Camera
    ) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """As ``ShadingModel`` has it; on the CPU in float32 one native pass."""
        texels = light["texels"]
        if not fits(splatted.features, texels):
            return super().shade_detached(splatted, light, camera)
        layers = self._shade_native(splatted, texels, camera, detached=True)
        return layers, {name: layers.pop(f"detached_{name}") for name in ("specular", "diffuse")}

    def _with_metals(self, layers: dict[str, Any], splatted: GBuffer, camera: Camera) -> dict[str, Any]:
        """The layers of dielectrics with what metals add to them; as they are where the model knows no metals."""
        if not self.metal:
            return layers
        features = splatted.features
        metal = splatted.metal
        if metal is None and "metal" in splatted.layout:
            rays = camera.world_rays(dtype=features.dtype, device=features.device)
            metal = metal_pixels(
                features.flatten(0, 1),
                splatted.layout,
                rays.flatten(0, 1),
                splatted["normal"].flatten(0, 1),
                layers["reflection"].flatten(0, 1),
            )
        mixed = layers if metal is None else with_metal(layers, metal)
        return {**mixed, "metalness": metalness_picture(metal, features), "metal": metal}

    def _shown_roughness(self, splatted: GBuffer) -> dict[str, Tensor]:
        """The layer ``roughness``, where surfaces can have one."""
        if not (self.rough or self.metal):
            return {}
        blended = blended_roughness(splatted)
        roughness = torch.zeros_like(splatted.alpha) if blended is None else blended
        return {"roughness": gltf_roughness(roughness, self.environment_resolution)}

    def _index_picture(self, splatted: GBuffer) -> Tensor | None:
        """Refractive indices [H, W]; None: the run's everywhere."""
        if "index" not in splatted.layout:
            return None
        return self.refractive_index + splatted["index"][..., 0].detach()

    def _shade_native(
        self, splatted: GBuffer, texels: Tensor, camera: Camera, *, detached: bool
    ) -> dict[str, Any]:
        textures = self.light_levels(texels, rough="roughness" in splatted.layout)
        fresnel = self.blend == "fresnel"
        arguments = reflect_arguments(splatted, fresnel, self.local, self.refractive_index, detached)
        layers: dict[str, Any] = shade_native(splatted, textures, camera, arguments)
        layers |= {"strength": splatted["strength"][..., 0], "index": self._index_picture(splatted)}
        layers |= self._shown_roughness(splatted)
        if self.metal:
            layers["metalness"] = metalness_picture(layers["metal"], splatted.features)
        else:
            del layers["metal"]
        return layers

    def colors(self, gaussians: Parameters, light: Light, rays: Tensor, normals: Tensor) -> Tensor:
        """Colors [N, 3] of Gaussians by themselves; see ``ShadingModel``."""
        directions = mirrored(rays, normals).contiguous()
        rough = self._roughness(gaussians)
        reflected = self.far_light(light["texels"], directions, None if rough is None else LEVELS * rough)
        if self.local:
            reflected = (reflected + local_light(gaussians, directions, 3)).clamp(min=0)
        cosine = -(rays * normals).sum(dim=-1, keepdim=True).clamp(-1, 0)
        base = harmonic_colors(gaussians, rays)
        strength = self.strength(gaussians)[:, None]
        several = self._has_indices(gaussians)
        index = self.refractive_index + gaussians["index_offset"][:, None] if several else None
        specular, diffuse = self.contributions(base, strength, reflected, cosine, index)
        if not self._has_metal(gaussians):
            return specular + diffuse
        mean, _ = optics.conductor(cosine, reflectance(gaussians["reflectance_logits"]))
        return torch.lerp(specular + diffuse, mean * reflected, gaussians["metalness"][:, None])

    def diffuse_colors(self, gaussians: Parameters, rays: Tensor) -> Tensor:
        """Linear colors [N, 3] without reflections: none of metals."""
        colors = super().diffuse_colors(gaussians, rays)
        return colors * (1 - gaussians["metalness"][:, None]) if self._has_metal(gaussians) else colors

    def fields(self, gaussians: Parameters) -> dict[str, Tensor]:
        """Linear harmonics of the base color, ``strength`` [N], ``roughness`` [N] as in glTF (the square root of GGX's
        alpha), of metals ``metalness`` [N] and ``reflectance`` [N, 3], and ``refractive_index`` [N].
        """
        own = {**super().fields(gaussians), "strength": self.strength(gaussians)}
        if self.metal:
            own["metalness"] = gaussians["metalness"]
            own["reflectance"] = reflectance(gaussians["reflectance_logits"])
        if self.rough or self.metal:
            rough = self._roughness(gaussians)
            rough = torch.zeros_like(own["strength"]) if rough is None else rough
            own["roughness"] = gltf_roughness(rough, self.environment_resolution)
        if self._has_indices(gaussians):
            own["refractive_index"] = self.refractive_index + gaussians["index_offset"]
        return own

    def page(self, gaussians: Parameters, light: Light) -> PageShading | None:
        """Harmonics, strength and texels; where there is metal, also what that needs."""
        values = {**harmonic_values(gaussians), "share": self.strength(gaussians)}
        notes = [self.local_note] if self.local else []
        drawn = self.refractive_index
        if self._has_indices(gaussians):
            own = self.refractive_index + gaussians["index_offset"].detach()
            drawn = float(own.max())  # so that strengths become less, never more than 1
            values["share"] = values["share"] * self._at_45_degrees(own) / self._at_45_degrees(drawn)
            notes.append(INDEX_NOTE)
        if self.local:
            values |= {"own_color": gaussians["local_dc"], "own_harmonics": gaussians["local_rest"]}
        constants: dict[str, Any] = {"blend": self.blend, "index": drawn}
        if not self.local and (self.rough or self._has_metal(gaussians)):
            return None  # no recipe has such surfaces, and the page no shaders for them
        if (rough := self._roughness(gaussians)) is not None:
            values["roughness"] = rough
            constants["mirror"] = float(ggx_alpha(torch.zeros(()), self.environment_resolution))
        if self._has_metal(gaussians):
            metalness = gaussians["metalness"].detach()[:, None]
            values["metal"] = metalness * reflectance(gaussians["reflectance_logits"])
            constants["metal"] = True
        return PageShading(
            kind="local" if self.local else "reflection",
            values=values,
            light=self.light_levels(light["texels"], rough=rough is not None),
            constants=constants,
            notes=notes,
        )

    @staticmethod
    def _at_45_degrees(index: Tensor | float) -> Tensor:
        """Twice the reflectance there."""
        s, p = reflectances_from_cosine(torch.tensor(math.sqrt(0.5)), index)
        return s + p
