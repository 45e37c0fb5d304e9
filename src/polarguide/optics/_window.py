"""Means over square windows of a picture."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import avg_pool2d, pad


def window_mean(planes: Tensor, window: int) -> Tensor:
    """Means over square windows of planes [K, H, W]; the border's pixels are repeated beyond it.

    Raises:
        ValueError: ``window`` is not a positive odd number.
    """
    if window < 1 or window % 2 == 0:
        raise ValueError(f"window: expected an odd number of pixels, found {window}")
    margin = window // 2
    return avg_pool2d(pad(planes[None], (margin,) * 4, mode="replicate"), window, stride=1)[0]
