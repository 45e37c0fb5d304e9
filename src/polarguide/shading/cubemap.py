"""A cubemap of learned light: seamless bilinear look-up, differentiable in texels and directions.

Faces are in OpenGL's order and orientation. On each, s runs with the columns and t with the rows, both from -1 to 1:

==== ===== ===== =====
face major s     t
==== ===== ===== =====
0    +x    -z    -y
1    -x    +z    -y
2    +y    +x    +z
3    -y    +x    -z
4    +z    +x    -y
5    -z    -x    -y
==== ===== ===== =====

so that the direction of face 0 at (s, t) is (1, -t, -s). Seen from within the cube, pictures are upright with +y up.
At a face's edge the taps beyond it are the texels of the neighboring face; beyond a corner, where only three faces
meet, the missing tap is the mean of their three corner texels. So the look-up is continuous everywhere. On the CPU in
float32 it is a native kernel; ``cubemap_lookup_reference`` is its reference implementation in plain torch.

``box_mips`` are box-filtered copies, and ``mip_lookup`` interpolates between two of them (trilinear).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from polarguide import _native
from polarguide.core.native import fits

# Per face: axis and sign of the major component, of s and of t.
_FACES = (
    (0, 1, 2, -1, 1, -1),
    (0, -1, 2, 1, 1, -1),
    (1, 1, 0, 1, 2, 1),
    (1, -1, 0, 1, 2, -1),
    (2, 1, 0, 1, 1, -1),
    (2, -1, 0, -1, 1, -1),
)


def _face_points(coordinates: Tensor, distance: int) -> Tensor:
    """Points [6, n, n, 3] on (extended) faces ``distance`` from the center, at coordinates [n] along s and t."""
    t, s = torch.meshgrid(coordinates, coordinates, indexing="ij")
    points = torch.empty(6, *s.shape, 3, dtype=coordinates.dtype)
    for face, (axis, sign, s_axis, s_sign, t_axis, t_sign) in enumerate(_FACES):
        points[face, ..., axis] = sign * distance
        points[face, ..., s_axis] = s_sign * s
        points[face, ..., t_axis] = t_sign * t
    return points


def texel_directions(resolution: int) -> Tensor:
    """Unit directions of the texel centers, [6, R, R, 3] float32; R at least 1."""
    coordinates = (torch.arange(resolution) + 0.5) * 2 / resolution - 1
    return torch.nn.functional.normalize(_face_points(coordinates, 1), dim=-1)


class _Ring(NamedTuple):
    """The faces with a ring of texels around each, [6, R + 2, R + 2] flattened, as indices into [6, R, R]."""

    source: Tensor  # [6 (R + 2)^2]; at a corner, the face's own corner texel
    corners: Tensor  # [24] places in the ring
    around: Tensor  # [24, 3] the texels that meet there


def _texel_index(face: Tensor, points: Tensor, resolution: int) -> Tensor:
    """Flat texel of points [..., 3] in half texels from the cube's center, on the given faces [...]."""
    table = torch.tensor(_FACES)[face]
    s = table[..., 3] * points.gather(-1, table[..., 2:3])[..., 0]
    t = table[..., 5] * points.gather(-1, table[..., 4:5])[..., 0]
    column = (s + resolution - 1) // 2
    row = (t + resolution - 1) // 2
    return (face * resolution + row) * resolution + column


