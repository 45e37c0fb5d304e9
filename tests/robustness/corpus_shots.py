"""The corpus of single shots: folders, regions, limits, golden parts, calibration files, tables, watched folders.

A bad shot of a folder ends in an error of one line, and in a line of the table beside those of the good ones.
"""

from __future__ import annotations

import json
import os
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from forked import Case
from safetensors.numpy import load_file, save_file

Change = Callable[[Path], object]
OF_FILTER = ["measure", "shots", "--out", "new", "--threads", "1", "--no-align"]
OF_SENSOR = ["measure", "mosaics", "--out", "new", "--threads", "1", "--sensor", "IMX250MYR", "--bits", "16"]
WATCHED = ["measure", "--watch", *OF_SENSOR[1:], "--settle", "0.05", "--patience", "0.2", "--idle", "1"]
PICTURES = ["priors", *OF_SENSOR[1:], "--formats", "npy"]
LIMITS, CAMERA = ["--limits", "limits.json"], ["--calibration", "camera.safetensors"]
PART = "mosaics/v001.png"


def _case(
    name: str, change: Change, command: list[str], says: str = "", accepted: str = "", **lines: str
) -> Case:
    """A case; ``lines``: shot -> status, of the table that it has to leave."""

    def make(folder: Path, rng: random.Random) -> list[str]:
        change(folder)
        return command

    def check(folder: Path) -> None:
        table = (folder / "new" / "table.jsonl").read_text(encoding="utf-8").splitlines()
        found = {(line["shot"], line["status"]) for line in map(json.loads, table)}
        assert set(lines.items()) <= found, found
        assert len(table) == len(found), found

    return Case(f"single {name}", 0, make, accepted, check if lines else None, says)


def shot_cases() -> Iterator[Case]:
    """All of them."""
    for make in (
        listing_cases,
        file_cases,
        option_cases,
        limits_cases,
        calibration_cases,
        table_cases,
        watch_cases,
    ):
        yield from make()


def _copy(source: str, target: str) -> Change:
    def change(folder: Path) -> None:
        (folder / target).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(folder / source, folder / target)

    return change


def _text(name: str, text: str | bytes) -> Change:
    data = text.encode() if isinstance(text, str) else text
    return lambda folder: (folder / name).write_bytes(data)


def listing_cases() -> Iterator[Case]:
    """One bad shot, and a good one beside it."""
    of_two = "one picture of v000 at 45 degrees, found v000.jpg and v000.png"
    good = {"v001": "measured"}
    yield _case("two files of an angle", _copy("shots/45/v000.png", "shots/45/v000.jpg"), OF_FILTER, of_two,
                v000="unread", **good)  # fmt: skip
    yield _case("three of four", lambda f: (f / "shots/90/v000.png").unlink(), OF_FILTER, "none at 90",
                v000="unread", **good)  # fmt: skip
    yield _case(
        "a folder of an angle is missing", lambda f: shutil.rmtree(f / "shots/90"), OF_FILTER, "four folders"
    )
    yield _case(
        "two folders of an angle", lambda f: (f / "shots/I-45").mkdir(), OF_FILTER, "one folder for 45"
    )
    yield _case("a folder that is called like a picture", lambda f: (f / "mosaics/w.png").mkdir(), OF_SENSOR,
                "w.png: expected", w="unread", **good)  # fmt: skip
    yield _case("a pipe that is called like a picture", lambda f: os.mkfifo(f / "mosaics/w.png"), OF_SENSOR,
                "w.png: expected", w="unread", **good)  # fmt: skip
    yield _case("a link to itself", lambda f: (f / "mosaics/w.png").symlink_to("w.png"), OF_SENSOR,
                "w.png: expected", w="unread", **good)  # fmt: skip
    yield _case("a name of a new line and a command of the terminal", _copy(PART, "mosaics/a\n\x1b[2Jb.png"),
                [*OF_SENSOR, "--roi", "0,0,99,99"], "roi1 within")  # fmt: skip
    yield _case("a name as long as it can be", _copy(PART, f"mosaics/{'x' * 251}.png"),
                [*OF_SENSOR, "--reference", PART], "name", v001="measured")  # fmt: skip


