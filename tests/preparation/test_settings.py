"""The options of ``prepare``: what they may be, how they are recorded, and that they are read without torch."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
from camera_files import write_mosaics

from polarguide.capture.calibration import Calibration
from polarguide.capture.datasets import DATASETS
from polarguide.capture.sensor.demosaic import DEMOSAIC_MODES
from polarguide.capture.sensor.pattern import SENSORS
from polarguide.capture.sensor.raw_file import PACKINGS
from polarguide.errors import PolarguideError
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import CalibrationOptions, PrepareSettings


def choices(hint: Any) -> set[str]:
    """The values of all ``Literal`` in a type."""
    parts = get_args(hint)
    return {part for part in parts if isinstance(part, str)} | {c for part in parts for c in choices(part)}


@pytest.mark.parametrize(
    ("field", "known"),
    [
        ("format", {"auto", "mosaic", "filter", "singles", *DATASETS}),
        ("sensor", set(SENSORS)),
        ("packing", set(PACKINGS)),
        ("demosaic", set(DEMOSAIC_MODES)),
        ("interpolation", set(("bilinear", "guided"))),
    ],
)
def test_options_offer_what_there_is(field: str, known: set[str]) -> None:
    assert choices(get_type_hints(PrepareSettings)[field]) == known


def test_settings_are_recorded_with_absolute_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    settings = PrepareSettings(poses="model", masks=Path("masks"), white_balance="grey").checked()
    record = json.loads(json.dumps(settings.record()))
    assert record.keys() == {field.name for field in fields(PrepareSettings)}
    assert record["poses"] == str(tmp_path.resolve() / "model")
    assert record["masks"] == str(tmp_path.resolve() / "masks")
    assert record["white_balance"] == "gray"
    assert record["calibration"] == {"gains": None, "order": [0, 45, 90, 135], "sense": None, "zero": 0.0}
    assert PrepareSettings(poses="none").checked().record()["poses"] == "none"


def test_options_go_over_the_calibration_file(tmp_path: Path) -> None:
    (tmp_path / "c.json").write_text('{"order": [90, 45, 0, 135], "sense": "cw", "zero": 3}')
    options = CalibrationOptions(tmp_path / "c.json", order="0,135,90,45", zero=0.0)
    assert options.read() == Calibration(None, (0, 135, 90, 45), "cw", 0.0)
    assert CalibrationOptions().read() == Calibration()


def test_a_journal_with_an_earlier_name_goes_on(tmp_path: Path) -> None:
    write_mosaics(tmp_path / "in")
    settings = PrepareSettings(poses="none", sensor="IMX250MYR", white_balance="gray")
    assert prepare_scene(tmp_path / "in", tmp_path / "out", settings).new
    path = tmp_path / "out" / "scene.json"
    path.write_text(path.read_text().replace('"white_balance": "gray"', '"white_balance": "grey"'))
    assert not prepare_scene(tmp_path / "in", tmp_path / "out", settings).new


def test_a_damaged_journal_is_refused(tmp_path: Path) -> None:
    write_mosaics(tmp_path / "in")
    settings = PrepareSettings(poses="none", sensor="IMX250MYR")
    prepare_scene(tmp_path / "in", tmp_path / "out", settings)
    path = tmp_path / "out" / "scene.json"
    content = json.loads(path.read_text())
    content["prepare"]["views"]["v000"]["files"]["polar/v000_000.png"] = "large"
    path.write_text(json.dumps(content))
    with pytest.raises(
        PolarguideError, match=r"scene.json \(prepare.views\[...\].*a whole number, found text"
    ):
        prepare_scene(tmp_path / "in", tmp_path / "out", settings)


@pytest.mark.parametrize("verb", ["prepare", "inspect", "synth"])
def test_options_are_read_without_heavy_libraries(verb: str) -> None:
    program = (
        f"import sys, polarguide.cli.{verb}\n"
        "print([m for m in ('torch', 'scipy', 'pycolmap', 'cv2', 'mitsuba') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
