"""Whether a mosaic has color filters is told from its samples; the other kind of sensor is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from camera_files import COLOR, MONO, behind, busy_light, mosaic, smooth_light, write_mosaic

from polarguide.capture.sensor.pattern import SIDE, color_filters
from polarguide.errors import PolarguideError
from polarguide.preparation.mosaic_source import sample_blocks
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings


def codes(light: np.ndarray, pattern: tuple[str, ...], noise: float = 0.0) -> np.ndarray:
    values = mosaic(behind(light), pattern) + np.random.default_rng(1).normal(0, noise, light.shape[1:3])
    return np.rint(np.clip(values, 0, 1) * 4095).astype(np.uint16)


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize(
    ("light", "fine"), [(smooth_light(128, 192), False), (busy_light(128, 192, 3), True)]
)
def test_filters_are_told_apart(light: np.ndarray, fine: bool, noise: float) -> None:
    """Rings as fine as the cells may leave it open; they are never taken for filters."""
    colored = light * np.array([0.55, 1.0, 0.7])  # as silicon sees daylight
    assert color_filters(sample_blocks(codes(colored, COLOR, noise), SIDE), 4095) == "color"
    gray = light.mean(axis=-1, keepdims=True).repeat(3, axis=-1)
    found = color_filters(sample_blocks(codes(gray, MONO, noise), SIDE), 4095)
    assert found in (("monochrome", None) if fine else ("monochrome",))


def test_darkness_does_not_tell() -> None:
    assert color_filters(sample_blocks(codes(smooth_light(128, 192) * 0.001, COLOR), SIDE), 4095) is None


@pytest.mark.parametrize(
    ("pattern", "named", "right", "found"),
    [
        (COLOR, "IMX250MZR", "IMX250MYR", "the Bayer pattern of color filters"),
        (MONO, "IMX250MYR", "IMX250MZR", "no sign of color filters"),
    ],
)
def test_the_wrong_kind_of_sensor_is_refused(tmp_path: Path, pattern, named, right, found: str) -> None:
    color = pattern is COLOR
    write_mosaic(
        tmp_path / "in" / "v.png", mosaic(behind(smooth_light(128, 192, color=color)), pattern), bits=12
    )
    with pytest.raises(PolarguideError, match=f"found {found}. Use --sensor {right}"):
        prepare_scene(tmp_path / "in", tmp_path / "out", PrepareSettings(sensor=named, poses="none"))
    prepare_scene(tmp_path / "in", tmp_path / "out2", PrepareSettings(sensor=right, poses="none"))
