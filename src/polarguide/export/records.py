"""Gaussians as small fixed-size records for the page: what a texture of the graphics card can hold.

A record is a few texels of 16 bytes. All numbers are little-endian; ``f16`` is a half float, ``u16`` an unsigned and
``i16`` a signed 16-bit fraction (of 65535 and 32767).

===== ==================================================================================================
texel content
===== ==================================================================================================
0     mean 3 x float32; opacity u16; ``share`` u16 (strength or roughness)
1     rotation (w, x, y, z) 4 x i16; logarithms of the scales 3 x f16; scale of ``harmonics`` f16
2     ``color`` of degree 0 (or albedo) 3 x f16; normal axis 3 x i16; side u16 (1: the axis points outward)
3-5   ``harmonics`` of degrees 1 to 3, 45 signed bytes in steps of their scale; or ``features`` 4 x i16 in texel 3
6-9   light of its own: ``own_color`` of degree 0 3 x f16, scale f16; then ``own_harmonics`` as above
10    ``metal``: reflectance 3 x f16, roughness f16; 0 of what is no metal
===== ==================================================================================================

The harmonics' scale is each Gaussian's own: the largest of its 45 values is 127 steps. A shading model says which of
these values its records have; they are as long as the last of them needs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize

from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.raster.interface import MINIMUM_ALPHA
from polarguide.shading.model import Parameters

TEXEL = 16
HARMONICS = ("harmonics", "own_harmonics")
SLOTS = {
    "mean": (0, "3<f4"),
    "opacity": (12, "<u2"),
    "share": (14, "<u2"),
    "rotation": (16, "4<i2"),
    "scales": (24, "3<f2"),
    "harmonics_scale": (30, "<f2"),
    "color": (32, "3<f2"),
    "axis": (38, "3<i2"),
    "side": (44, "<u2"),
    "features": (48, "4<i2"),
    "harmonics": (48, "45i1"),
    "own_color": (96, "3<f2"),
    "own_harmonics_scale": (102, "<f2"),
    "own_harmonics": (112, "45i1"),
    "metal": (160, "4<f2"),
}
"""First byte and NumPy type of what a record can hold; a shading model gives ``share`` and what has a color."""


@torch.no_grad()
def records(gaussians: Parameters, values: Mapping[str, Tensor]) -> NDArray[Any]:
    """Quantize Gaussians; those too faint to be drawn at all are left out.

    Args:
        gaussians: the Gaussians. values: of the shading model, [N, ...] by the names of ``SLOTS``.

    Returns:
        [K] records of whole texels, with named fields; in the order of a curve that fills space, so that neighbors
        in it are alike.
    """
    opacity = torch.sigmoid(gaussians["opacity_logits"])
    kept = (opacity >= MINIMUM_ALPHA).nonzero()[:, 0]
    kept = kept[torch.from_numpy(curve_order(gaussians["means"][kept].numpy()))]
    axis, side = _axes(gaussians, kept)
    fields = {
        "mean": gaussians["means"][kept],
        "opacity": opacity[kept],
        "rotation": normalize(gaussians["quaternions"][kept], dim=-1),
        "scales": gaussians["log_scales"][kept],
        "axis": axis,
        **{name: value[kept] for name, value in values.items()},
    }
    harmonics = {name: harmonics_steps(fields.pop(name)) for name in HARMONICS if name in fields}
    data = np.zeros(
        len(kept), record_type([*fields, "side", *harmonics, *(f"{name}_scale" for name in harmonics)])
    )
    data["side"] = side.numpy()
    for name, value in fields.items():
        data[name] = _quantized(value, data.dtype[name].base)
    for name, (steps, scale) in harmonics.items():
        data[name], data[f"{name}_scale"] = steps, scale
    return data


def record_type(names: Sequence[str]) -> np.dtype[Any]:
    """The type of a record with some of ``SLOTS``, as many texels long as these need."""
    offsets, formats = zip(*(SLOTS[name] for name in names), strict=True)
    end = max(at + np.dtype(form).itemsize for at, form in zip(offsets, formats, strict=True))
    size = -(-end // TEXEL) * TEXEL
    return np.dtype({"names": names, "offsets": offsets, "formats": formats, "itemsize": size})


def _quantized(values: Tensor, kind: np.dtype[Any]) -> NDArray[Any]:
    """Values in [0, 1] or [-1, 1] as whole numbers up to the type's largest; floats as they are, within its range."""
    if kind.kind == "f":
        return values.clamp(-6e4, 6e4).numpy() if kind.itemsize == 2 else values.numpy()
    return np.rint(values.numpy().astype(np.float64) * np.iinfo(kind).max)


def planes(data: NDArray[Any]) -> bytes:
    """Records byte by byte, first all first bytes: neighbors are alike, so that they compress well."""
    return np.ascontiguousarray(data.view(np.uint8).reshape(len(data), data.itemsize).T).tobytes()


def harmonics_steps(rest: Tensor) -> tuple[NDArray[np.int8], NDArray[np.float16]]:
    """Harmonics [N, 15, 3] as signed bytes [N, 45] (coefficient by coefficient, RGB), and their steps [N]."""
    flat = rest.flatten(1).numpy()
    step = (np.abs(flat).max(axis=1, initial=0.0) / 127).astype("<f2")
    step = np.maximum(step, np.float16(6e-8))
    steps = np.clip(np.rint(flat / step[:, None].astype(np.float32)), -127, 127)
    return steps.astype(np.int8), step


def _axes(gaussians: Parameters, kept: Tensor) -> tuple[Tensor, Tensor]:
    """Normal axes [K, 3], and 1 [K] where they are turned outward, 0 where the camera alone decides."""
    means, origin = gaussians["means"][kept], torch.zeros(3)
    axes = shortest_axis_normals(means, gaussians["quaternions"][kept], gaussians["log_scales"][kept], origin)
    outward = gaussians.get("outward")
    if outward is None:
        return axes, torch.zeros(len(kept))
    along = (axes * outward[kept]).sum(dim=1)
    return torch.where(along < 0, -1.0, 1.0)[:, None] * axes, (along != 0).float()


def curve_order(means: NDArray[np.float32]) -> NDArray[np.int64]:
    """Order [N] of points [N, 3] along a Z curve (Morton 1966) with 1,024 cells each way."""
    if not len(means):
        return np.zeros(0, dtype=np.int64)
    low, high = np.quantile(means, 0.01, axis=0), np.quantile(means, 0.99, axis=0)
    cells = np.clip((means - low) / np.maximum(high - low, 1e-12) * 1023, 0, 1023).astype(np.int64)
    return curve_places(torch.from_numpy(cells)).argsort(stable=True).numpy()


def curve_places(cells: Tensor) -> Tensor:
    """Places [N] of cells [N, 3], int64 below 1,024, along a Z curve."""
    code = torch.zeros(len(cells), dtype=torch.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code
