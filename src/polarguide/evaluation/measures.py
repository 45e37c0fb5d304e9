"""Metrics of what was measured beside the picture: polarization, depth, and where something is at all.

Pixels outside ``keep`` are left out, arithmetic is float64, and results stay on the device of the prediction, as in
``metrics``.
"""

from __future__ import annotations

import torch
from torch import Tensor

from polarguide.evaluation.metrics import Selection

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
