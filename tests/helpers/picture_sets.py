"""Sets of pictures of a sphere of known polarization, with the noise of a sensor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from polarguide.geometry.polarizer import malus

WELL, READ = 8000.0, 5.0
"""Electrons at full scale and of noise without light."""


def sphere(side: int = 120) -> np.ndarray:
    """Stokes vectors [3, H, W] of a sphere before an even wall: all angles, DoLP from 0.05 to 0.5."""
    y, x = np.mgrid[0:side, 0:side] - (side - 1) / 2
    radius = np.hypot(x, y) / (0.45 * side)
    inside = radius < 1
    s0 = np.where(inside, 0.5 + 0.5 * np.sqrt(np.maximum(1 - radius**2, 0)), 0.3)
    degree = np.where(inside, 0.05 + 0.45 * radius**2, 0.2)
    angle = np.where(inside, np.arctan2(-y, x), 0.5)
    return np.stack((s0, s0 * degree * np.cos(2 * angle), s0 * degree * np.sin(2 * angle)))


def plate(side: int = 120) -> np.ndarray:
    """Stokes vectors of one polarization: no picture tells its angle."""
    return np.stack([np.full((side, side), value) for value in (0.9, 0.3, 0.1)])


def photographed(
    stokes: np.ndarray, angles: Sequence[float], *, noisy: bool = True, seed: int = 0
) -> np.ndarray:
    """Pictures [K, H, W] uint16 at angles in degrees: Poisson noise of the light, Gaussian noise of reading."""
    rng = np.random.default_rng(seed)
    clean = np.stack([malus(stokes, math.radians(angle)) for angle in angles])
    if noisy:
        clean = (rng.poisson(clean * WELL) + rng.normal(0, READ, clean.shape)) / WELL
    return np.rint(np.clip(clean, 0, 1) * 65535).astype(np.uint16)


def write_set(folder: Path, names: Sequence[str], pictures: np.ndarray) -> list[Path]:
    """Write each picture under its name; returns the paths."""
    paths = [folder / name for name in names]
    for path, picture in zip(paths, pictures, strict=True):
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), picture)
    return paths
