"""Listing a folder: what is ambiguous or incomplete is a fault of its own, and the shots beside it are read."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from faults import Fault

from polarguide.core.errors import PolarguideError
from polarguide.geometry.polarizer import ANGLES
from polarguide_shots.exposures import find_shots
from polarguide_shots.options import ShotOptions
from polarguide_shots.read import read_shot
from polarguide_shots.sets import ExposureSet
from polarguide_shots.write import write_shots
from tests.shots.test_read import CUP, MONO, PLAIN, write_four, write_mosaic

BARE = tuple(f"I{angle}.png" for angle in ANGLES)


def good_and_bad(found: list[ExposureSet]) -> tuple[list[str], dict[str, str]]:
    """Names of the shots that can be read, and what is said of the others."""
    good, bad = [], {}
    for shot in found:
        try:
            read_shot(shot, PLAIN)
            good.append(shot.name)
        except PolarguideError as error:
            bad[shot.name] = str(error)
    return good, bad


@pytest.fixture
def parts(tmp_path: Path) -> Path:
    """Write a folder of the shots cup and jar."""
    for name in ("cup", "jar"):
        write_four(tmp_path / "parts", tuple(f"{name}_{angle}.png" for angle in ANGLES))
    return tmp_path / "parts"


@pytest.mark.parametrize("second", ["cup_45.tif", "cup_045.png", "cup-I45.PNG"])
def test_two_files_of_one_angle(parts: Path, second: str) -> None:
    shutil.copy(parts / "cup_45.png", parts / second)
    good, bad = good_and_bad(find_shots([parts]))
    assert good == ["jar"]
    assert "one picture of cup at 45 degrees" in bad["cup"]
    assert "cup_45.png" in bad["cup"]
    assert second in bad["cup"]
    (cup,) = (shot for shot in find_shots([parts]) if shot.name == "cup")
    assert parts / "cup_45.png" in cup.paths
    assert parts / second in cup.paths


def test_three_of_four_angles(parts: Path) -> None:
    (parts / "cup_90.png").unlink()
    good, bad = good_and_bad(find_shots([parts]))
    assert good == ["jar"]
    assert "none at 90" in bad["cup"]


def test_three_of_four_files_called_like_the_angles(parts: Path) -> None:
    write_four(parts / "sub", BARE)[3].unlink()
    write_four(parts / "other", BARE)
    for path in parts.glob("*.png"):
        path.unlink()
    good, bad = good_and_bad(find_shots([parts]))
    assert good == ["other"]
    assert list(bad) == ["sub"]
    assert "none at 135" in bad["sub"]


def test_files_that_tell_no_angle(parts: Path) -> None:
    for name in ("overview.png", "jar_61.png"):
        shutil.copy(parts / "cup_0.png", parts / name)
    good, bad = good_and_bad(find_shots([parts]))
    assert good == ["cup", "jar"]
    assert bad.keys() == {"overview.png", "jar_61.png"}
    assert f"{parts / 'overview.png'}: expected raw mosaics with --sensor" in bad["overview.png"]


def test_a_subfolder_that_is_no_shot_does_not_hide_the_others(tmp_path: Path) -> None:
    write_four(tmp_path / "parts" / "one", CUP)
    write_four(tmp_path / "parts" / "two", ("0/cup.png", "45/cup.png", "90/cup.png", "135/cup.png"))
    (tmp_path / "parts" / "empty").mkdir()
    (tmp_path / "parts" / "unnamed").mkdir()
    shutil.copy(tmp_path / "parts" / "one" / "cup_0.png", tmp_path / "parts" / "unnamed" / "a.png")
    write_four(tmp_path / "parts" / "three", ("0/cup.png", "45/cup.png", "90/cup.png", "135/cup.png"))
    shutil.rmtree(tmp_path / "parts" / "three" / "45")
    good, bad = good_and_bad(find_shots([tmp_path / "parts"]))
    assert good == ["one_cup", "two_cup"]
    assert bad.keys() == {"three", "unnamed_a.png"}
    assert "four folders" in bad["three"]


def test_two_files_of_one_angle_in_folders_of_angles(tmp_path: Path) -> None:
    for name in ("cup", "jar"):
        write_four(tmp_path / "in", tuple(f"{angle}/{name}.png" for angle in ANGLES))
    shutil.copy(tmp_path / "in" / "0" / "cup.png", tmp_path / "in" / "0" / "cup.tif")
    good, bad = good_and_bad(find_shots([tmp_path / "in"]))
    assert good == ["jar"]
    assert "one picture of cup at 0 degrees, found cup.png and cup.tif" in bad["cup"]


def test_a_folder_that_cannot_be_listed(parts: Path, tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "all" / "locked").mkdir(parents=True)
    parts.rename(tmp_path / "all" / "parts")
    iterdir = Path.iterdir

    def refusing(path: Path):
        if path.name == "locked":
            raise PermissionError(13, "Permission denied")
        return iterdir(path)

    monkeypatch.setattr(Path, "iterdir", refusing)
    good, bad = good_and_bad(find_shots([tmp_path / "all"]))
    assert good == ["parts_cup", "parts_jar"]
    assert "found Permission denied" in bad["locked"]


def test_several_paths(parts: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    good, bad = good_and_bad(find_shots([tmp_path / "empty", parts]))
    assert (good, list(bad)) == (["cup", "jar"], ["empty"])
    given = [*sorted(parts.glob("cup*")), *sorted(parts.glob("jar*"))[:3]]
    stranger = tmp_path / "empty" / "photo.png"
    shutil.copy(given[0], stranger)
    good, bad = good_and_bad(find_shots([*given, stranger]))
    assert (good, sorted(bad)) == (["cup"], ["jar", "photo.png"])


def test_a_path_that_is_given_twice_is_one(parts: Path) -> None:
    paths = sorted(parts.glob("cup*"))
    assert [shot.name for shot in find_shots([*paths, *paths])] == ["cup"]


def test_nothing_but_faults_is_an_error(tmp_path: Path) -> None:
    write_mosaic(tmp_path / "a.png")
    write_mosaic(tmp_path / "b.png")
    Fault(expected="--sensor, or shots", found="a folder with a.png, b.png").raised_by(find_shots, [tmp_path])
    Fault("a.png", expected="raw mosaics with --sensor").raised_by(
        find_shots, [tmp_path / "a.png", tmp_path / "b.png"]
    )


def test_mosaics_of_one_stem_are_two_shots(tmp_path: Path) -> None:
    write_mosaic(tmp_path / "a.png")
    write_mosaic(tmp_path / "a.tif")
    write_mosaic(tmp_path / "b.png")
    assert [shot.name for shot in find_shots([tmp_path], MONO)] == ["a.png", "a.tif", "b"]


def test_shots_whose_names_cannot_be_told_apart(tmp_path: Path) -> None:
    for folder in ("a", "c/a", "d"):
        (tmp_path / folder).mkdir(parents=True)
        write_mosaic(tmp_path / folder / "part.png")
    write_mosaic(tmp_path / "d" / "whole.png")
    found = find_shots([tmp_path / "a", tmp_path / "c" / "a", tmp_path / "d"], MONO)
    assert [(shot.name, shot.fault is None) for shot in found] == [
        ("a_part", False), ("a_part", False), ("d_part", True), ("whole", True),
    ]  # fmt: skip
    Fault(expected="one shot of each name", found="a_part also at").raised_by(read_shot, found[0], MONO)


def test_the_others_are_written(parts: Path, tmp_path: Path) -> None:
    shutil.copy(parts / "cup_45.png", parts / "cup_045.png")
    done = write_shots([parts], tmp_path / "out", PLAIN, formats=("npy",))
    assert list(done.folders) == ["jar"]
    assert list(done.faults) == ["cup"]
    assert np.load(done.folders["jar"] / "DoLP.npy").shape == (64, 96)


def test_options_that_name_no_sensor_do_not_read_mosaics(tmp_path: Path) -> None:
    write_mosaic(tmp_path / "cup_0.png")
    Fault(found="none at 45 and 90 and 135").raised_by(read_shot, tmp_path / "cup_0.png", ShotOptions())
