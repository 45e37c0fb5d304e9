"""Options that mean nothing for a kind of shot, and shots that cannot be written, are refused or told."""

from __future__ import annotations

import json
import shutil
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from faults import Fault

import polarguide
from polarguide.capture.calibration import Calibration
from polarguide.capture.raw_options import (
    EncodedOptions,
    FilterOptions,
    RawMosaicOptions,
    RawOptions,
    SetOptions,
)
from polarguide_shots.exposures import find_shots
from polarguide_shots.options import ShotOptions
from polarguide_shots.read import read_shot
from polarguide_shots.sets import ExposureSet
from polarguide_shots.write import write_shots
from tests.helpers.heard import Heard
from tests.shots.test_read import CUP, MONO, write_four, write_mosaic

MOSAIC_ONLY: list[dict[str, Any]] = [
    {"black_level": 500.0}, {"flip": "x"}, {"gamma": 0.8}, {"demosaic": "quarter"}, {"packing": "12p"},
    {"dark_frame": Path("none.png")}, {"offset_x": 2}, {"demosaic": "half"}, {"width": 2448},
]  # fmt: skip


def test_every_option_of_camera_files_has_a_kind() -> None:
    """An option that no kind has would be allowed everywhere."""
    kinds = (RawMosaicOptions, FilterOptions, SetOptions, EncodedOptions)
    of_kinds = {f.name for kind in kinds for f in fields(kind)}
    assert {f.name for f in fields(RawOptions)} == of_kinds
    assert {f.name for f in fields(ShotOptions)} - of_kinds == {"full_well", "read_noise", "snr"}


@pytest.mark.parametrize("given", MOSAIC_ONLY)
def test_options_of_mosaics_are_refused_for_four_shots(tmp_path: Path, given: dict[str, Any]) -> None:
    paths = write_four(tmp_path, CUP)
    option = "--" + next(iter(given)).replace("_", "-")
    fault = Fault(option, "raw mosaics", "cup, a shot through a filter")
    fault.raised_by(find_shots, paths, ShotOptions(**given))
    fault.raised_by(read_shot, find_shots(paths)[0], ShotOptions(**given))


@pytest.mark.parametrize("given", [*MOSAIC_ONLY, {"gains": "auto"}, {"align": False}])
def test_options_of_sensors_and_filters_are_refused_for_views(given: dict[str, Any]) -> None:
    name = next(iter(given))
    option = "--no-align" if name == "align" else "--" + name.replace("_", "-")
    Fault(option, found="a view of a scene").raised_by(
        find_shots, [polarguide.demo_scene()], ShotOptions(**given)
    )


def test_gains_of_a_calibration_are_refused_for_views() -> None:
    scene = polarguide.demo_scene()
    given = ShotOptions(calibration=Calibration(gains=(1.0, 1.1, 1.0, 1.0)))
    Fault("calibration (gains)", found="a view of a scene").raised_by(find_shots, [scene], given)
    assert find_shots([scene], ShotOptions(calibration=Calibration(sense="cw")))


@pytest.mark.parametrize("given", [{"transfer": "srgb"}, {"align": False}])
def test_options_of_filters_are_refused_for_mosaics(tmp_path: Path, given: dict[str, Any]) -> None:
    write_mosaic(tmp_path / "part.png")
    option = "--no-align" if "align" in given else "--transfer"
    Fault(option, found="part, a raw mosaic").raised_by(
        find_shots, [tmp_path], ShotOptions(sensor="IMX250MZR", **given)
    )


def test_read_noise_needs_a_full_well() -> None:
    Fault("--read-noise", expected="--full-well").raised_by(ShotOptions(read_noise=5.0).checked)
    ShotOptions(read_noise=5.0, full_well=5000.0).checked()


def test_no_paths() -> None:
    for call in (find_shots, read_shot, lambda paths: write_shots(paths, "out")):
        Fault("paths", expected="at least one file or folder").raised_by(call, [])
    Fault("paths", expected="at least one file or folder").raised_by(polarguide.shot_priors, [], "out")


