"""Cubemaps of learned light: seamless bilinear look-up, differentiable in texels and directions.

Faces have OpenGL's order and orientation. On each face s increases along columns and t along rows, from -1 to 1:

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

The direction of face 0 at (s, t) is (1, -t, -s). From within the cube, pictures are upright with +y up. Beyond an
edge of a face the taps are texels of the neighboring face. Beyond a corner, where three faces meet, the tap is the
mean of their three corner texels. So the look-up is continuous everywhere. On the CPU in float32 it is a native
kernel; ``cubemap_lookup_reference`` is its reference implementation in plain torch.

``box_mips`` returns box-filtered copies, and ``mip_lookup`` interpolates between two of them (trilinear).

The blur b of a Gaussian, in [0, 1], selects the level ``LEVELS b`` of the box-filtered radiance. A pixel has the mean
blur of its Gaussians. A level blurs like the GGX lobe (Walter et al. 2007) whose full width at half maximum equals the
width of the level's texels. For narrow lobes that width is 147 degrees times alpha, so with R texels along a face's
side

    alpha = 2^(LEVELS b) (90 degrees / R) / (147 degrees)

With R = 32 a mirror has an alpha of 0.019, the blur of its own texel, and a blur of 1 has 0.31.
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

_FACES = (
    (0, 1, 2, -1, 1, -1),
    (0, -1, 2, 1, 1, -1),
    (1, 1, 0, 1, 2, 1),
    (1, -1, 0, 1, 2, -1),
    (2, 1, 0, 1, 1, -1),
    (2, -1, 0, -1, 1, -1),
)
"""Axis and sign of the major component, of s and of t, for each face."""


def _face_points(coordinates: Tensor, distance: int) -> Tensor:
    """Return points [6, n, n, 3] in the planes of the faces, for coordinates [n] of s and t.

    The planes are at ``distance`` from the center, and coordinates may lie beyond the edges of a face.
    """
    t, s = torch.meshgrid(coordinates, coordinates, indexing="ij")
    points = torch.empty(6, *s.shape, 3, dtype=coordinates.dtype)
    for face, (axis, sign, s_axis, s_sign, t_axis, t_sign) in enumerate(_FACES):
        points[face, ..., axis] = sign * distance
        points[face, ..., s_axis] = s_sign * s
        points[face, ..., t_axis] = t_sign * t
    return points


def texel_directions(resolution: int) -> Tensor:
    """Return unit directions of the texel centers, [6, R, R, 3] float32; R at least 1."""
    coordinates = (torch.arange(resolution) + 0.5) * 2 / resolution - 1
    return torch.nn.functional.normalize(_face_points(coordinates, 1), dim=-1)


class _Ring(NamedTuple):
    """Index tables that surround each face of texels [6, R, R] with a ring of neighboring texels.

    The result of these tables is [6, R + 2, R + 2].

    Attributes:
        source: [6 (R + 2)^2] index of the texel at each place. At a corner it is the corner texel of the face itself.
        corners: [24] places of the corners.
        around: [24, 3] indices of the texels that meet at each corner.
    """

    source: Tensor
    corners: Tensor
    around: Tensor


def _texel_index(face: Tensor, points: Tensor, resolution: int) -> Tensor:
    """Return the flat index of texels at points [..., 3] on faces [...], in half texels from the cube's center."""
    table = torch.tensor(_FACES)[face]
    s = table[..., 3] * points.gather(-1, table[..., 2:3])[..., 0]
    t = table[..., 5] * points.gather(-1, table[..., 4:5])[..., 0]
    column = (s + resolution - 1) // 2
    row = (t + resolution - 1) // 2
    return (face * resolution + row) * resolution + column


@lru_cache(maxsize=8)
def _ring(resolution: int, device: torch.device) -> _Ring:
    """Return the index tables. Beyond an edge lies the texel of the neighboring face that touches the edge."""
    last = resolution - 1
    place = 2 * torch.arange(-1, resolution + 1) - last  # half texels from the middle of a face
    inner = place.clamp(-last, last)
    face = torch.arange(6)[:, None, None].expand(6, resolution + 2, resolution + 2)
    own = _texel_index(face, _face_points(inner, resolution), resolution)

    points = _face_points(inner, last)
    outer = _face_points(place, last)

    def across(axis_column: int) -> Tensor:
        """Return the texels beyond the edge in s (column 2 of the table) or t (column 4)."""
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
    """Return ``_FACES`` on a device, [6, 6]."""
    return torch.tensor(_FACES, device=device)


