"""Mip levels of a cubemap: box-filtered copies, and the look-up between two of them (trilinear)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from polarguide.shading.cubemap import bilinear, cubemap_lookup, face_coordinates, ringed_texels


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


def mip_lookup(levels: Sequence[Tensor], directions: Tensor, level: Tensor) -> Tensor:
    """Look-up between mip levels: seamless bilinear on the two nearest, linear between them.

    Only the two levels that a direction needs are read: on the CPU level by level, with the native look-up;
    elsewhere all directions at once, since counting those of a level would wait for the device. The gradient with
    respect to ``level`` is the difference of those two, and 0 beyond the ends.

    Args:
        levels: L textures as of ``box_mips``, [6, R_l, R_l, C].
        directions: [P, 3], of any length.
        level: [P], clamped to [0, L - 1].

    Returns:
        [P, C], differentiable in all three.
    """
    last = len(levels) - 1
    level = level.clamp(0, last)
    # The last level is reached as the upper one of a pair, so that there is always a pair.
    lower = level.detach().nan_to_num(0).floor().long().clamp(max=max(0, last - 1))
    fraction = level - lower
    if directions.device.type != "cpu":
        return mip_lookup_at_once(levels, directions, lower, fraction)
    out = directions.new_zeros(directions.shape[0], levels[0].shape[-1])
    for index, texture in enumerate(levels):
        own = lower == index
        chosen = (own | (lower == index - 1)).nonzero()[:, 0]
        if chosen.numel():
            weight = torch.where(own, 1 - fraction, fraction)[chosen, None]
            out.index_add_(0, chosen, weight * cubemap_lookup(texture, directions[chosen]))
    return out


@lru_cache(maxsize=8)
def _sizes(resolutions: tuple[int, ...], device: torch.device) -> tuple[Tensor, Tensor]:
    """Resolutions of levels, and where each begins among their ringed texels, [L] int64 both."""
    counts = [6 * (resolution + 2) ** 2 for resolution in resolutions]
    begins = [sum(counts[:level]) for level in range(len(counts))]
    return torch.tensor(resolutions, device=device), torch.tensor(begins, device=device)


def mip_lookup_at_once(
    levels: Sequence[Tensor], directions: Tensor, lower: Tensor, fraction: Tensor
) -> Tensor:
    """``mip_lookup`` in plain torch without a loop over what is found, for any device.

    Args:
        levels, directions: as of ``mip_lookup``.
        lower: [P] int64, the lower level of the pair, at most L - 2 (0 for a single level).
        fraction: [P], of the way to the upper one.
    """
    resolutions, begins = _sizes(tuple(texture.shape[1] for texture in levels), directions.device)
    ringed = torch.cat([ringed_texels(texture) for texture in levels])
    place = face_coordinates(directions)
    upper = (lower + 1).clamp(max=len(levels) - 1)
    below, above = (bilinear(ringed, place, resolutions[k], begins[k]) for k in (lower, upper))
    return torch.lerp(below, above, fraction[:, None].expand_as(below))
