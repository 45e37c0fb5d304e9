"""Sets at any angles, as names, folders, tables and videos state them; and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from faults import Fault

import polarguide
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings
from polarguide_shots.exposures import find_shots, list_shots
from polarguide_shots.measurement.table import KEYS
from polarguide_shots.options import ShotOptions, WatchOptions
from polarguide_shots.read import read_shot
from polarguide_shots.sets import ExposureSet
from polarguide_shots.write import write_shots
from tests.helpers.picture_sets import photographed, sphere, write_set

SIX = (10, 40, 70, 100, 130, 160)
SMALL = sphere(40)


def write(folder: Path, names: list[str], angles: tuple[float, ...] = SIX) -> list[Path]:
    return write_set(folder, names, photographed(SMALL, angles))


def angles_of(shot: ExposureSet) -> list[object]:
    return [picture.angle for picture in shot.pictures]


@pytest.mark.parametrize(
    "form",
    ["cup_a{}.png", "cup-{}deg.png", "cup_{}.png", "cup_{:03d}.png", "{}/cup.png", "I_{}/cup.png", "cup/{:03d}.png"],
)  # fmt: skip
def test_names_and_folders(tmp_path: Path, form: str) -> None:
    paths = write(tmp_path / "in", [form.format(angle) for angle in SIX])
    for given in ([tmp_path / "in"], *([paths] if not form.endswith("/cup.png") else [])):
        (shot,) = find_shots(given)
        assert (shot.kind, angles_of(shot)) == ("set", list(SIX))
        assert "cup" in shot.name
    assert read_shot(tmp_path / "in").usable.mean() > 0.5


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [((0, 60, 120), 3), (tuple(range(0, 180, 5)), 36), (tuple(range(0, 181, 10)), 19), ((3, 4, 5, 6), 0),
     ((10, 50, 70), 0)],
)  # fmt: skip
def test_plain_numbers_are_angles_where_they_go_round(
    tmp_path: Path, numbers: tuple[int, ...], expected: int
) -> None:
    write(tmp_path, [f"cup_{number:03d}.png" for number in numbers], numbers)
    found = list_shots([tmp_path])
    assert sum(len(shot.pictures) for shot in found if shot.kind == "set") == expected
    assert all("angles.csv" in shot.fault.remedy for shot in found if shot.fault is not None)


def test_several_sets_and_a_shot_of_four(tmp_path: Path) -> None:
    write(tmp_path, [f"cup_a{angle}.png" for angle in SIX])
    write(tmp_path, [f"jar_{angle}.png" for angle in (0, 60, 120)], (0, 60, 120))
    write(tmp_path, [f"mug_{angle}.png" for angle in (0, 45, 90, 135)], (0, 45, 90, 135))
    found = {shot.name: shot for shot in find_shots([tmp_path])}
    assert {name: shot.kind for name, shot in found.items()} == {"cup": "set", "jar": "set", "mug": "filter"}


def test_a_table_with_views_doubles_and_other_names(tmp_path: Path) -> None:
    write(tmp_path, [f"IMG_{k:04d}.png" for k in range(6)], (0, 60, 120, 0, 60, 120))
    lines = [f"IMG_{k:04d}.png,{angle}" for k, angle in enumerate((0, 60, 120, 0, 60, 120))]
    (tmp_path / "angles.csv").write_text("\n".join(["file,angle", *lines]))
    (shot,) = find_shots([tmp_path])
    assert (shot.name, angles_of(shot)) == (tmp_path.name, [0, 0, 60, 60, 120, 120])
    views = [f"{line},{'a' if k < 3 else 'b'}" for k, line in enumerate(lines)]
    (tmp_path / "angles.csv").write_text("\n".join(["file,angle,view", *views]))
    assert [(s.name, len(s.pictures)) for s in find_shots([tmp_path])] == [("a", 3), ("b", 3)]
    assert [(s.name, len(s.pictures)) for s in find_shots(sorted(tmp_path.glob("IMG_000[0-2].png")))] == [
        ("a", 3)
    ]
    assert tmp_path / "angles.csv" in find_shots([tmp_path])[0].paths


def test_frames_of_a_video(tmp_path: Path) -> None:
    path, angles = tmp_path / "turn.avi", list(range(0, 180, 15))
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), 10, (40, 40))
    if not writer.isOpened():
        pytest.skip("OpenCV has no encoder for FFV1")
    for frame in range(2 * len(angles)):  # every second frame is blurred by the turn
        picture = photographed(SMALL, [angles[frame // 2] + 7.5 * (frame % 2)], noisy=False)[0]
        writer.write(np.repeat(np.rint(picture / 257).astype(np.uint8)[..., None], 3, axis=2))
    writer.release()
    Fault(str(tmp_path / "turn.csv")).raised_by(read_shot, path)
    lines = [f"{2 * k},{angle}" for k, angle in enumerate(angles)]
    (tmp_path / "turn.csv").write_text("\n".join(["frame,angle", *lines]))
    maps = read_shot(path, ShotOptions(transfer="linear"))
    assert (maps.name, [fit.angle for fit in maps.pictures]) == ("turn", angles)
    np.testing.assert_allclose(maps.s0, SMALL[0], atol=0.01)
    np.testing.assert_allclose(maps.stokes, SMALL, atol=0.02)
    (tmp_path / "turn.csv").write_text("frame,angle\n0,0\n8,60\n99,120\n")
    Fault(expected="frame 99").raised_by(read_shot, path)
    for number in ("9" * 4301, "-1", "1e400", "1.5"):
        (tmp_path / "turn.csv").write_text(f"frame,angle\n0,0\n{number},60\n")
        Fault("line 3", expected="a frame", found=number[:80]).raised_by(read_shot, path)


@pytest.mark.parametrize(
    ("table", "where", "found"),
    [
        ("file,angle\na.png,0\nb.png,90\nc.png,180", "angles.csv", "2 (0, 90, 180)"),
        ("file,angle\na.png,0\nb.png,90\nc.png,unknown", "angles.csv", "2 (0, 90, unknown)"),
        ("file,angle\na.png,10\nb.png,12\nc.png,14", "angles.csv", "0.0"),
        ("file,angle\na.png,10\nb.png,50\nd.png,90", "angles.csv", "nothing of this name"),
    ],
)
def test_angles_that_determine_nothing_are_refused(
    tmp_path: Path, table: str, where: str, found: str
) -> None:
    write(tmp_path, ["a.png", "b.png", "c.png"], (0, 60, 120))
    (tmp_path / "angles.csv").write_text(table)
    (fault,) = (shot.fault for shot in list_shots([tmp_path]) if shot.kind == "set")
    assert fault is not None
    assert where in fault.where
    assert fault.found.startswith(found)


def test_two_files_of_one_angle_are_ambiguous(tmp_path: Path) -> None:
    write(tmp_path, [f"cup_a{angle}.png" for angle in SIX])
    write(tmp_path, ["cup_a010.png"], (10,))
    Fault(expected="one picture of cup at 10 degrees").raised_by(read_shot, tmp_path)


@pytest.mark.parametrize("option", [{"align": False}, {"gains": "auto"}, {"flip": "x"}])
def test_options_of_others_are_refused(tmp_path: Path, option: dict) -> None:
    write(tmp_path, [f"cup_a{angle}.png" for angle in SIX])
    Fault(found="cup, a set at other angles").raised_by(find_shots, [tmp_path], ShotOptions(**option))


def test_what_prepare_wrote_is_read(tmp_path: Path) -> None:
    write(tmp_path / "in", [f"{view}_{a}.png" for view in "ab" for a in (0, 60, 120)], (0, 60, 120) * 2)
    prepare_scene(tmp_path / "in", tmp_path / "scene", PrepareSettings(poses="none", transfer="linear"))
    shots = find_shots([tmp_path / "scene"])
    assert [(shot.kind, shot.name) for shot in shots] == [("scene", "a"), ("scene", "b")]
    assert np.median(np.abs(read_shot(shots[0]).s0 - SMALL[0])) < 0.01


def test_the_residual_is_written(tmp_path: Path) -> None:
    write(tmp_path / "in", [f"cup_a{angle}.png" for angle in SIX], (10, 40, 90, 100, 130, 160))
    write_shots([tmp_path / "in"], tmp_path / "out", formats=("png", "npy", "page"))
    folder = tmp_path / "out" / "cup"
    assert {"residual.png", "residual.npy", "left_out.png"} <= {path.name for path in folder.iterdir()}
    assert np.median(np.load(folder / "residual.npy")) > 1
    record = json.loads((folder / "maps.json").read_text())
    assert {"residual", "left_out"} <= record["maps"].keys()
    (wrong,) = (picture for picture in record["pictures"] if picture["left_out"])
    assert (wrong["angle"], wrong["looks_like"]) == (70, pytest.approx(90, abs=1))
    page = (folder / "shot.html").read_text()
    assert "looks like 90" in page
    assert ">residual<" in page
    # A later shot of four with this name replaces all files of the set.
    for path in (tmp_path / "in").iterdir():
        path.unlink()
    write(tmp_path / "in", [f"cup_{angle}.png" for angle in (0, 45, 90, 135)], (0, 45, 90, 135))
    write_shots([tmp_path / "in"], tmp_path / "out", formats=("png", "npy"))
    assert not list(folder.glob("residual*"))


def test_a_table_of_measurements_and_a_watched_folder(tmp_path: Path) -> None:
    paths = write(tmp_path / "in", [f"cup_a{angle}.png" for angle in SIX])
    (tmp_path / "in" / "cup_a160.png").rename(tmp_path / "late.png")
    watching = WatchOptions(settle=0.05, patience=60.0, idle=1.5)
    looks = 0

    def should_stop() -> bool:
        nonlocal looks
        looks += 1
        if looks == 12 and (tmp_path / "late.png").exists():
            (tmp_path / "late.png").rename(paths[-1])
        return False

    outcome = polarguide.watch_folder(
        tmp_path / "in", tmp_path / "watched", watching=watching, should_stop=should_stop
    )
    assert dict(outcome.counts) == {"measured": 1}
    polarguide.measure([tmp_path / "in"], tmp_path / "passed")
    tables = [(tmp_path / name / "table.csv").read_text().splitlines() for name in ("watched", "passed")]
    assert tables[0] == tables[1]
    assert len(tables[0]) == 2
    assert tables[0][0] == ",".join(KEYS)
