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
===== ==================================================================================================

The harmonics' scale is each Gaussian's own: the largest of its 45 values is 127 steps. A shading model says which of
these values its records have; they are as long as the last of them needs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize

from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.raster.interface import MINIMUM_ALPHA
from polarguide.shading.model import Parameters

TEXEL = 16
Bytes = NDArray[np.uint8]


class Slot(NamedTuple):
    """Where a value lies in a record: its first byte; for harmonics also that of their scale."""

    at: int
    form: str
    scale_at: int = 0


SLOTS = {
    "share": Slot(14, "u16"),
    "color": Slot(32, "f16"),
    "harmonics": Slot(48, "steps", scale_at=30),
    "features": Slot(48, "i16"),
    "own_color": Slot(96, "f16"),
    "own_harmonics": Slot(112, "steps", scale_at=102),
}
"""What a shading model can put into records, by name."""


@dataclass(frozen=True, eq=False)
class Records:
    """Quantized Gaussians.

    Attributes:
        data: [N, 16 K] uint8, K texels each.
    """

    data: Bytes

    @property
    def texels(self) -> int:
        """K."""
        return self.data.shape[1] // TEXEL

    def planes(self) -> bytes:
        """The records byte by byte, first all first bytes: neighbors are alike, so that they compress well."""
        return np.ascontiguousarray(self.data.T).tobytes()


@torch.no_grad()
def records(gaussians: Parameters, values: Mapping[str, Tensor]) -> Records:
    """Quantize Gaussians; those too faint to be drawn at all are left out.

    Args:
        gaussians: the Gaussians. values: of the shading model, [N, ...] by the names of ``SLOTS``.

    Returns:
        In the order of a curve that fills space, so that neighbors in it are alike.
    """
    opacity = torch.sigmoid(gaussians["opacity_logits"])
    kept = (opacity >= MINIMUM_ALPHA).nonzero()[:, 0]
    kept = kept[torch.from_numpy(curve_order(gaussians["means"][kept].numpy()))]
    axis, side = _axes(gaussians, kept)
    parts = [
        (0, gaussians["means"][kept].numpy().astype("<f4")),
        (12, _fraction(opacity[kept], 65535, "<u2")),
        (16, _fraction(normalize(gaussians["quaternions"][kept], dim=-1), 32767, "<i2")),
        (24, gaussians["log_scales"][kept].numpy().astype("<f2")),
        (38, _fraction(axis, 32767, "<i2")),
        (44, side.numpy().astype("<u2")),
    ]
    for name, value in values.items():
        slot, chosen = SLOTS[name], value[kept]
        if slot.form == "steps":
            steps, scale = harmonics_steps(chosen)
            parts += [(slot.at, steps), (slot.scale_at, scale)]
        elif slot.form == "f16":
            parts.append((slot.at, chosen.clamp(-6e4, 6e4).numpy().astype("<f2")))
        else:
            full, kind = (65535, "<u2") if slot.form == "u16" else (32767, "<i2")
            parts.append((slot.at, _fraction(chosen, full, kind)))
    return _joined(parts, len(kept))


def _joined(parts: list[tuple[int, NDArray[Any]]], count: int) -> Records:
    """Records of arrays [N, ...] that begin at certain bytes."""
    sizes = [values.dtype.itemsize * math.prod(values.shape[1:]) for _, values in parts]
    texels = -(-max(at + size for (at, _), size in zip(parts, sizes, strict=True)) // TEXEL)
    data = np.zeros((count, TEXEL * texels), dtype=np.uint8)
    for (at, values), size in zip(parts, sizes, strict=True):
        data[:, at : at + size] = np.ascontiguousarray(values).view(np.uint8).reshape(count, size)
    return Records(data)


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


def _fraction(values: Tensor, full: int, kind: str) -> NDArray[np.generic]:
    """Values in [0, 1] or [-1, 1] as whole numbers up to ``full``."""
    return np.rint(values.detach().numpy().astype(np.float64) * full).astype(kind)


def curve_order(means: NDArray[np.float32]) -> NDArray[np.int64]:
    """Order [N] of points [N, 3] along a Z curve (Morton 1966) with 1,024 cells each way."""
    if not len(means):
        return np.zeros(0, dtype=np.int64)
    low, high = np.quantile(means, 0.01, axis=0), np.quantile(means, 0.99, axis=0)
    cells = np.clip((means - low) / np.maximum(high - low, 1e-12) * 1023, 0, 1023).astype(np.uint64)
    code = np.zeros(len(means), dtype=np.uint64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")
