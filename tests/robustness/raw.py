"""Raw files: mosaics and shots through a filter, what is given beside them, and preparations that are gone on with."""

from __future__ import annotations  # noqa: I001

import importlib
import io
import json
import os
import socket
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import hostile_files as made
import numpy as np
import spoil
from base import INSPECT, MAPS, MEASURE, MOSAIC, MOSAICS, READ, SHOTS, into, of, posed
from case import Case, Change, nothing, table
from changes import (
    A_NAME, OF_FILES, PLAUSIBLE, SAME, copy, drawn, edit, instead, instead_bytes, memory,
    put, remove, rename, same_bytes, several, small_machine, sparse, write, write_json,
)  # fmt: skip

CASES: list[Case] = []

CHECKED = "the chunk or the bytes that changed are not read, such as those behind the end of the picture"
FORM = "it is the same picture in another form"
SHOT = "shots/45/v001.png"
OF_SHOTS = ("0", "45", "90", "135")
HEIGHT, WIDTH = 48, 64
CALIBRATED = f"{MOSAICS} --calibration calibration.json"

sizes = "mosaics may differ in size"
reasons = {"noise": "any picture may be noise", "small": sizes, "wide": sizes, "turned": sizes}
warnings = {"black": "v001: .*black throughout", "white": "v001: 100% .*saturated"}
CASES += [
    *table("mosaic", MOSAICS,
           *(Case(how, spoil.bytes_of(MOSAIC, how), passes=CHECKED, seeds=2, ci=how in ("cut", "fill"))
             for how in spoil.BYTES),
           *(Case(f"is a {how}", put(MOSAIC, how), ci=True) for how in OF_FILES),
           *(Case(f"picture {how}", spoil.picture(MOSAIC, how), passes=reasons.get(how, ""),
                  warning=warnings.get(how, ""), ci=how != "huge") for how in spoil.PICTURES if how != "gray")),
    *table("shot", SHOTS,
           *(Case(how, spoil.bytes_of(SHOT, how), passes=CHECKED, seeds=2, ci=how == "flip") for how in spoil.BYTES),
           *(Case(f"is a {how}", put(SHOT, how)) for how in OF_FILES),
           *(Case(f"picture {how}", spoil.picture(SHOT, how), passes=reasons["noise"] if how == "noise" else "",
                  ci=how == "small") for how in spoil.PICTURES if how != "gray")),
    *table("journal", into("unfinished", MOSAICS), *(
        Case(how, spoil.json_of("unfinished/prepare.json", how), passes="a field may be missing", seeds=8,
             ci=how in ("value", "nested")) for how in spoil.FIELDS)),
    *table("calibration", CALIBRATED, *(
        Case(how, spoil.json_of("calibration.json", how), passes=PLAUSIBLE, seeds=4, ci=how in ("value", "near"))
        for how in spoil.FIELDS)),
]  # fmt: skip


def _saved(suffix: str, make: Callable[[Path, Any], object]) -> Change:
    """The mosaic as ``make`` saves its values."""

    def change() -> None:
        values, path = cv2.imread(MOSAIC, cv2.IMREAD_UNCHANGED), Path(MOSAIC)
        path.unlink()
        make(path.with_suffix(suffix), values)

    return change


def _tiff(convert: Callable[[Any], Any] = lambda values: values, **how: Any) -> Change:
    tifffile = importlib.import_module("tifffile")
    return _saved(".tif", lambda path, values: tifffile.imwrite(path, convert(values), **how))


def _pillow(suffix: str, mode: str, **how: Any) -> Change:
    def make(path: Path, values: Any) -> None:
        picture = importlib.import_module("PIL.Image").fromarray((values >> 8).astype(np.uint8)).convert(mode)
        picture.save(path, format={".png": "PNG", ".tif": "TIFF"}[suffix], **how)

    return _saved(suffix, make)


