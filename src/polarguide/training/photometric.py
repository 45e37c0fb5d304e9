"""The photometric loss of Gaussian splatting on shown pictures: (1 - l) L1 + l (1 - SSIM)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import conv2d

from polarguide import _native
from polarguide.shading.display import srgb_encode

_WINDOW = 11
_SIGMA = 1.5
_C1, _C2 = 0.01**2, 0.03**2


class _Clip(torch.autograd.Function):
    """Clips to [0, 1]; outside, a gradient passes only if it brings the value back."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        ctx.save_for_backward(values)
        return values.clamp(0, 1)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (values,) = ctx.saved_tensors
        stuck = ((values < 0) & (grad > 0)) | ((values > 1) & (grad < 0))
        return grad.masked_fill(stuck, 0.0)


def _blur(planes: Tensor) -> Tensor:
    """Gaussian window over planes [K, H, W], zero beyond the border."""
    offsets = torch.arange(_WINDOW, dtype=planes.dtype, device=planes.device) - _WINDOW // 2
    window = torch.exp(-(offsets**2) / (2 * _SIGMA**2))
    window = window / window.sum()
    stack = conv2d(planes[:, None], window[None, None, None], padding=(0, _WINDOW // 2))
    return conv2d(stack, window[None, None, :, None], padding=(_WINDOW // 2, 0))[:, 0]


def photometric_loss_reference(
    prediction: Tensor, target: Tensor, weight: Tensor | None = None, ssim_weight: float = 0.2
) -> Tensor:
    """The slow twin of ``photometric_loss``: plain torch, any dtype and device."""
    shown = srgb_encode(_Clip.apply(prediction))
    weight = torch.ones_like(prediction[..., 0]) if weight is None else weight
    count = 3 * weight.sum().clamp(min=1)
    l1 = ((shown - target).abs() * weight[..., None]).sum() / count
    x, y = shown.permute(2, 0, 1), target.permute(2, 0, 1)
    mx, my, xx, yy, xy = _blur(torch.cat((x, y, x * x, y * y, x * y))).split(3)
    numerator = (2 * mx * my + _C1) * (2 * (xy - mx * my) + _C2)
    denominator = (mx * mx + my * my + _C1) * ((xx - mx * mx) + (yy - my * my) + _C2)
    ssim = (numerator / denominator * weight).sum() / count
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim)


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, prediction: Tensor, target: Tensor, weight: Tensor | None, ssim_weight: float
    ) -> Tensor:
        prediction, target = prediction.detach().contiguous(), target.contiguous()
        total = (
            float(weight.sum()) if weight is not None else float(prediction.shape[0] * prediction.shape[1])
        )
        gradient = torch.empty_like(prediction) if ctx.needs_input_grad[0] else None
        weight = weight.contiguous() if weight is not None else None
        l1, ssim = _native.photometric(prediction, target, weight, max(total, 1.0), ssim_weight, gradient)
        ctx.save_for_backward(gradient)
        return torch.tensor((1 - ssim_weight) * l1 + ssim_weight * (1 - ssim), dtype=prediction.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, None, None, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * grad, None, None, None


def photometric_loss(
    prediction: Tensor, target: Tensor, weight: Tensor | None = None, ssim_weight: float = 0.2
) -> Tensor:
    """L1 and SSIM between shown pictures (Kerbl et al. 2023, Eq. 7, on sRGB of linear radiance).

    SSIM has an 11 x 11 Gaussian window of sigma 1.5 with zeros beyond the border, K1 = 0.01, K2 = 0.03.

    Args:
        prediction: [H, W, 3] linear radiance; clipped to [0, 1], with a gradient outside that only leads back in.
        target: [H, W, 3] shown picture in [0, 1].
        weight: [H, W] 1 where a pixel counts, 0 where not; None: everywhere.
        ssim_weight: l in [0, 1].

    Returns:
        The scalar loss, differentiable in the prediction.
    """
    if prediction.device.type == "cpu" and prediction.dtype == torch.float32:
        result: Tensor = _Photometric.apply(prediction, target, weight, ssim_weight)
        return result
    return photometric_loss_reference(prediction, target, weight, ssim_weight)
