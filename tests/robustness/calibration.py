"""Files of ``calibrate`` that do not fit, and shots of a polarizer from which it makes none."""

from __future__ import annotations

import hashlib
import importlib
import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from base import CALIBRATE, CHECKPOINT, INSPECT, MEASURE, MOSAICS, READ, SHOTS
from camera_files import write_mosaics
from case import Case, table
from changes import copy, deferred, edit_bytes, several
from made_sensor import made_sensor, write_polarizer_shots

CASES: list[Case] = []
FILE = "camera.safetensors"
WITH = f"--calibration {FILE}"
GIVEN = f"{MOSAICS.replace('MYR', 'MZR')} {WITH}"
ALIKE = np.tile(np.array([0.5, 0.5, 0.0], np.float32), (24, 32, 2, 2, 1))
ANGLES = 2 * np.radians(np.array([[90, 45], [135, 0]]))
ONE_BLOCK = np.stack([np.ones((2, 2)), np.cos(ANGLES), np.sin(ANGLES)], -1) / 2
IDEAL = np.tile(ONE_BLOCK, (24, 32, 1, 1, 1)).astype(np.float32)


@deferred
def _made(vectors: Any = IDEAL, mono: bool = True, **changed: Any) -> None:
    """A file with any metadata, and the checksum that belongs to it; mosaics of the monochrome sensor that it is of."""
    files = importlib.import_module("polarguide.capture.sensor.analyzers")
    record = {"format": files.FORMAT, "version": files.VERSION, "units": files.UNITS, "sensor": "IMX250MZR", "lens": "",
              "width": 64, "height": 48, "offset_x": 0, "offset_y": 0, "block": 2, "reference": "mean",
              "polarizer_extinction": None, **changed}  # fmt: skip
    data = np.ascontiguousarray(vectors).tobytes()
    digest = hashlib.sha256(json.dumps(record, ensure_ascii=False, sort_keys=True).encode())
    digest.update(f"{vectors.dtype.str} {vectors.shape}".encode() + data)
    record.setdefault("sha256", digest.hexdigest())
    tensor = {"dtype": "F32", "shape": list(vectors.shape), "data_offsets": [0, len(data)]}
    metadata = {files._ENTRY: json.dumps(record, ensure_ascii=False)}
    text = json.dumps({"__metadata__": metadata, files._TENSOR: tensor}).encode()
    Path(FILE).write_bytes(struct.pack("<Q", len(text)) + text + data)
    if mono:
        shutil.rmtree("mosaics")
        write_mosaics(Path("mosaics"), 3, color=False)


CASES += table(
    "analyzers", GIVEN,
    *(Case(name, _made(**how), ci=ci) for name, how, ci in (
        ("of no sensor", {"sensor": "\x1b[2J"}, False),
        ("of a width of 2^62", {"width": 1 << 62}, False),
        ("of another region", {"offset_x": 4}, True),
        ("of another version", {"version": 99}, False),
        ("of a wrong checksum", {"sha256": "0" * 64}, True),
        ("of vectors of zeros", {"vectors": ALIKE * 0}, False),
        ("of vectors of 1e30", {"vectors": ALIKE * np.float32(1e30)}, True),
        ("of vectors of 1e-30", {"vectors": ALIKE * np.float32(1e-30)}, True),
        ("of four polarizers alike", {"vectors": ALIKE}, True),
    )),
    Case("cut", several(_made(), edit_bytes(FILE, lambda data: data[:4000])), where=r"camera\.safetensors", ci=True),
    Case("of another sensor", _made(mono=False), f"{MOSAICS} {WITH}", found="IMX250MZR", ci=True),
    Case("of another sensor, measured", _made(mono=False), f"{MEASURE} {WITH}", found="IMX250MZR"),
    Case("of a lens of a million letters", _made(lens="\x1b[2J" * 250_000),
         passes="any name will do, and control characters are not shown"),
    Case("for shots of a filter", _made(), f"{SHOTS} {WITH}", ci=True),
    Case("for measured shots of a filter", _made(), f"measure shots --out new --no-align {WITH}"),
    Case("for an inspection of a color scene", _made(), f"{INSPECT} {WITH}"),
    Case("for priors of a scene", _made(), f"{READ} {WITH}", ci=True),
    Case("with an order beside them", _made(), more="--order 90,45,0,135", passes="options go before the file"),
)  # fmt: skip


@deferred
def _polarizer(change: Callable[[list[str]], object] = lambda paths: None, count: int = 6) -> None:
    """Shots of a polarizer at steps of 30 degrees; ``change`` is given their paths."""
    angles = [30.0 * k for k in range(count)]
    write_polarizer_shots(Path("made"), made_sensor(size=(64, 64)), angles, level=0.5)
    shutil.move("made/shots", "polarizer")
    change(sorted(map(str, Path("polarizer").iterdir())))


def _smaller(paths: list[str]) -> None:
    cv2.imwrite(paths[0], cv2.imread(paths[0], cv2.IMREAD_UNCHANGED)[:-2])


CASES += table(
    "polarizer shots", CALIBRATE,
    Case("that are all alike", _polarizer(lambda paths: copy(paths[0], *paths[1:])()), ci=True),
    Case("of two sizes", _polarizer(_smaller), ci=True),
    Case("of four", _polarizer(count=4)),
    Case("of a color sensor", _polarizer(), CALIBRATE.replace("MZR", "MYR")),
    *(Case(name, _polarizer(), more=more, ci=ci) for name, more, ci in (
        ("at angles that are no numbers", "--angles 0,30,60,90,nan,150", True),
        ("at too few angles", "--angles 0,30", False),
        ("at wrong angles", "--angles 0,90,10,80,20,70", True),
        ("with a polarizer of infinity", "--polarizer-extinction inf", False),
        ("with blocks of 3", "--block 3", False),
        ("with blocks of 2^31", f"--block {1 << 31}", True),
        ("with a lens of a million letters", f"--lens {'x' * 100_000}", True),
        ("with a lens of two lines", ["--lens", "a\nb\x1b[2J"], True),
    )),
    Case("with a dark frame as bright as they", _polarizer(lambda paths: shutil.copyfile(paths[0], "dark.png")),
         more="--dark-frame dark.png"),
    *(Case(f"into {name}", _polarizer(), CALIBRATE.replace("new.safetensors", out), ci=name == "a checkpoint")
      for name, out in (("a folder", "scene"), ("a checkpoint", CHECKPOINT), ("their folder", "polarizer/c"))),
)  # fmt: skip
