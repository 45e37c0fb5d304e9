"""Raw files: mosaics and shots through a filter, what is given beside them, and preparations that are gone on with."""

from __future__ import annotations  # noqa: I001

import importlib
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import hostile_files as made
import numpy as np
import spoil
from base import MAPS, MEASURE, MOSAIC, MOSAICS, READ, SHOTS, into, of, posed
from case import Case, Change, nothing, table
from changes import (
    A_NAME, CHECKED, OF_FILES, PLAUSIBLE, copy, deferred, drawn, edit, instead, memory, put, remove, rename,
    several, small_machine, sparse, text_forms, write,
)  # fmt: skip

CASES: list[Case] = []
FORM = "it is the same picture in another form"
NOISE, SIZES = "any picture may be noise", "mosaics may differ in size"
SHOT = "shots/45/v001.png"
ANGLES = ("0", "45", "90", "135")
CALIBRATED = f"{MOSAICS} --calibration calibration.json"

reasons = {"noise": NOISE, "small": SIZES, "wide": SIZES, "turned": SIZES}
warnings = {"black": "v001: .*completely black", "white": "v001: 100% .*saturated"}
CASES += table(
    "mosaic", MOSAICS,
    *(Case(how, spoil.bytes_of(MOSAIC, how), passes=CHECKED, seeds=2, ci=how == "cut") for how in spoil.BYTES),
    *(Case(f"is a {how}", put(MOSAIC, how), ci=True) for how in OF_FILES),
    *(Case(f"picture {how}", spoil.picture(MOSAIC, how), passes=reasons.get(how, ""), warning=warnings.get(how, ""),
           ci=how != "huge") for how in spoil.PICTURES if how != "gray"),
) + table(
    "shot", SHOTS,
    *(Case(how, spoil.bytes_of(SHOT, how), passes=CHECKED, seeds=2, ci=how == "flip") for how in spoil.BYTES),
    *(Case(f"picture {how}", spoil.picture(SHOT, how), passes=NOISE if how == "noise" else "", ci=how == "small")
      for how in ("black", "white", "small", "noise", "floats", "huge")),
)  # fmt: skip
for how in spoil.FIELDS:
    journal, file = spoil.json_of("unfinished/prepare.json", how), spoil.json_of("calibration.json", how)
    again = into("unfinished", MOSAICS)
    CASES += [
        Case(
            f"journal {how}",
            journal,
            again,
            passes="a field may be missing",
            seeds=8,
            ci=how in ("value", "nested"),
        ),
        Case(f"calibration {how}", file, CALIBRATED, passes=PLAUSIBLE, seeds=4, ci=how in ("value", "near")),
    ]


@deferred
def _saved(suffix: str, make: Callable[[Path, Any], object]) -> None:
    """The mosaic as ``make`` saves its values."""
    values, path = cv2.imread(MOSAIC, cv2.IMREAD_UNCHANGED), Path(MOSAIC)
    path.unlink()
    make(path.with_suffix(suffix), values)


def _tiff(convert: Callable[[Any], Any] = lambda values: values, **how: Any) -> Change:
    tifffile = importlib.import_module("tifffile")
    return _saved(".tif", lambda path, values: tifffile.imwrite(path, convert(values), **how))


def _far_directory(path: Path, values: Any) -> None:
    """A TIFF file whose directory stands behind a hole."""
    tags = made.gray_tags(*values.shape[::-1], values.nbytes)
    with open(path, "wb") as file:
        file.write(struct.pack("<2sHI", b"II", 42, 1 << 30) + values.tobytes())
        file.seek(1 << 30)
        file.write(struct.pack("<H", len(tags)))
        file.write(
            b"".join(struct.pack("<HHII", n, kind, k, 8 if v == -1 else v) for n, kind, k, v in tags)
            + bytes(4)
        )


def _small_in_large(path: Path, values: Any) -> None:
    made.tiff(path, made.gray_tags(*values.shape[::-1], values.nbytes), values.tobytes())
    os.truncate(path, (1 << 31) - 1)


def _png(side: int, at: str = MOSAIC) -> Change:
    return lambda: made.png(Path(at), side, side, bits=8)


