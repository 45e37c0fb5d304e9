"""Captures on disk and in memory with planted faults."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from polarguide.geometry.polarizer import ANGLES
from polarguide.inspection.capture import Capture, read_capture


def soft_intensities(seed: int, size: tuple[int, int] = (60, 80)) -> np.ndarray:
    """Smooth partly polarized light behind an ideal analyzer, [4, H, W, 3] in [0.05, 0.8]."""
    rng = np.random.default_rng(seed)

    def soft(low: float, high: float) -> np.ndarray:
        field = cv2.GaussianBlur(rng.standard_normal(size), (0, 0), 6)
        return low + (high - low) * (field - field.min()) / np.ptp(field)

    s0, degree, angle = soft(0.3, 1.0), soft(0.0, 0.6), soft(0, np.pi)
    theta = np.radians(ANGLES)[:, None, None]
    gray = 0.5 * s0 * (1 + degree * np.cos(2 * (theta - angle)))
    tint = np.array([1.0, 0.9, 0.8])
    return gray[..., None] * tint + rng.normal(0, 2e-4, (4, *size, 3))


def write_scene(
    root: Path,
    change: Callable[[np.ndarray], np.ndarray] = lambda values: values,
    views: int = 3,
    bits: int = 16,
    names: str = "v{}",
) -> Path:
    """A scene folder without poses."""
    (root / "polar").mkdir(parents=True)
    full = 2**bits - 1
    for index in range(views):
        values = np.clip(change(soft_intensities(index)), 0, 1)
        for angle, picture in zip(ANGLES, values, strict=True):
            stored = np.rint(picture[..., ::-1] * full).astype(np.uint16 if bits == 16 else np.uint8)
            assert cv2.imwrite(str(root / "polar" / f"{names.format(index)}_{angle:03d}.png"), stored)
    return root


def gained(*gains: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda values: values * np.array(gains)[:, None, None, None]


def one_view(root: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Write view v1 anew with other values."""
    for angle, picture in zip(ANGLES, np.clip(change(soft_intensities(1)), 0, 1), strict=True):
        stored = np.rint(picture[..., ::-1] * 65535).astype(np.uint16)
        assert cv2.imwrite(str(root / "polar" / f"v1_{angle:03d}.png"), stored)


def with_views(root: Path, **changes: object) -> Capture:
    """A capture as read, with other values of some fields."""
    return dataclasses.replace(read_capture(root), **changes)  # type: ignore[arg-type]
