"""Files of ``calibrate``, which do not fit, and shots of a polarizer from which it makes none."""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import shutil
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from base import CALIBRATE, CHECKPOINT, MOSAICS, READ, SHOTS
from camera_files import write_mosaics
from case import Case, Change, nothing, table
from changes import copy, drawn, edit_bytes, several
from made_sensor import made_sensor, write_polarizer_shots

CASES: list[Case] = []

FILE = "camera.safetensors"
GIVEN = f"{MOSAICS.replace('MYR', 'MZR')} --calibration {FILE}"
WHOLE = np.full((24, 32, 2, 2, 3), 0.5, np.float32)
WHOLE[..., 2] = 0


def _mono() -> None:
    """Mosaics of a monochrome sensor."""
    shutil.rmtree("mosaics")
    write_mosaics(Path("mosaics"), 3, color=False)


def _file(changed: Mapping[str, Any], vectors: Any, *, overlap: bool, end: int | None) -> bytes:
    """A file with any metadata, and the checksum that belongs to it."""
    files = importlib.import_module("polarguide.capture.sensor.analyzer_file")
    if vectors is None:
        angles = 2 * np.radians(np.array([[90, 45], [135, 0]]))
        ideal = np.stack([np.ones((2, 2)), np.cos(angles), np.sin(angles)], -1) / 2
        vectors = np.tile(ideal, (24, 32, 1, 1, 1)).astype(np.float32)
    record = {"format": files.FORMAT, "version": files.VERSION, "units": files.UNITS, "sensor": "IMX250MZR", "lens": "",
              "width": 64, "height": 48, "offset_x": 0, "offset_y": 0, "block": 2, "reference": "mean",
              "polarizer_extinction": None, **changed}  # fmt: skip
    data = np.ascontiguousarray(vectors).tobytes()
    if "sha256" not in changed:
        digest = hashlib.sha256(json.dumps(record, ensure_ascii=False, sort_keys=True).encode())
        digest.update(f"{vectors.dtype.str} {vectors.shape}".encode() + data)
        record["sha256"] = digest.hexdigest()
    kind = {"float32": "F32", "float64": "F64"}[str(vectors.dtype)]
    offsets = [0, len(data) if end is None else end]
    tensor = {"dtype": kind, "shape": list(vectors.shape), "data_offsets": offsets}
    head: dict[str, Any] = {"__metadata__": {files._ENTRY: json.dumps(record, ensure_ascii=False)}, files._TENSOR: tensor}
    text = json.dumps({**head, "other": tensor} if overlap else head).encode()
    return struct.pack("<Q", len(text)) + text + data


def _made(vectors: Any = None, *, overlap: bool = False, end: int | None = None, **changed: Any) -> Change:
    return several(_mono, lambda: Path(FILE).write_bytes(_file(changed, vectors, overlap=overlap, end=end)))


def _ideal(change: Change = nothing, sensor: str = "IMX250MYR") -> Change:
    """The calibration of ideal polarizers on 64x48 pixels, the size of the mosaics; then it is changed."""

    def make() -> None:
        pattern = importlib.import_module("polarguide.capture.sensor.pattern")
        files = importlib.import_module("polarguide.capture.sensor.analyzer_file")
        analyzers = importlib.import_module("polarguide.capture.sensor.analyzers")
        period = pattern.sensor_pattern(sensor).period
        twice = 2 * np.deg2rad(pattern.tiled(pattern.sensor_pattern(sensor).angles, (period, period)))
        vectors = np.stack([np.ones_like(twice), np.cos(twice), np.sin(twice)], axis=-1) / 2
        blocks = np.broadcast_to(vectors, (3, 4, period, period, 3)).astype(np.float32)
        made = analyzers.AnalyzerCalibration(sensor, "", (0, 0), (64, 48), 16, blocks, "angles")
        files.write_analyzers(Path(FILE), made)
        change()

    return make

color = f"{MOSAICS} --calibration {FILE}"
brackets = {"vectors": np.zeros((2, 2), np.float32)}

def without_fields() -> None:
    save = importlib.import_module("safetensors.numpy").save_file
    save(brackets, FILE, metadata={"polarguide": '{"format": "polarguide-analyzers"}'})