def _tiled_bomb(path: Path, side: int) -> None:
    """Tiles that are all the same few bytes."""
    packed = zlib.compress(bytes(2 * 4096 * 4096), 9)
    count = (-(-side // 4096)) ** 2
    start = 8 + 2 + 12 * 10 + 4
    tags = [(256, 4, 1, side), (257, 4, 1, side), (258, 3, 1, 16), (259, 3, 1, 8), (262, 3, 1, 1), (277, 3, 1, 1),
            (322, 4, 1, 4096), (323, 4, 1, 4096), (324, 4, count, start + len(packed)),
            (325, 4, count, start + len(packed) + 4 * count)]  # fmt: skip
    made.tiff(path, tags, packed + struct.pack(f"<{2 * count}I", *[start] * count, *[len(packed)] * count))


def _far_directory(path: Path, values: Any) -> None:
    """A TIFF file whose directory stands behind a hole."""
    with open(path, "wb") as file:
        file.write(struct.pack("<2sHI", b"II", 42, 1 << 30) + values.tobytes())
        file.seek(1 << 30)
        tags = made.gray_tags(*values.shape[::-1], values.nbytes)
        file.write(struct.pack("<H", len(tags)))
        for number, kind, count, value in tags:
            file.write(struct.pack("<HHII", number, kind, count, 8 if value == -1 else value))
        file.write(bytes(4))


def _small_in_large(path: Path, values: Any) -> None:
    made.tiff(path, made.gray_tags(*values.shape[::-1], values.nbytes), values.tobytes())
    os.truncate(path, (1 << 31) - 1)

bomb = instead(".tif", _tiled_bomb, 60000, at=MOSAIC)
b"II*\0" + struct.pack("<I", 0xFFFFFFF0) + bytes(64)
b"II*\0\x08\0\0\0" + struct.pack("<HHHIII", 1, 256, 4, 1, 96, 8)
CASES += table(
    "mosaic TIFF", MOSAICS,
    Case("in tiles", _tiff(tile=(16, 16)), passes=FORM, ci=True),
    Case("of double precision", _tiff(lambda v: (v / 65535).astype(np.float64)), ci=True),
    Case("of 40 pages", _tiff(lambda v: np.stack([v] * 40), photometric="minisblack"), ci=True),
    Case("turned by its orientation", _tiff(extratags=[(274, "H", 1, 6, True)]), ci=True),
    Case("where white is 0", _tiff(photometric="miniswhite"), ci=True),
    Case("of signed sizes", instead(".tif", made.deflated_tiff, 30000, kind=9, at=MOSAIC), ci=True),
    Case("in tiles of 60000 pixels, measured", bomb, MEASURE),
    Case("whose directory is at its end, behind a hole", _saved(".tif", _far_directory), ci=True),
    Case("of 2 GiB, sparse, with a small picture in it", _saved(".tif", _small_in_large), ci=True),
    Case("of 2 GiB, sparse", several(remove(MOSAIC), sparse("mosaics/v001.tif", (1 << 31) - 1, b"II*\0")), ci=True),
)  # fmt: skip


def _png(width: int = WIDTH, height: int = HEIGHT, at: str = MOSAIC, **how: Any) -> Change:
    return lambda: made.png(Path(at), width, height, **how)


def _encoded(kind: str) -> bytes:
    stream = io.BytesIO()
    importlib.import_module("PIL.Image").new("L", (WIDTH, HEIGHT), 99).save(stream, kind)
    return stream.getvalue()

(1 << 16) - 1
(b"IHDR", struct.pack(">IIBBBBB", 30000, 30000, 16, 0, 0, 0, 0))
others = {
    "a JPEG": _encoded("JPEG"),
}  # fmt: skip
large = _png(12000, 12000, bits=8)
CASES += table(
    "mosaic PNG", MOSAICS,
    Case("of 8 bits among those of 16", _pillow(".png", "L"), ci=True),
    *(Case(f"that is {name}", write(MOSAIC, data), ci=name == "a JPEG") for name, data in others.items()),
    Case("of 12000 pixels a side and little memory, measured", small_machine(large), MEASURE, ci=True),
    Case("of 6000 pixels a side and 50 MiB", several(remove("mosaics/v000.png", "mosaics/v002.png"), _png(6000, 6000),
                                                     memory(50)), found="", prints="memory"),
)  # fmt: skip


def _npy(convert: Callable[[Any], Any]) -> Change:
    return _saved(".npy", lambda path, values: np.save(path, convert(values)))

packed = f"{MOSAICS} --packing 12p --width {WIDTH} --height {HEIGHT}"
size = WIDTH * HEIGHT * 3 // 2
CASES += [
    *table(
        "mosaic .npy", MOSAICS,
        Case("of four pictures", _npy(lambda v: np.stack([v] * 4)), ci=True),
        Case("of objects", _npy(lambda v: np.array([[{}]], dtype=object)), ci=True),
        *(Case(name, instead_bytes(".npy", data), ci=ci) for name, data, ci in (
            ("of a broken head", made.header("{'descr': ("), True),
            ("of a wrong key", made.header("{{}: 1}"), True),
        )),
    ),
    *table(
        "mosaic .raw", packed,
        Case("of one byte too few", instead_bytes(".raw", bytes(size - 1)), ci=True),
        Case("without a size", instead_bytes(".raw", bytes(size)), MOSAICS),
    ),
]  # fmt: skip


def _socket() -> None:
    here = os.getcwd()
    os.chdir("mosaics")  # the path of a socket has at most 108 bytes
    with socket.socket(socket.AF_UNIX) as made:
        made.bind("v009.png")
    os.chdir(here)

odd = {
    "that is no UTF-8": os.fsdecode(b"v\xff\xfe.png"),
}  # fmt: skip
CASES += table(
    "mosaic called", MOSAICS,
    *(Case(name, rename(MOSAIC, f"mosaics/{to}"), passes=A_NAME, ci="UTF-8" in name) for name, to in odd.items()),
    Case("with suffixes of both cases", copy("mosaics/v000.png", "mosaics/v001.PNG")),
    Case("of a folder", lambda: os.mkdir("mosaics/v009.png")),
    Case("loop, in a folder with links to itself and to /",
         lambda: (os.symlink(".", "mosaics/loop"), os.symlink("/", "mosaics/root")), MAPS,
         passes="links are followed one level down"),
)  # fmt: skip


def _angle(of_: str, *to: str) -> Change:
    return several(*(rename(f"shots/{old}", f"shots/{new}") for old, new in zip(of_.split(), to, strict=True)))


def _everywhere(path: str) -> Change:
    """One picture for all shots of all angles."""
    return copy(path, *(p for a in OF_SHOTS for v in ("v000", "v001") if (p := f"shots/{a}/{v}.png") != path))


def _scans() -> None:
    remove(*(f"shots/{angle}/v000.png" for angle in OF_SHOTS))()
    made.scans_jpeg(Path("shots/0/v000.jpg"), 12000, 4000)
    copy("shots/0/v000.jpg", *(f"shots/{angle}/v000.jpg" for angle in OF_SHOTS[1:]))()


def _cmyk(path: str) -> Change:
    def change() -> None:
        size = cv2.imread(path).shape[1::-1]
        importlib.import_module("PIL.Image").new("CMYK", size, (9, 9, 9, 9)).save(path, "JPEG")

    return change


def _exif(of_: str, value: int) -> Change:
    def change() -> None:
        image = importlib.import_module("PIL.Image")
        for path in sorted(Path("shots").glob(of_)):
            with image.open(path) as opened:
                opened.load()
            exif = image.Exif()
            exif[0x0112] = value
            opened.save(path, exif=exif)

    return change


def _alike() -> None:
    for angle in ("45", "90", "135"):
        Path(f"shots/{angle}/v000.png").unlink()
        Path(f"shots/{angle}/v000.png").symlink_to("../0/v000.png")

singles = "prepare shots/0 --out new --poses none --format singles"
five = copy("shots/45/v000.png", *(f"alone/v_{angle}.png" for angle in (0, 45, 90, 135, 60)))
CASES += table(
    "shots", SHOTS,
    Case("without one angle", remove("shots/45"), ci=True),
    Case("with two suffixes", copy("shots/90/v000.png", "shots/90/v000.PNG"), ci=True),
    Case("that all are one file", _alike, ci=True),
    Case("with a file as an angle", put("shots/45", "file")),
    Case("of which one of four is turned", _exif("45/v001.png", 6), ci=True),
    Case("of 4000 scans", _scans, ci=True),
    Case("at 60 degrees beside four", five, of("alone", SHOTS), warning=".*its pictures are the same"),
    Case("single, with a table of half of them", write("t.csv", b"file,angle\nv000.png,0\n"), singles,
         "--angles t.csv"),
) + []  # fmt: skip

drawn("dark.png", np.full((HEIGHT, WIDTH), 65000, np.uint16))


def text_forms(path: str, content: dict[str, Any], number: str) -> list[tuple[str, Change, str]]:
    """A JSON file as Windows and careless programs save it: name, change, and why it may pass."""
    plain = json.dumps(content)
    inside = plain[1:-1]
    return [
        ("with a mark of its bytes", write(path, "\ufeff" + plain), SAME),
        ("with lines as Windows has them", write(path, plain.replace(", ", ",\r\n ")), SAME),
        ("with a number of 1e400", write(path, f'{{{inside}, "{number}": 1e400}}'), ""),
        ("with a number of 400 digits", write(path, f'{{{inside}, "{number}": {"9" * 400}}}'), ""),
        ("with true for a number", write_json(path, {**content, number: True}), ""),
        ("with a comment", write(path, "// mine\n" + plain), ""),
        ("with a comma too many", write(path, plain[:-1] + ",}"), ""),
        ("in Latin-1", write(path, f'{{"na\u00efve": 1, {inside}}}'.encode("latin-1")), ""),
    ]


zeros = {"gains": {"0": 0, "45": 1, "90": 1, "135": 1}, "order": [0, 0, 0, 0]}
one = [{"order": [0, 45, 90, 135], "zero": 0.0}, "zero", CALIBRATED]
pipe = put("calibration.json", "pipe")
of_shots = f"{SHOTS} --calibration calibration.json"
CASES += [
    *table(
        "mosaics with", MOSAICS,
        *(Case(name, more=more, ci=ci) for name, more, ci in (
            ("an offset below zero", "--offset-x -1", False),
            ("a zero of 1e308", "--zero 1e308", True),
            ("an order of one angle", "--order 0,0,0,0", True),
            ("a dark frame of another size", "--dark-frame scene/polar/v000_000.png", False),
            ("a dark frame that is a device", "--dark-frame /dev/zero", True),
            ("intrinsics that are no numbers", "--intrinsics nan,1,1,1", False),
        )),
        *(Case(f"poses that are {name}", command=posed(path)) for name, path in (
            ("a device", "/dev/zero"), ("a picture", "mosaics/v000.png"), ("a scene of other views", "run"))),
        Case("a calibration of zeros", write_json("calibration.json", zeros), CALIBRATED),
        *(Case(f"a calibration {name}", change, CALIBRATED, passes=reason) for name, change, reason in text_forms(
            "calibration.json", *one[:2])),
    ),
    *table(
        "calibration", of_shots,
        Case("with a key twice", write("calibration.json", '{"zero": 0, "zero": 90}'), found="stands there twice", ci=True),
        Case("of a key that begins like a file of analyzers", write("calibration.json", '{"gain":{"0": 1.0}}'),
             expected="only gains, order", ci=True),
        *(Case(f"that is a pipe, to {verb}", pipe, f"{command} --calibration calibration.json",
               found="a pipe or device", ci=True) for verb, command in (
            ("prepare", SHOTS), ("priors", "priors shots --out new --no-align --formats npy"),
            ("measure", "measure shots --out new --no-align"), ("inspect", of("prepared", INSPECT)))),
    ),
]  # fmt: skip


def _listed(given: str) -> str:
    data = json.loads(given)
    views = data["prepare"]["views"]
    data["prepare"]["views"] = {name: [1] for name in views} if isinstance(views, dict) else [[1] for _ in views]
    return json.dumps(data)


def _halved() -> None:
    for name in ("DoLP", "S0"):
        shape = np.load(f"new/v001/{name}.npy").shape
        assert shape[:2] == (10, 12), shape


again, record = into("prepared", MOSAICS), "prepared/scene.json"
png = f"priors S0/S0.png --out . {MAPS.partition('new ')[2].replace('npy', 'png')}"

def others_written() -> None:
    assert Path("new/v000/maps.json").exists()
    assert Path("new/v002/maps.json").exists()

CASES += [
    *table(
        "prepared scene whose views", again,
        Case("lie outside", edit(record, lambda given: given.replace('"v001"', '"../../outside/victim"')),
             posed("model", again), ci=True),
        Case("are lists", edit(record, _listed)),
    ),
    *table(
        "maps", MAPS,
        Case("into a file", command=into("calibration.json", MAPS), ci=True),
        Case("with noise that is no number", more="--full-well 0 --read-noise nan --snr -1"),
        Case("over their mosaic", copy(MOSAIC, "S0/S0.png"), png, check=same_bytes("S0/S0.png", MOSAIC), ci=True),
        Case("of a shot whose folder is a file", several(lambda: os.mkdir("new"), write("new/v001", "a file")),
             check=others_written),
        Case("of a folder of which a picture is cut short", write(MOSAIC, b"\x89PNG\r\n\x1a\n"), ci=True,
             warning=r".*v001\.png.*cut short"),
    ),
    Case("maps of a view of a scene in half its size", nothing, READ, "--downscale 2 --formats npy", check=_halved,
         passes="the maps have the size that was asked for"),
]  # fmt: skip