def test_a_name_that_leads_out_of_the_folder(tmp_path: Path) -> None:
    write_mosaic(tmp_path / "a.png")
    odd = tmp_path / "in" / "...png"
    odd.parent.mkdir()
    shutil.copy(tmp_path / "a.png", odd)
    Fault(expected="valid for a folder", found="'..'").raised_by(
        write_shots, [odd], tmp_path / "out" / "deep", MONO, formats=("npy",)
    )
    for name in ("..", "../b"):
        shot = ExposureSet(name, "mosaic", {0: tmp_path / "a.png"})
        Fault(expected="valid for a folder").raised_by(
            write_shots, [shot], tmp_path / "out" / "deep", MONO, formats=("npy",)
        )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (PermissionError(13, "Permission denied"), "Permission denied"),
        (MemoryError(), "too little free memory"),
    ],
)
def test_no_error_of_one_shot_stops_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, said: str
) -> None:
    for name in "abc":
        write_mosaic(tmp_path / f"{name}.png")

    def read(shot: ExposureSet, options: ShotOptions) -> Any:
        if shot.name == "b":
            raise error
        return read_shot(shot, options)

    monkeypatch.setattr("polarguide_shots.write.read_shot", read)
    heard = Heard()
    done = write_shots([tmp_path], tmp_path / "out", MONO, formats=("npy",), reporter=heard)
    assert list(done.folders) == ["a", "c"]
    assert said in str(done.faults["b"])
    assert any("b.png" in text and said in text for text in heard.said)
    Fault(found=said).raised_by(write_shots, [tmp_path / "b.png"], tmp_path / "out", MONO, formats=("npy",))


def test_formats_of_an_earlier_call_do_not_stay(tmp_path: Path) -> None:
    write_mosaic(tmp_path / "a.png")
    folder = tmp_path / "out" / "a"
    folder.mkdir(parents=True)
    (folder / "S0.npy").write_bytes(b"mine")  # not known to be of this program
    write_shots([tmp_path / "a.png"], tmp_path / "out", MONO, formats=("png", "page"))
    assert (folder / "S0.npy").read_bytes() == b"mine"
    (folder / "notes.png").write_bytes(b"mine")
    write_shots([tmp_path / "a.png"], tmp_path / "out", MONO, formats=("npy",))
    assert {path.suffix for path in folder.iterdir()} == {".npy", ".json", ".png"}
    assert [path.name for path in folder.glob("*.png")] == ["notes.png"]


@pytest.mark.parametrize(
    "given",
    [{"full_well": 1e4}, {"snr": 5.0}, {"gains": "auto"}, {"calibration": Calibration(order=(90, 45, 0, 135))},
     {"calibration": Calibration(gains=(1.0, 1.1, 1.0, 1.0))}, {"bits": 12}, {"transfer": "srgb"}],
)  # fmt: skip
def test_options_of_shots_are_refused_for_a_scene_with_poses(tmp_path: Path, given: dict[str, Any]) -> None:
    name = next(iter(given))
    where = "calibration (" if name == "calibration" else f"--{name.replace('_', '-')}"
    Fault(where, "shots", "a scene with poses").raised_by(
        polarguide.priors, polarguide.demo_scene(), tmp_path / "x", views="v000", shots=ShotOptions(**given)
    )
    assert not (tmp_path / "x").exists()


def test_noise_counts_for_the_maps_of_a_scene_with_poses(tmp_path: Path) -> None:
    scene = polarguide.demo_scene()
    noisy = ShotOptions(full_well=100.0)
    polarguide.priors(scene, tmp_path, views="v000", shots=noisy, formats=["npy"])
    record = json.loads((tmp_path / "v000" / "maps.json").read_text())
    assert record["noise"]["source"] == "given"
    wrong = ShotOptions(calibration=Calibration(order=(90, 45, 0, 135)))
    Fault("calibration (order)", expected="shots").raised_by(
        polarguide.priors, scene, tmp_path, views="v000", shots=wrong, formats=["npy"]
    )


@pytest.mark.parametrize(
    ("option", "reading"),
    [
        ("--black-level", ShotOptions(black_level=5)),
        ("--no-align", ShotOptions(sensor="IMX250MZR", align=False)),
    ],
)
def test_options_of_a_watch_are_refused_before_it_begins(
    tmp_path: Path, option: str, reading: ShotOptions
) -> None:
    (tmp_path / "in").mkdir()
    Fault(option).raised_by(
        polarguide.watch_folder, tmp_path / "in", tmp_path / "out", reading=reading, should_stop=lambda: True
    )
    assert not (tmp_path / "out").exists()
