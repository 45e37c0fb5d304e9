"""Gaussians as small fixed-size records for the page: what a texture of the graphics card can hold.

A record is a few texels of 16 bytes. All numbers are little-endian; ``f16`` is a half float, ``u16`` an unsigned and
``i16`` a signed 16-bit fraction (of 65535 and 32767).

===== ==================================================================================================
texel content
===== ==================================================================================================
0     mean 3 x float32; opacity u16; strength u16 (roughness for the directional shading)
1     rotation (w, x, y, z) 4 x i16; logarithms of the scales 3 x f16; scale of the harmonics f16
2     color of degree 0 (or albedo) 3 x f16; normal axis 3 x i16; side u16 (1: the axis points outward)
3-5   harmonics of degrees 1 to 3, 45 signed bytes in steps of their scale; or 4 x i16 features in texel 3
6-9   light of its own: degree 0 3 x f16, scale f16; then its harmonics as above
===== ==================================================================================================

The harmonics' scale is each Gaussian's own: the largest of its 45 values is 127 steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize

from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.raster.interface import MINIMUM_ALPHA
from polarguide.shading.deferred import Shading
from polarguide.shading.directional import DirectionalShading, albedo_of
from polarguide.shading.model import Parameters, ShadingModel

TEXEL = 16
Bytes = NDArray[np.uint8]
Kind = Literal["plain", "reflection", "local", "directional"]
TEXELS: dict[Kind, int] = {"plain": 6, "reflection": 6, "local": 10, "directional": 4}
"""Texels of a record by what is shaded."""


@dataclass(frozen=True, eq=False)
class Records:
    """Quantized Gaussians.

    Attributes:
        kind: how they are shaded. data: [N, 16 K] uint8, K texels each.
    """

    kind: Kind
    data: Bytes

    def planes(self) -> bytes:
        """The records byte by byte, first all first bytes: neighbors are alike, so that they compress well."""
        return np.ascontiguousarray(self.data.T).tobytes()


def shading_kind(shading: ShadingModel, *, lit: bool) -> Kind | None:
    """What the page has to do for a shading model; None where it knows no such shading. ``lit``: has an environment."""
    if not lit:
        return "plain"
    if isinstance(shading, Shading):
        return "local" if shading.local else "reflection"
    return "directional" if isinstance(shading, DirectionalShading) else None


@torch.no_grad()
def records(gaussians: Parameters, kind: Kind) -> Records:
    """Quantize Gaussians; those too faint to be drawn at all are left out.

    Args:
        gaussians: the Gaussians, with the side tensors that the kind needs.
        kind: see ``shading_kind``.

    Returns:
        In the order of a curve that fills space, so that neighbors in it are alike.
    """
    opacity = torch.sigmoid(gaussians["opacity_logits"])
    kept = (opacity >= MINIMUM_ALPHA).nonzero()[:, 0]
    kept = kept[torch.from_numpy(curve_order(gaussians["means"][kept].numpy()))]
    data = np.zeros((len(kept), TEXEL * TEXELS[kind]), dtype=np.uint8)

    def put(at: int, values: NDArray[np.generic]) -> None:
        raw = np.ascontiguousarray(values).view(np.uint8).reshape(len(kept), -1)
        data[:, at : at + raw.shape[1]] = raw

    def row(name: str) -> Tensor:
        return gaussians[name][kept].detach()

    axis, side = _axes(gaussians, kept)
    put(0, row("means").numpy().astype("<f4"))
    put(12, _fraction(opacity[kept], 65535, "<u2"))
    put(16, _fraction(normalize(row("quaternions"), dim=-1), 32767, "<i2"))
    put(24, row("log_scales").numpy().astype("<f2"))
    put(38, _fraction(axis, 32767, "<i2"))
    put(44, side.numpy().astype("<u2"))
    if kind == "directional":
        put(14, _fraction(torch.sigmoid(row("roughness_logits")), 65535, "<u2"))
        put(32, _half(albedo_of(gaussians)[kept]))
        put(48, _fraction(torch.tanh(row("features")), 32767, "<i2"))
        return Records(kind, data)
    if kind != "plain":
        put(14, _fraction(torch.sigmoid(row("strength_logits")), 65535, "<u2"))
    put(32, _half(row("sh_dc")))
    for name, scale_at, at in (
        ("sh_rest", 30, 48),
        *((("local_rest", 102, 112),) if kind == "local" else ()),
    ):
        steps, scale = harmonics_steps(row(name))
        put(scale_at, scale)
        put(at, steps)
    if kind == "local":
        put(96, _half(row("local_dc")))
    return Records(kind, data)


def harmonics_steps(rest: Tensor) -> tuple[NDArray[np.int8], NDArray[np.float16]]:
    """Harmonics [N, 15, 3] as signed bytes [N, 45] (coefficient by coefficient, RGB) and the step of each row [N]."""
    flat = rest.flatten(1).numpy()
    step = (np.abs(flat).max(axis=1, initial=0.0) / 127).astype("<f2")
    step = np.maximum(step, np.float16(6e-8))
    steps = np.clip(np.rint(flat / step[:, None].astype(np.float32)), -127, 127)
    return steps.astype(np.int8), step


def _axes(gaussians: Parameters, kept: Tensor) -> tuple[Tensor, Tensor]:
    """Normal axes [K, 3], and 1 [K] where they are turned outward, 0 where the camera alone decides."""
    means, origin = gaussians["means"][kept], torch.zeros(3)
    axes = shortest_axis_normals(means, gaussians["quaternions"][kept], gaussians["log_scales"][kept], origin)
    if "outward" not in gaussians:
        return axes, torch.zeros(len(kept))
    along = (axes * gaussians["outward"][kept]).sum(dim=1)
    return torch.where(along < 0, -1.0, 1.0)[:, None] * axes, (along != 0).float()


def _fraction(values: Tensor, full: int, kind: str) -> NDArray[np.generic]:
    """Values in [0, 1] or [-1, 1] as whole numbers up to ``full``."""
    return np.rint(values.detach().numpy().astype(np.float64) * full).astype(kind)


def _half(values: Tensor) -> NDArray[np.generic]:
    return values.detach().clamp(-6e4, 6e4).numpy().astype("<f2")


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
