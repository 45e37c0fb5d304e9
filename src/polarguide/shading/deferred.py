"""Deferred reflection of a learned environment per pixel, as in 3DGS-DR (Ye et al. 2024) or by Fresnel's equations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from polarguide.core.native import fits
from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import dot, unit
from polarguide.optics import reflectances_from_cosine
from polarguide.shading.cubemap import LEVELS, cubemap_lookup, gltf_roughness, light_levels, mip_lookup
from polarguide.shading.metal import (
    FIRST_REFLECTANCE,
    metal_pixels,
    metalness_picture,
    reflectance,
    reflectance_logits,
    with_metal,
)
from polarguide.shading.model import (
    MAXIMUM_LOG_LIGHT,
    Channels,
    GBuffer,
    Light,
    Parameter,
    Parameters,
    RadianceCubemap,
    ShadingModel,
    mirrored,
)
from polarguide.shading.native import shade_native
from polarguide.shading.result import LAYERS
from polarguide.shading.surface import SurfaceProperty, surface_channels

Blend = Literal["lerp", "fresnel"]
RESET_STRENGTH = 1e-3
"""Lower bound of strengths after a reset of the opacities."""
_NO_LIGHT = 1e-4
"""Radiance that stands for black, so that its logarithm is finite."""
LOCAL_NOTE = (
    "Turning the environment turns reflections of distant surroundings. Gaussians themselves hold reflections of near "
    "surroundings, which do not turn."
)
"""Note on local light for exports."""
_REFLECTANCE = SurfaceProperty(
    "reflectance",
    "reflectance_logits",
    channels=3,
    activation=reflectance,
    inverse=reflectance_logits,
    initial=FIRST_REFLECTANCE,
    weight="metalness",
)
_METALNESS = SurfaceProperty("metalness", "metalness", weight="metalness")
_INDEX = SurfaceProperty("index", "index_offset", weight="index_offset")
"""Offset of a Gaussian's refractive index from the index of the run."""
_OWN = ("strength", "blur", "reflectance", "metalness", "index")
"""Names of the surface properties that ``DeferredShading.shade`` reads. Other properties become layers."""


