"""Photometric loss of Gaussian splatting on displayed pictures: (1 - l) L1 + l (1 - SSIM).

In float32 on the CPU, a native kernel computes the loss and its gradient in one call. For other tensors, the gradient
is written out in plain torch. This blurs nine planes in each direction, while autograd would blur fifteen planes and
store intermediate results. ``photometric_terms_reference`` is the reference implementation.

``partial_terms`` is the loss of views whose pictures do not determine the Stokes vector, because they have fewer than
three polarizer angles. The rendered layers predict S0, S1 and S2, and thus the intensity behind any analyzer, ``(S0 +
S1 c + S2 s) / 2``. The prediction is compared with the measured intensities.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import conv2d

from polarguide import _native
from polarguide.core.native import fits
from polarguide.optics.color import srgb_encode
from polarguide.training.targets import PartialView, Step

SSIM_WINDOW = 11
"""Side of SSIM's window, in pixels."""
_SIGMA = 1.5
_C1 = 0.01**2
_C2 = 0.03**2


class Photometric(NamedTuple):
    """Difference of a picture from a photograph.

    Attributes:
        loss: result of ``photometric_loss``.
        error: mean squared difference of the displayed pictures, over the same pixels and colors, without a gradient.
    """

    loss: Tensor
    error: Tensor


class _Clip(torch.autograd.Function):
    """Clipping to [0, 1]. Outside this range, a gradient passes only if a step against it brings the value back."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        ctx.save_for_backward(values)
        return values.clamp(0, 1)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (values,) = ctx.saved_tensors
        stuck = ((values < 0) & (grad > 0)) | ((values > 1) & (grad < 0))
        return grad.masked_fill(stuck, 0.0)


@lru_cache(maxsize=4)
def gaussian_window(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the weights [11] of SSIM's Gaussian window along one axis, which add up to 1."""
    offsets = torch.arange(SSIM_WINDOW, dtype=dtype, device=device) - SSIM_WINDOW // 2
    window = torch.exp(-(offsets**2) / (2 * _SIGMA**2))
    return window / window.sum()


def structural_similarity(x: Tensor, y: Tensor, xx: Tensor, yy: Tensor, xy: Tensor) -> Tensor:
    """Return the SSIM [...] of two pictures in [0, 1] (Wang et al. 2004, Eq. 13).

    The constants are K1 = 0.01 and K2 = 0.03. Variances and the covariance are population values.

    Args:
        x, y: [...] means of both pictures under the window.
        xx, yy: [...] means of their squares.
        xy: [...] mean of their product.
    """
    numerator = (2 * x * y + _C1) * (2 * (xy - x * y) + _C2)
    return numerator / ((x * x + y * y + _C1) * ((xx - x * x) + (yy - y * y) + _C2))


