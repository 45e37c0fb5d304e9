"""Mip levels of a cubemap: box-filtered copies, and the look-up between two of them (trilinear)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from polarguide import _native
from polarguide.native import fits
from polarguide.shading.cubemap import bilinear, face_coordinates, ringed_texels

# Of the native look-up.
MOST_LEVELS, MOST_CHANNELS = 16, 64


def box_mips(texture: Tensor) -> list[Tensor]:
    """A cubemap and its box-filtered levels.

    Each level averages 2 x 2 texels of the one before within a face. Below one texel a face comes a last level, the
    plain mean of all texels on every face, so that the coarsest light has no direction left.

    Args:
        texture: [6, R, R, C], R a power of two.

    Returns:
        ``log2 R + 2`` textures of resolutions R, R / 2, ..., 1, and 1; differentiable.

    Raises:
        ValueError: if the shape is not as above.
    """
    resolution = texture.shape[1] if texture.ndim == 4 else 0
    if (
        tuple(texture.shape[:3]) != (6, resolution, resolution)
        or resolution < 1
        or resolution.bit_count() != 1
    ):
        raise ValueError(f"texture: expected [6, R, R, C], R a power of two, found {list(texture.shape)}")
    levels = [texture]
    while (size := levels[-1].shape[1]) > 1:
        boxes = levels[-1].reshape(6, size // 2, 2, size // 2, 2, -1)
        levels.append(boxes.mean(dim=(2, 4)))
    levels.append(levels[-1].mean(dim=0, keepdim=True).expand_as(levels[-1]))
    return levels


class _Between(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, directions: Tensor, level: Tensor, *levels: Tensor) -> Tensor:
        directions, level = directions.detach().contiguous(), level.detach().contiguous()
        kept = [t.detach().contiguous() for t in levels]
        out = directions.new_empty(len(directions), kept[0].shape[-1])
        _native.mips_forward(kept, directions, level, out)
        ctx.save_for_backward(directions, level, *kept)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        directions, level, *levels = ctx.saved_tensors
        to_directions, to_level, to_levels = mips_backward(
            levels, directions, level, grad.contiguous(), any(ctx.needs_input_grad[2:])
        )
        return to_directions, to_level, *to_levels


def mips_backward(
    levels: Sequence[Tensor], directions: Tensor, level: Tensor, grad: Tensor, textures: bool
) -> tuple[Tensor, Tensor, Sequence[Tensor | None]]:
    """Gradients of the native look-up by directions, level and, with ``textures``, the levels; contiguous tensors."""
    to_directions, to_level = torch.empty_like(directions), torch.empty_like(level)
    sizes = [texture.numel() for texture in levels]
    flat = grad.new_empty(sum(sizes)) if textures else None
    _native.mips_backward(levels, directions, level, grad, flat, to_directions, to_level)
    if flat is None:
        return to_directions, to_level, [None] * len(levels)
    parts = zip(flat.split(sizes), levels, strict=True)
    return to_directions, to_level, [part.view_as(texture) for part, texture in parts]


def mip_lookup(levels: Sequence[Tensor], directions: Tensor, level: Tensor) -> Tensor:
    """Look-up between mip levels: seamless bilinear on the two nearest, linear between them.

    On the CPU in float32 a native pass, up to 16 levels and 64 channels; ``mip_lookup_reference`` is its reference
    implementation. The gradient with respect to ``level`` is the difference of the two levels, and 0 beyond the ends.

    Args:
        levels: L textures as of ``box_mips``, [6, R_l, R_l, C].
        directions: [P, 3], of any length.
        level: [P], clamped to [0, L - 1].

    Returns:
        [P, C], differentiable in all three; on the CPU the same bits for any number of threads.
    """
    native = len(levels) <= MOST_LEVELS and 1 <= levels[0].shape[-1] <= MOST_CHANNELS
    if native and fits(directions, level, *levels):
        found: Tensor = _Between.apply(directions, level, *levels)
        return found
    return mip_lookup_reference(levels, directions, level)


@lru_cache(maxsize=8)
def _sizes(resolutions: tuple[int, ...], device: torch.device) -> tuple[Tensor, Tensor]:
    """Resolutions of levels, and where each begins among their ringed texels, [L] int64 both."""
    counts = [6 * (resolution + 2) ** 2 for resolution in resolutions]
    begins = [sum(counts[:level]) for level in range(len(counts))]
    return torch.tensor(resolutions, device=device), torch.tensor(begins, device=device)


def mip_lookup_reference(levels: Sequence[Tensor], directions: Tensor, level: Tensor) -> Tensor:
    """The reference implementation of ``mip_lookup``: plain torch, any dtype and device, without a loop over what is
    found, since counting the directions of a level would wait for the device.
    """
    last = len(levels) - 1
    level = level.clamp(0, last)
    # The last level is reached as the upper one of a pair, so that there is always a pair.
    lower = level.detach().nan_to_num(0).floor().long().clamp(max=max(0, last - 1))
    resolutions, begins = _sizes(tuple(texture.shape[1] for texture in levels), directions.device)
    ringed = torch.cat([ringed_texels(texture) for texture in levels])
    place = face_coordinates(directions)
    upper = (lower + 1).clamp(max=last)
    below, above = (bilinear(ringed, place, resolutions[k], begins[k]) for k in (lower, upper))
    return torch.lerp(below, above, (level - lower)[:, None].expand_as(below))
