"""Native passes over the G-buffer on the CPU.

The reference implementations of ``reflect_native`` are ``DeferredShading.reflect`` and ``metal.metal_pixels``. The
reference implementation of ``split_native`` is ``gbuffer.split_reference``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from polarguide import _native
from polarguide.core.native import applied
from polarguide.geometry.camera import Camera
from polarguide.shading.cubemap import LEVELS, mips_backward
from polarguide.shading.metal import MINIMUM_SHARE, where_metal
from polarguide.shading.model import GBuffer
from polarguide.shading.result import MetalPixels, first_channel


class MetalArguments(NamedTuple):
    """Arguments of the native pass for metals, see ``shading.metal``.

    Attributes:
        pixels: [K] int64 indices of pixels that show metal, ascending.
        first: index of the first of the four channels of metals.
        least_share: metalness of a pixel below which it is shaded as a dielectric.
    """

    pixels: Tensor
    first: int
    least_share: float = MINIMUM_SHARE


class ReflectArguments(NamedTuple):
    """Arguments of ``reflect_native`` from a shading model and its G-buffer.

    Attributes:
        fresnel: True for the blend "fresnel", False for the blend "lerp", see ``DeferredShading``.
        local: True if channels 7 to 9 are local light, which is added to the light of the environment.
        refractive_index: refractive index in Fresnel's equations.
        index_channel: channel of the offset of the refractive index, without a gradient. -1 means that all surfaces
        have the index of the run.
        blur_channel: channel of the blended blur. -1 means that all surfaces are mirrors.
        blur: number of mip levels from a mirror to a blur of 1.
        alpha: [P] divisor of the blended blur, without a gradient.
        metal: metals in the picture, which are added to ``final`` and ``specular``. None without metals.
        detached: True to also return ``specular`` and ``diffuse`` without a gradient on the normals. Light that metals
            mirror keeps this gradient.
    """

    fresnel: bool
    local: bool
    refractive_index: float
    index_channel: int = -1
    blur_channel: int = -1
    blur: float = 0.0
    alpha: Tensor | None = None
    metal: MetalArguments | None = None
    detached: bool = False

    @property
    def shading(self) -> dict[str, Any]:
        """Arguments of the native functions that determine the weight of the light."""
        return {
            "fresnel": self.fresnel,
            "local": self.local,
            "refractive_index": self.refractive_index,
            "index": self.index_channel,
        }

    @property
    def level(self) -> dict[str, Any]:
        """Arguments of the native functions that determine the mip level of the light."""
        return {"roughness": self.blur_channel, "blur": self.blur, "alpha": self.alpha}

    @property
    def outputs(self) -> list[str]:
        """Names of the outputs of ``reflect_native``, in order."""
        detached = DETACHED if self.detached else []
        return [*_LAYERS, *detached, *(_METAL if self.metal is not None else [])]


_LAYERS = ["final", "specular", "diffuse", "reflection"]
DETACHED = ["detached_specular", "detached_diffuse"]
"""Names of the layers without a gradient on the normals."""
_METAL = ["share", "reflected", "slope"]


class _Reflect(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, features: Tensor, rays: Tensor, arguments: ReflectArguments, *textures: Tensor
    ) -> tuple[Tensor, ...]:
        features, rays, *levels = (t.detach().contiguous() for t in (features, rays, *textures))
        learns = any(ctx.needs_input_grad)
        directions = torch.empty_like(rays) if learns else None
        level = rays.new_empty(len(rays)) if learns else None
        looked_up = torch.empty_like(rays) if learns else None
        outputs: dict[str, Any] = {name: torch.empty_like(rays) for name in _LAYERS}
        _native.reflect_forward(
            features,
            rays,
            levels,
            **arguments.shading,
            **arguments.level,
            directions=directions,
            level=level,
            seen=looked_up,
            **outputs,
        )
        light = None
        reflected: dict[str, Any] = {}
        if arguments.metal is not None:
            light = outputs["reflection"]
            count = len(arguments.metal.pixels)
            reflected = {name: rays.new_empty(count, 3) for name in _METAL}
            reflected["share"] = rays.new_empty(count)
            lobes = {name: outputs[name] for name in ("final", "specular")}
            _native.metal_layers(
                features, rays, **arguments.metal._asdict(), light=light, **reflected, **lobes
            )
            ctx.mark_non_differentiable(reflected["share"])
        ctx.arguments = arguments
        ctx.set_materialize_grads(False)
        if learns:
            ctx.save_for_backward(features, rays, directions, level, looked_up, light, *levels)
        if arguments.detached:
            outputs |= {name: outputs[name.removeprefix("detached_")].clone() for name in DETACHED}
        return *outputs.values(), *reflected.values()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        features, rays, directions, level, looked_up, light, *levels = ctx.saved_tensors
        arguments: ReflectArguments = ctx.arguments
        contiguous = (None if grad is None else grad.contiguous() for grad in grads)
        by = dict(zip(arguments.outputs, contiguous, strict=True))
        by_detached = [by.get(name) for name in DETACHED]
        to_features = torch.empty_like(features)
        to_looked_up = torch.empty_like(looked_up)
        # Gradients of the detached layers reach the light, but not the normals through the directions.
        to_texels = None if all(grad is None for grad in by_detached) else torch.empty_like(looked_up)
        to_light = by["reflection"]
        metal = arguments.metal
        if metal is not None:
            to_light = torch.zeros_like(rays) if to_light is None else to_light.clone()
            to_normal = rays.new_empty(len(metal.pixels), 3)
            to_metal = rays.new_empty(len(metal.pixels), 4)
            _native.metal_backward(
                features,
                rays,
                **metal._asdict(),
                light=light,
                grad_final=by["final"],
                grad_specular=by["specular"],
                grad_held=by_detached[0],
                grad_reflected=by["reflected"],
                grad_slope=by["slope"],
                grad_light=to_light,
                grad_normal=to_normal,
                grad_metal=to_metal,
            )
        _native.reflect_backward_layers(
            features,
            rays,
            looked_up,
            **arguments.shading,
            grad_final=by["final"],
            grad_specular=by["specular"],
            grad_diffuse=by["diffuse"],
            grad_reflection=to_light,
            grad_held_specular=by_detached[0],
            grad_held_diffuse=by_detached[1],
            grad_seen=to_looked_up,
            grad_texels=to_texels,
            grad_features=to_features,
        )
        if metal is not None:
            to_features[:, 3:6].index_add_(0, metal.pixels, to_normal)
            to_features[:, metal.first : metal.first + 4].index_add_(0, metal.pixels, to_metal)
        learns_light = any(ctx.needs_input_grad[3:])
        to_directions, to_level, to_textures = mips_backward(
            levels, directions, level, to_looked_up, learns_light, to_texels
        )
        _native.reflect_backward_directions(
            features,
            rays,
            **arguments.level,
            grad_directions=to_directions,
            grad_level=to_level,
            grad_features=to_features,
        )
        return to_features, None, None, *to_textures


def world_rays_native(camera: Camera) -> Tensor:
    """Return ``Camera.world_rays`` in float32 on the CPU, computed in one pass: [P, 3]."""
    rays = camera.rays().flatten(0, 1)
    turned = torch.empty_like(rays)
    _native.turn(rays, camera.pose(torch.float32, rays.device).rotation.flatten().tolist(), turned)
    return turned


def reflect_native(
    features: Tensor, rays: Tensor, textures: Sequence[Tensor], arguments: ReflectArguments
) -> tuple[Tensor, ...]:
    """Shade a G-buffer by deferred reflection (Ye et al. 2024, Eq. 5, or Fresnel-weighted).

    All tensors are float32 on the CPU.

    Args:
        features: [P, D] blended base color, normal, strength and, with ``local``, local light. Other channels may
            follow.
        rays: [P, 3] unit rays, world axes.
        textures: mip levels of the environment, [6, R, R, 3] each. With ``fresnel`` they are radiance. Otherwise there
            is one level of raw texels.
        arguments: arguments of the shading.

    Returns:
        ``final``, ``specular``, ``diffuse`` and ``reflection``, each [P, 3], differentiable in features and textures.
        With ``detached``, the two detached layers follow. With ``metal``, three tensors of K pixels follow: the share
        of metal [K] without a gradient, the light that metal reflects [K, 3], and its degree of polarization over
        ``sin^2(zenith)`` [K, 3]. Results do not depend on the number of threads.

    Raises:
        ValueError: a shape does not fit.
    """
    layers: tuple[Tensor, ...] = applied(_Reflect, features, rays, arguments, *textures)
    return layers


def shade_native(
    splatted: GBuffer,
    textures: Sequence[Tensor],
    camera: Camera,
    *,
    fresnel: bool,
    local: bool,
    refractive_index: float,
) -> dict[str, Any]:
    """Return the layers of ``reflect_native`` by name, each [H, W, 3].

    The entry ``metal`` holds the metals in the picture, or None without metals.
    """
    layout = splatted.layout
    features = splatted.features.flatten(0, 1)
    index_channel = first_channel(layout, "index")
    arguments = ReflectArguments(fresnel, local, refractive_index, index_channel, detached=splatted.detached)
    if "blur" in layout:
        alpha = splatted.alpha.detach().flatten()
        arguments = arguments._replace(blur_channel=first_channel(layout, "blur"), blur=LEVELS, alpha=alpha)
    if "reflectance" in layout:
        first = first_channel(layout, "reflectance")
        arguments = arguments._replace(metal=MetalArguments(where_metal(features, first), first))
    outputs = reflect_native(features, world_rays_native(camera), textures, arguments)
    shaded = dict(zip(arguments.outputs, outputs, strict=True))
    metal = None
    if arguments.metal is not None:
        metal = MetalPixels(arguments.metal.pixels, *(shaded.pop(name) for name in _METAL))
    size = splatted.alpha.shape
    return {**{name: layer.unflatten(0, size) for name, layer in shaded.items()}, "metal": metal}


class _GBufferSplit(torch.autograd.Function):
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
    """Extract the blended normal and the depth from a G-buffer, with one gradient pass for all results.

    Args:
        features: [H, W, D] blended color, normal and at least one further channel; float32 on the CPU.
        alpha: [H, W], float32 on the CPU.
        depth: True if the last channel is the depth times alpha.

    Returns:
        A tuple of ``features`` for further use, the normal [H, W, 3], and the depth [H, W] or None.

    Raises:
        ValueError: a shape does not fit.
    """
    rest, normal, deep = _GBufferSplit.apply(features, alpha, depth)
    return rest, normal, deep
