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
from polarguide.shading.cubemap import mips_backward
from polarguide.shading.metal import MINIMUM_SHARE, where_metal
from polarguide.shading.model import GBuffer, mirrored
from polarguide.shading.result import MetalPixels
from polarguide.shading.roughness import LEVELS


class MetalArguments(NamedTuple):
    """Arguments of the native pass for metals, see ``shading.metal``.

    Attributes:
        pixels: [K] int64, those that show metal, ascending.
        first: the channel where ``metal_channels`` begin.
        least_share: of metal.
    """

    pixels: Tensor
    first: int
    least_share: float


class RoughnessArguments(NamedTuple):
    """Arguments of the native pass for rough surfaces.

    Attributes:
        channel: channel of the blended roughness.
        blur: mip levels from a mirror to a roughness of 1.
        alpha: [P] by which a pixel's blended roughness is divided; without a gradient.
    """

    channel: int
    blur: float
    alpha: Tensor


class ReflectArguments(NamedTuple):
    """Arguments of ``reflect_native`` from a shading model and its G-buffer.

    Attributes:
        fresnel: Fresnel's weight of radiance, in place of the lerp with the logistic function of raw texels.
        local: whether channels 7 to 9 are light that is added to the environment's.
        refractive_index: of Fresnel's weight.
        added_index: the channel of what is added to it, without a gradient; -1: there is none.
        roughness: where surfaces have one; None: all are mirrors.
        metal: where there is some; it is added to ``final`` and ``specular``.
        detached: also ``specular`` and ``diffuse`` once more, without a gradient on the normals but for that of metals.
    """

    fresnel: bool
    local: bool
    refractive_index: float
    added_index: int = -1
    roughness: RoughnessArguments | None = None
    metal: MetalArguments | None = None
    detached: bool = False

    @property
    def model(self) -> tuple[bool, bool, float, int]:
        """The arguments of each native function."""
        return self.fresnel, self.local, self.refractive_index, self.added_index

    @property
    def levels(self) -> tuple[int, float, Tensor | None]:
        """The arguments for the mip level of a look-up."""
        rough = self.roughness
        return (-1, 0.0, None) if rough is None else (rough.channel, rough.blur, rough.alpha)


