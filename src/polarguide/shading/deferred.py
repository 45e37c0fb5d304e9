"""Deferred reflection per pixel of a learned environment (3DGS-DR, Ye et al. 2024), or Fresnel-weighted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from polarguide import optics
from polarguide.core.native import fits
from polarguide.gaussians.gaussians import any_nonzero
from polarguide.geometry.camera import Camera
from polarguide.optics import reflectances_from_cosine
from polarguide.shading.cubemap import cubemap_lookup, mip_lookup
from polarguide.shading.metal import (
    FIRST_REFLECTANCE,
    metal_channels,
    metal_pixels,
    metalness_picture,
    reflectance,
    reflectance_logits,
    with_metal,
)
from polarguide.shading.model import (
    MAXIMUM_LOG_LIGHT,
    ChannelParameters,
    GBuffer,
    Light,
    Parameter,
    Parameters,
    RadianceCubemap,
    ShadingModel,
    harmonic_colors,
    local_light,
    mirrored,
)
from polarguide.shading.native import reflect_arguments, reflect_reference, shade_native
from polarguide.shading.result import LAYERS
from polarguide.shading.roughness import LEVELS, blended_blur, gltf_roughness, light_levels
from polarguide.shading.surface import SurfaceProperty

Blend = Literal["lerp", "fresnel"]
RESET_STRENGTH = 1e-3
_NO_LIGHT = 1e-4  # radiance of black, so that its logarithm is finite
LOCAL_NOTE = (
    "Turning the environment turns what is reflected from afar. What stands near is reflected by the Gaussians "
    "themselves, which stay as they are."
)
METALNESS = SurfaceProperty("metalness", "metalness")
REFLECTANCE = SurfaceProperty(
    "reflectance",
    "reflectance_logits",
    channels=3,
    activation=reflectance,
    inverse=reflectance_logits,
    initial=FIRST_REFLECTANCE,
    slot="metal",
)
INDEX = SurfaceProperty("index", "index_offset")
"""Offset of a Gaussian's refractive index from the run's."""


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
    def surface(self) -> tuple[SurfaceProperty, ...]:
        """Strength; with ``metal`` metalness and reflectance; with either kind of blur the blur; with ``indices`` the
        offset of the refractive index.
        """
        minimum = float(torch.logit(torch.tensor(RESET_STRENGTH, dtype=torch.float64)))
        logistic = SurfaceProperty("strength", "strength_logits", 1, torch.sigmoid, torch.logit, slot="share")
        rows = [
            replace(logistic, initial=self.first_strength, rate=self.strength_rate, reset_minimum=minimum)
        ]
        if self.metal:
            rows += [METALNESS, replace(REFLECTANCE, rate=self.metal_rate)]
        if self.blurs:
            blur = replace(logistic, name="blur", parameter="roughness_logits", slot="blur")
            rows.append(replace(blur, initial=self.first_roughness, rate=self.roughness_rate))
        if self.indices:
            rows.append(INDEX)
        return (*rows, *self.added_surface)

    @property
    def blurs(self) -> bool:
        """True if surfaces can be rough."""
        return self.rough or self.metal

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """Those of the surface properties; with ``local`` harmonics of the mirrored direction."""
        own = {**super().parameters}
        if self.local:
            own["local_dc"] = Parameter((3,), self.local_rate)
            own["local_rest"] = Parameter((15, 3), self.local_rate / 20)
        return own

    @property
    def light_parameters(self) -> Mapping[str, Parameter]:
        """``texels`` [6, R, R, 3]."""
        side = self.environment_resolution
        return {"texels": Parameter((6, side, side, 3), self.environment_rate)}

    def initialize(
        self, colors: Tensor, far: Tensor, generator: torch.Generator
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The surface everywhere the same, no light of the Gaussians' own, and uniform texels."""
        first, _ = super().initialize(colors, far, generator)
        uniform = torch.rand(self.light_parameters["texels"].shape, generator=generator) * 2 - 1
        return first, {"texels": uniform * self.environment_spread}

    @property
    def layers(self) -> tuple[str, ...]:
        """All, ``metalness`` if there can be metals, ``roughness`` if there is some."""
        absent = {"metalness": not self.metal, "roughness": not self.blurs}
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
        return RadianceCubemap("texels", self.radiance, self.raw_texels, LOCAL_NOTE if self.local else "")

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

    def channel_parameters(self, gaussians: Parameters) -> ChannelParameters | None:
        """``color`` and ``strength``, with ``local`` the Gaussians' own light ``local``; behind them ``blur`` where
        there is some, where Gaussians are metals ``metal`` [N, 4], where they have refractive indices of their own
        ``index`` [N, 1], the offset from the run's, and the added surface properties.
        """
        further = {}
        if (blur := self.blur(gaussians)) is not None:
            further["blur"] = blur[:, None]
        has_metal = self.has_metal(gaussians)
        if has_metal:
            metals = gaussians["metalness"].detach(), reflectance(gaussians["reflectance_logits"])
            further["metal"] = metal_channels(*metals)
        if self.has_indices(gaussians):
            further["index"] = gaussians["index_offset"].detach()[:, None]
        for row in self.added_surface:
            further[row.name] = row.values(gaussians).reshape(-1, row.channels)
        return ChannelParameters(
            gaussians["strength_logits"],
            gaussians["local_dc"] if self.local else None,
            gaussians["local_rest"] if self.local else None,
            gaussians["metalness"].detach() if has_metal else None,
            further,
        )

    def has_indices(self, gaussians: Parameters) -> bool:
        """Whether any Gaussian has a refractive index other than the run's."""
        return self.indices and any_nonzero(gaussians, "index_offset")

    def has_metal(self, gaussians: Parameters) -> bool:
        """Whether one of the Gaussians is a metal; without, everything is as if there could be none."""
        return self.metal and any_nonzero(gaussians, "metalness")

    def blur(self, gaussians: Parameters) -> Tensor | None:
        """Return the share [N] of the mip levels by which each Gaussian blurs; None: all are mirrors."""
        if self.rough:
            return torch.sigmoid(gaussians["roughness_logits"])
        if self.has_metal(gaussians):
            return gaussians["metalness"].detach() * torch.sigmoid(gaussians["roughness_logits"])
        return None

    def shade(self, splatted: GBuffer, light: Light, camera: Camera) -> dict[str, Any]:
        """``final``, ``specular``, ``diffuse`` and ``reflection`` [H, W, 3], ``strength`` and ``roughness`` [H, W].

        With ``metal`` also ``metalness`` [H, W] and, where there is some, ``metal``. Where there are several refractive
        indices, ``index`` [H, W]. Added surface properties by their names, [H, W] or [H, W, C], blended over alpha.
        """
        texels = light["texels"]
        strength = splatted["strength"][..., 0]
        index = None
        if "index" in splatted.layout:
            index = self.refractive_index + splatted["index"][..., 0].detach()
        blur = blended_blur(splatted)
        layers: dict[str, Any]
        if splatted.metal is None and fits(splatted.features, texels):
            textures = self.light_levels(texels, rough=blur is not None)
            arguments = reflect_arguments(
                splatted, self.blend == "fresnel", self.local, self.refractive_index
            )
            layers = shade_native(splatted, textures, camera, arguments)
        else:
            local = splatted["local"] if self.local else None
            level = None if blur is None else LEVELS * blur
            layers = {
                **reflect_reference(
                    splatted["color"], splatted["normal"], strength, texels, camera, self, local, index, level
                )
            }
            layers = self._with_metals(layers, splatted, camera)
        layers["strength"] = strength
        if index is not None:
            layers["index"] = index
        if self.blurs:
            shown = torch.zeros_like(splatted.alpha) if blur is None else blur
            layers["roughness"] = gltf_roughness(shown, self.environment_resolution)
        if self.metal:
            layers["metalness"] = metalness_picture(layers["metal"], splatted.features)
        for row in self.added_surface:
            blended = splatted[row.name] / splatted.alpha.detach().clamp(min=1e-6)[..., None]
            layers[row.name] = blended[..., 0] if row.channels == 1 else blended
        return layers

    def _with_metals(self, layers: dict[str, Any], splatted: GBuffer, camera: Camera) -> dict[str, Any]:
        """The layers of dielectrics with the contribution of metals: the reference of ``shade_native``."""
        metal = splatted.metal
        if metal is None and "metal" in splatted.layout:
            features = splatted.features
            rays = camera.world_rays(dtype=features.dtype, device=features.device)
            metal = metal_pixels(
                features.flatten(0, 1),
                splatted.layout,
                rays.flatten(0, 1),
                splatted["normal"].flatten(0, 1),
                layers["reflection"].flatten(0, 1),
            )
        return {**(layers if metal is None else with_metal(layers, metal)), "metal": metal}

    def colors(self, gaussians: Parameters, light: Light, rays: Tensor, normals: Tensor) -> Tensor:
        """Colors [N, 3] of Gaussians by themselves; see ``ShadingModel``."""
        directions = mirrored(rays, normals).contiguous()
        blur = self.blur(gaussians)
        reflected = self.far_light(light["texels"], directions, None if blur is None else LEVELS * blur)
        if self.local:
            reflected = (reflected + local_light(gaussians, directions, 3)).clamp(min=0)
        cosine = -(rays * normals).sum(dim=-1, keepdim=True).clamp(-1, 0)
        base = harmonic_colors(gaussians, rays)
        strength = self.strength(gaussians)[:, None]
        several = self.has_indices(gaussians)
        index = self.refractive_index + gaussians["index_offset"][:, None] if several else None
        specular, diffuse = self.contributions(base, strength, reflected, cosine, index)
        if not self.has_metal(gaussians):
            return specular + diffuse
        mean, _ = optics.conductor(cosine, reflectance(gaussians["reflectance_logits"]))
        return torch.lerp(specular + diffuse, mean * reflected, gaussians["metalness"][:, None])

    def diffuse_colors(self, gaussians: Parameters, rays: Tensor) -> Tensor:
        """Linear colors [N, 3] without reflections: none of metals."""
        colors = super().diffuse_colors(gaussians, rays)
        return colors * (1 - gaussians["metalness"][:, None]) if self.has_metal(gaussians) else colors
