"""Which differences are noise: what another seed of the same two trainings would move them by."""

from __future__ import annotations

import math
from collections.abc import Mapping

from polarguide.experiments.intervals import (
    LEAST_UNITS,
    NORMAL_QUANTILE,
    mean,
    means_by_seed,
    t_half_width,
)

KNOWN_SCATTER: Mapping[str, float] = {
    "psnr": 0.23,
    "psnr_foreground": 0.113,
    "psnr_reflective": 0.143,
    "ssim": 0.00126,
    "normal_mae_deg": 0.46,
    "normal_within_11": 0.0093,
    "specular_psnr": 0.28,
    "diffuse_psnr": 0.28,
    "specular_psnr_aligned": 0.28,
    "diffuse_psnr_aligned": 0.28,
}
"""Standard deviation over seeds of the difference between two recipes at the same seed on one scene, by metric.

Its origin stands in ``docs/explanation/statistics.md``."""
KNOWN_SCATTER_ON_BLACK: Mapping[str, float] = {**KNOWN_SCATTER, "psnr": 1.5}
"""The same where the background is black: fog before it, which a seed decides on, makes up the error of the picture."""
BLACK_SHARE = 0.25
"""From this share of black pixels on, a scene is one on black."""


def known_scatter(key: str, black_share: float | None) -> float | None:
    """The known scatter of a metric on a scene with this share of black pixels (None: not known, taken as small)."""
    black = black_share is not None and black_share >= BLACK_SHARE
    return (KNOWN_SCATTER_ON_BLACK if black else KNOWN_SCATTER).get(key)


def training_noise(
    by_scene: Mapping[str, Mapping[int, float]], scatter: Mapping[str, float | None]
) -> float | None:
    """How large a mean difference between two recipes can be by chance, at the same seeds on the same scenes.

    Args:
        by_scene: differences by scene and seed; every scene has at least one.
        scatter: the known scatter by scene.

    Returns:
        Half the width of the 95 % confidence interval over seeds: from the seeds themselves if at least three are on
        every scene, else from the known scatter, else from two seeds; None where neither is there.
    """
    values = means_by_seed(by_scene)
    if len(values) >= LEAST_UNITS:
        return t_half_width(values)
    variances = [
        known**2 / len(by_seed)
        for scene, by_seed in by_scene.items()
        if (known := scatter.get(scene)) is not None
    ]
    if len(variances) == len(by_scene):
        return NORMAL_QUANTILE * math.sqrt(math.fsum(variances)) / len(by_scene)
    return t_half_width(values) if len(values) > 1 else None


def is_noise(by_scene: Mapping[str, Mapping[int, float]], scatter: Mapping[str, float | None]) -> bool | None:
    """Whether a difference is within ``training_noise``; None where that is not known."""
    half = training_noise(by_scene, scatter)
    return None if half is None else abs(mean(mean(d.values()) for d in by_scene.values())) <= half
