"""Real spherical harmonics to degree 3, in the order and with the signs of the 3DGS release.

Degree 1 is in the order -y, z, -x. On the CPU in float32 a native kernel evaluates the colors;
``evaluate_sh_reference`` is its reference implementation in plain torch. ``native/harmonics_kernels.cpp`` and
``export/page/derive.frag`` repeat the constants.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from polarguide import _native
from polarguide.core.native import fits

SH_C0 = 0.28209479177387814
"""The basis function of degree 0."""
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Evaluate the basis functions at unit directions.

    Args:
        directions: [..., 3], unit length.
        degree: 0 to 3.

    Returns:
        [..., (degree + 1)^2], differentiable.

    Raises:
        ValueError: another degree.
    """
    if not 0 <= degree <= 3:
        raise ValueError(f"degree: expected 0 to 3, found {degree}")
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, SH_C0)]
    if degree > 0:
        basis += [-_C1 * y, _C1 * z, -_C1 * x]
    xx = x * x
    yy = y * y
    zz = z * z
    if degree > 1:
        basis += [
            _C2[0] * x * y,
            _C2[1] * y * z,
            _C2[2] * (2 * zz - xx - yy),
            _C2[3] * x * z,
            _C2[4] * (xx - yy),
        ]
    if degree > 2:
        basis += [
            _C3[0] * y * (3 * xx - yy),
            _C3[1] * x * y * z,
            _C3[2] * y * (4 * zz - xx - yy),
            _C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            _C3[4] * x * (4 * zz - xx - yy),
            _C3[5] * z * (xx - yy),
            _C3[6] * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, dim=-1)


def _directions(means: Tensor, center: Tensor) -> Tensor:
    """Return unit vectors from the center to the means. A mean at the center has a zero vector and no gradient."""
    offsets = means - center
    squared = offsets.square().sum(dim=-1, keepdim=True)
    return offsets * squared.masked_fill(squared <= 1e-24, torch.inf).rsqrt()


def evaluate_sh_reference(means: Tensor, center: Tensor, dc: Tensor, rest: Tensor, degree: int) -> Tensor:
    """Compute ``evaluate_sh`` in plain torch: the reference implementation, for any dtype and device."""
    basis = sh_basis(_directions(means, center), degree)
    coefficients = torch.cat((dc[:, None], rest), dim=1)[:, : basis.shape[-1]]
    return (basis[..., None] * coefficients).sum(dim=1)


class _Harmonics(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, center: Tensor, dc: Tensor, rest: Tensor, degree: int) -> Tensor:
        means, center, dc, rest = (t.detach().contiguous() for t in (means, center, dc, rest))
        out = torch.empty_like(dc)
        _native.harmonics_forward(degree, means, center, dc, rest, out)
        ctx.save_for_backward(means, center, dc, rest)
        ctx.degree = degree
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        means, center, dc, rest = ctx.saved_tensors
        to_dc = torch.empty_like(dc)
        to_means = torch.empty_like(means) if ctx.needs_input_grad[0] else None
        to_rest = torch.empty_like(rest) if ctx.needs_input_grad[3] else None
        _native.harmonics_backward(
            ctx.degree, means, center, dc, rest, grad.contiguous(), to_means, to_dc, to_rest
        )
        return to_means, None, to_dc, to_rest, None


def evaluate_sh(means: Tensor, center: Tensor, dc: Tensor, rest: Tensor, degree: int) -> Tensor:
    """Evaluate the color of each Gaussian as seen from a camera.

    The color is ``sum_k basis_k(d) coefficient_k``, with ``d`` the unit direction from the camera center to the
    Gaussian. ``d`` is zero for a Gaussian at the center. The offset 0.5 of 3DGS is not added.

    Args:
        means: [N, 3] Gaussian centers.
        center: [3] camera center, of any dtype and device; gets no gradient.
        dc: [N, 3] coefficients of degree 0.
        rest: [N, 15, 3] coefficients of degrees 1 to 3.
        degree: 0 to 3; coefficients beyond it count as zero and get a zero gradient.

    Returns:
        Colors [N, 3], differentiable in means (through the direction), dc and rest.

    Raises:
        ValueError: a shape or the degree differs.
    """
    count = means.shape[0]
    expected = {"means": (means, (count, 3)), "center": (center, (3,)), "dc": (dc, (count, 3))}
    for name, (tensor, shape) in (expected | {"rest": (rest, (count, 15, 3))}).items():
        if tensor.shape != shape:
            raise ValueError(f"{name}: expected shape {list(shape)}, found {list(tensor.shape)}")
    if not 0 <= degree <= 3:
        raise ValueError(f"degree: expected 0 to 3, found {degree}")
    center = center.detach().to(means)
    if fits(means, dc, rest):
        result: Tensor = _Harmonics.apply(means, center, dc, rest, degree)
        return result
    return evaluate_sh_reference(means, center, dc, rest, degree)
