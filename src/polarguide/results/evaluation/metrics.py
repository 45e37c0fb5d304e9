"""The metrics of pictures, layers, normals, polarization, depth and coverage: one definition each.

Pictures are linear radiance [H, W, 3] on the exposure of the photograph (S0/2). "Shown" means clipped to [0, 1] and
sRGB-encoded; every picture metric compares shown pictures with peak 1. Pixels outside ``keep`` are left out of every
metric, whatever they hold. All arithmetic is float64, on the device of the prediction, and results stay there, as
tensors [] of float64: a caller that wants several reads them at once.
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
    """Pixels that count, as a mask and by their numbers.

    A device that picks by a mask has to count it first, and whoever asked waits for the answer. So masks are counted on
    the CPU, where they come from, and pixels are picked by number: the same ones in the same order.

    Attributes:
        mask: [H, W] bool. places: [P] int64, the pixels in it, counted along the rows.
    """

    mask: Tensor
    places: Tensor

    @classmethod
    def of(cls, mask: Tensor, device: torch.device) -> Selection:
        """The pixels of a mask [H, W] bool, on a device; the mask itself should lie on the CPU."""
        return cls(mask.to(device), mask.flatten().nonzero()[:, 0].to(device))

    def pick(self, values: Tensor) -> Tensor:
        """[P, ...] of values [H, W, ...] on the same device."""
        return values.flatten(0, 1).index_select(0, self.places)


Keep = Tensor | Selection | None
REFLECTIVE_SHARE = 0.3
CLOSE_NORMAL_DEG = 11.25
SHORTEST = 1e-12
"""Vectors that are not longer have no direction."""


def psnr(pred_linear: Tensor, true_linear: Tensor, keep: Keep = None) -> float:
    """Peak signal-to-noise ratio of shown pictures: ``decibels`` of their ``squared_error``, waited for."""
    return decibels(float(squared_error(pred_linear, true_linear, keep)))


def decibels(error: float) -> float:
    """``-10 log10`` of a mean squared error: infinity for 0, NaN for NaN."""
    return math.inf if error == 0 else -10 * math.log10(error)


def squared_error(
    pred_linear: Tensor, true_linear: Tensor, keep: Keep = None, *, aligned: bool = False
) -> Tensor:
    """Mean squared error of shown pictures.

    Args:
        pred_linear, true_linear: [H, W, C] linear radiance.
        keep: [H, W] bool or a selection, the pixels that count; None counts all.
        aligned: first multiply each channel by the one factor that brings it closest to the true picture in linear
            least squares, so that a wrong overall brightness or tint costs nothing.

    Returns:
        [], NaN where no pixel counts.

    Raises:
        ValueError: shapes that do not fit.
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
    """Structural similarity of shown pictures (Wang et al. 2004).

    Gaussian window of 11 x 11 pixels, sigma 1.5, K1 = 0.01, K2 = 0.03, population covariance, windows entirely inside
    the picture, mean over windows and channels: what scikit-image computes with ``gaussian_weights=True, sigma=1.5,
    use_sample_covariance=False, data_range=1``.

    A pixel outside ``keep`` has no weight in any window (the weights of the others are normalized to one) and the
    window around it does not count. Without such pixels this is the plain definition.

    Args:
        pred_linear, true_linear: [H, W, C] linear radiance, H and W at least 11.
        keep: [H, W] bool or a selection, the pixels that count; None counts all.
        windows: ``window_centers`` of ``keep``, where they are known already.

    Returns:
        [], at most 1; NaN where no window counts.

    Raises:
        ValueError: shapes that do not fit, or a picture smaller than the window.
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
    """Of a mask [H, W] of pixels, the centers of SSIM's windows: [H - 10, W - 10]."""
    margin = SSIM_WINDOW // 2
    return keep[margin:-margin, margin:-margin]


def normal_angles_deg(pred: Tensor, true: Tensor) -> Tensor:
    """Angle between two directions, in degrees.

    Args:
        pred, true: [..., 3] in the same axes, of any length.

    Returns:
        [...] float64 in [0, 180]. A prediction without a direction (zero, or not finite) counts as 90 degrees
        off, so that holes are not free. NaN where the ground truth has none.
    """
    if pred.shape != true.shape or pred.shape[-1] != 3:
        raise ValueError(
            f"normals: expected equal shapes [..., 3], found {list(pred.shape)} and {list(true.shape)}"
        )
    a = torch.nan_to_num(pred.to(torch.float64), nan=0.0, posinf=0.0, neginf=0.0)
    b = true.to(a.device, torch.float64)
    # atan2 of sine and cosine: accurate to the last digit near 0 and 180 degrees, where acos is not.
    sine = torch.linalg.vector_norm(torch.linalg.cross(a, b, dim=-1), dim=-1)
    angle = torch.rad2deg(torch.atan2(sine, (a * b).sum(-1)))
    angle = torch.where(has_direction(a), angle, 90.0)
    return torch.where(has_direction(b), angle, math.nan)


def has_direction(vectors: Tensor) -> Tensor:
    """Whether vectors [..., 3] are long enough to point anywhere, [...] bool."""
    return torch.linalg.vector_norm(vectors.to(torch.float64), dim=-1) > SHORTEST


def normal_mae_deg(pred: Tensor, true: Tensor, keep: Keep = None) -> Tensor:
    """Mean angle between rendered and true normals in degrees (see ``normal_angles_deg``).

    Args:
        pred, true: [H, W, 3] in the same axes.
        keep: [H, W] bool, the pixels that count, of which those without a true normal are left out, or a selection
            without those; None counts all.

    Returns:
        [] degrees; NaN where no pixel counts.
    """
    return _selected_angles(pred, true, keep).mean()