def _blur(planes: Tensor) -> Tensor:
    """Blur planes [K, H, W] with the Gaussian window, with zeros beyond the border."""
    window = gaussian_window(planes.dtype, planes.device)
    stack = conv2d(planes[:, None], window[None, None, None], padding=(0, SSIM_WINDOW // 2))
    return conv2d(stack, window[None, None, :, None], padding=(SSIM_WINDOW // 2, 0))[:, 0]


def photometric_terms_reference(
    prediction: Tensor, target: Tensor, weight: Tensor | None = None, ssim_weight: float = 0.2
) -> Photometric:
    """Compute ``photometric_terms`` in plain torch: the reference implementation, for any dtype and device."""
    encoded = srgb_encode(_Clip.apply(prediction))
    weight = (torch.ones_like(prediction[..., 0]) if weight is None else weight)[..., None]
    x = encoded.permute(2, 0, 1)
    y = target.permute(2, 0, 1)
    means = _blur(torch.cat((x, y, x * x, y * y, x * y))).split(3)
    ssim = structural_similarity(*means).permute(1, 2, 0)
    per_value = (1 - ssim_weight) * (encoded - target).abs() + ssim_weight * (1 - ssim)
    total = 3 * weight.sum()
    count = torch.where(total > 0, total, torch.ones_like(total))
    squared = (encoded - target).detach().square()
    return Photometric((weight * per_value).sum() / count, (weight * squared).sum() / count)


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, prediction: Tensor, target: Tensor, weight: Tensor | None, ssim_weight: float
    ) -> tuple[Tensor, Tensor]:
        prediction = prediction.detach().contiguous()
        target = target.detach().contiguous()
        weight = None if weight is None else weight.detach().contiguous()
        total = prediction.shape[0] * prediction.shape[1] if weight is None else float(weight.sum())
        gradient = torch.empty_like(prediction) if ctx.needs_input_grad[0] else None
        l1, ssim, squares = _native.photometric(
            prediction, target, weight, total or 1.0, ssim_weight, gradient
        )
        ctx.save_for_backward(gradient)
        loss = prediction.new_tensor((1 - ssim_weight) * l1 + ssim_weight * (bool(total) - ssim))
        error = prediction.new_tensor(squares)
        ctx.mark_non_differentiable(error)
        return loss, error

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, _: Tensor) -> tuple[Tensor | None, None, None, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * grad, None, None, None


class ExplicitPhotometric(_Photometric):
    """Photometric loss whose forward pass also computes the gradient, for any device."""

    @staticmethod
    def forward(
        ctx: Any, prediction: Tensor, target: Tensor, weight: Tensor | None, ssim_weight: float
    ) -> tuple[Tensor, Tensor]:
        clipped = prediction.detach().clamp(0, 1)
        x = srgb_encode(clipped).permute(2, 0, 1)
        y = target.permute(2, 0, 1)
        count = x.new_full((), x[0].numel()) if weight is None else weight.sum()
        share = 1 / (3 * torch.where(count > 0, count, torch.ones_like(count)))
        share = share if weight is None else share * weight
        mx, xx, xy = _blur(torch.cat((x, x * x, x * y))).split(3)
        my, yy = _blur(torch.cat((y, y * y))).split(3)
        # SSIM is a1 a2 / (b1 b2).
        a1 = 2 * mx * my + _C1
        a2 = 2 * (xy - mx * my) + _C2
        b1 = mx * mx + my * my + _C1
        b2 = (xx - mx * mx) + (yy - my * my) + _C2
        inverse = 1 / (b1 * b2)
        ssim = a1 * a2 * inverse
        difference = x - y
        loss = (share * ((1 - ssim_weight) * difference.abs() + ssim_weight * (1 - ssim))).sum()
        if ctx.needs_input_grad[0]:
            pull = -ssim_weight * share
            to_mx = pull * 2 * (my * (a2 - a1) * inverse - mx * ssim * (1 / b1 - 1 / b2))
            # The window is symmetric and pads with zeros, so its adjoint is itself.
            by_mx, by_xx, by_xy = _blur(torch.cat((to_mx, -pull * ssim / b2, pull * 2 * a1 * inverse))).split(
                3
            )
            to_x = by_mx + 2 * x * by_xx + y * by_xy + (1 - ssim_weight) * share * difference.sign()
            to_x = to_x.permute(1, 2, 0)
            slope = torch.where(
                clipped <= 0.0031308, 12.92, 1.055 / 2.4 * clipped.clamp(min=0.0031308) ** (1 / 2.4 - 1)
            )
            gradient = to_x * slope
            stuck = ((prediction < 0) & (gradient > 0)) | ((prediction > 1) & (gradient < 0))
            ctx.save_for_backward(gradient.masked_fill(stuck, 0.0))
        error = (share * difference.square()).sum()
        ctx.mark_non_differentiable(error)
        return loss, error


def _check(prediction: Tensor, target: Tensor, weight: Tensor | None) -> None:
    """Check the shapes of the arguments of ``photometric_loss``."""
    if prediction.ndim != 3 or prediction.shape[-1] != 3:
        raise ValueError(f"prediction: expected shape [H, W, 3], found {list(prediction.shape)}")
    if target.shape != prediction.shape:
        raise ValueError(f"target: expected shape {list(prediction.shape)}, found {list(target.shape)}")
    if weight is not None and weight.shape != prediction.shape[:2]:
        raise ValueError(f"weight: expected shape {list(prediction.shape[:2])}, found {list(weight.shape)}")


def photometric_loss(
    prediction: Tensor, target_shown: Tensor, weight: Tensor | None = None, ssim_weight: float = 0.2
) -> Tensor:
    """Return the mean over valid pixels and colors of ``(1 - l) |x - y| + l (1 - SSIM(x, y))``.

    ``x`` is the clipped prediction, encoded in sRGB, and ``y`` is the target (Kerbl et al. 2023, Eq. 7, on displayed
    pictures). SSIM has an 11 x 11 Gaussian window of sigma 1.5, K1 = 0.01 and K2 = 0.03. The picture is padded with
    zeros. Within five pixels of the border, SSIM differs from metrics that mirror the picture at the border. Pixels
    with weight 0 still influence the SSIM of their neighbors.

    A predicted value outside [0, 1] gets the gradient at the boundary if a step against this gradient leads back into
    the interval. Otherwise its gradient is zero. Saturated pixels can therefore recover. A single NaN makes the loss
    NaN.

    Args:
        prediction: [H, W, 3] linear radiance, any size.
        target_shown: [H, W, 3] picture as displayed, in [0, 1]; gets no gradient.
        weight: [H, W] nonnegative weights, 1 for valid pixels and 0 for others; gets no gradient. None means that all
            pixels are valid.
        ssim_weight: l in [0, 1].

    Returns:
        The scalar loss, differentiable in the prediction; 0 if no pixel is valid.

    Raises:
        ValueError: a shape differs.
    """
    return photometric_terms(prediction, target_shown, weight, ssim_weight).loss


def photometric_terms(
    prediction: Tensor, target_shown: Tensor, weight: Tensor | None = None, ssim_weight: float = 0.2
) -> Photometric:
    """Compute ``photometric_loss`` and the mean squared difference of the displayed pictures.

    The second value costs almost no additional time.
    """
    _check(prediction, target_shown, weight)
    target_shown = target_shown.detach().to(prediction)
    weight = None if weight is None else weight.detach().to(prediction)
    if fits(prediction):
        return Photometric(*_Photometric.apply(prediction, target_shown, weight, ssim_weight))
    if prediction.device.type == "cpu":
        return photometric_terms_reference(prediction, target_shown, weight, ssim_weight)
    return Photometric(*ExplicitPhotometric.apply(prediction, target_shown, weight, ssim_weight))


def behind_analyzer(stokes: Tensor, analyzer: Tensor) -> Tensor:
    """Return ``(S1 c + S2 s) / 2``, the difference [H, W, 3] of the intensity behind an analyzer from S0/2.

    Args:
        stokes: [3, H, W, 3] Stokes vectors.
        analyzer: c and s, [2], or [2, H, W] if they depend on the pixel.
    """
    cosine, sine = analyzer.to(stokes)[..., None].unbind(0)
    return (stokes[1] * cosine + stokes[2] * sine) / 2


def partial_terms(
    step: Step, view: PartialView, photometric: float, polarization: float
) -> tuple[Tensor, Photometric]:
    """Return the loss of a view whose pictures do not determine the Stokes vector.

    The photometric term compares a measured picture with its prediction. The picture is S0/2 if that was measured, and
    otherwise the mean M of the intensities behind the analyzers. The polarization term replaces the Stokes term and has
    its weight. It is the mean of ``2 |(I - M) - (S1 c + S2 s) / 2| / sqrt(2 M + 0.01)`` over the pictures I. Here c and
    s are the components of the analyzer of I minus the components of the mean analyzer of M. Both I - M and its
    prediction are differences, so S0 cancels.

    A view with one picture has no polarization term, because all its information is in the photometric term. The
    polarization term uses the measured M and not the rendered S0/2. Otherwise a rendering that is too bright could be
    explained by more light that the analyzer blocks, which would make it even brighter.

    If the weight of the polarization is 0, or if layers for a prediction are missing, the picture is treated as a
    photograph without a filter.

    Args:
        step: data of the step.
        view: measurements of its view.
        photometric, polarization: weights of both terms in the stage.

    Returns:
        A tuple of the weighted sum of both terms, and the photometric term.
    """
    result = step.result

    def compared(rendered: Tensor) -> Photometric:
        return photometric_terms(rendered, view.shown, step.targets.valid, step.ssim_weight)

    if not (polarization and len(view.intensities) and result.is_polarized):
        picture = compared(result.final)
        return photometric * picture.loss, picture
    stokes = step.shading.predicted_stokes(result, step.targets.camera)
    picture = compared(result.final if view.mix is None else result.final + behind_analyzer(stokes, view.mix))
    common = 0.0 if view.mix is None else view.mix
    weight = view.reliable * (2 * view.picture.mean(dim=-1) + 0.01).rsqrt()
    distance = result.final.new_zeros(())
    for intensity, analyzer in zip(view.intensities, view.analyzers, strict=True):
        difference = 2 * (intensity - view.picture) - 2 * behind_analyzer(stokes, analyzer - common)
        distance = distance + (weight * difference.abs().mean(dim=-1)).mean()
    return photometric * picture.loss + polarization * distance / len(view.intensities), picture
