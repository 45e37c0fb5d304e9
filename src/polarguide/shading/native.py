"""Native passes over the G-buffer on the CPU.

The reference implementation of ``reflect_native`` is ``reflect_reference``, of metals ``metal.metal_pixels``;
that of ``split_native`` is ``gbuffer.split_reference``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from polarguide import _native
from polarguide.core.native import applied
from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import dot, unit
from polarguide.shading.cubemap import cubemap_lookup, mips_backward
from polarguide.shading.model import mirrored


class MetalArguments(NamedTuple):
    """Arguments of the native pass for metals, see ``shading.metal``.

    Attributes:
        pixels: [K] int64, those that show metal, ascending.
        first: the channel where ``metal_channels`` begin. local: that of the Gaussians' own light; -1: there is none.
        least_share: of metal. blur: mip levels from a mirror to a roughness of 1.
    """

    pixels: Tensor
    first: int
    local: int
    least_share: float
    blur: float


class _Reflect(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        features: Tensor,
        rays: Tensor,
        texels: Tensor,
        fresnel: bool,
        local: bool,
        ior: float,
        index: int,
        detached: bool,
        metal: MetalArguments | None,
        *levels: Tensor,
    ) -> tuple[Tensor, ...]:
        features, rays, texels = (t.detach().contiguous() for t in (features, rays, texels))
        learns = any(ctx.needs_input_grad)
        directions, reflected_rays = (torch.empty_like(rays) if learns else None for _ in range(2))
        layers = [torch.empty_like(rays) for _ in range(4)]
        _native.reflect_forward(
            features, rays, texels, fresnel, local, ior, index, directions, reflected_rays, *layers
        )
        ctx.model, ctx.metal = (fresnel, local, ior, index), metal
        ctx.set_materialize_grads(False)
        outputs: list[Tensor] = []
        saved: list[Tensor] = []
        if metal is not None:
            inputs = features, rays, *metal
            count = len(metal.pixels)
            mirrored, reflected, slope, light = (rays.new_empty(count, 3) for _ in range(4))
            share, level = rays.new_empty(count), rays.new_empty(count)
            mips = [t.detach().contiguous() for t in levels]
            _native.metal_directions(*inputs, mirrored, level)
            _native.mips_forward(mips, mirrored, level, light)
            _native.metal_layers(*inputs, light, share, reflected, slope, *layers[:2])
            saved = [metal.pixels, mirrored, level, light, *mips]
            ctx.mark_non_differentiable(share)
            outputs = [share, reflected, slope]
        ctx.save_for_backward(features, rays, texels, directions, reflected_rays, *saved)
        again = [layers[1].clone(), layers[2].clone()] if detached else []
        return (*layers, *again, *outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        features, rays, texels, directions, reflected_rays, *saved = ctx.saved_tensors
        contiguous = [None if g is None else g.contiguous() for g in grads]
        by_metal = contiguous[-2:]
        to_layers = contiguous if ctx.metal is None else contiguous[:-3]
        to_layers += [None] * (6 - len(to_layers))
        to_features, to_seen = torch.empty_like(features), torch.empty_like(reflected_rays)
        # What comes by the detached layers goes to the texels, and not by way of the directions to the normals.
        needs_metal = to_layers[4] is not None or to_layers[5] is not None
        to_look_up = torch.empty_like(reflected_rays) if needs_metal else None
        inputs: list[Any] = [
            features,
            rays,
            reflected_rays,
            *ctx.model,
            *to_layers,
            to_seen,
            to_look_up,
            to_features,
        ]
        _native.reflect_backward_layers(*inputs)
        to_texels, to_directions = torch.empty_like(texels), torch.empty_like(directions)
        if to_look_up is None:
            _native.cubemap_backward(texels, directions, to_seen, to_texels, to_directions)
        else:
            _native.cubemap_backward(texels, directions, to_look_up, to_texels, None)
            _native.cubemap_backward(texels, directions, to_seen, None, to_directions)
        _native.reflect_backward_directions(features, rays, to_directions, to_features)
        to_levels: Sequence[Tensor | None] = [None] * len(ctx.needs_input_grad[9:])
        if ctx.metal is not None:
            _, mirrored, level, light, *levels = saved
            to_light, by_layers = torch.empty_like(light), [*to_layers[:2], to_layers[4]]
            inputs = [features, rays, *ctx.metal, light, *by_layers, *by_metal, to_light, to_features]
            _native.metal_backward_layers(*inputs)
            to_mirrored, to_level, to_levels = mips_backward(
                levels, mirrored, level, to_light, any(ctx.needs_input_grad[9:])
            )
            inputs = [features, rays, *ctx.metal, to_mirrored, to_level, to_features]
            _native.metal_backward_directions(*inputs)
        return to_features, None, to_texels, None, None, None, None, None, None, *to_levels


def world_rays_native(camera: Camera) -> Tensor:
    """``Camera.world_rays`` in float32 on the CPU, in one pass: [P, 3]."""
    rays = camera.rays().flatten(0, 1)
    turned = torch.empty_like(rays)
    _native.turn(rays, camera.pose(torch.float32, rays.device).rotation.flatten().tolist(), turned)
    return turned


def reflect_native(
    features: Tensor,
    rays: Tensor,
    texels: Tensor,
    *,
    fresnel: bool,
    local: bool,
    refractive_index: float,
    index: int = -1,
    detached: bool = False,
    metal: MetalArguments | None = None,
    levels: Sequence[Tensor] = (),
) -> tuple[Tensor, ...]:
    """The layers of a picture from its G-buffer (Ye et al. 2024, Eq. 5, or Fresnel-weighted), with what metals reflect.

    Args:
        features: [P, D] blended base color, normal, strength and, with ``local``, light; others may follow.
        rays: [P, 3] unit, world. texels: [6, R, R, 3] raw. All float32 on the CPU.
        fresnel: Fresnel's weight and exponential light in place of the lerp and the logistic function.
        local: whether channels 7 to 9 are light that is added to the environment's.
        refractive_index: of Fresnel's weight. index: the channel of what is added to it, without a gradient; -1: there
            is none.
        detached: also ``specular`` and ``diffuse`` once more, without a gradient on the normals but for that of metals.
        metal: where there is some; it is added to ``final`` and ``specular``. levels: of light that it mirrors.

    Returns:
        ``final``, ``specular``, ``diffuse`` and ``reflection``, each [P, 3], differentiable in features, texels and
        levels. With ``detached`` also the two detached layers. With ``metal`` also its share [K] (no gradient),
        its reflected light [K, 3], and its degree of polarization over ``sin^2(zenith)`` [K, 3]. The bits are the same
        for any number of threads.

    Raises:
        ValueError: if a shape is not as above.
    """
    layers: tuple[Tensor, ...] = applied(
        _Reflect, features, rays, texels, fresnel, local, refractive_index, index, detached, metal, *levels
    )
    return layers


class _Split(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, features: Tensor, alpha: Tensor, deep: bool
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        values, covered = features.detach().contiguous(), alpha.detach().contiguous()
        normal = values.new_empty(*covered.shape, 3)
        depth = torch.empty_like(covered) if deep else None
        flat_depth = None if depth is None else depth.view(-1)
        _native.gbuffer_split(values.flatten(0, 1), covered.view(-1), normal.view(-1, 3), flat_depth)
        ctx.save_for_backward(covered, depth)
        ctx.channels = features.shape[-1]
        ctx.set_materialize_grads(False)
        return features.view_as(features), normal, depth

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, Tensor | None, None]:
        covered, depth = ctx.saved_tensors
        by_features, by_normal, by_depth = (None if g is None else g.contiguous() for g in grads)
        if by_normal is None and by_depth is None:
            return by_features, None, None
        to_features = covered.new_empty(*covered.shape, ctx.channels)
        to_alpha = None if by_depth is None else torch.empty_like(covered)
        _native.gbuffer_join(
            covered.view(-1),
            None if depth is None else depth.view(-1),
            None if by_features is None else by_features.flatten(0, 1),
            None if by_normal is None else by_normal.view(-1, 3),
            None if by_depth is None else by_depth.view(-1),
            to_features.flatten(0, 1),
            None if to_alpha is None else to_alpha.view(-1),
        )
        return to_features, to_alpha, None


def split_native(features: Tensor, alpha: Tensor, *, depth: bool) -> tuple[Tensor, Tensor, Tensor | None]:
    """The blended normal and the depth of a G-buffer, with one gradient pass for them and whatever else is read.

    Args:
        features: [H, W, D] blended color, normal and at least one channel more. alpha: [H, W]. Both float32 on the CPU.
        depth: whether the last channel is the depth times alpha.

    Returns:
        ``features`` for whoever else reads them, the normal [H, W, 3] and the depth [H, W] or None.

    Raises:
        ValueError: if a shape is not as above.
    """
    rest, normal, deep = _Split.apply(features, alpha, depth)
    return rest, normal, deep


class Reflecting(Protocol):
    """The interface between deferred reflection and its shading model; see ``DeferredShading``."""

    def radiance(self, texels: Tensor, /) -> Tensor:
        """Linear radiance of raw texels."""

    def contributions(
        self, base: Tensor, strength: Tensor, light: Tensor, cosine: Tensor, index: Tensor | None, /
    ) -> tuple[Tensor, Tensor]:
        """Specular and diffuse contributions [..., 3]."""


def reflect_reference(
    base: Tensor,
    normal: Tensor,
    strength: Tensor,
    environment: Tensor,
    camera: Camera,
    shading: Reflecting,
    local: Tensor | None = None,
    index: Tensor | None = None,
) -> dict[str, Tensor]:
    """Deferred reflection per pixel: the reference implementation of ``reflect_native``, any dtype and device.

    Args:
        base: [H, W, 3]. normal: [H, W, 3] world, any length. strength: [H, W]. environment: [6, R, R, 3] raw texels.
        local: [H, W, 3] blended light of the Gaussians' own, added to the environment's.
        index: [H, W] refractive index; None: the run's.

    Returns:
        ``final``, ``specular``, ``diffuse`` and ``reflection``, each [H, W, 3].
    """
    rays = camera.world_rays(dtype=base.dtype, device=base.device)
    facing = unit(normal, 1e-3)
    directions = mirrored(rays, facing)
    light = shading.radiance(cubemap_lookup(environment, directions.reshape(-1, 3)).reshape(base.shape))
    if local is not None:
        light = (light + local).clamp(min=0)
    cosine = -dot(rays, facing)[..., None].clamp(-1, 0)
    indices = None if index is None else index[..., None]
    specular, diffuse = shading.contributions(base, strength[..., None], light, cosine, indices)
    return {"final": specular + diffuse, "specular": specular, "diffuse": diffuse, "reflection": light}
