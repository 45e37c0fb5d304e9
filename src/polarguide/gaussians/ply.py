"""PLY files of Gaussians in the format of the 3DGS release, which ordinary viewers open.

The file has one ``vertex`` per Gaussian, in binary little-endian float32. Its 62 fields are position, normal (zero in
the release), spherical harmonics of the display color, opacity (logit), scales (logarithms) and rotation (w, x, y, z).
Some programs, such as the SIBR viewer of the release, assume records of this size for every header. Files with
additional fields are for programs that find fields by name.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError
from torch import Tensor

from polarguide.core.errors import PolarguideError
from polarguide.core.files import atomic
from polarguide.gaussians.harmonics import sh_basis
from polarguide.geometry.vectors import spread_directions

REST_COUNT = 15
DIRECTIONS = 64
TOGETHER = 8192
"""Batch size in Gaussians of the fit, which takes about 100 MB."""

RELEASE_FIELDS = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{i}" for i in range(3)),
    *(f"f_rest_{i}" for i in range(3 * REST_COUNT)),
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
)
"""Fields of the 3DGS release at degree 3, in order. The fields ``f_rest`` begin with all coefficients of red."""


def write_ply(
    path: str | Path,
    *,
    means: Tensor,
    log_scales: Tensor,
    quaternions: Tensor,
    opacity_logits: Tensor,
    sh_dc: Tensor,
    sh_rest: Tensor,
    normals: Tensor | None = None,
    extra: Mapping[str, Tensor] | None = None,
) -> None:
    """Write Gaussians atomically.

    Args:
        path: the file; its folder must exist.
        means: [N, 3] world positions.
        log_scales: [N, 3] natural logarithms of the standard deviations.
        quaternions: [N, 4] rotations (w, x, y, z).
        opacity_logits: [N] or [N, 1].
        sh_dc, sh_rest: [N, 1, 3] and [N, 15, 3] harmonics of the display (sRGB-encoded) color minus 0.5.
        normals: [N, 3] world axes; zero, as in the release, if None.
        extra: additional floating-point tensors [N, ...] by name (letters, digits, underscores). A tensor [N] becomes
            the field ``name``. A tensor [N, ..., C] becomes the fields ``name_0``, ``name_1`` and so on, with the last
            axis varying slowest as in ``f_rest``. A header comment records its shape.

    Raises:
        ValueError: a shape, name or type is wrong.
    """
    count = means.shape[0]
    core = {
        "means": (means, (3,)),
        "log_scales": (log_scales, (3,)),
        "quaternions": (quaternions, (4,)),
        "sh_dc": (sh_dc, (1, 3)),
        "sh_rest": (sh_rest, (REST_COUNT, 3)),
        "normals": (torch.zeros_like(means) if normals is None else normals, (3,)),
    }
    for name, (tensor, shape) in core.items():
        if tensor.shape != (count, *shape):
            raise ValueError(f"{name}: expected {[count, *shape]}, found {list(tensor.shape)}")
    if opacity_logits.numel() != count:
        raise ValueError(f"opacity_logits: expected [{count}], found {list(opacity_logits.shape)}")
    columns = [means, core["normals"][0], sh_dc, sh_rest, opacity_logits, log_scales, quaternions]
    names = list(RELEASE_FIELDS)
    comments = []
    for name, tensor in (extra or {}).items():
        _check_extra(name, tensor, count)
        fields = _extra_fields(name, tuple(tensor.shape[1:]))
        if set(fields) & set(names):
            raise ValueError(f"extra {name!r}: its fields are in the file already")
        names += fields
        columns.append(tensor)
        comments.append(f"extra {' '.join([name, *map(str, tensor.shape[1:])])}")
    table = np.concatenate([_columns(column) for column in columns], axis=1)
    vertices = np.ascontiguousarray(table).view([(name, "<f4") for name in names])[:, 0]
    # Comments of the element, so that its own line is the third, where SIBR expects it.
    element = PlyElement.describe(vertices, "vertex", comments=comments)
    with atomic(Path(path)) as temporary:
        PlyData([element], byte_order="<").write(temporary)


def read_ply(path: str | Path) -> dict[str, Any]:
    """Read Gaussians written by ``write_ply`` or another 3DGS program (any degree of harmonics up to 3).

    Returns:
        ``means``, ``log_scales``, ``quaternions``, ``opacity_logits`` [N], ``sh_dc`` [N, 1, 3] and ``sh_rest`` [N, K,
        3] (K = 15 for degree 3) as float32 tensors. ``extra`` has the other tensors by name, in their shapes. A field
        without a comment is a tensor [N].

    Raises:
        PolarguideError: the file is not a PLY file, or lacks fields of the 3DGS release.
    """
    element = _read_vertex(path)
    names = [p.name for p in element.properties]
    rest = sum(bool(re.fullmatch(r"f_rest_\d+", name)) for name in names)
    missing = [n for n in RELEASE_FIELDS if n not in names and not n.startswith(("f_rest_", "n"))]
    if missing or rest not in (0, 9, 24, 45):
        found = f"no {missing[0]}" if missing else f"{rest} fields f_rest_*"
        raise _unreadable(path, "the vertex fields of a 3DGS file (degree 0 to 3)", found)

    # One pass over the records; reading by field would traverse the file for each field.
    table = torch.from_numpy(structured_to_unstructured(np.asarray(element.data), dtype=np.float32))
    column = {name: index for index, name in enumerate(names)}

    def tensor(fields: list[str], *shape: int) -> Tensor:
        return _from_columns(table[:, [column[f] for f in fields]], shape)

    extra = {}
    allowed = {*RELEASE_FIELDS}
    for comment in element.comments:
        if match := re.fullmatch(r"extra (\w+)((?: \d+)*)", comment):
            shape = tuple(int(size) for size in match[2].split())
            fields = _extra_fields(match[1], shape)
            if not set(fields) <= set(names):
                raise _unreadable(path, f"the fields of {match[1]} that a comment announces", "some missing")
            extra[match[1]] = tensor(fields, *shape)
            allowed |= set(fields)
    extra |= {name: tensor([name]) for name in names if name not in allowed}
    return {
        "means": tensor(["x", "y", "z"], 3),
        "log_scales": tensor([f"scale_{i}" for i in range(3)], 3),
        "quaternions": tensor([f"rot_{i}" for i in range(4)], 4),
        "opacity_logits": tensor(["opacity"]),
        "sh_dc": tensor([f"f_dc_{i}" for i in range(3)], 1, 3),
        "sh_rest": tensor([f"f_rest_{i}" for i in range(rest)], rest // 3, 3)
        if rest
        else torch.zeros(len(element.data), 0, 3),
        "extra": extra,
    }


def refit_sh(
    color_fn: Callable[[slice, Tensor], Tensor],
    normals: Tensor,
    slope: Callable[[Tensor], Tensor] | None = None,
) -> tuple[Tensor, Tensor]:
    """Fit spherical harmonics of degree 3 to the colors of each Gaussian by weighted least squares.

    The model is ``color = 0.5 + sum``, where the sum is over the harmonics. Colors are sampled in evenly spread
    directions. The weight of a direction is the visible area of a flat Gaussian, which is the absolute cosine between
    the direction and the normal.

    Args:
        color_fn: function that returns the colors [P, K, 3] of P selected Gaussians in K directions. The directions [K,
            3] are unit vectors from the camera to the Gaussian.
        normals: [N, 3] unit normals.
        slope: function that returns the slope of the display curve at linear colors. Errors of linear colors are
            multiplied by it, so that they count as displayed. None if ``color_fn`` returns displayed colors.

    Returns:
        A tuple of the harmonics of degree 0, [N, 1, 3], and of degrees 1 to 3, [N, 15, 3], in float32.

    Raises:
        ValueError: ``color_fn`` returns another shape.
    """
    directions = spread_directions(DIRECTIONS).to(torch.float32)
    basis = sh_basis(directions, 3)
    fitted = torch.empty(len(normals), 1 + REST_COUNT, 3)
    for begin in range(0, len(normals), TOGETHER):
        part = slice(begin, min(begin + TOGETHER, len(normals)))
        colors = color_fn(part, directions).detach().to("cpu", torch.float32)
        cosine = normals[part].to("cpu", torch.float32) @ directions.T
        if colors.shape != (*cosine.shape, 3):
            raise ValueError(f"colors: expected {[*cosine.shape, 3]}, found {list(colors.shape)}")
        weights = cosine.abs()[..., None]
        if slope is not None:
            weights = weights * slope(colors).square()
        weighted = weights.movedim(-1, 1)[..., None] * basis  # [P, 1 or 3, K, 16]
        right = weighted.mT @ (colors - 0.5).movedim(-1, 1)[..., None]
        fitted[part] = torch.linalg.solve(basis.T @ weighted, right)[..., 0].mT
    return fitted[:, :1].clone(), fitted[:, 1:].clone()


def _check_extra(name: str, tensor: Tensor, count: int) -> None:
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name):
        raise ValueError(f"extra: expected a name of letters, digits and underscores, found {name!r}")
    if tensor.ndim == 0 or tensor.shape[0] != count or tensor.numel() == 0 < count:
        raise ValueError(f"extra {name!r}: expected [{count}, ...], found {list(tensor.shape)}")
    if not tensor.is_floating_point():
        raise ValueError(f"extra {name!r}: expected floating-point numbers, found {tensor.dtype}")


def _extra_fields(name: str, shape: tuple[int, ...]) -> list[str]:
    return [f"{name}_{i}" for i in range(math.prod(shape))] if shape else [name]


def _columns(tensor: Tensor) -> NDArray[np.float32]:
    """Convert a tensor [N, ...] to a table [N, fields], with the last axis varying slowest."""
    table = tensor.detach().to("cpu", torch.float32)
    if table.ndim > 2:
        table = table.movedim(-1, 1)
    return table.reshape(table.shape[0], math.prod(table.shape[1:])).numpy()


def _from_columns(table: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Convert a table of ``_columns`` back to a tensor [N, *shape]."""
    if len(shape) < 2:
        return table.reshape(-1, *shape)
    return table.reshape(-1, shape[-1], *shape[:-1]).movedim(1, -1).contiguous()


def _read_vertex(path: str | Path) -> PlyElement:
    try:
        data = PlyData.read(path)
    except FileNotFoundError:
        raise _unreadable(path, "a PLY file", "no file") from None
    except (PlyParseError, ValueError, EOFError) as error:
        raise _unreadable(path, "a PLY file", f"something else ({error})") from error
    if "vertex" not in data:
        raise _unreadable(path, "a vertex element", "none")
    vertex = data["vertex"]
    if any(isinstance(field, PlyListProperty) for field in vertex.properties):
        raise _unreadable(path, "vertices of plain numbers", "a list property")
    return vertex


def _unreadable(path: str | Path, expected: str, found: str) -> PolarguideError:
    return PolarguideError(path, expected=expected, found=found, remedy="Specify a PLY file of Gaussians.")
