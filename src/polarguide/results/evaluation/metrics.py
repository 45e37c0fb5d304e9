"""Metrics of pictures, layers, normals, polarization, depth and coverage: one definition each.

Pictures are linear radiance [H, W, 3] at the exposure of the photograph (S0/2). Displayed pictures are
clipped to [0, 1] and sRGB-encoded. All picture metrics compare displayed pictures with peak 1. Pixels outside
``keep`` have no influence on any metric.

The arithmetic is float64 on the device of the prediction. Results are tensors [] of float64 on that device,
so that a caller can read several of them with one transfer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as functional
from torch import Tensor

from polarguide.optics.color import shown
from polarguide.training.photometric import SSIM_WINDOW, gaussian_window, structural_similarity


@dataclass(frozen=True, eq=False)
class Selection:
    """Pixels to score, as a mask and as indices.

    Indexing with a mask on a GPU makes the CPU wait for the number of pixels. So the indices are computed on the CPU,
    in row order, and pixels are selected by index.

    Attributes:
        mask: [H, W] bool.
        places: [P] int64, indices of the pixels in the mask.
    """

    mask: Tensor
    places: Tensor

    @classmethod
    def of(cls, mask: Tensor, device: torch.device) -> Selection:
        """Create a selection on a device from a mask [H, W] bool, which should be on the CPU."""
        return cls(mask.to(device), mask.flatten().nonzero()[:, 0].to(device))

    def pick(self, values: Tensor) -> Tensor:
        """Return the selected values [P, ...] of values [H, W, ...] on the same device."""
        return values.flatten(0, 1).index_select(0, self.places)


Keep = Tensor | Selection | None
REFLECTIVE_SHARE = 0.3
"""Share of the specular lobe in S0 above which a pixel counts as reflective."""
CLOSE_NORMAL_DEG = 11.25
"""Angle in degrees below which a normal counts as close."""
SHORTEST = 1e-12
"""Largest length of a vector without a direction."""


def psnr(pred_linear: Tensor, true_linear: Tensor, keep: Keep = None) -> float:
    """Compute the peak signal-to-noise ratio of displayed pictures in decibels, and wait for the result."""
    return decibels(float(squared_error(pred_linear, true_linear, keep)))


def decibels(error: float) -> float:
    """Convert a mean squared error to decibels; 0 gives infinity, NaN gives NaN."""
    return math.inf if error == 0 else -10 * math.log10(error)


def squared_error(
    pred_linear: Tensor, true_linear: Tensor, keep: Keep = None, *, aligned: bool = False
) -> Tensor:
    """Compute the mean squared error of displayed pictures.

    Args:
        pred_linear, true_linear: [H, W, C] linear radiance.
        keep: [H, W] bool or a selection, the pixels to score; None scores all.
        aligned: first fit the scale of each channel to the true picture by linear least squares, which removes errors
            of overall brightness and tint.

    Returns:
        []; NaN without a pixel to score.

    Raises:
        ValueError: the shapes do not match.
    """
    _check_pair(pred_linear, true_linear)
    selection = _selected(keep, pred_linear)
    pred = selection.pick(pred_linear.to(torch.float64))
    true = selection.pick(true_linear.to(pred_linear.device, torch.float64))
    if aligned:
        energy = (pred * pred).sum(0)
        lit = energy > 0
        pred = pred * torch.where(lit, (pred * true).sum(0) / torch.where(lit, energy, 1.0), 1.0)
    return ((shown(pred) - shown(true)) ** 2).mean()


def ssim(pred_linear: Tensor, true_linear: Tensor, keep: Keep = None, windows: Keep = None) -> Tensor:
    """Compute the structural similarity of displayed pictures (Wang et al. 2004).

    The window is Gaussian, 11 x 11 pixels, sigma 1.5. K1 is 0.01, K2 is 0.03. The covariance is the population
    covariance. The result is the mean over channels and over windows inside the picture. scikit-image computes the same
    value with ``gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1``.

    A pixel outside ``keep`` has no weight in any window, and the other weights are normalized to one. Windows
    centered on such a pixel are left out.

    Args:
        pred_linear, true_linear: [H, W, C] linear radiance, H and W at least 11.
        keep: [H, W] bool or a selection, the pixels to score; None scores all.
        windows: result of ``window_centers`` for ``keep`` if it is already computed.

    Returns:
        [], at most 1; NaN if there is no window.

    Raises:
        ValueError: the shapes do not match, or the picture is smaller than the window.
    """
    _check_pair(pred_linear, true_linear)
    height, width = pred_linear.shape[:2]
    if min(height, width) < SSIM_WINDOW:
        raise ValueError(
            f"SSIM: expected at least {SSIM_WINDOW} x {SSIM_WINDOW} pixels, found {width} x {height}"
        )
    selected = _selected(keep, pred_linear).mask
    x, y = (
        torch.where(selected, shown(picture.to(selected.device, torch.float64)).movedim(-1, 0), 0.0)
        for picture in (pred_linear, true_linear)
    )
    weight = _blur(selected.to(torch.float64)[None]).clamp(min=torch.finfo(torch.float64).tiny)
    similarity = structural_similarity(*(_blur(plane) / weight for plane in (x, y, x * x, y * y, x * y)))
    counted = _selected(window_centers(selected) if windows is None else windows, similarity[0])
    return similarity.flatten(1).index_select(1, counted.places).mean()


def window_centers(keep: Tensor) -> Tensor:
    """Crop a mask of pixels [H, W] to the pixels that can be centers of SSIM windows, [H - 10, W - 10]."""
    margin = SSIM_WINDOW // 2
    return keep[margin:-margin, margin:-margin]


def normal_angles_deg(pred: Tensor, true: Tensor) -> Tensor:
    """Compute the angle between directions, in degrees.

    Args:
        pred, true: [..., 3] in the same axes, of any length.

    Returns:
        [...] float64 in [0, 180]. A prediction without a direction (zero or not finite) has the error 90, so that holes
        are penalized. The result is NaN if the true vector has no direction.
    """
    if pred.shape != true.shape or pred.shape[-1] != 3:
        raise ValueError(
            f"normals: expected equal shapes [..., 3], found {list(pred.shape)} and {list(true.shape)}"
        )
    a = torch.nan_to_num(pred.to(torch.float64), nan=0.0, posinf=0.0, neginf=0.0)
    b = true.to(a.device, torch.float64)
    # atan2 is accurate near 0 and 180 degrees, in contrast to acos.
    sine = torch.linalg.vector_norm(torch.linalg.cross(a, b, dim=-1), dim=-1)
    angle = torch.rad2deg(torch.atan2(sine, (a * b).sum(-1)))
    angle = torch.where(has_direction(a), angle, 90.0)
    return torch.where(has_direction(b), angle, math.nan)


def has_direction(vectors: Tensor) -> Tensor:
    """Return a mask [...] of vectors [..., 3] that are long enough to have a direction."""
    return torch.linalg.vector_norm(vectors.to(torch.float64), dim=-1) > SHORTEST


def normal_mae_deg(pred: Tensor, true: Tensor, keep: Keep = None) -> Tensor:
    """Compute the mean angle between rendered and true normals in degrees, see ``normal_angles_deg``.

    Args:
        pred, true: [H, W, 3] in the same axes.
        keep: pixels to score. A mask [H, W] may contain pixels without a true normal, which are left out. A selection
            must not contain pixels without a true normal. None scores all pixels.

    Returns:
        [] degrees; NaN without a pixel to score.
    """
    return _selected_angles(pred, true, keep).mean()


def normal_within_11(pred: Tensor, true: Tensor, keep: Keep = None) -> Tensor:
    """Compute the share in [0, 1] of pixels with a normal error below 11.25 degrees, see ``normal_mae_deg``."""
    return (_selected_angles(pred, true, keep) < CLOSE_NORMAL_DEG).to(torch.float64).mean()


def layer_error(contribution: Tensor, true_s0: Tensor, keep: Keep, *, aligned: bool = False) -> Tensor:
    """Compute the ``squared_error`` between a layer's contribution to S0/2 and half of its true S0, both [H, W, 3]."""
    return squared_error(contribution, true_s0 / 2, keep, aligned=aligned)