@lru_cache(maxsize=8)
def _ring(resolution: int, device: torch.device) -> _Ring:
    """A texel beyond an edge is the one that touches the edge from the other side."""
    last = resolution - 1
    place = 2 * torch.arange(-1, resolution + 1) - last  # in half texels from the middle of a face
    inner = place.clamp(-last, last)
    face = torch.arange(6)[:, None, None].expand(6, resolution + 2, resolution + 2)
    own = _texel_index(face, _face_points(inner, resolution), resolution)

    points = _face_points(inner, last)
    outer = _face_points(place, last)

    def across(axis_column: int) -> Tensor:
        """The texel over the edge in s (column 2 of the table) or t (column 4)."""
        axis = torch.tensor(_FACES)[face][..., axis_column]
        negative = outer.gather(-1, axis[..., None])[..., 0] < 0
        return _texel_index(2 * axis + negative.long(), points, resolution)

    out_s = (place.abs() > last)[None, None, :].expand_as(own)
    out_t = (place.abs() > last)[None, :, None].expand_as(own)
    source = torch.where(out_s & ~out_t, across(2), torch.where(out_t & ~out_s, across(4), own))
    corners = (out_s & out_t).flatten().nonzero()[:, 0]
    around = torch.stack([texels.flatten()[corners] for texels in (own, across(2), across(4))], dim=1)
    return _Ring(source.flatten().to(device), corners.to(device), around.to(device))


@lru_cache(maxsize=4)
def _face_table(device: torch.device) -> Tensor:
    """``_FACES`` on a device, [6, 6]."""
    return torch.tensor(_FACES, device=device)


def face_coordinates(directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Face [P], and s and t [P] in [-1, 1], of directions [P, 3]; ties go to the earlier axis, zero to +x's center."""
    x, y, z = directions.abs().unbind(-1)
    axis = torch.where((x >= y) & (x >= z), 0, torch.where(y >= z, 1, 2))
    major = directions.gather(-1, axis[:, None])[:, 0]
    face = 2 * axis + (major < 0)
    table = _face_table(directions.device)[face]
    inverse = 1 / major.abs().masked_fill(major.abs() <= 1e-20, torch.inf)
    s = table[:, 3] * directions.gather(-1, table[:, 2:3])[:, 0] * inverse
    t = table[:, 5] * directions.gather(-1, table[:, 4:5])[:, 0] * inverse
    return face, s, t


def ringed_texels(texture: Tensor) -> Tensor:
    """Texels [6, R, R, C] with a ring of their neighbors around each face, [6 (R + 2)^2, C]."""
    ring = _ring(texture.shape[1], texture.device)
    texels = texture.reshape(-1, texture.shape[-1])
    return texels[ring.source].index_put((ring.corners,), texels[ring.around].mean(dim=1))


def ringed_lookup(
    ringed: Tensor,
    place: tuple[Tensor, Tensor, Tensor],
    resolution: int | Tensor,
    begin: int | Tensor = 0,
) -> Tensor:
    """Bilinear look-up of ringed texels at ``face_coordinates``, [P, C].

    Args:
        ringed: [T, C], one cubemap's or several one after the other.
        place: face, s and t, each [P].
        resolution: R, of all or of each, [P] int64. begin: where in ``ringed`` the cubemap begins, likewise.
    """
    channels = ringed.shape[-1]
    face, s, t = place
    # Texel centers are at half-integers; one is added for the ring. A NaN reads cell 0 and stays in the fraction.
    u = (s + 1) * (resolution / 2) + 0.5
    v = (t + 1) * (resolution / 2) + 0.5
    column, row = (x.detach().nan_to_num(0).clamp(min=0).floor().long() for x in (u, v))
    if isinstance(resolution, Tensor):
        column = column.minimum(resolution)
        row = row.minimum(resolution)
    else:
        column = column.clamp(max=resolution)
        row = row.clamp(max=resolution)
    fu = (u - column)[:, None]
    fv = (v - row)[:, None]
    first = (face * (resolution + 2) + row) * (resolution + 2) + column + begin
    second = first + resolution + 2
    # index_select, not an index: its gradient adds atomically on a GPU, where that of an index sorts first.
    taps = [ringed.index_select(0, tap) for tap in (first, first + 1, second, second + 1)]
    top, bottom = (torch.lerp(a, b, fu.expand(-1, channels)) for a, b in (taps[:2], taps[2:]))
    return torch.lerp(top, bottom, fv.expand(-1, channels))


def cubemap_lookup_reference(texture: Tensor, directions: Tensor) -> Tensor:
    """The reference implementation of ``cubemap_lookup``: plain torch, any dtype and device."""
    return ringed_lookup(ringed_texels(texture), face_coordinates(directions), texture.shape[1])


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, texture: Tensor, directions: Tensor) -> Tensor:
        texture = texture.detach().contiguous()
        directions = directions.detach().contiguous()
        out = texture.new_empty(directions.shape[0], texture.shape[-1])
        _native.cubemap_forward(texture, directions, out)
        ctx.save_for_backward(texture, directions)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:
        texture, directions = ctx.saved_tensors
        to_texture = torch.empty_like(texture) if ctx.needs_input_grad[0] else None
        to_directions = torch.empty_like(directions) if ctx.needs_input_grad[1] else None
        _native.cubemap_backward(texture, directions, grad.contiguous(), to_texture, to_directions)
        return to_texture, to_directions