class _Reflect(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, features: Tensor, rays: Tensor, given: ReflectArguments, *textures: Tensor
    ) -> tuple[Tensor, ...]:
        features, rays, *levels = (t.detach().contiguous() for t in (features, rays, *textures))
        learns = any(ctx.needs_input_grad)
        count = len(rays)
        sizes = ((count, 3), (count,), (count, 3)) if learns else ()
        looked_up = [rays.new_empty(*size) for size in sizes]
        layers = [torch.empty_like(rays) for _ in range(4)]
        inputs: list[Any] = [features, rays, levels, *given.model, *given.levels]
        _native.reflect_forward(*inputs, *(looked_up or (None, None, None)), *layers)
        metal = given.metal
        outputs = []
        light = []
        if metal is not None:
            pixels = len(metal.pixels)
            outputs = [rays.new_empty(pixels), rays.new_empty(pixels, 3), rays.new_empty(pixels, 3)]
            light = [layers[3]]
            _native.metal_layers(features, rays, *metal, *light, *outputs, *layers[:2])
            ctx.mark_non_differentiable(outputs[0])
        ctx.given = given
        ctx.set_materialize_grads(False)
        if learns:
            ctx.save_for_backward(features, rays, *looked_up, *light, *levels)
        again = [layers[1].clone(), layers[2].clone()] if given.detached else []
        return (*layers, *again, *outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        features, rays, directions, level, looked_up, *saved = ctx.saved_tensors
        given = ctx.given
        contiguous = [None if g is None else g.contiguous() for g in grads]
        metal = given.metal
        to_layers = contiguous if metal is None else contiguous[:-3]
        to_layers += [None] * (6 - len(to_layers))
        to_features = torch.empty_like(features)
        to_seen = torch.empty_like(looked_up)
        if metal is not None:
            light, *saved = saved
            by_layers = [*to_layers[:2], to_layers[4]]
            by_metal = contiguous[-2:]
            to_light = torch.zeros_like(rays) if to_layers[3] is None else to_layers[3].clone()
            to_normal = rays.new_empty(len(metal.pixels), 3)
            to_metal = rays.new_empty(len(metal.pixels), 4)
            inputs: list[Any] = [features, rays, *metal, light, *by_layers, *by_metal]
            inputs += [to_light, to_normal, to_metal]
            _native.metal_backward(*inputs)
            to_layers[3] = to_light
        # What comes by the detached layers goes to the light, and not by way of the directions to the normals.
        to_look_up = None if to_layers[4] is None and to_layers[5] is None else torch.empty_like(looked_up)
        inputs = [features, rays, looked_up, *given.model, *to_layers, to_seen, to_look_up, to_features]
        _native.reflect_backward_layers(*inputs)
        if metal is not None:
            to_features[:, 3:6].index_add_(0, metal.pixels, to_normal)
            to_features[:, metal.first : metal.first + 4].index_add_(0, metal.pixels, to_metal)
        to_directions, to_level, to_textures = mips_backward(
            saved, directions, level, to_seen, any(ctx.needs_input_grad[3:]), to_look_up
        )
        inputs = [features, rays, *given.levels, to_directions, to_level, to_features]
        _native.reflect_backward_directions(*inputs)
        return to_features, None, None, *to_textures


def world_rays_native(camera: Camera) -> Tensor:
    """``Camera.world_rays`` in float32 on the CPU, in one pass: [P, 3]."""
    rays = camera.rays().flatten(0, 1)
    turned = torch.empty_like(rays)
    _native.turn(rays, camera.pose(torch.float32, rays.device).rotation.flatten().tolist(), turned)
    return turned


def reflect_native(
    features: Tensor, rays: Tensor, textures: Sequence[Tensor], given: ReflectArguments
) -> tuple[Tensor, ...]:
    """The layers of a picture from its G-buffer (Ye et al. 2024, Eq. 5, or Fresnel-weighted), with what metals reflect.

    Args:
        features: [P, D] blended base color, normal, strength and, with ``local``, light; others may follow.
        rays: [P, 3] unit, world.
        textures: levels of the light from afar, [6, R, R, 3] each: radiance with ``fresnel``, else one, raw. All
            float32 on the CPU.

    Returns:
        ``final``, ``specular``, ``diffuse`` and ``reflection``, each [P, 3], differentiable in features and textures.
        With ``detached`` also the two detached layers. With ``metal`` also its share [K] (no gradient), its reflected
        light [K, 3], and its degree of polarization over ``sin^2(zenith)`` [K, 3]. The bits are the same for any
        number of threads.

    Raises:
        ValueError: if a shape is not as above.
    """
    layers: tuple[Tensor, ...] = applied(_Reflect, features, rays, given, *textures)
    return layers


def reflect_arguments(
    splatted: GBuffer, fresnel: bool, local: bool, refractive_index: float, detached: bool
) -> ReflectArguments:
    """Arguments of ``reflect_native`` for a G-buffer, by the channels that it has."""
    layout = splatted.layout
    rough = None
    metal = None
    if "roughness" in layout:
        rough = RoughnessArguments(layout.first("roughness"), LEVELS, splatted.alpha.detach().flatten())
    if "metal" in layout:
        first = layout.first("metal")
        metal = MetalArguments(where_metal(splatted.features.flatten(0, 1), first), first, MINIMUM_SHARE)
    index = layout.first("index")
    return ReflectArguments(fresnel, local, refractive_index, index, rough, metal, detached)


def shade_native(
    splatted: GBuffer, textures: Sequence[Tensor], camera: Camera, given: ReflectArguments
) -> dict[str, Any]:
    """The layers of ``reflect_native`` by name, [H, W, 3] each.

    If ``given.detached`` is set, ``detached_specular`` and ``detached_diffuse`` are among them: the same layers, whose
    gradient does not reach the normals. ``metal`` is None if no Gaussian is a metal.
    """
    shaded = reflect_native(splatted.features.flatten(0, 1), world_rays_native(camera), textures, given)
    names = ["final", "specular", "diffuse", "reflection"]
    names += ["detached_specular", "detached_diffuse"] if given.detached else []
    shape = splatted.features.shape[:2]
    layers = {name: layer.unflatten(0, shape) for name, layer in zip(names, shaded, strict=False)}
    metal = None if given.metal is None else MetalPixels(given.metal.pixels, *shaded[len(names) :])
    return {**layers, "metal": metal}


class _Split(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, features: Tensor, alpha: Tensor, deep: bool
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        values = features.detach().contiguous()
        covered = alpha.detach().contiguous()
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

    def far_light(self, texels: Tensor, directions: Tensor, level: Tensor | None, /) -> Tensor:
        """Linear radiance [P, 3] from directions [P, 3], blurred by mip levels [P]; None: by none."""

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
    level: Tensor | None = None,
) -> dict[str, Tensor]:
    """Deferred reflection per pixel: the reference implementation of ``reflect_native``, any dtype and device.

    Args:
        base: [H, W, 3]. normal: [H, W, 3] world, any length. strength: [H, W]. environment: [6, R, R, 3] raw texels.
        local: [H, W, 3] blended light of the Gaussians' own, added to the environment's.
        index: [H, W] refractive index; None: the run's.
        level: [H, W] mip level of the environment; None: everything is a mirror.

    Returns:
        ``final``, ``specular``, ``diffuse`` and ``reflection``, each [H, W, 3].
    """
    rays = camera.world_rays(dtype=base.dtype, device=base.device)
    facing = unit(normal, 1e-3)
    directions = mirrored(rays, facing).reshape(-1, 3).contiguous()
    levels = None if level is None else level.flatten()
    light = shading.far_light(environment, directions, levels).reshape(base.shape)
    if local is not None:
        light = (light + local).clamp(min=0)
    cosine = -dot(rays, facing)[..., None].clamp(-1, 0)
    indices = None if index is None else index[..., None]
    specular, diffuse = shading.contributions(base, strength[..., None], light, cosine, indices)
    return {"final": specular + diffuse, "specular": specular, "diffuse": diffuse, "reflection": light}
