"""Watching a folder: each file once, none half written, whatever ends the process."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from bracketed import write_bracket

from polarguide.core.progress import Reporter
from polarguide.geometry.polarizer import ANGLES
from polarguide_shots.measurement.line import measure_shots, watch_folder
from polarguide_shots.measurement.table import CSV, LINES
from polarguide_shots.options import MeasureOptions, ShotOptions, WatchOptions
from tests.shots.test_read import PLAIN, write_four

QUICK = WatchOptions(settle=0.1, patience=0.4, idle=0.2)


def names(out: Path) -> list[str]:
    found = [json.loads(line)["shot"] for line in (out / LINES).read_bytes().splitlines()]
    with open(out / CSV, newline="", encoding="utf-8") as file:
        assert [row["shot"] for row in csv.DictReader(file)] == found
    return found


def test_each_once_and_after_a_restart_only_what_is_new(
    folder: Path, tmp_path: Path, reading: ShotOptions
) -> None:
    out = tmp_path / "out"
    first = watch_folder(folder, out, reading=reading, watching=QUICK)
    assert first.counts == {"measured": 3}
    assert first.exit_status == 0
    shutil.copy(folder / "v000.png", folder / "new.png")
    assert watch_folder(folder, out, reading=reading, watching=QUICK).counts == {"measured": 1}
    assert sorted(names(out)) == ["new", "v000", "v001", "v002"]


def test_the_same_numbers_as_a_pass_over_the_folder(
    folder: Path, tmp_path: Path, reading: ShotOptions
) -> None:
    watch_folder(folder, tmp_path / "a", reading=reading, watching=QUICK)
    measure_shots([folder], tmp_path / "b", reading=reading)
    a, b = (sorted((tmp_path / out / LINES).read_bytes().splitlines()) for out in "ab")
    assert a == b


def test_a_file_in_pieces_is_measured_when_it_is_whole(
    folder: Path, tmp_path: Path, reading: ShotOptions
) -> None:
    """A file grows in pieces for longer than the time to settle, without a change of its time."""
    data = (folder / "v000.png").read_bytes()
    coming = folder / "slow.png"
    coming.write_bytes(data[: len(data) // 2])
    begin = time.monotonic()
    seen: list[str] = []

    def should_stop() -> bool:
        if time.monotonic() - begin > 0.5 and coming.stat().st_size < len(data):
            assert "slow" not in seen
            coming.write_bytes(data)
        return len(seen) == 4 or time.monotonic() - begin > 60

    watching = WatchOptions(settle=0.1, patience=30)
    done = watch_folder(
        folder, tmp_path / "out", reading=reading, watching=watching, should_stop=should_stop,
        heard=lambda entry: seen.append(entry.shot),
    )  # fmt: skip
    assert done.counts == {"measured": 4}
    assert seen[-1] == "slow"


def test_a_file_that_never_becomes_whole_gets_one_line(
    folder: Path, tmp_path: Path, reading: ShotOptions
) -> None:
    data = (folder / "v000.png").read_bytes()
    (folder / "cut.png").write_bytes(data[:-40])
    watching = WatchOptions(settle=0.1, patience=0.4, idle=2)
    done = watch_folder(folder, tmp_path / "out", reading=reading, watching=watching)
    assert done.counts == {"measured": 3, "unread": 1}
    assert done.exit_status == 2
    assert watch_folder(folder, tmp_path / "out", reading=reading, watching=QUICK).counts == {}
    (line,) = [x for x in (tmp_path / "out" / LINES).read_bytes().splitlines() if b"unread" in x]
    assert "cut short" in json.loads(line)["why"]


def test_a_whole_file_that_is_no_mosaic_is_not_waited_for(tmp_path: Path, reading: ShotOptions) -> None:
    import cv2
    import numpy as np

    (tmp_path / "in").mkdir()
    cv2.imwrite(str(tmp_path / "in" / "color.png"), np.zeros((32, 32, 3), np.uint8))
    watching = WatchOptions(settle=0.1, patience=1000, idle=0.2)
    assert watch_folder(tmp_path / "in", tmp_path / "out", reading=reading, watching=watching).counts == {
        "unread": 1
    }


def test_a_file_that_changes_while_it_is_read_is_measured_once(
    folder: Path, tmp_path: Path, reading: ShotOptions, monkeypatch
) -> None:
    from polarguide_shots.measurement import line

    read, touched = line.read_shot, []

    def read_and_touch(shot, options, part):
        maps = read(shot, options, part=part)
        if not touched:
            touched.append(shot.name)
            os.utime(shot.paths[0], ns=(1, 1))
        return maps

    monkeypatch.setattr(line, "read_shot", read_and_touch)
    watch_folder(folder, tmp_path / "out", reading=reading, watching=QUICK)
    assert sorted(names(tmp_path / "out")) == ["v000", "v001", "v002"]


def test_of_four_files_the_last_is_waited_for(tmp_path: Path) -> None:
    from camera_files import behind, smooth_light, write_shots

    whole, parts = tmp_path / "whole", tmp_path / "in"
    whole.mkdir()
    parts.mkdir()
    write_shots(whole, "cup", behind(smooth_light()))
    files = sorted(path for path in whole.rglob("*") if path.is_file())
    assert len(files) == 4
    flat = [parts / (f"cup_{int(p.parent.name)}.png" if p.parent != whole else p.name) for p in files]
    for source, target in zip(files[:3], flat[:3], strict=True):
        shutil.copy(source, target)
    heard: list[str] = []

    class Heard(Reporter):
        def warn(self, text: str) -> None:
            heard.append(text)

    watching = WatchOptions(settle=0.1, patience=0.2, idle=0.5)
    done = watch_folder(parts, tmp_path / "out", watching=watching, reporter=Heard())
    assert done.waiting == ("cup",)
    assert done.exit_status == 2
    assert len(heard) == 1
    assert heard[0].startswith("cup: still no picture at")
    shutil.copy(files[3], flat[3])
    assert watch_folder(parts, tmp_path / "out", watching=watching).counts == {"measured": 1}


def test_what_is_ambiguous_gets_a_line_when_nothing_has_mended_it(tmp_path: Path) -> None:
    parts = tmp_path / "in"
    for name in ("cup", "jar"):
        write_four(parts, tuple(f"{name}_{angle}.png" for angle in ANGLES))
    shutil.copy(parts / "cup_0.png", parts / "cup_000.png")
    shutil.copy(parts / "cup_0.png", parts / "photo.png")
    patient = WatchOptions(settle=0.1, patience=30, idle=0.3)
    first = watch_folder(parts, tmp_path / "out", reading=PLAIN, watching=patient)
    assert first.counts == {"measured": 1}
    assert first.waiting == ("cup", "photo.png")
    assert first.exit_status == 2
    watching = WatchOptions(settle=0.1, patience=0.3, idle=1)
    done = watch_folder(parts, tmp_path / "out", reading=PLAIN, watching=watching)
    assert done.counts == {"unread": 2}
    assert done.exit_status == 2
    lines = [json.loads(line) for line in (tmp_path / "out" / LINES).read_bytes().splitlines()]
    why = {line["shot"]: line["why"] for line in lines}
    assert "one picture of cup at 0 degrees, found cup_0.png and cup_000.png" in why["cup"]
    assert "no angle in its name" in why["photo.png"]
    (parts / "cup_000.png").unlink()
    (parts / "photo.png").unlink()
    assert watch_folder(parts, tmp_path / "out", reading=PLAIN, watching=watching).counts == {"measured": 1}
    assert watch_folder(parts, tmp_path / "out", reading=PLAIN, watching=watching).counts == {}


def test_a_lone_exposure_waits_for_further_exposures(tmp_path: Path) -> None:
    parts = tmp_path / "in"
    bracket = write_bracket(tmp_path / "done", "part", stops=(0.0, -3.0))
    parts.mkdir()
    shutil.copy(bracket[1], parts)
    reading = ShotOptions(sensor="IMX250MZR", black_level=64, bits=12, gains="none")
    patient = WatchOptions(settle=0.1, patience=30, idle=0.3)
    first = watch_folder(parts, tmp_path / "out", reading=reading, watching=patient)
    assert (first.counts, first.waiting) == ({}, ("part",))
    shutil.copy(bracket[0], parts)
    assert watch_folder(parts, tmp_path / "out", reading=reading, watching=patient).counts == {"measured": 1}
    (parts / bracket[1].name).unlink()
    # A normal exposure alone is measured after the patience.
    watching = WatchOptions(settle=0.1, patience=0.3, idle=1)
    assert watch_folder(parts, tmp_path / "out", reading=reading, watching=watching).counts == {"measured": 1}


def test_a_folder_of_an_angle_that_never_comes_is_told(tmp_path: Path) -> None:
    parts = tmp_path / "in"
    write_four(parts, tuple(f"{angle}/cup.png" for angle in ANGLES))
    (parts / "135").rename(tmp_path / "135")
    watching = WatchOptions(settle=0.1, patience=0.2, idle=0.4)
    done = watch_folder(parts, tmp_path / "out", reading=PLAIN, watching=watching)
    assert "none for 135" in done.trouble
    assert done.exit_status == 2
    (tmp_path / "135").rename(parts / "135")
    done = watch_folder(parts, tmp_path / "out", reading=PLAIN, watching=watching)
    assert (done.counts, done.trouble, done.exit_status) == ({"measured": 1}, "", 0)


def test_an_empty_folder_is_no_fault(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    done = watch_folder(tmp_path / "in", tmp_path / "out", reading=PLAIN, watching=QUICK)
    assert (done.counts, done.exit_status) == ({}, 0)


def test_the_reference_and_the_dark_frame_are_not_measured(
    folder: Path, tmp_path: Path, reading: ShotOptions
) -> None:
    options = MeasureOptions(reference=folder / "v001.png")
    watch_folder(folder, tmp_path / "out", options, reading, QUICK)
    assert sorted(names(tmp_path / "out")) == ["v000", "v002"]


def test_a_reference_is_named_by_one_of_its_four_files(tmp_path: Path) -> None:
    from camera_files import behind, smooth_light, write_shots

    write_shots(tmp_path / "in", "cup", behind(smooth_light()))
    write_shots(tmp_path / "in", "jar", behind(0.9 * smooth_light()))
    one = next(path for path in sorted((tmp_path / "in").rglob("*.png")) if "cup" in path.stem)
    options = MeasureOptions(reference=one)
    done = measure_shots([tmp_path / "in"], tmp_path / "out", options, ShotOptions(align=False))
    assert done.counts == {"measured": 2}
    rows = [json.loads(line)["regions"][0] for line in (tmp_path / "out" / LINES).read_bytes().splitlines()]
    assert rows[0]["s0_difference"] == 0
    assert rows[1]["s0_difference"] == pytest.approx(-0.1 * rows[0]["s0_mean"], rel=1e-3)


@pytest.mark.skipif(os.name != "posix", reason="kills a process as POSIX systems do")
def test_kill_9_loses_no_line_and_doubles_none(folder: Path, tmp_path: Path, reading: ShotOptions) -> None:
    for number in range(3, 40):
        shutil.copy(folder / "v000.png", folder / f"v{number:03d}.png")
    out = tmp_path / "out"
    command = [
        sys.executable, "-m", "polarguide", "measure", "--watch", str(folder), "--out", str(out),
        "--sensor", "IMX250MZR", "--bits", "12", "--settle", "0.1", "--patience", "0.4", "--threads", "1",
    ]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    try:
        begin = time.monotonic()
        while not (out / LINES).exists() or (out / LINES).read_bytes().count(b"\n") < 5:
            assert process.poll() is None, process.stderr.read()
            assert time.monotonic() - begin < 120
            time.sleep(0.002)
    finally:
        process.send_signal(signal.SIGKILL)
        process.communicate()
    before = (out / LINES).read_bytes()
    whole = before[: before.rindex(b"\n") + 1]
    assert 5 <= whole.count(b"\n") < 40
    done = watch_folder(folder, out, reading=reading, watching=QUICK)
    assert done.counts == {"measured": 40 - whole.count(b"\n")}
    assert (out / LINES).read_bytes().startswith(whole)
    assert sorted(names(out)) == [f"v{number:03d}" for number in range(40)]