def _npy(data: Any) -> Change:
    return _saved(
        ".npy",
        lambda path, values: path.write_bytes(data if isinstance(data, bytes) else made.npy(data(values))),
    )


def _raw(size: int) -> Change:
    return _saved(".raw", lambda path, values: path.write_bytes(bytes(size)))


PACKED = "--packing 12p --width {} --height {}"
CASES += table(
    "mosaic", MOSAICS,
    Case("big-endian BigTIFF in tiles", _tiff(bigtiff=True, byteorder=">", tile=(16, 16)), passes=FORM, ci=True),
    Case("TIFF of 40 pages", _tiff(lambda v: np.stack([v] * 40), photometric="minisblack"), ci=True),
    Case("TIFF where white is 0", _tiff(photometric="miniswhite"), ci=True),
    Case("TIFF of signed sizes", instead(".tif", made.deflated_tiff, 30000, kind=9, at=MOSAIC), ci=True),
    Case("TIFF whose directory is at its end, behind a hole", _saved(".tif", _far_directory), ci=True),
    Case("TIFF of 2 GiB, sparse, with a small picture in it", _saved(".tif", _small_in_large), ci=True),
    Case("sparse of 2 GiB", several(remove(MOSAIC), sparse("mosaics/v001.tif", (1 << 31) - 1, b"II*\0")), ci=True),
    Case("of 12000 pixels a side and little memory, measured", small_machine(_png(12000)), MEASURE, ci=True),
    Case("of 9000 pixels and 50 MiB", several(copy(MOSAIC, "one/v001.png"), _png(9000, "one/v001.png"), memory(50)),
         of("one", MOSAICS), prints="memory"),
    Case(".npy of four pictures", _npy(lambda v: np.stack([v] * 4)), ci=True),
    Case(".npy of a broken head", _npy(made.header("{'descr': (")), ci=True),
    Case(".npy of a wrong key", _npy(made.header("{{}: 1}")), ci=True),
    Case(".raw of one byte too few", _raw(4607), more=PACKED.format(64, 48), ci=True),
    Case(".raw of 10^9 columns", _raw(4608), more=PACKED.format(10**9, 10**9)),
    Case(".raw without a size", _raw(4608)),
    Case("called that is no UTF-8", rename(MOSAIC, os.fsdecode(b"mosaics/v\xff\xfe.png")), passes=A_NAME, ci=True),
    Case("folder with links to itself and to /", lambda: (os.symlink(".", "mosaics/a"), os.symlink("/", "mosaics/b")),
         MAPS, passes="links are followed one level down"),
)  # fmt: skip


def _scans() -> None:
    remove(*(f"shots/{angle}/v000.png" for angle in ANGLES))()
    made.scans_jpeg(Path("shots/0/v000.jpg"), 12000, 4000)
    copy("shots/0/v000.jpg", *(f"shots/{angle}/v000.jpg" for angle in ANGLES[1:]))()


@deferred
def _turned(of_: str) -> None:
    """Shots that their EXIF turns."""
    image = importlib.import_module("PIL.Image")
    for path in sorted(Path("shots").glob(of_)):
        with image.open(path) as opened:
            opened.load()
        exif = image.Exif()
        exif[0x0112] = 6
        opened.save(path, exif=exif)


def _alike() -> None:
    for angle in ("45", "90", "135"):
        Path(f"shots/{angle}/v000.png").unlink()
        Path(f"shots/{angle}/v000.png").symlink_to("../0/v000.png")