def reflective_mask(specular: Tensor, s0: Tensor, mask: Tensor) -> Tensor:
    """Return the mask of pixels that are dominated by reflection.

    Args:
        specular: [H, W, 3] true linear S0 of the specular lobe.
        s0: [H, W, 3] linear S0 of the photograph (twice the picture S0/2).
        mask: [H, W] bool, foreground.

    Returns:
        [H, W] bool: foreground pixels at which ``specular``, summed over channels, exceeds 0.3 times ``s0``, summed
        over channels.
    """
    return mask & (specular.to(torch.float64).sum(-1) > REFLECTIVE_SHARE * s0.to(torch.float64).sum(-1))


def _selected_angles(pred: Tensor, true: Tensor, keep: Keep) -> Tensor:
    if not isinstance(keep, Selection):
        directed = has_direction(true)
        keep = directed if keep is None else directed & keep.to(directed.device)
    return _selected(keep, pred).pick(normal_angles_deg(pred, true))


def _selected(keep: Keep, picture: Tensor) -> Selection:
    """Return the selection of pixels to score on the device of a picture [H, W, ...]."""
    size = picture.shape[:2]
    mask = torch.ones(size, dtype=torch.bool) if keep is None else keep
    selection = mask.mask if isinstance(mask, Selection) else mask
    if selection.dtype != torch.bool or selection.shape != size:
        raise ValueError(f"keep: expected bool {list(size)}, found {selection.dtype} {list(selection.shape)}")
    return mask if isinstance(mask, Selection) else Selection.of(mask, picture.device)


