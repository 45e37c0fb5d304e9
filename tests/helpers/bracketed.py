"""Bracketed captures of known light: mosaics and shots through a filter, with sensor noise and clipping."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from PIL.ExifTags import Base

from polarguide.geometry.polarizer import ANGLES, malus
from polarguide.optics.color import srgb_encode_array
from polarguide_synth.sensor import Sensor, mosaic, noisy

STOPS = (0.0, -3.0, -6.0)
SIZE = (96, 128)
SENSOR = Sensor(gains=(1.0, 1.0, 1.0, 1.0), extinction=1e9)


def bright_light(peak: float = 40.0, shift: int = 0) -> np.ndarray:
    """Stokes vectors [3, H, W, 3] of a matte surface, a bright spot, and a lamp of ``peak`` times full scale."""
    height, width = SIZE
    y, x = np.mgrid[:height, :width] / width
    x = x - shift / width
    s0 = 0.3 + 0.1 * np.sin(30 * x) * np.cos(40 * y)
    s0 = s0 + 1.2 * np.exp(-((x - 0.3) ** 2 + (y - 0.4) ** 2) / 0.02)
    s0 = s0 + peak * np.exp(-((x - 0.7) ** 2 + (y - 0.4) ** 2) / 0.004)
    s0 = s0[..., None] * np.array([1.0, 0.9, 0.8])
    aolp = 0.5 + x
    dolp = 0.4
    return np.stack(
        [s0, s0 * (dolp * np.cos(2 * aolp))[..., None], s0 * (dolp * np.sin(2 * aolp))[..., None]]
    )


def labels(stops: Sequence[float]) -> list[str]:
    return [f"ev{stop:g}" for stop in stops]


def write_bracket(
    root: Path,
    view: str,
    stokes: np.ndarray | None = None,
    stops: Sequence[float] = STOPS,
    names: Sequence[str] | None = None,
    noise: float = 1.0,
    seed: int = 0,
) -> list[Path]:
    """Write the exposures of a monochrome mosaic with a black level of 64 and 12 bits."""
    root.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(seed)
    stokes = bright_light() if stokes is None else stokes
    paths = [root / f"{view}_{name}.png" for name in names or labels(stops)]
    for path, stop in zip(paths, stops, strict=True):
        raw = mosaic(stokes, "IMX250MZR", noise, random, SENSOR, 2.0**stop)
        assert cv2.imwrite(str(path), raw)
    return paths


def write_bracketed_shots(
    root: Path,
    view: str,
    stops: Sequence[float] = STOPS,
    names: Sequence[str] | None = None,
    suffix: str = ".png",
    angles: Sequence[int] = ANGLES,
    seconds: float | None = None,
) -> list[Path]:
    """Write color shots at some angles and exposures: linear PNG, or sRGB JPEG with an exposure time."""
    root.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(7)
    paths = []
    for angle in angles:
        light = np.asarray(malus(bright_light(), np.radians(angle)))
        for stop, name in zip(stops, names or labels(stops), strict=True):
            path = root / f"{view}_{angle}_{name}{suffix}"
            value = np.clip(noisy(light * 2.0**stop, 1.0, random, SENSOR), 0, 1)
            if suffix == ".png":
                assert cv2.imwrite(str(path), np.rint(value[..., ::-1] * 65535).astype(np.uint16))
            else:
                exif = Image.Exif()
                if seconds is not None:
                    exif.get_ifd(0x8769)[Base.ExposureTime] = seconds * 2.0**stop
                pixels = np.rint(255 * srgb_encode_array(value)).astype(np.uint8)
                Image.fromarray(pixels).save(path, quality=95, subsampling=0, exif=exif)
            paths.append(path)
    return paths


def write_table(root: Path, rows: Sequence[str]) -> None:
    (root / "exposures.csv").write_text("\n".join(["file,shot,stops", *rows]) + "\n")