def file_cases() -> Iterator[Case]:
    """Files that are no mosaic of this sensor."""

    def array(values: np.ndarray) -> Change:
        return lambda folder: np.save(folder / "mosaics/w.npy", values)

    good = {"v000": "measured", "v001": "measured", "v002": "measured", "w": "unread"}
    for name, values, says in (
        ("floats that are none", np.full((32, 32), np.nan, np.float32), "raw mosaic"),
        ("four numbers a pixel", np.zeros((32, 32, 4), np.uint16), "raw mosaic"),
        ("no pixels", np.zeros((0, 32), np.uint16), "raw mosaic"),
        ("three pixels", np.zeros((1, 3), np.uint16), "at least 16x16 pixels"),
        ("more pixels than the sensor", np.zeros((2058, 2466), np.uint16), "at most 2464x2056 pixels"),
    ):
        yield _case(f"mosaic of {name}", array(values), OF_SENSOR, says, **good)
    yield _case("mosaic packed, of unknown size", _text("mosaics/w.raw", bytes(4608)), OF_SENSOR,
                "width, height and packing", **good)  # fmt: skip
    yield _case(
        "mosaic in a map folder",
        _text(PART, b"\x89PNG\r\n\x1a\n"),
        PICTURES,
        "v001.png: expected .* cut short",
    )
    yield _case("dark frame of another size",
                lambda f: np.save(f / "dark.npy", np.zeros((16, 16), np.uint16)),
                [*OF_SENSOR, "--dark-frame", "dark.npy"], "dark frame of 64x48", v000="unread")  # fmt: skip


def option_cases() -> Iterator[Case]:
    """Regions and golden parts."""
    for name, text in (("beyond", "a=60,0,5,1"), ("of a size that overflows", "0,0,4294967297,1"),
                       ("of half a pixel", "0,0,1.5,1"), ("that is called by a new line", "a\nb=0,0,1,1"),
                       ("of 5000 digits", f"{'9' * 5000},0,1,1"), ("of other digits", "٩٩,0,1,1")):  # fmt: skip
        yield _case(f"region {name}", lambda f: None, [*OF_SENSOR, "--roi", text])
    yield _case(
        "golden part that is three",
        lambda f: None,
        [*OF_SENSOR, "--reference", "mosaics"],
        "one shot, found 3",
    )
    yield _case("golden part of another size", lambda f: np.save(f / "g.npy", np.zeros((32, 32), np.uint16)),
                [*OF_SENSOR, "--reference", "g.npy"])  # fmt: skip


def limits_cases() -> Iterator[Case]:
    """Files of limits."""
    for name, text in (
        ("an unknown field", '{"limits": {"dolp_maen": {"max": 1}}}'),
        ("a bound that is no number", '{"limits": {"dolp_mean": {"max": NaN}}}'),
        ("a number beyond floats", '{"limits": {"dolp_mean": {"max": 1e999}}}'),
        ("half a character", b'{"limits": {"dolp_mean\xff": {"max": 1}}}'),
        ("100000 brackets", "[" * 100_000),
        ("a region that there is not", '{"regions": {"../x": {"dolp_mean": {"max": 1}}}}'),
    ):
        yield _case(f"limits of {name}", _text("limits.json", text), [*OF_SENSOR, *LIMITS])
    yield _case("limits that are a folder", lambda f: (f / "limits.json").mkdir(), [*OF_SENSOR, *LIMITS])
    yield _case("limits that are a pipe", lambda f: os.mkfifo(f / "limits.json"), [*OF_SENSOR, *LIMITS])