def _check_pair(pred: Tensor, true: Tensor) -> None:
    if pred.ndim != 3 or pred.shape != true.shape:
        raise ValueError(
            f"pictures: expected equal shapes [H, W, C], found {list(pred.shape)} and {list(true.shape)}"
        )


def _blur(channels: Tensor) -> Tensor:
    """Average channels [C, H, W] over the Gaussian windows that lie inside the picture, [C, H - 10, W - 10]."""
    kernel = gaussian_window(channels.dtype, channels.device)
    rows = functional.conv2d(channels[:, None], kernel.view(1, 1, -1, 1))
    return functional.conv2d(rows, kernel.view(1, 1, 1, -1))[:, 0]


LEAST_POLARIZED = 1e-3
"""Ratio of |S1| + |S2| to S0 below which the Stokes error would compare noise."""
DEPTH_BEYOND = 1.25
"""Depth behind a surface that counts as an error, relative to the depth of the surface."""


def stokes_error(pred: Tensor, true: Tensor, keep: Selection, photograph: Tensor) -> Tensor:
    """Compute the relative error of predicted S1 and S2: the sum of |pred - true|, divided by the sum of |true|.

    Args:
        pred, true: [H, W, 6] linear S1, then S2, of each channel, on the scale of a picture S0/2.
        keep: the pixels to score.
        photograph: [H, W, 3] linear S0/2.

    Returns:
        [], 0 or more; 1 for a prediction of zero. NaN if there is no pixel to score, or if the sum of |true| is below
        ``LEAST_POLARIZED`` times the sum of S0.
    """
    measured = keep.pick(true).abs().sum()
    enough = (measured > 0) & (measured >= LEAST_POLARIZED * 2 * keep.pick(photograph).sum())
    error = (keep.pick(pred) - keep.pick(true)).abs().sum()
    return torch.where(enough, error / measured, torch.nan)


def depth_error_percent(pred: Tensor, true: Tensor, keep: Selection, extent: float) -> Tensor:
    """Compute the median error of depths [H, W] in percent of ``extent``; NaN if there is no pixel to score."""
    return 100 / extent * _median((keep.pick(pred) - keep.pick(true)).abs())


def beyond_share(pred: Tensor, true: Tensor, keep: Selection) -> Tensor:
    """Compute the share of pixels whose depth [H, W] lies behind the true surface; NaN if there is no pixel to score.

    A pixel counts if its depth exceeds ``DEPTH_BEYOND`` times the true depth, or if it is empty (depth 0).
    """
    drawn = keep.pick(pred)
    beyond = (drawn > DEPTH_BEYOND * keep.pick(true)) | (drawn <= 0)
    return beyond.to(torch.float64).mean()


def seen_share(pred: Tensor, seen: Selection, valid: Selection) -> Tensor:
    """Return the share of valid pixels whose content is visible in a training view; NaN without valid pixels.

    Args:
        pred: the rendered picture. Only its device is used.
        seen: valid pixels whose content is visible in a training view.
        valid: the pixels that count.
    """
    share = len(seen.places) / len(valid.places) if len(valid.places) else math.nan
    return pred.new_full((), share, dtype=torch.float64)


def coverage_error(alpha: Tensor, mask: Tensor, keep: Selection) -> Tensor:
    """Compute the mean of |alpha - mask| over pixels, in [0, 1]; NaN if there is no pixel to score."""
    return (keep.pick(alpha) - keep.pick(mask)).abs().mean()


def mean_alpha(alpha: Tensor, keep: Selection) -> Tensor:
    """Compute the mean of alpha [H, W] over pixels; NaN if there is no pixel to score."""
    return keep.pick(alpha).mean()


def _median(values: Tensor) -> Tensor:
    """Compute the median of values [P]; NaN for an empty tensor.

    The median of an even number of values is the mean of the middle two.
    """
    count = len(values)
    if count == 0:
        return values.new_full((), torch.nan)
    ordered = values.sort().values
    return (ordered[(count - 1) // 2] + ordered[count // 2]) / 2
