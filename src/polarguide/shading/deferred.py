"""From Gaussians to layers: one splat of the G-buffer, then deferred reflection per pixel (Ye et al. 2024)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from polarguide.camera import Camera
from polarguide.gaussians.geometry import mirrored_directions, shortest_axis_normals
from polarguide.gaussians.harmonics import evaluate_sh
from polarguide.optics import reflectances_from_cosine
from polarguide.raster.interface import Rasterize, ScreenStatistic, Splats
from polarguide.shading.cubemap import cubemap_lookup
from polarguide.shading.model import MAXIMUM_LOG_LIGHT, GBuffer, Parameters, ShadingModel, mirrored
from polarguide.shading.native import reflect_native
from polarguide.shading.result import RenderResult
from polarguide.vectors import dot, unit

COLOR_CHANNELS = (0, 1, 2)
Blend = Literal["lerp", "fresnel"]


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


@dataclass(frozen=True)
class Shading:
    """How base color and reflection make the picture.

    Attributes:
        blend: "lerp": final = (1 - r) base + r sigmoid(environment), as in 3DGS-DR (Ye et al. 2024, Eq. 5);
            "fresnel": final = base + r F(i) exp(environment), with F the unpolarized power reflectance of a
            dielectric at the angle between ray and normal, so that strength can be a property of the surface.
        index: refractive index of F.
        local: whether Gaussians add light of their own to the environment's, a function of the mirrored direction:
            what stands near, and what the far environment cannot say.
    """

    blend: Blend = "lerp"
    index: float = 1.5
    local: bool = False

    def light(self, texels: Tensor) -> Tensor:
        """Radiance of raw texel values."""
        return (
            torch.sigmoid(texels) if self.blend == "lerp" else torch.exp(texels.clamp(max=MAXIMUM_LOG_LIGHT))
        )

    def layers(self, base: Tensor, strength: Tensor, light: Tensor, cosine: Tensor) -> tuple[Tensor, Tensor]:
        """Specular and diffuse contributions [..., 3].

        Args:
            base: [..., 3]. strength: [..., 1] in [0, 1]. light: [..., 3] from the mirrored direction.
            cosine: [..., 1] of the angle between the ray and the normal, in [0, 1].
        """
        if self.blend == "lerp":
            return strength * light, (1 - strength) * base
        s, p = reflectances_from_cosine(cosine, self.index)
        return strength * (0.5 * (s + p)) * light, base

    def channels(
        self, gaussians: Parameters, normals: Tensor, center: Tensor, sh_degree: int
    ) -> list[Tensor]:
        """Base color [N, 3], strength [N, 1] and, with ``local``, the Gaussians' own light [N, 3]."""
        channels = [
            base_colors(gaussians, center, sh_degree),
            torch.sigmoid(gaussians["strength_logits"])[:, None],
        ]
        if self.local:
            directions = mirrored_directions(gaussians["means"], center, normals)
            channels.append(local_light(gaussians, directions, sh_degree))
        return channels

    def shade(self, splatted: GBuffer, light: Mapping[str, Tensor], camera: Camera) -> dict[str, Tensor]:
        """The layers of ``reflect``, and ``strength`` [H, W]."""
        features, texels = splatted.features, light["texels"]
        strength = features[..., 6]
        if all(t.device.type == "cpu" and t.dtype == torch.float32 for t in (features, texels)):
            size = features.shape[:2]
            found = reflect_native(
                features.flatten(0, 1),
                camera.world_rays().flatten(0, 1),
                texels,
                fresnel=self.blend == "fresnel",
                local=self.local,
                index=self.index,
            )
            final, specular, diffuse, reflection = (layer.unflatten(0, size) for layer in found)
            layers = {"final": final, "specular": specular, "diffuse": diffuse, "reflection": reflection}
        else:
            local = features[..., 7:10] if self.local else None
            layers = reflect(splatted.color, splatted.normal, strength, texels, camera, self, local)
        return {**layers, "strength": strength}

    def colors(
        self, gaussians: Parameters, light: Mapping[str, Tensor], rays: Tensor, normals: Tensor
    ) -> Tensor:
        """Colors [N, 3] of Gaussians by themselves; see ``ShadingModel``."""
        directions = mirrored(rays, normals).contiguous()
        seen = self.light(cubemap_lookup(light["texels"], directions))
        if self.local:
            seen = (seen + local_light(gaussians, directions, 3)).clamp(min=0)
        strength = torch.sigmoid(gaussians["strength_logits"])[:, None]
        cosine = -(rays * normals).sum(dim=-1, keepdim=True).clamp(-1, 0)
        specular, diffuse = self.layers(harmonic_colors(gaussians, rays), strength, seen, cosine)
        return specular + diffuse

    def fields(self, gaussians: Parameters) -> dict[str, Tensor]:
        """Linear harmonics of the base color and, where Gaussians have one, ``strength`` [N]."""
        fields = {"linear_dc": gaussians["sh_dc"], "linear_rest": gaussians["sh_rest"].flatten(1)}
        if "strength_logits" in gaussians:
            fields["strength"] = torch.sigmoid(gaussians["strength_logits"])
        return fields