def calibration_cases() -> Iterator[Case]:
    """Files of ``calibrate``, and what they do not fit."""

    def spoiled(change: Callable[[Path], object] = lambda path: None, sensor: str = "IMX250MYR") -> Change:
        def make(folder: Path) -> None:
            _write_ideal(folder / "camera.safetensors", sensor)
            change(folder / "camera.safetensors")

        return make

    def head(path: Path, length: int) -> None:
        path.write_bytes(length.to_bytes(8, "little") + path.read_bytes()[8:])

    def other(path: Path) -> None:
        values = load_file(path)["vectors"]
        save_file({"vectors": values}, path, metadata={"polarguide": '{"format": "polarguide-analyzers"}'})

    command = [*OF_SENSOR, *CAMERA]
    for name, change in (
        ("cut", lambda path: os.truncate(path, path.stat().st_size // 2)),
        ("empty", lambda path: os.truncate(path, 0)),
        ("with a head of 2^62 bytes", lambda path: head(path, 1 << 62)),
        ("without its fields", other),
        ("a link to itself", lambda path: (path.unlink(), path.symlink_to(path.name))),
    ):
        yield _case(f"calibration {name}", spoiled(change), command, "camera.safetensors")
    yield _case("calibration of another sensor", spoiled(sensor="IMX250MZR"), command, "one of IMX250MZR")
    yield _case("calibration of a region elsewhere", spoiled(), [*command, "--offset-x", "64"], "column 64")
    yield _case("calibration of a sensor for a filter", spoiled(), [*OF_FILTER, *CAMERA], "raw mosaics")


def _write_ideal(path: Path, sensor: str) -> None:
    """The calibration of ideal polarizers on 64x48 pixels, the size of the mosaics."""
    from polarguide.capture.sensor.analyzer_file import write_analyzers
    from polarguide.capture.sensor.analyzers import AnalyzerCalibration
    from polarguide.capture.sensor.pattern import sensor_pattern, tiled

    period = sensor_pattern(sensor).period
    twice = 2 * np.deg2rad(tiled(sensor_pattern(sensor).angles, (period, period)))
    vectors = np.stack([np.ones_like(twice), np.cos(twice), np.sin(twice)], axis=-1) / 2
    blocks = np.broadcast_to(vectors, (3, 4, period, period, 3)).astype(np.float32)
    write_analyzers(path, AnalyzerCalibration(sensor, "", (0, 0), (64, 48), 16, blocks, "angles"))


def table_cases() -> Iterator[Case]:
    """Tables that others have left."""

    def left(name: str, data: bytes) -> Change:
        def change(folder: Path) -> None:
            from polarguide.cli.app import run

            assert run(OF_SENSOR) == 0
            (folder / "new" / name).write_bytes(data)

        return change

    for name, data in (("table.jsonl", b'{"format": 1}\n'), ("table.jsonl", b"\xff\xfe\n"), ("measure.json", b"[]"),
                       ("measure.json", b"")):  # fmt: skip
        yield _case(f"table with a {name} of {data!r}", left(name, data), OF_SENSOR, name)
    yield _case("table whose folder is a file", _text("new", "mine"), OF_SENSOR, "new")
    yield _case("table whose pictures are a file", lambda f: ((f / "new").mkdir(), _text("new/differences", "mine")(f)),
                [*OF_SENSOR, "--reference", PART], "differences")  # fmt: skip


def watch_cases() -> Iterator[Case]:
    """Watched folders."""
    good = {"v000": "measured", "v001": "measured", "v002": "measured"}
    yield _case(
        "watched folder that is a file", _text("w", ""), [*WATCHED[:2], "w", *WATCHED[3:]], "w: expected"
    )

    def half(folder: Path) -> None:
        (folder / "mosaics/w.png").write_bytes((folder / PART).read_bytes()[:99])

    yield _case("watched folder with half a file", half, WATCHED, "cut short", w="unread", **good)
    yield _case("watched folder with a pipe", lambda f: os.mkfifo(f / "mosaics/w.png"), WATCHED,
                accepted="what is no file is passed over", **good)  # fmt: skip
    watched = ["measure", "--watch", *OF_FILTER[1:], *WATCHED[-6:]]
    yield _case("watched folder with two files of an angle", _copy("shots/45/v000.png", "shots/45/v000.tif"), watched,
                "one picture of v000 at 45 degrees", v000="unread", v001="measured")  # fmt: skip
    yield _case(
        "watched folder without one of its angles",
        lambda f: shutil.rmtree(f / "shots/90"),
        watched,
        "four folders",
    )
