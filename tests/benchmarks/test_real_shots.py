"""``benchmarks/accuracy/real_shots.py``: the table in the documentation, and its measurements on known light."""

import sys
from pathlib import Path

import numpy as np
import pytest

import polarguide as pg

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "benchmarks" / "accuracy"))

import real_shots  # noqa: E402

RECORD = ROOT / "benchmarks" / "records" / "real-shots.json"


def test_the_table_of_the_page_is_that_of_the_record() -> None:
    rows = real_shots.read_rows(RECORD)
    page = (ROOT / "docs" / "reference" / "real-shots.md").read_text(encoding="utf-8")
    assert real_shots.table(rows) in page
    assert {row.shots for row in rows} == {"ball", "sphere", "color4", "labels", "pot", "underwater"}
    assert f"{sum(row.agrees for row in rows)} of {len(rows)} measured values agree" in page


def test_a_value_outside_of_the_expected_range_does_not_agree() -> None:
    row = real_shots.Row("ball", "offset of the zero", "degrees", 1.8, 2.6, 2.64)
    assert row.cells() == ["`ball`", "offset of the zero (degrees)", "1.8 to 2.6", "2.6", "yes"]
    assert real_shots.Row("ball", "offset of the zero", "degrees", 1.8, 2.6, 2.66).cells()[-1] == "**no**"
    warned = real_shots.Row("underwater", "warning", real_shots.YES_OR_NO, 1, 1, 0)
    assert warned.cells()[1:] == ["warning", "yes", "no", "**no**"]


@pytest.mark.parametrize("offset", [0.0, 12.0, 90.0])
def test_radial_light_has_the_offset_of_its_zero(offset: float) -> None:
    rows, columns = np.mgrid[:40, :40]
    direction = np.arctan2(20 - rows, columns - 20)
    aolp = direction + np.radians(offset)
    light = np.stack(
        [(1 + 0.4 * np.cos(2 * (aolp - np.radians(angle)))) / 4 for angle in (0, 45, 90, 135)]
    ).astype(np.float32)
    maps = pg.read_shot(np.repeat(light[..., None], 3, axis=-1))
    ccw, cw, distance = real_shots.polar_offset(maps, (20, 20, 15))
    inside = distance < 1
    assert real_shots.mean_degrees(ccw[inside]) % 180 == pytest.approx(offset, abs=0.1)
    assert abs(ccw[inside].mean()) > 0.99
    assert abs(cw[inside].mean()) < 0.1


def test_the_angle_between_colors() -> None:
    gray = np.array([0.5, 0.5, 0.5])
    assert real_shots.color_angle(3 * gray, gray) == pytest.approx(0.0, abs=1e-5)
    assert real_shots.color_angle(np.array([1.0, 0, 0]), np.array([1.0, 1, 0])) == pytest.approx(45.0)
