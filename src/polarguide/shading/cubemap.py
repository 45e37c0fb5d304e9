"""A cubemap of learned light: seamless bilinear look-up, differentiable in texels and directions.

Faces are in OpenGL's order +x, -x, +y, -y, +z, -z with OpenGL's s to the right and t downwards on each face. At a
face's edge the taps beyond it come from the neighbouring face.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from polarguide import _native

# Per face: axis of the face, of s and of t, and their signs.
_FACES = (
    (0, 1.0, 2, -1.0, 1, -1.0),
    (0, -1.0, 2, 1.0, 1, -1.0),
    (1, 1.0, 0, 1.0, 2, 1.0),
    (1, -1.0, 0, 1.0, 2, -1.0),
    (2, 1.0, 0, 1.0, 1, -1.0),
    (2, -1.0, 0, -1.0, 1, -1.0),
)


def _face_points(coordinates: Tensor) -> Tensor:
    """Points [6, n, n, 3] on the (extended) faces of the cube [-1, 1]^3 at coordinates [n] along s and t."""
    t, s = torch.meshgrid(coordinates, coordinates, indexing="ij")
    points = torch.empty(6, *s.shape, 3, dtype=coordinates.dtype)
    for face, (axis, sign, s_axis, s_sign, t_axis, t_sign) in enumerate(_FACES):
        points[face, ..., axis] = sign
        points[face, ..., s_axis] = s_sign * s
        points[face, ..., t_axis] = t_sign * t
    return points


def texel_directions(resolution: int) -> Tensor:
    """Unit directions of the texel centres, [6, R, R, 3]."""
    coordinates = (torch.arange(resolution) + 0.5) * 2 / resolution - 1
    return torch.nn.functional.normalize(_face_points(coordinates), dim=-1)


def _face_coordinates(directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Face [...], and s and t [...] in [-1, 1] of directions [..., 3]; ties go to the earlier axis."""
    size = directions.abs()
    x, y, z = size.unbind(-1)
    axis = torch.where((x >= y) & (x >= z), 0, torch.where(y >= z, 1, 2))
    major = directions.gather(-1, axis[..., None])[..., 0]
    face = 2 * axis + (major < 0)
    table = torch.tensor(_FACES, dtype=directions.dtype, device=directions.device)[face]
    length = major.abs().clamp(min=1e-20)
    s = table[..., 3] * directions.gather(-1, table[..., 2:3].long())[..., 0] / length
    t = table[..., 5] * directions.gather(-1, table[..., 4:5].long())[..., 0] / length
    return face, s, t


@lru_cache(maxsize=8)
def border_table(resolution: int) -> Tensor:
    """Flat texel of (face, row + 1, column + 1), one texel beyond each edge included: [6, R + 2, R + 2] int32.

    A place beyond an edge is the texel of the neighbouring face in which the extended texel's direction lies.
    """
    coordinates = (torch.arange(-1, resolution + 1, dtype=torch.float64) + 0.5) * 2 / resolution - 1
    face, s, t = _face_coordinates(_face_points(coordinates))
    column = ((s + 1) / 2 * resolution).floor().clamp(0, resolution - 1)
    row = ((t + 1) / 2 * resolution).floor().clamp(0, resolution - 1)
    return ((face * resolution + row) * resolution + column).to(torch.int32).contiguous()


def cubemap_lookup_reference(texture: Tensor, directions: Tensor) -> Tensor:
    """The slow twin of ``cubemap_lookup``: plain torch, any dtype and device."""
    resolution = texture.shape[1]
    face, s, t = _face_coordinates(directions)
    u, v = (s + 1) * resolution / 2 + 0.5, (t + 1) * resolution / 2 + 0.5
    u0 = u.detach().floor().clamp(0, resolution)
    v0 = v.detach().floor().clamp(0, resolution)
    fu, fv = (u - u0)[:, None], (v - v0)[:, None]
    table = border_table(resolution).to(texture.device).long()
    texels = texture.reshape(-1, texture.shape[-1])
    row, column = v0.long(), u0.long()

    def tap(down: int, right: int) -> Tensor:
        return texels[table[face, row + down, column + right]]

    top = tap(0, 0) * (1 - fu) + tap(0, 1) * fu
    bottom = tap(1, 0) * (1 - fu) + tap(1, 1) * fu
    return top * (1 - fv) + bottom * fv


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, texture: Tensor, directions: Tensor) -> Tensor:
        texture, directions = texture.detach().contiguous(), directions.detach().contiguous()
        out = torch.empty(directions.shape[0], texture.shape[-1])
        _native.cubemap_forward(texture, border_table(texture.shape[1]), directions, out)
        ctx.save_for_backward(texture, directions)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:
        texture, directions = ctx.saved_tensors
        to_texture = torch.zeros_like(texture) if ctx.needs_input_grad[0] else None
        to_directions = torch.empty_like(directions) if ctx.needs_input_grad[1] else None
        border = border_table(texture.shape[1])
        _native.cubemap_backward(texture, border, directions, grad.contiguous(), to_texture, to_directions)
        return to_texture, to_directions


def cubemap_lookup(texture: Tensor, directions: Tensor) -> Tensor:
    """Bilinear look-up.

    Args:
        texture: [6, R, R, C]. directions: [P, 3], any length but 0.

    Returns:
        [P, C], differentiable in both.
    """
    if texture.device.type == "cpu" and texture.dtype == torch.float32:
        result: Tensor = _Lookup.apply(texture, directions)
        return result
    return cubemap_lookup_reference(texture, directions)