CASES += [
    *table(
        "analyzers", GIVEN,
        *(Case(name, _made(**how), ci=ci) for name, how, ci in (
            ("of another sensor", {"sensor": "IMX250MYR"}, True),
            ("of a width of 2^62", {"width": 1 << 62}, False),
            ("of a smaller region", {"width": 32, "vectors": WHOLE[:, :16]}, False),
            ("of another region", {"offset_x": 4}, True),
            ("of another version", {"version": 99}, False),
            ("of vectors of zeros", {"vectors": WHOLE * 0}, False),
            ("of vectors of 1e30", {"vectors": WHOLE * np.float32(1e30)}, True),
            ("of vectors of 1e-30", {"vectors": WHOLE * np.float32(1e-30)}, True),
            ("of four polarizers alike", {"vectors": WHOLE}, True),
            ("of doubles", {"vectors": WHOLE.astype(np.float64)}, False),
        )),
        Case("of a lens of a million letters", _made(lens="\x1b[2J" * 250_000),
             passes="any name will do, and control characters are not shown"),
        Case("for shots of a filter", _made(), f"{SHOTS} --calibration {FILE}", ci=True),
        Case("for priors of a scene", _made(), f"{READ} --calibration {FILE}", ci=True),
        Case("with an order beside them", _made(), more="--order 90,45,0,135", passes="options go before the file"),
    ),
    *table(
        "analyzers", color,
        *(Case(name, _ideal(change), where=r"camera\.safetensors", ci=ci) for name, change, ci in (
            ("cut", edit_bytes(FILE, lambda data: data[: len(data) // 2]), True),
            ("without their fields", without_fields, False),
        )),
        Case("of a region elsewhere", _ideal(), more="--offset-x 64", prints="column 64", ci=True),
    ),
]  # fmt: skip


def _polarizer(change: Callable[[list[str]], object] = lambda paths: None, count: int = 6) -> Change:
    """Shots of a polarizer at steps of 30 degrees; ``change`` is given their paths."""

    def make() -> None:
        sensor = made_sensor(size=(64, 64))
        write_polarizer_shots(Path("made"), sensor, [30.0 * k for k in range(count)], level=0.5)
        shutil.move("made/shots", "polarizer")
        change(sorted(map(str, Path("polarizer").iterdir())))

    return make


def _flat(level: int) -> Change:
    return several(*(drawn(f"polarizer/shot_{angle:03d}.png", np.full((48, 64), level, np.uint16))
                     for angle in range(0, 180, 15)))  # fmt: skip


def _smaller(paths: list[str]) -> None:
    cv2.imwrite(paths[0], cv2.imread(paths[0], cv2.IMREAD_UNCHANGED)[:-2])

anywhere = CALIBRATE.replace("--out new.safetensors", "--out {}")
alike = _polarizer(lambda paths: copy(paths[0], *paths[1:])())
numbered = _polarizer(lambda paths: [os.rename(p, f"polarizer/{k}_x.png") for k, p in enumerate(paths)])
bits = "--bits 12"
CASES += table(
    "polarizer shots", CALIBRATE,
    Case("that are all alike", alike, ci=True),
    Case("of two sizes", _polarizer(_smaller), ci=True),
    Case("of four", _polarizer(count=4)),
    Case("of a color sensor", _polarizer(), CALIBRATE.replace("MZR", "MYR")),
    Case("that are flat", _flat(2000), more=bits),
    Case("at the angles of no names", numbered, more="--angles names"),
    *(Case(name, _polarizer(), more=more, passes=reason, ci=ci) for name, more, reason, ci in (
        ("at angles that are none", "--angles 0,30,60,90,nan,150", "", True),
        ("at wrong angles", "--angles 0,90,10,80,20,70", "", True),
        ("with a polarizer of infinity", "--polarizer-extinction inf", "", False),
        ("with blocks of 2^31", f"--block {1 << 31}", "", True),
        ("with a lens of a million letters", f"--lens {'x' * 100_000}", "", True),
        ("with the shots as flat field", "--flat polarizer", "", False),
    )),
    Case("with a lens of two lines", _polarizer(), more=["--lens", "a\nb\x1b[2J"], ci=True),
    Case("with a dark frame as bright as they", _polarizer(lambda paths: shutil.copyfile(paths[0], "dark.png")),
         more="--dark-frame dark.png"),
    Case("into a folder", _polarizer(), anywhere.format("scene")),
    Case("over a checkpoint", _polarizer(), anywhere.format(CHECKPOINT), ci=True),
)  # fmt: skip
