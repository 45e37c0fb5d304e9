"""The table on disk: torn at any byte, it loses no line and doubles none."""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from faults import Fault

from polarguide_shots.measurement.line import measure_shots
from polarguide_shots.measurement.table import CSV, FORMAT, KEYS, LINES, Entry, FileStamp, Table, stamps
from polarguide_shots.options import MeasureOptions, ShotOptions

SETTINGS = {"threshold": 0.05}


def entry(number: int, name: str = "shot", status: str = "measured") -> Entry:
    figures = ({"region": "all", "status": status, "s0_mean": 0.5 + number},) if status != "unread" else ()
    files = (FileStamp(f"/in/{name}{number}.png", 10, 10**18 + number),)
    return Entry(FORMAT, f"{name}{number}", files, status, "", (), figures)  # type: ignore[arg-type]


def write(folder: Path, entries: list[Entry], **options: bool) -> None:
    with Table(folder, SETTINGS, **options) as table:
        for one in entries:
            if table.entry_of(one.files) is None:
                table.add(one)


def test_torn_at_any_byte_it_is_mended(tmp_path: Path) -> None:
    entries = [entry(n) for n in range(3)]
    write(tmp_path, entries)
    lines, rows = (tmp_path / LINES).read_bytes(), (tmp_path / CSV).read_bytes()
    assert len(lines.splitlines()) == 3
    assert len(rows.splitlines()) == 4
    second = lines.index(b"\n") + 1
    for cut in (0, 1, second - 1, second, second + 1, second + 90, len(lines) - 1, len(lines)):
        for torn in (0, len(rows) // 2, len(rows) - 1, len(rows)):
            (tmp_path / LINES).write_bytes(lines[:cut])
            (tmp_path / CSV).write_bytes(rows[:torn])
            with Table(tmp_path, SETTINGS) as table:
                done = [table.entry_of(one.files) is not None for one in entries]
            assert sum(done) == lines[:cut].count(b"\n")
            write(tmp_path, entries)
            assert (tmp_path / LINES).read_bytes() == lines
            assert (tmp_path / CSV).read_bytes() == rows


def test_the_line_is_on_disk_before_the_row_is_written(tmp_path: Path, monkeypatch) -> None:
    with Table(tmp_path, SETTINGS) as table:
        header = (tmp_path / CSV).stat().st_size
        seen = []

        def fsync(number: int) -> None:
            seen.append(((tmp_path / LINES).stat().st_size > 0, (tmp_path / CSV).stat().st_size > header))

        monkeypatch.setattr("os.fsync", fsync)
        table.add(entry(0))
    assert seen == [(True, False), (True, True)]


def test_what_cannot_be_written_leaves_no_half_line(tmp_path: Path, monkeypatch) -> None:
    with Table(tmp_path, SETTINGS) as table:
        table.add(entry(0))
        before = (tmp_path / LINES).read_bytes()

        def full(number: int) -> None:
            raise OSError(28, "No space left on device")

        with monkeypatch.context() as patch:
            patch.setattr("os.fsync", full)
            Fault(found="No space left").raised_by(table.add, entry(1))
        assert (tmp_path / LINES).read_bytes() == before
        assert table.entry_of(entry(1).files) is None


def test_damage_in_the_middle_is_told(tmp_path: Path) -> None:
    write(tmp_path, [entry(0), entry(1)])
    lines = (tmp_path / LINES).read_bytes()
    (tmp_path / LINES).write_bytes(b"x" + lines)
    Fault("line 1)", expected="a JSON file").raised_by(Table, tmp_path, SETTINGS)
    assert (tmp_path / LINES).read_bytes() == b"x" + lines


def test_one_table_has_one_set_of_options(tmp_path: Path) -> None:
    write(tmp_path, [entry(0)])
    lines = (tmp_path / LINES).read_bytes()
    Fault("threshold)", "0.05", "0.1").raised_by(Table, tmp_path, {"threshold": 0.1})
    assert (tmp_path / LINES).read_bytes() == lines
    Table(tmp_path, {"threshold": 0.1}, overwrite=True).close()
    assert (tmp_path / LINES).read_bytes() == b""


def test_which_of_many_options_is_another_is_told(tmp_path: Path) -> None:
    settings = {"reading": {"order": (0, 45), "bits": 12, **{f"o{k}": 1 for k in range(99)}}}
    with Table(tmp_path, settings) as table:
        table.add(entry(0))
    Table(tmp_path, settings).close()
    settings["reading"]["o98"] = 2
    Fault("(reading.o98)", "1", "2").raised_by(Table, tmp_path, settings)


def test_a_table_of_nothing_but_failures_is_begun_anew(tmp_path: Path) -> None:
    write(tmp_path, [entry(0, status="unread")])
    Table(tmp_path, {"threshold": 0.1}).close()
    assert (tmp_path / LINES).read_bytes() == b""


def test_two_do_not_write_one_table(tmp_path: Path) -> None:
    with Table(tmp_path, SETTINGS):
        Fault(found="another polarguide measure").raised_by(Table, tmp_path, SETTINGS)
    Table(tmp_path, SETTINGS).close()


def test_names_are_no_formulas_and_need_not_be_unicode(tmp_path: Path) -> None:
    write(tmp_path, [entry(0, "=1+1"), entry(1, "a\udcff"), entry(2, 'b,"c\nd')])
    with open(tmp_path / CSV, newline="", encoding="utf-8") as file:
        head, *rows = csv.reader(file)
    assert head == list(KEYS)
    assert [row[0] for row in rows] == ["'=1+10", "a\\udcff1", 'b,"c\nd2']
    shots = [json.loads(line)["shot"] for line in (tmp_path / LINES).read_bytes().splitlines()]
    assert shots == ["=1+10", "a\udcff1", 'b,"c\nd2']
    write(tmp_path, [entry(0, "=1+1"), entry(1, "a\udcff"), entry(2, 'b,"c\nd')])
    assert (tmp_path / LINES).read_bytes().count(b"\n") == 3


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads the memory as Linux states it")
def test_two_hundred_shots_take_no_more_memory_than_twenty(tmp_path: Path, reading: ShotOptions) -> None:
    """The maps of one of these shots take 2 MB."""
    parts = tmp_path / "parts"
    parts.mkdir()
    rng = np.random.default_rng(0)
    cv2.imwrite(str(parts / "s000.png"), rng.integers(200, 3000, (144, 192)).astype(np.uint16))
    for number in range(1, 200):
        os.link(parts / "s000.png", parts / f"s{number:03d}.png")
    taken: list[int] = []

    def heard(_: Entry) -> None:
        taken.append(int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE"))

    assert measure_shots([parts], tmp_path / "out", reading=reading, heard=heard).counts == {"measured": 200}
    assert max(taken[20:]) - max(taken[:20]) < 30e6


@pytest.mark.parametrize(
    ("line", "fault"),
    [({"format": FORMAT + 1}, Fault("format")),
     ({"files": [{"path": "a", "bytes": 1, "modified": 10**30}]}, Fault("modified")),
     ({"files": [{"path": "a", "bytes": 1, "modified": -(10**20)}]}, Fault("modified"))],
)  # fmt: skip
def test_a_line_that_this_version_does_not_write_is_named(tmp_path: Path, line: dict, fault: Fault) -> None:
    write(tmp_path, [entry(0)])
    written = json.loads((tmp_path / LINES).read_text())
    (tmp_path / LINES).write_text(json.dumps({**written, **line}) + "\n")
    fault.raised_by(Table, tmp_path, SETTINGS)


def test_a_time_of_no_date_is_still_a_line(tmp_path: Path) -> None:
    """Some disks have times of any 64 bits."""
    path = tmp_path / "a.png"
    path.touch()
    try:
        os.utime(path, (0, 2**34 - 1))  # the year 2514
    except OSError:
        pytest.skip("this disk has no such time")
    files = stamps([path])
    folder = tmp_path / "table"
    write(folder, [Entry(FORMAT, "a", files, "measured", "", (), ({"region": "all"},))])
    with Table(folder, SETTINGS) as table:
        assert table.entry_of(files).status == "measured"


@pytest.mark.parametrize("name", [LINES, "measure.json"])
@pytest.mark.parametrize("how", ["link", "pipe"])
def test_a_table_writes_nowhere_else_and_waits_for_nothing(tmp_path: Path, name: str, how: str) -> None:
    folder, victim = tmp_path / "table", tmp_path / "victim.txt"
    write(folder, [entry(0)])
    victim.write_bytes((folder / name).read_bytes())
    before = victim.read_bytes()
    (folder / name).unlink()
    (folder / name).symlink_to(victim) if how == "link" else os.mkfifo(folder / name)
    Fault(name).raised_by(Table, folder, SETTINGS)
    assert victim.read_bytes() == before


def test_pictures_of_shots_of_one_name_do_not_replace_each_other(
    tmp_path: Path, reading: ShotOptions
) -> None:
    rng = np.random.default_rng(0)
    limits = tmp_path / "limits.json"
    limits.write_text('{"limits": {"s0_mean": {"max": 0.001}}}')
    out = tmp_path / "out"

    def measured(day: str, name: str) -> dict:
        (tmp_path / day).mkdir(exist_ok=True)
        path = tmp_path / day / f"{name}.png"
        cv2.imwrite(str(path), rng.integers(200, 3000, (48, 64)).astype(np.uint16))
        options = MeasureOptions(limits=limits, reference=tmp_path / "golden.png")
        assert measure_shots([path], out, options, reading).counts == {"beyond": 1}
        return json.loads((out / LINES).read_bytes().splitlines()[-1])

    cv2.imwrite(str(tmp_path / "golden.png"), rng.integers(200, 3000, (48, 64)).astype(np.uint16))
    assert measured("monday", "part1")["picture"] == "part1"
    before = {path: path.read_bytes() for path in out.glob("*/part1.png")}
    assert len(before) == 2
    assert measured("tuesday", "part1")["picture"] == "part1-2"
    assert measured("tuesday", "part1")["picture"] == "part1-3"  # the file was rewritten
    assert measured("tuesday", "part1-2")["picture"] == "part1-2-2"
    assert measured("tuesday", "PART1")["picture"] == "PART1-4"
    assert {path: path.read_bytes() for path in before} == before
    assert len(list((out / "beyond").iterdir())) == len(list((out / "differences").iterdir())) == 5


@pytest.mark.parametrize("how", ["removed", "replaced"])
def test_a_table_that_goes_away_takes_no_more_lines(tmp_path: Path, how: str) -> None:
    with Table(tmp_path / "table", SETTINGS) as table:
        table.add(entry(0))
        (tmp_path / "table" / LINES).unlink()
        if how == "replaced":
            (tmp_path / "table" / LINES).write_text("")
        for act in (table.require_present, lambda: table.add(entry(1))):
            Fault("table.jsonl", found="removed, renamed or replaced").raised_by(act)


def test_no_table_among_the_shots(folder: Path, reading: ShotOptions) -> None:
    Fault(found="the folder of the shots").raised_by(
        measure_shots, [folder], folder, MeasureOptions(), reading
    )
    assert not (folder / LINES).exists()


def test_a_table_of_somebody_else_is_kept(tmp_path: Path) -> None:
    (tmp_path / CSV).write_text("mine")
    Fault(found="a file of this name only").raised_by(Table, tmp_path, SETTINGS)
    assert (tmp_path / CSV).read_text() == "mine"
    Table(tmp_path, SETTINGS, overwrite=True).close()