def normal_within_11(pred: Tensor, true: Tensor, keep: Keep = None) -> Tensor:
    """Share in [0, 1] of the pixels whose normal is under 11.25 degrees off, else as ``normal_mae_deg``."""
    return (_selected_angles(pred, true, keep) < CLOSE_NORMAL_DEG).to(torch.float64).mean()


def layer_error(contribution: Tensor, true_s0: Tensor, keep: Keep, *, aligned: bool = False) -> Tensor:
    """``squared_error`` of what a layer adds to the final picture (S0/2) against the true S0 of its lobe [H, W, 3]."""
    return squared_error(contribution, true_s0 / 2, keep, aligned=aligned)


def reflective_mask(specular: Tensor, s0: Tensor, mask: Tensor) -> Tensor:
    """The pixels that are mostly seen by their reflection.

    Args:
        specular: [H, W, 3] true linear S0 of the specular lobe.
        s0: [H, W, 3] linear S0 of the photograph (twice the picture S0/2).
        mask: [H, W] bool, foreground.

    Returns:
        [H, W] bool: foreground where the sum over channels of ``specular`` exceeds 0.3 times that of ``s0``.
    """
    return mask & (specular.to(torch.float64).sum(-1) > REFLECTIVE_SHARE * s0.to(torch.float64).sum(-1))


def _selected_angles(pred: Tensor, true: Tensor, keep: Keep) -> Tensor:
    if not isinstance(keep, Selection):
        directed = has_direction(true)
        keep = directed if keep is None else directed & keep.to(directed.device)
    return _selected(keep, pred).pick(normal_angles_deg(pred, true))


def _selected(keep: Keep, picture: Tensor) -> Selection:
    """The pixels of a picture [H, W, ...] that count, on its device."""
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
    """[C, H, W] averaged under the Gaussian window, where it lies inside the picture: [C, H - 10, W - 10]."""
    kernel = gaussian_window(channels.dtype, channels.device)
    rows = functional.conv2d(channels[:, None], kernel.view(1, 1, -1, 1))
    return functional.conv2d(rows, kernel.view(1, 1, 1, -1))[:, 0]


LEAST_POLARIZED = 1e-3
"""Where |S1| + |S2| is less than this share of S0, nothing was measured that a prediction could be compared with."""
HAZE_DEPTH = 0.8
"""What hangs before a surface is nearer than this share of the surface's depth."""
DEPTH_BEYOND = 1.25
"""What is drawn behind a surface is farther than this many times the surface's depth."""


def stokes_error(pred: Tensor, true: Tensor, keep: Selection, photograph: Tensor) -> Tensor:
    """Error of predicted S1 and S2 over that of predicting none: sum of |pred - true| over sum of |true|.

    Args:
        pred, true: [H, W, 6] linear S1, then S2, of each channel, on the scale where the picture is S0/2.
        keep: the pixels that count. photograph: [H, W, 3] linear S0/2.

    Returns:
        [], 0 or more, 1 for no prediction; NaN where no pixel counts, or the sum of |true| is less than a thousandth
        of that of S0, so that the quotient would be about noise.
    """
    measured = keep.pick(true).abs().sum()
    enough = (measured > 0) & (measured >= LEAST_POLARIZED * 2 * keep.pick(photograph).sum())
    error = (keep.pick(pred) - keep.pick(true)).abs().sum()
    return torch.where(enough, error / measured, torch.nan)


def depth_error_percent(pred: Tensor, true: Tensor, keep: Selection, extent: float) -> Tensor:
    """Median of |pred - true| of depths [H, W], in percent of an extent; NaN where no pixel counts."""
    return 100 / extent * _median((keep.pick(pred) - keep.pick(true)).abs())


def haze_share(in_front: Tensor, keep: Selection) -> Tensor:
    """Share of the pixels of which at least half the weight [H, W] lies in front; NaN where no pixel counts."""
    return (keep.pick(in_front) >= 0.5).to(torch.float64).mean()


def beyond_share(pred: Tensor, true: Tensor, keep: Selection) -> Tensor:
    """Share of the pixels drawn from behind the true surface, of depths [H, W]; NaN where no pixel counts.

    Those are the ones farther than ``DEPTH_BEYOND`` times the true depth, and those that nothing covers (depth 0).
    """
    drawn = keep.pick(pred)
    beyond = (drawn > DEPTH_BEYOND * keep.pick(true)) | (drawn <= 0)
    return beyond.to(torch.float64).mean()


def seen_share(pred: Tensor, seen: Selection, valid: Selection) -> Tensor:
    """Return the share of the valid pixels whose content a training view shows; NaN without valid pixels.

    Args:
        pred: the rendered picture, for its device.
        seen: valid pixels whose content a training view shows.
        valid: the pixels that count.
    """
    count = pred.new_tensor(len(valid.places), dtype=torch.float64)
    return len(seen.places) / torch.where(count > 0, count, torch.nan)


def coverage_error(alpha: Tensor, mask: Tensor, keep: Selection) -> Tensor:
    """Mean |alpha - mask| of [H, W] in [0, 1]; NaN where no pixel counts."""
    return (keep.pick(alpha) - keep.pick(mask)).abs().mean()


def mean_alpha(alpha: Tensor, keep: Selection) -> Tensor:
    """Mean alpha [H, W]; NaN where no pixel counts."""
    return keep.pick(alpha).mean()


def _median(values: Tensor) -> Tensor:
    """The median of [P], of an even number the mean of the middle two; NaN of none."""
    count = len(values)
    if count == 0:
        return values.new_full((), torch.nan)
    ordered = values.sort().values
    return (ordered[(count - 1) // 2] + ordered[count // 2]) / 2
