"""Means over windows, against another package."""

from __future__ import annotations

import pytest
import torch
from scipy.ndimage import uniform_filter
from torch.testing import assert_close

from polarguide.optics._numerics import window_mean


@pytest.mark.parametrize("window", [1, 3, 5, 15])
def test_window_means_repeat_the_border(window: int) -> None:
    planes = torch.randn(2, 9, 13, generator=torch.Generator().manual_seed(window), dtype=torch.float64)
    expected = uniform_filter(planes.numpy(), size=(1, window, window), mode="nearest")
    assert_close(window_mean(planes, window), torch.from_numpy(expected), rtol=0, atol=1e-13)
