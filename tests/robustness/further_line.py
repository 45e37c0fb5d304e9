# ruff: noqa: E501
"""Inspection lines and calibrations: regions, limits, tables of before, analyzers that do not fit."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from base import MOSAICS, READ, SHOTS
from further_folders import CALIBRATE, MEASURE
from making import MOSAIC, Change, MadeCase, made_case, nothing, of_json, put, sparse


def option_cases() -> Iterator[MadeCase]:
    """Regions, and other options of ``measure``."""
    for name, words, reason in (
        ("no text", ["--roi", ""], ""),
        ("blanks", ["--roi", "1, 2, 3, 4"], ""),
        ("other digits", ["--roi", "\u0661,2,3,4"], ""),
        ("5000 digits", ["--roi", f"1,2,3,{'9' * 5000}"], ""),
        ("no width", ["--roi", "1,2,0,4"], ""),
        ("negative places", ["--roi", "a=-1,2,3,4"], ""),
        ("fractions", ["--roi", "1.5,2,3,4"], ""),
        ("a place beyond the picture", ["--roi", "60,40,9,9"], ""),
        ("one name twice", ["--roi", "a=1,1,2,2", "--roi", "a=2,2,2,2"], ""),
        ("the same name in another case", ["--roi", "a=1,1,2,2", "--roi", "A=2,2,2,2"], "names differ in case"),
        ("a name like that of another", ["--roi", "roi2=1,1,2,2", "--roi", "2,2,2,2"], ""),
        ("a name that leaves", ["--roi", "../../outside/x=1,1,2,2"], "a name is text of the table, not of a file"),
        ("a name that is a formula", ["--roi", "@SUM(1)=1,1,2,2"], "a formula is written as text"),
        ("a name of two lines", ["--roi", "a\nb=1,1,2,2"], ""),
        ("a name of 65 letters", ["--roi", "x" * 65 + "=1,1,2,2"], ""),
        ("300 regions", [w for k in range(300) for w in ("--roi", f"r{k}=1,1,2,2")], "there may be many"),
        ("one pixel", ["--roi", "0,0,1,1"], "a region may be a pixel"),
        ("a threshold above 1", ["--threshold", "1.5"], ""),
        ("a full well of nothing", ["--full-well", "0"], ""),
        ("noise without a full well", ["--read-noise", "5"], ""),
        ("a watched folder beside shots", ["--watch", "mosaics"], ""),
        ("a reference of another size", ["--reference", "shots/0/v000.png"], "it has the same size"),
        ("a reference that is a folder", ["--reference", "mosaics"], ""),
        ("a reference that is a device", ["--reference", "/dev/zero"], ""),
        ("a reference that is a run", ["--reference", "run"], ""),
        ("limits that are a folder", ["--limits", "scene"], ""),
        ("limits that are a device", ["--limits", "/dev/zero"], ""),
        ("a calibration that is a device", ["--calibration", "/dev/zero"], ""),
        ("a dark frame that is a mosaic", ["--dark-frame", MOSAIC], "the table says how many pixels count"),
        ("more bits than there are", ["--bits", "17"], ""),
        ("a saturation of 1", ["--saturation", "1"], "the table says that all are saturated"),
        ("a black level above all", ["--black-level", "65535"], ""),
    ):  # fmt: skip
        yield made_case(f"further measure with {name}", nothing, [*MEASURE, *words], reason)
    watch = ["measure", "--out", "new", *MEASURE[4:], "--settle", "0.05", "--idle", "0.6"]
    for name, change, words, reason in (
        ("of a file", nothing, ["--watch", MOSAIC], ""),
        ("of nothing", nothing, ["--watch", "nowhere"], ""),
        ("of its own table", nothing, ["--watch", "new"], ""),
        ("that goes away", _gone, ["--watch", "mosaics"], "a folder of the network may come back"),
        ("of a pipe among mosaics", lambda f: os.mkfifo(f / "mosaics/a.png"), ["--watch", "mosaics"], "only files are shots"),
        ("of a mosaic that is cut short", lambda f: (f / MOSAIC).write_bytes((f / MOSAIC).read_bytes()[:900]), ["--watch", "mosaics", "--patience", "0.3"], ""),
    ):  # fmt: skip
        yield made_case(f"further watch {name}", change, [*watch, *words], reason)


def _gone(folder: Path) -> None:
    """Rename the watched folder from another process, once it has been looked at."""
    if not os.fork():
        import time

        time.sleep(0.4)
        with open(os.devnull, "w") as quiet:
            os.dup2(quiet.fileno(), 1)
        os.rename(folder / "mosaics", folder / "elsewhere")
        os._exit(0)


def limit_cases() -> Iterator[MadeCase]:
    """Limits files."""
    for name, content in {
        "of an unknown field": {"limits": {"dolp_men": {"max": 1}}},
        "of a field of references": {"limits": {"dolp_diff_mean": {"max": 1}}},
        "of a bound of nothing": {"limits": {"dolp_mean": {}}},
        "of a bound of null": {"limits": {"dolp_mean": None}},
        "of a bound of text": {"limits": {"dolp_mean": {"max": "1"}}},
        "of a bound of a truth": {"limits": {"dolp_mean": {"max": True}}},
        "of bounds the wrong way": {"limits": {"dolp_mean": {"min": 0.9, "max": 0.1}}},
        "of an unknown region": {"regions": {"label": {"dolp_mean": {"max": 1}}}},
        "of a hostile region": {"regions": {"\x1b[2J\u202e</script>": {"dolp_mean": {"max": 1}}}},
        "of another format": {"format": 2, "limits": {"dolp_mean": {"max": 1}}},
        "of nothing": {},
        "as a list": [],
        "with a word too many": {"limits": {"dolp_mean": {"max": 1, "mx": 2}}},
        "with 200000 fields": {"limits": {f"f{k}": {"max": 1} for k in range(200_000)}},
    }.items():
        yield made_case(
            f"further limits {name}", of_json("limits.json", content), [*MEASURE, "--limits", "limits.json"]
        )


def table_cases() -> Iterator[MadeCase]:
    """What stands in the folder of a table already."""
    entry = {
        "format": 1,
        "shot": "a",
        "files": [],
        "status": "measured",
        "why": "",
        "notes": [],
        "regions": [],
    }

    def table(lines: bytes, settings: Any = None) -> Change:
        def change(folder: Path) -> None:
            _measured(folder)
            (folder / "new/table.jsonl").write_bytes(lines)
            if settings is not None:
                (folder / "new/measure.json").write_bytes(settings)

        return change

    def line(**changed: Any) -> bytes:
        return json.dumps({**entry, **changed}).encode() + b"\n"

    there = {"path": "/x/a.png", "bytes": 1, "modified": 1}
    for name, change, reason in (
        ("of zeros", table(bytes(4096)), "a last line without an end is one that a kill has torn"),
        ("of a line that is none", table(b"{}\n" + line()), ""),
        ("of a line of another format", table(line(format=99)), ""),
        ("of a status that is none", table(line(status="fine")), ""),
        ("of 10^30 nanoseconds", table(line(files=[{**there, "modified": 10**30}])), ""),
        ("of 9 * 10^18 nanoseconds", table(line(files=[{**there, "modified": 9 * 10**18}])), "a clock may be wrong"),
        ("of a negative time", table(line(files=[{**there, "modified": -(10**18)}])), "a clock may be wrong"),
        ("of formulas", table(line(shot="=cmd|' /C calc'!A0", status="unread", why="@SUM(1)")), "a formula is written as text"),
        ("of unknown figures", table(line(regions=[{"region": "a", "stranger": 3}])), "figures of no column are passed over"),
        ("of figures in lists", table(line(regions=[{"region": [1], "dolp_mean": {}}])), ""),
        ("of a million empty lines", table(b"\n" * 1_000_000), ""),
        ("of one line of 40 MB", table(line(why="x" * 40_000_000)), "a line may be long"),
        ("with other options", table(line(), b'{"format": 1}\n'), ""),
        ("with options that are none", table(line(), b"\xff\xfe"), ""),
        ("with options in a list", table(line(), b"[]"), ""),
        ("whose CSV is a folder", lambda f: (_measured(f), put("new/table.csv", "folder")(f)), ""),
        ("whose CSV is a link outside", lambda f: (_measured(f), put("new/table.csv", "outside")(f)), "a link is replaced, and what it led to stays"),
        ("whose lines are a link outside", lambda f: (_measured(f), put("new/table.jsonl", "outside")(f)), ""),
        ("whose lines are a pipe", lambda f: (_measured(f), put("new/table.jsonl", "pipe")(f)), ""),
        ("whose lock is a folder", lambda f: (_measured(f), put("new/.lock", "folder")(f)), ""),
        ("whose lock is a link outside", lambda f: (_measured(f), put("new/.lock", "outside")(f)), ""),
        ("whose pictures go outside", lambda f: (f.joinpath("new").mkdir(), (f / "new/beyond").symlink_to("../../outside"), of_json("limits.json", {"limits": {"dolp_mean": {"max": 0}}})(f)), ""),
    ):  # fmt: skip
        more = ["--limits", "limits.json"] if "pictures go outside" in name else []
        csv = (lambda f: _no_formula(f)) if "formulas" in name else None
        yield made_case(f"further table {name}", change, [*MEASURE, *more], reason, csv)


def _measured(folder: Path) -> None:
    from polarguide.cli.app import run

    run(MEASURE)


def _no_formula(folder: Path) -> None:
    for line in (folder / "new/table.csv").read_text().splitlines():
        assert not line.startswith(("=", "@", "+", "-")), line


def analyzer_cases() -> Iterator[MadeCase]:
    """Files of ``calibrate`` whose checksum fits, and whose content does not."""
    given = [*MOSAICS[:5], "IMX250MZR", *MOSAICS[6:], "--calibration", "camera.safetensors"]

    def analyzers(change: Mapping[str, Any] | None = None, vectors: Any = None, **how: Any) -> Change:
        def write(folder: Path) -> None:
            _mono(folder)
            (folder / "camera.safetensors").write_bytes(_analyzers(dict(change or {}), vectors, **how))

        return write

    whole = np.full((24, 32, 2, 2, 3), 0.5, np.float32)
    whole[..., 2] = 0
    for name, change, command, reason in (
        ("of another sensor", analyzers({"sensor": "IMX250MYR"}), given, ""),
        ("of no sensor", analyzers({"sensor": "\x1b[2J"}), given, ""),
        ("of a block of 0", analyzers({"block": 0}), given, ""),
        ("of a negative block", analyzers({"block": -2}), given, ""),
        ("of a block of 2^62", analyzers({"block": 1 << 62}), given, ""),
        ("of a width of 0", analyzers({"width": 0}), given, ""),
        ("of a width of 2^62", analyzers({"width": 1 << 62}), given, ""),
        ("of a smaller region", analyzers({"width": 32}, whole[:, :16]), given, ""),
        ("of another region", analyzers({"offset_x": 4}), given, ""),
        ("of a region at -2", analyzers({"offset_x": -2}), given, ""),
        ("of another version", analyzers({"version": 99}), given, ""),
        ("of vectors of zeros", analyzers(vectors=whole * 0), given, ""),
        ("of vectors of NaN", analyzers(vectors=whole * np.nan), given, ""),
        ("of vectors of 1e30", analyzers(vectors=whole * np.float32(1e30)), given, ""),
        ("of vectors of 1e-30", analyzers(vectors=whole * np.float32(1e-30)), given, ""),
        ("of four polarizers alike", analyzers(vectors=whole), given, ""),
        ("of doubles", analyzers(vectors=whole.astype(np.float64)), given, ""),
        ("of a wrong checksum", analyzers({"sha256": "0" * 64}), given, ""),
        ("of a lens of a million letters", analyzers({"lens": "\x1b[2J" * 250_000}), given, "any name will do, and control characters are not shown"),
        ("of tensors that overlap", analyzers(overlap=True), given, ""),
        ("of an offset of 2^63", analyzers(end=1 << 63), given, ""),
        ("that is JSON", of_json("camera.safetensors", {"zero": 0}), given, ""),
        ("that is called JSON", lambda f: (analyzers()(f), (f / "camera.safetensors").rename(f / "camera.json")), [*given[:-1], "camera.json"], "it is known by its content"),
        ("for shots of a filter", analyzers(), [*SHOTS, "--calibration", "camera.safetensors"], ""),
        ("for an inspection of a color scene", analyzers(), ["inspect", "scene", "--out", "new", "--normals", "points", "--calibration", "camera.safetensors"], ""),
        ("for priors of a scene", analyzers(), [*READ, "--calibration", "camera.safetensors"], ""),
        ("with an order beside it", analyzers(), [*given, "--order", "90,45,0,135"], "options go before the file"),
        ("of 2 GiB, sparse", lambda f: sparse(f / "camera.safetensors", (1 << 31) - 1, b"\x02\0\0\0\0\0\0\0{}"), given, ""),
    ):  # fmt: skip
        yield made_case(f"further analyzers {name}", change, command, reason)


def _mono(folder: Path) -> None:
    """Mosaics of a monochrome sensor."""
    from camera_files import write_mosaics

    shutil.rmtree(folder / "mosaics")
    write_mosaics(folder / "mosaics", 3, color=False)


def _analyzers(
    changed: dict[str, Any], vectors: Any, *, overlap: bool = False, end: int | None = None
) -> bytes:
    """A file with any metadata, and the checksum that belongs to it."""
    if vectors is None:
        angles = np.radians(np.array([[90, 45], [135, 0]]))
        vectors = np.tile(
            np.stack([np.ones((2, 2)), np.cos(2 * angles), np.sin(2 * angles)], -1) / 2, (24, 32, 1, 1, 1)
        ).astype(np.float32)
    said = {"format": "polarguide-analyzers", "version": 1, "sensor": "IMX250MZR", "lens": "", "width": 64, "height": 48,
            "offset_x": 0, "offset_y": 0, "block": 2, "reference": "mean", "polarizer_extinction": None, **_units()}  # fmt: skip
    said |= changed
    if "sha256" not in changed:
        digest = hashlib.sha256(json.dumps(said, ensure_ascii=False, sort_keys=True).encode())
        digest.update(f"{vectors.dtype.str} {vectors.shape}".encode())
        digest.update(np.ascontiguousarray(vectors).tobytes())
        said["sha256"] = digest.hexdigest()
    from polarguide.capture.sensor import analyzer_file as analyzers

    kind = {"float32": "F32", "float64": "F64"}[str(vectors.dtype)]
    data = vectors.tobytes()
    tensor = {
        "dtype": kind,
        "shape": list(vectors.shape),
        "data_offsets": [0, len(data) if end is None else end],
    }
    head: dict[str, Any] = {
        "__metadata__": {analyzers._ENTRY: json.dumps(said, ensure_ascii=False)},
        analyzers._TENSOR: tensor,
    }
    if overlap:
        head["other"] = tensor
    text = json.dumps(head).encode()
    return struct.pack("<Q", len(text)) + text + data


def _units() -> dict[str, Any]:
    from polarguide.capture.sensor import analyzer_file as analyzers

    return {"format": analyzers.FORMAT, "version": analyzers.VERSION, "units": analyzers.UNITS}


def calibrate_cases() -> Iterator[MadeCase]:
    """Shots of a polarizer."""

    def shots(change: Change = nothing, count: int = 6) -> Change:
        def write(folder: Path) -> None:
            from made_sensor import made_sensor, write_polarizer_shots

            write_polarizer_shots(
                folder / "made", made_sensor(size=(64, 64)), [30.0 * k for k in range(count)], level=0.5
            )
            shutil.move(folder / "made/shots", folder / "polarizer")
            change(folder / "polarizer")

        return write

    def first(p: Path) -> Path:
        return sorted(p.iterdir())[0]

    alike = lambda p: [shutil.copyfile(first(p), other) for other in sorted(p.iterdir())[1:]]  # noqa: E731
    for name, change, words, reason in (
        ("that are all alike", shots(alike), [], ""),
        ("that are all alike, at named angles", shots(alike), ["--angles", "names"], ""),
        ("of two sizes", shots(lambda p: _smaller(first(p))), [], ""),
        ("of four", shots(count=4), [], ""),
        ("with an empty one", shots(lambda p: first(p).write_bytes(b"")), [], ""),
        ("with a pipe", shots(lambda p: put(first(p).name, "pipe")(p)), [], ""),
        ("of a color sensor", shots(), ["--sensor", "IMX250MYR"], ""),
        ("at too few angles", shots(), ["--angles", "0,30"], ""),
        ("at angles that are none", shots(), ["--angles", "0,30,60,90,nan,150"], ""),
        ("at the angles of no names", shots(lambda p: [x.rename(x.with_name(f"{k}_x.png")) for k, x in enumerate(sorted(p.iterdir()))]), ["--angles", "names"], ""),
        ("at one angle", shots(), ["--angles", "0,0,0,0,0,0"], ""),
        ("at wrong angles", shots(), ["--angles", "0,90,10,80,20,70"], ""),
        ("with a polarizer of 1", shots(), ["--polarizer-extinction", "1"], ""),
        ("with a polarizer of infinity", shots(), ["--polarizer-extinction", "inf"], ""),
        ("with blocks of 3", shots(), ["--block", "3"], ""),
        ("with blocks of 2^31", shots(), ["--block", str(1 << 31)], ""),
        ("with a region at 2^20", shots(), ["--offset-x", str(1 << 20)], "a sensor may be large"),
        ("with a region at -1", shots(), ["--offset-x", "-1"], ""),
        ("with a lens of two lines", shots(), ["--lens", "a\nb\x1b[2J"], ""),
        ("with a lens of a million letters", shots(), ["--lens", "x" * 100_000], ""),
        ("with the shots as flat field", shots(), ["--flat", "polarizer"], ""),
        ("with a flat field that is a device", shots(), ["--flat", "/dev/zero"], ""),
        ("with a dark frame as bright as they", shots(lambda p: shutil.copyfile(first(p), p.parent / "dark.png")), ["--dark-frame", "dark.png"], ""),
        ("into a folder", shots(), ["--out", "scene"], ""),
        ("into another suffix", shots(), ["--out", "new.json"], ""),
        ("into its shots", shots(), ["--out", "polarizer/new.safetensors"], "it may lie anywhere"),
        ("over a checkpoint", shots(), ["--out", "run/checkpoint.safetensors"], ""),
    ):  # fmt: skip
        command = [*CALIBRATE, *words]
        if "--out" in words or "--sensor" in words:
            at = CALIBRATE.index(words[0])
            command = [*CALIBRATE[:at], *words, *CALIBRATE[at + 2 :]]
        yield made_case(f"further polarizer shots {name}", change, command, reason)


def _smaller(path: Path) -> None:
    import cv2

    cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:-2])
