"""The comparison of kinds of capture: the files of each kind, and the table of the documentation."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "benchmarks" / "accuracy"))

import capture_kinds  # noqa: E402


@pytest.mark.parametrize(("name", "files"), [("single", 1), ("four", 4), ("four-bracket", 12), ("mosaic", 1)])
def test_files_of_a_view(name: str, files: int) -> None:
    kind = capture_kinds.KINDS[name]
    names = [file for file, _, _ in kind.names("v004", 4)]
    assert len(names) == len(set(names)) == kind.files == files


def test_names_state_angle_and_exposure() -> None:
    assert list(capture_kinds.KINDS["single"].names("v004", 4)) == [("v004_60.png", 0.0, 60)]
    assert ("v000_135_ev-3.png", -3.0, 135) in set(capture_kinds.KINDS["four-bracket"].names("v000", 0))


def test_codes_have_the_bits_of_the_sensor() -> None:
    codes = capture_kinds.sensor_codes(np.array([-0.1, 0.0, 0.5 / 4095, 1.6 / 4095, 1.0, 30.0]))
    assert codes.tolist() == [0, 0, 0, 32, 65535, 65535]


def test_the_page_shows_the_recorded_scores() -> None:
    record = json.loads(capture_kinds.RECORD.read_text(encoding="utf-8"))
    page = (ROOT / "docs" / "how-to" / "capture.md").read_text(encoding="utf-8")
    assert "\n".join(capture_kinds.table(record)) in page


def test_the_figure_is_small() -> None:
    assert capture_kinds.FIGURE.stat().st_size < 150_000