singles = "prepare shots/0 --out new --poses none --format singles"
five = copy("shots/45/v000.png", *(f"alone/v_{angle}.png" for angle in (0, 45, 90, 135, 60)))
CASES += table(
    "shots", SHOTS,
    Case("without one angle", remove("shots/45"), ci=True),
    Case("with an empty angle", remove("shots/90/v000.png", "shots/90/v001.png")),
    Case("with two suffixes", copy("shots/90/v000.png", "shots/90/v000.PNG"), ci=True),
    Case("that all are one file", _alike, ci=True),
    Case("with alpha", drawn(SHOT, np.full((48, 64, 4), 100, np.uint8))),
    Case("of which one of four is turned", _turned("45/v001.png"), ci=True),
    Case("of which all of an angle are turned", _turned("90/*.png")),
    Case("as DNG of zeros", several(*(rename(f"shots/{a}/v001.png", f"shots/{a}/v001.dng") for a in ANGLES))),
    Case("of 4000 scans", _scans, ci=True),
    Case("at 60 degrees beside four", five, of("alone", SHOTS), warning=".*its pictures are the same"),
    Case("single, with a table of half of them", write("t.csv", "file,angle\nv000.png,0\n"), singles, "--angles t.csv"),
    Case("single, with an angle left out", nothing, singles, "--angles 0,,60,inf"),
)  # fmt: skip

CASES += table(
    "mosaics with", MOSAICS,
    *(Case(name, more=more, ci=ci) for name, more, ci in (
        ("an offset below zero", "--offset-x -1", False),
        ("a zero of 1e308", "--zero 1e308", True),
        ("a black level of 1e308", "--black-level 1e308", False),
        ("an order of one angle", "--order 0,0,0,0", True),
        ("a dark frame that is a device", "--dark-frame /dev/zero", True),
        ("masks that are a file", "--masks calibration.json", False),
        ("masks of other names", "--masks scene/polar", False),
        ("intrinsics that are no numbers", "--intrinsics nan,1,1,1", False),
    )),
    Case("intrinsics of 1e308", command=posed("sfm"), more="--intrinsics 1e308,1e308,1e308,1e308"),
    *(Case(f"a calibration {name}", change, CALIBRATED, passes=reason) for name, change, reason in text_forms(
        "calibration.json", {"order": [0, 45, 90, 135], "zero": 0.0}, "zero")),
)  # fmt: skip

CALIBRATED_SHOTS = f"{SHOTS} --calibration calibration.json"
CASES += table(
    "calibration", CALIBRATED_SHOTS,
    Case("with a key twice", write("calibration.json", '{"zero": 0, "zero": 90}'), found="occurs twice", ci=True),
    Case("of a key that begins like a file of analyzers", write("calibration.json", '{"gain":{"0": 1.0}}'),
         expected="only gains, order", ci=True),
    *(Case(f"that is a pipe, to {verb}", put("calibration.json", "pipe"), f"{command} --calibration calibration.json",
           found="a pipe or device", ci=True) for verb, command in (
        ("prepare", SHOTS), ("priors", "priors shots --out new --no-align --formats npy"),
        ("measure", "measure shots --out new --no-align"))),
)  # fmt: skip


def _halved() -> None:
    for name in ("DoLP", "S0"):
        shape = np.load(f"new/v001/{name}.npy").shape
        assert shape[:2] == (10, 12), shape


def _kept() -> None:
    assert Path("S0/S0.png").read_bytes() == Path(MOSAIC).read_bytes()


CASES += table(
    "maps", MAPS,
    Case("into a file", command=into("calibration.json", MAPS), ci=True),
    Case("among mosaics", command=into("mosaics", MAPS)),
    Case("in formats that there are not", command=MAPS.replace("npy", ",npy,exe")),
    Case("with noise that is no number", more="--full-well 0 --read-noise nan --snr -1"),
    Case("with a focal length of 1e308", more="--intrinsics 1e308,1e308,0,0"),
    Case("over their mosaic", copy(MOSAIC, "S0/S0.png"), into(".", of("S0/S0.png", MAPS)).replace("npy", "png"),
         check=_kept, ci=True),
    Case("of a folder of which a picture is cut short", write(MOSAIC, b"\x89PNG\r\n\x1a\n"), ci=True,
         warning=r".*v001\.png.*cut short"),
    Case("of a view of a scene in half its size", nothing, READ, "--downscale 2 --formats npy", check=_halved,
         passes="the maps have the size that was asked for"),
    Case("of a prepared scene whose views lie outside", edit("prepared/scene.json", lambda given: given.replace(
        '"v001"', '"../../outside/victim"')), posed("model", into("prepared", MOSAICS)), ci=True),
)  # fmt: skip