def cubemap_lookup(texture: Tensor, directions: Tensor) -> Tensor:
    """Seamless bilinear look-up, ``sum_k w_k(direction) texel_k`` over four taps; see the module for the faces.

    The gradient with respect to a direction is that of the weights: it is constant along the ray, so orthogonal to
    the direction, and jumps where the direction passes between cells of four texel centers. A direction of length
    zero reads the middle of +x and gets no gradient; one with a NaN reads NaN.

    Args:
        texture: [6, R, R, C], R at least 1.
        directions: [P, 3], of any length.

    Returns:
        [P, C], differentiable in both; on the CPU the same bits for any number of threads.

    Raises:
        ValueError: if a shape is not as above.
    """
    if (
        texture.ndim != 4
        or texture.shape[0] != 6
        or texture.shape[1] != texture.shape[2]
        or not texture.shape[1]
    ):
        raise ValueError(f"texture: expected shape [6, R, R, C], found {list(texture.shape)}")
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise ValueError(f"directions: expected shape [P, 3], found {list(directions.shape)}")
    if fits(texture, directions):
        result: Tensor = _Lookup.apply(texture, directions)
        return result
    return cubemap_lookup_reference(texture, directions)


# Of the native look-up.
MOST_LEVELS = 16
MOST_CHANNELS = 64


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
        directions = directions.detach().contiguous()
        level = level.detach().contiguous()
        contiguous = [t.detach().contiguous() for t in levels]
        out = directions.new_empty(len(directions), contiguous[0].shape[-1])
        _native.mips_forward(contiguous, directions, level, out)
        ctx.save_for_backward(directions, level, *contiguous)
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
    levels: Sequence[Tensor],
    directions: Tensor,
    level: Tensor,
    grad: Tensor,
    textures: bool,
    grad_light: Tensor | None = None,
) -> tuple[Tensor, Tensor, Sequence[Tensor | None]]:
    """Gradients of the native look-up by directions, level and, with ``textures``, the levels; contiguous tensors.

    Args:
        grad: [P, C]. grad_light: in its place for all but the directions.
    """
    to_directions = torch.empty_like(directions)
    if len(levels) == 1:
        (texture,) = levels
        to_texture = torch.empty_like(texture) if textures else None
        both = None if grad_light is not None else to_texture
        _native.cubemap_backward(texture, directions, grad, both, to_directions)
        if grad_light is not None and textures:
            _native.cubemap_backward(texture, directions, grad_light, to_texture, None)
        return to_directions, torch.zeros_like(level), [to_texture]
    to_level = torch.empty_like(level)
    sizes = [texture.numel() for texture in levels]
    flat = grad.new_empty(sum(sizes)) if textures else None
    _native.mips_backward(levels, directions, level, grad, grad_light, flat, to_directions, to_level)
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
        looked_up: Tensor = _Between.apply(directions, level, *levels)
        return looked_up
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
    below, above = (ringed_lookup(ringed, place, resolutions[k], begins[k]) for k in (lower, upper))
    return torch.lerp(below, above, (level - lower)[:, None].expand_as(below))