@dataclass(frozen=True)
class DeferredShading(ShadingModel):
    """Deferred reflection: the G-buffer of a pixel mirrors a learned environment.

    Attributes:
        blend: "lerp" or "fresnel". "lerp" computes final = (1 - r) base + r sigmoid(environment), with the strength r,
            as 3DGS-DR does (Ye et al. 2024, Eq. 5). "fresnel" computes final = base + r F(i) exp(environment). F is the
            unpolarized power reflectance of a dielectric at the angle between ray and normal, so that r can be a
            property of the surface.
        local: True if Gaussians add local light to the light of the environment. Local light is a function of the
            mirrored direction. It represents near surroundings, which a distant environment cannot represent.
        first_strength: reflection strength before the first step.
        strength_rate: learning rate of the strengths.
        local_rate: learning rate of local light of degree 0. Higher degrees have a twentieth of this rate.
        environment_spread: largest absolute value of the first raw texels, which are uniform random numbers.
        environment_rate: learning rate of the texels.
        environment_resolution: number of texels along the side of a cube face.
        rough: True if dielectrics have a roughness, False if only metals have one. Needs the blend "fresnel".
        first_roughness: blur before the first step, in (0, 1).
        roughness_rate: learning rate of the blur.
        metal: True if Gaussians can be metals, see ``shading.metal``. Needs the blend "fresnel".
        indices: True if Gaussians can have different refractive indices, which are never learned. Needs the blend
            "fresnel".
        metal_rate: learning rate of the metals' reflectance.
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
        """Surface properties of the model.

        They are the strength, the blur (with ``rough`` or ``metal``), reflectance and metalness (with ``metal``), and
        the offset of the refractive index (with ``indices``). The native pass expects metalness directly after the
        reflectance.
        """
        minimum = float(torch.logit(torch.tensor(RESET_STRENGTH, dtype=torch.float64)))
        rows = [
            SurfaceProperty(
                "strength",
                "strength_logits",
                activation=torch.sigmoid,
                inverse=torch.logit,
                initial=self.first_strength,
                rate=self.strength_rate,
                reset_minimum=minimum,
            )
        ]
        if self.blurs:
            blur = SurfaceProperty(
                "blur",
                "roughness_logits",
                activation=torch.sigmoid,
                inverse=torch.logit,
                initial=self.first_roughness,
                rate=self.roughness_rate,
                weight="" if self.rough else "metalness",
            )
            rows.append(blur)
        if self.metal:
            rows += [replace(_REFLECTANCE, rate=self.metal_rate), _METALNESS]
        if self.indices:
            rows.append(_INDEX)
        return tuple(rows)

    @property
    def blurs(self) -> bool:
        """True if surfaces can be rough."""
        return self.rough or self.metal

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """Parameters of the surface properties and, with ``local``, of the local light."""
        own = {**super().parameters}
        if self.local:
            own["local_dc"] = Parameter((3,), self.local_rate)
            own["local_rest"] = Parameter((15, 3), self.local_rate / 20)
        return own

    @property
    def light_parameters(self) -> Mapping[str, Parameter]:
        """Raw ``texels`` [6, R, R, 3] of the environment."""
        side = self.environment_resolution
        note = LOCAL_NOTE if self.local else ""
        radiance = RadianceCubemap("texels", self.radiance, self.raw_texels, note)
        return {"texels": Parameter((6, side, side, 3), self.environment_rate, radiance=radiance)}

    def initialize(
        self, colors: Tensor, far: Tensor, generator: torch.Generator
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Return initial values: the same surface for all Gaussians, no local light, and uniform random texels."""
        first, _ = super().initialize(colors, far, generator)
        uniform = torch.rand(self.light_parameters["texels"].shape, generator=generator) * 2 - 1
        return first, {"texels": uniform * self.environment_spread}

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of all layers. ``metalness`` needs ``metal``, and ``roughness`` needs surfaces that can be rough."""
        absent = {"metalness": not self.metal, "roughness": not self.blurs}
        return tuple(name for name in LAYERS if not absent.get(name))

    def radiance(self, texels: Tensor) -> Tensor:
        """Return the radiance of raw texel values."""
        return (
            torch.sigmoid(texels) if self.blend == "lerp" else torch.exp(texels.clamp(max=MAXIMUM_LOG_LIGHT))
        )

    def raw_texels(self, radiance: Tensor) -> Tensor:
        """Return the raw texel values of a radiance, which is below 1 for "lerp" and below e^5 for "fresnel"."""
        if self.blend == "lerp":
            return torch.logit(radiance.clamp(_NO_LIGHT, 1 - _NO_LIGHT))
        return torch.log(radiance.clamp(min=_NO_LIGHT)).clamp(max=MAXIMUM_LOG_LIGHT)

    def light_levels(self, texels: Tensor, *, rough: bool) -> list[Tensor]:
        """Return the levels of light that the look-up needs.

        With "fresnel" these are mip levels of the radiance, or only the first level if all surfaces are mirrors. With
        "lerp" these are the raw texels.
        """
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
        """Return specular and diffuse contributions [..., 3].

        Args:
            base: [..., 3] base color.
            strength: [..., 1] reflection strength in [0, 1].
            light: [..., 3] light from the mirrored direction.
            cosine: [..., 1] cosine of the angle between the ray and the normal, in [0, 1].
            index: refractive index, a number or [..., 1]. None means the index of the run.
        """
        if self.blend == "lerp":
            return strength * light, (1 - strength) * base
        s, p = reflectances_from_cosine(cosine, self.refractive_index if index is None else index)
        return strength * (0.5 * (s + p)) * light, base

    def channels(self, gaussians: Parameters, center: Tensor, degree: int) -> Channels:
        """Return the channels to splat: base color, surface properties and, with ``local``, the local light."""
        others = (row for row in self.surface if row.name != "strength")
        further = surface_channels(others, gaussians)
        return Channels(
            None,
            gaussians["strength_logits"],
            gaussians["local_dc"] if self.local else None,
            gaussians["local_rest"] if self.local else None,
            gaussians["metalness"].detach() if "metalness" in further else None,
            further,
        )

    def shade(self, splatted: GBuffer, light: Light, camera: Camera) -> dict[str, Any]:
        """Shade a splatted picture, and return its layers by name.

        All pictures have ``final``, ``specular``, ``diffuse`` and ``reflection`` [H, W, 3], and ``strength`` [H, W].
        ``roughness`` [H, W] is added if surfaces can be rough. ``metalness`` [H, W] is added with ``metal``. ``metal``
        and ``reflectance`` [H, W, 3] are added if a Gaussian is a metal. ``index`` [H, W] is added if there are several
        refractive indices. Surface properties that derived classes add become layers with the same names, [H, W] or [H,
        W, C].
        """
        layout = splatted.layout
        texels = light["texels"]
        if splatted.metal is None and fits(splatted.features, texels):
            layers = shade_native(
                splatted,
                self.light_levels(texels, rough="blur" in layout),
                camera,
                fresnel=self.blend == "fresnel",
                local=self.local,
                refractive_index=self.refractive_index,
            )
        else:
            layers = self._shade_reference(splatted, texels, camera)
        layers["strength"] = splatted["strength"][..., 0]
        if "index" in layout:
            layers["index"] = self._index(splatted)
        if self.blurs:
            blur = splatted.mean("blur") if "blur" in layout else torch.zeros_like(splatted.alpha)
            layers["roughness"] = gltf_roughness(blur, self.environment_resolution)
        if self.metal:
            layers["metalness"] = metalness_picture(layers["metal"], splatted.features)
        if "reflectance" in layout:
            share = splatted["metalness"].detach().clamp(min=1e-3)
            layers["reflectance"] = splatted["reflectance"].detach() / share
        added = (row.name for row in self.surface if row.name not in _OWN)
        return layers | {name: splatted.mean(name) for name in added}

    def _index(self, splatted: GBuffer) -> Tensor:
        """Return the refractive index [H, W] of each pixel."""
        return self.refractive_index + splatted["index"][..., 0].detach()

    def _shade_reference(self, splatted: GBuffer, texels: Tensor, camera: Camera) -> dict[str, Any]:
        """Compute the layers of ``shade_native`` by the reference implementations."""
        layers = self.reflect(
            splatted["color"],
            splatted["normal"],
            splatted["strength"][..., 0],
            texels,
            camera,
            splatted["local"] if self.local else None,
            self._index(splatted) if "index" in splatted.layout else None,
            LEVELS * splatted.mean("blur") if "blur" in splatted.layout else None,
        )
        metal = splatted.metal
        if metal is None and "reflectance" in splatted.layout:
            features = splatted.features
            rays = camera.world_rays(dtype=features.dtype, device=features.device)
            metal = metal_pixels(
                features.flatten(0, 1),
                splatted.layout["reflectance"].start,
                rays.flatten(0, 1),
                splatted["normal"].flatten(0, 1),
                layers["reflection"].flatten(0, 1),
            )
        return {**(layers if metal is None else with_metal(layers, metal)), "metal": metal}

    def reflect(
        self,
        base: Tensor,
        normal: Tensor,
        strength: Tensor,
        texels: Tensor,
        camera: Camera,
        local: Tensor | None = None,
        index: Tensor | None = None,
        level: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Shade dielectrics per pixel.

        This is the reference implementation of ``reflect_native``, for any dtype and device.

        Args:
            base: [H, W, 3] blended base color.
            normal: [H, W, 3] blended normal, world axes, any length.
            strength: [H, W] blended reflection strength.
            texels: [6, R, R, 3] raw texels of the environment.
            camera: camera of the picture.
            local: [H, W, 3] blended local light, which is added to the light of the environment.
            index: [H, W] refractive index. None means the index of the run.
            level: [H, W] mip level of the environment. None means that all surfaces are mirrors.

        Returns:
            ``final``, ``specular``, ``diffuse`` and ``reflection``, each [H, W, 3].
        """
        rays = camera.world_rays(dtype=base.dtype, device=base.device)
        facing = unit(normal, 1e-3)
        directions = mirrored(rays, facing).reshape(-1, 3).contiguous()
        textures = self.light_levels(texels, rough=level is not None)
        if level is None or self.blend == "lerp":
            light = cubemap_lookup(textures[0], directions)
        else:
            light = mip_lookup(textures, directions, level.flatten())
        if self.blend == "lerp":
            light = self.radiance(light)
        light = light.reshape(base.shape)
        if local is not None:
            light = (light + local).clamp(min=0)
        cosine = -dot(rays, facing)[..., None].clamp(-1, 0)
        indices = None if index is None else index[..., None]
        specular, diffuse = self.contributions(base, strength[..., None], light, cosine, indices)
        return {"final": specular + diffuse, "specular": specular, "diffuse": diffuse, "reflection": light}