def face_coordinates(directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the face [P] that directions [P, 3] meet, and the coordinates s and t [P] in [-1, 1] on it.

    Ties between axes go to the first axis. A zero direction meets the center of the face +x.
    """
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
    """Return texels [6, R, R, C] with a ring of neighboring texels around each face, [6 (R + 2)^2, C]."""
    ring = _ring(texture.shape[1], texture.device)
    texels = texture.reshape(-1, texture.shape[-1])
    return texels[ring.source].index_put((ring.corners,), texels[ring.around].mean(dim=1))


def ringed_lookup(
    ringed: Tensor,
    place: tuple[Tensor, Tensor, Tensor],
    resolution: int | Tensor,
    begin: int | Tensor = 0,
) -> Tensor:
    """Look up ringed texels bilinearly.

    Args:
        ringed: [T, C] texels of one or several cubemaps.
        place: face, s and t of ``face_coordinates``, each [P].
        resolution: R, a number or [P] int64.
        begin: index of the first texel of the cubemap in ``ringed``, a number or [P] int64.

    Returns:
        [P, C].
    """
    channels = ringed.shape[-1]
    face, s, t = place
    # Texel centers lie at half-integers, and the ring adds one. A NaN reads cell 0 and remains in the fraction.
    u = (s + 1) * (resolution / 2) + 0.5
    v = (t + 1) * (resolution / 2) + 0.5
    column, row = (x.detach().nan_to_num(0).clamp(min=0).floor().long().clamp(max=resolution) for x in (u, v))
    fu = (u - column)[:, None]
    fv = (v - row)[:, None]
    first = (face * (resolution + 2) + row) * (resolution + 2) + column + begin
    second = first + resolution + 2
    # On a GPU the gradient of index_select adds atomically; the gradient of an index sorts first, which is slower.
    taps = [ringed.index_select(0, tap) for tap in (first, first + 1, second, second + 1)]
    top, bottom = (torch.lerp(a, b, fu.expand(-1, channels)) for a, b in (taps[:2], taps[2:]))
    return torch.lerp(top, bottom, fv.expand(-1, channels))


def cubemap_lookup_reference(texture: Tensor, directions: Tensor) -> Tensor:
    """Compute ``cubemap_lookup`` in plain torch, for any dtype and device: the reference implementation."""
    return ringed_lookup(ringed_texels(texture), face_coordinates(directions), texture.shape[1])


def cubemap_lookup(texture: Tensor, directions: Tensor) -> Tensor:
    """Look up a cubemap by bilinear interpolation without seams: ``sum_k w_k(direction) texel_k`` over four texels.

    The gradient with respect to a direction is the gradient of the weights. It is orthogonal to the direction, and
    discontinuous where the four texels change. A direction of length zero reads the middle of the face +x and gets no
    gradient. A NaN in a direction gives NaN.

    Args:
        texture: [6, R, R, C], R at least 1; see the module for the faces.
        directions: [P, 3], of any length.

    Returns:
        Values [P, C], differentiable in texture and directions. On the CPU they do not depend on the number of threads.

    Raises:
        ValueError: a shape does not fit.
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
        result: Tensor = _Lookup.apply(directions, directions.new_zeros(len(directions)), texture)
        return result
    return cubemap_lookup_reference(texture, directions)


MOST_LEVELS = 16
"""Maximum number of mip levels of the native look-up."""
MOST_CHANNELS = 64
"""Maximum number of channels of the native look-up."""


def box_mips(texture: Tensor) -> list[Tensor]:
    """Return a cubemap and its box-filtered levels.

    Each level averages 2 x 2 texels of the previous level within a face. The last level but one has one texel per face.
    The last level is the mean of all texels, which does not depend on the direction.

    Args:
        texture: [6, R, R, C], R a power of two.

    Returns:
        ``log2 R + 2`` textures of resolutions R, R / 2, ..., 1, and 1; differentiable.

    Raises:
        ValueError: the shape does not fit.
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


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, directions: Tensor, level: Tensor, *levels: Tensor) -> Tensor:
        directions = directions.detach().contiguous()
        level = level.detach().contiguous()
        contiguous = [t.detach().contiguous() for t in levels]
        out = directions.new_empty(len(directions), contiguous[0].shape[-1])
        if len(contiguous) == 1:
            _native.cubemap_forward(contiguous[0], directions, out)
        else:
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
    """Return gradients of the native look-up with respect to directions, level and textures.

    Args:
        levels, directions, level: inputs of the look-up, contiguous.
        grad: [P, C] gradient with respect to the result of the look-up.
        textures: True to compute gradients with respect to the textures.
        grad_light: [P, C] gradient that replaces ``grad`` for the level and the textures.
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
    """Look up the two nearest mip levels without seams, and interpolate linearly between them.

    In float32 on the CPU, a native pass supports up to 16 levels and 64 channels. The gradient with respect to
    ``level`` is the difference of the two levels, and 0 beyond the ends.

    Args:
        levels: L textures [6, R_l, R_l, C] as returned by ``box_mips``.
        directions: [P, 3], of any length.
        level: [P], clamped to [0, L - 1].

    Returns:
        Values [P, C], differentiable in all arguments. On the CPU they do not depend on the number of threads.
    """
    native = len(levels) <= MOST_LEVELS and 1 <= levels[0].shape[-1] <= MOST_CHANNELS
    if native and fits(directions, level, *levels):
        looked_up: Tensor = _Lookup.apply(directions, level, *levels)
        return looked_up
    return mip_lookup_reference(levels, directions, level)


@lru_cache(maxsize=8)
def _sizes(resolutions: tuple[int, ...], device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the resolution of each level, and the index of its first ringed texel, both [L] int64."""
    counts = [6 * (resolution + 2) ** 2 for resolution in resolutions]
    begins = [sum(counts[:level]) for level in range(len(counts))]
    return torch.tensor(resolutions, device=device), torch.tensor(begins, device=device)


def mip_lookup_reference(levels: Sequence[Tensor], directions: Tensor, level: Tensor) -> Tensor:
    """Compute ``mip_lookup`` in plain torch, for any dtype and device: the reference implementation.

    It does not loop over levels, because counting the directions of a level would wait for the device.
    """
    last = len(levels) - 1
    level = level.clamp(0, last)
    # The last level is always the upper level of a pair.
    lower = level.detach().nan_to_num(0).floor().long().clamp(max=max(0, last - 1))
    resolutions, begins = _sizes(tuple(texture.shape[1] for texture in levels), directions.device)
    ringed = torch.cat([ringed_texels(texture) for texture in levels])
    place = face_coordinates(directions)
    upper = (lower + 1).clamp(max=last)
    below, above = (ringed_lookup(ringed, place, resolutions[k], begins[k]) for k in (lower, upper))
    return torch.lerp(below, above, (level - lower)[:, None].expand_as(below))


LEVELS = 4
"""Number of mip levels from a mirror to a blur of 1."""
LOBE_WIDTH = 147.0
"""Full width at half maximum of the GGX lobe, in degrees per unit of alpha."""


def light_levels(radiance: Tensor) -> list[Tensor]:
    """Return the mip levels of radiance [6, R, R, 3] from a mirror to a blur of 1."""
    return box_mips(radiance)[: LEVELS + 1]


def ggx_alpha(blur: Tensor, resolution: int) -> Tensor:
    """Return the alpha of GGX that gives a blur in [0, 1], for ``resolution`` texels along the side of a face."""
    return torch.exp2(LEVELS * blur) * (90 / resolution / LOBE_WIDTH)


def gltf_roughness(blur: Tensor, resolution: int) -> Tensor:
    """Return the roughness of glTF that gives a blur in [0, 1], without a gradient.

    It is the square root of the alpha of GGX.
    """
    return ggx_alpha(blur.detach(), resolution).sqrt()