SHADING_3DGS_DR = Shading()


def reflect(
    base: Tensor,
    normal: Tensor,
    strength: Tensor,
    environment: Tensor,
    camera: Camera,
    shading: Shading,
    local: Tensor | None = None,
) -> dict[str, Tensor]:
    """Deferred reflection per pixel, in plain torch: any dtype and device. ``reflect_native`` is its twin.

    Args:
        base: [H, W, 3]. normal: [H, W, 3] world, any length. strength: [H, W]. environment: [6, R, R, 3] raw texels.
        local: [H, W, 3] blended light of the Gaussians' own, added to the environment's.

    Returns:
        ``final``, ``specular``, ``diffuse`` and ``reflection``, each [H, W, 3].
    """
    rays = camera.world_rays(dtype=base.dtype, device=base.device)
    facing = unit(normal, 1e-3)
    directions = mirrored(rays, facing)
    light = shading.light(cubemap_lookup(environment, directions.reshape(-1, 3)).reshape(base.shape))
    if local is not None:
        light = (light + local).clamp(min=0)
    cosine = -dot(rays, facing)[..., None].clamp(-1, 0)
    specular, diffuse = shading.layers(base, strength[..., None], light, cosine)
    return {"final": specular + diffuse, "specular": specular, "diffuse": diffuse, "reflection": light}


def render(
    gaussians: Parameters,
    camera: Camera,
    rasterize: Rasterize,
    *,
    sh_degree: int = 3,
    environment: Mapping[str, Tensor] | None = None,
    shading: ShadingModel = SHADING_3DGS_DR,
    normals: bool = True,
    depth: bool = False,
    statistic: ScreenStatistic | None = None,
) -> RenderResult:
    """Render one view.

    Args:
        gaussians: the Gaussians; with the side tensors of the shading model when there is an environment; with
            ``outward`` where normals are turned to where they are seen from, not to the camera.
        sh_degree: SH degree of the base color, 0 to 3.
        environment: parameters of the learned environment by name; None: no reflection.
        shading: what is splatted for reflection, and how it makes the picture.
        normals: also splat normals (always done with an environment).
        depth: also splat camera depth.
        statistic: see ``ScreenStatistic``; the color channels come first.
    """
    pose = camera.pose(gaussians["means"].dtype, gaussians["means"].device)
    center = pose.center
    channels = [] if environment is not None else [base_colors(gaussians, center, sh_degree)]
    if normals or environment is not None:
        outward = gaussians["outward"] if "outward" in gaussians else None  # noqa: SIM401
        axes = shortest_axis_normals(
            gaussians["means"], gaussians["quaternions"], gaussians["log_scales"], center, outward
        )
        if environment is not None:
            channels = shading.channels(gaussians, axes, center, sh_degree)
        channels.insert(1, axes)
    if depth:
        channels.append(((gaussians["means"] - center) @ pose.rotation[2])[:, None])
    splats = Splats(
        gaussians["means"],
        gaussians["quaternions"],
        gaussians["log_scales"].exp(),
        torch.sigmoid(gaussians["opacity_logits"]),
        torch.cat(channels, dim=1),
    )
    picture = rasterize(splats, camera, statistic=statistic)
    base = picture.features[..., :3]
    normal = picture.features[..., 3:6] if normals or environment is not None else None
    layers = {"final": base}
    if environment is not None and normal is not None:
        splatted = GBuffer(picture.features, picture.alpha)
        layers = shading.shade(splatted, environment, camera)
    return RenderResult(
        final=layers["final"],
        specular=layers.get("specular"),
        diffuse=layers.get("diffuse"),
        base=base,
        reflection=layers.get("reflection"),
        strength=layers.get("strength"),
        normal=normal,
        depth=picture.features[..., -1] / picture.alpha.clamp(min=1e-6) if depth else None,
        alpha=picture.alpha,
        radii=picture.radii,
    )
