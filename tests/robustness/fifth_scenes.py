# ruff: noqa: E501
"""Scene folders: their records, COLMAP models, pictures, masks and truths, wrong as hostile and as careless people have them."""

from __future__ import annotations

import importlib
import io
import json
import os
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from base import EVAL, HEIGHT, READ, TRAIN, WIDTH
from further_records import RUNS
from making import PICTURE, SAME, TRUTH, UNUSED, Change, MadeCase, link, made_case, of_bytes, of_json, put

CAMERAS, IMAGES, POINTS = (f"scene/sparse/0/{name}.txt" for name in ("cameras", "images", "points3D"))
NAMES = [f"v{number:03d}" for number in range(9)]
INSPECT = ["inspect", "prepared", "--normals", "points", "--out", "new", *RUNS]


def text(path: str, change: Callable[[str], str]) -> Change:
    """A text file written otherwise."""

    def changed(folder: Path) -> None:
        (folder / path).write_text(change((folder / path).read_text()))

    return changed


def raw(path: str, change: Callable[[bytes], bytes]) -> Change:
    """A file of other bytes."""

    def changed(folder: Path) -> None:
        (folder / path).write_bytes(change((folder / path).read_bytes()))

    return changed


def drawn(path: str, pixels: object) -> Change:
    """A picture written anew."""

    def changed(folder: Path) -> None:
        (folder / path).parent.mkdir(exist_ok=True)
        done, data = importlib.import_module("cv2").imencode(Path(path).suffix, pixels)
        assert done
        (folder / path).write_bytes(data.tobytes())

    return changed


def several(*changes: Change) -> Change:
    """One after the other."""

    def changed(folder: Path) -> None:
        for change in changes:
            change(folder)

    return changed


def lines(change: Callable[[int, str], str]) -> Callable[[str], str]:
    """Every line of a text, by its number."""
    return lambda given: "\n".join(change(number, line) for number, line in enumerate(given.split("\n")))


def record_cases() -> Iterator[MadeCase]:
    """scene.json, split.json and angles.csv."""
    path = "scene/scene.json"
    objects = {"objects": [{"id": 1, "name": "\ud800\u202e\x1b[2J"}]}
    for name, change, command, accepted in (
        ("a list", of_json(path, [1, 2]), READ, ""),
        ("a polarizer of brackets", of_json(path, {"polarizer": {"a": [1]}}), READ, ""),
        ("UTF-16 with a mark of its bytes", of_bytes(path, "{}".encode("utf-16")), READ, SAME),
        ("100 MB of blanks", of_bytes(path, b" " * 100_000_000 + b"{}"), READ, ""),
        ("a pipe", put(path, "pipe"), READ, ""),
        ("a folder", put(path, "folder"), READ, ""),
        ("an object of half a character", of_json(path, objects), EVAL, ""),
        ("an index of a list", of_json(path, {"objects": [{"id": 1, "name": "a", "material": {"ior": [1, 2]}}]}), EVAL, UNUSED),
        ("a study of brackets", of_json(path, {"study": {"name": ["x"], "value": {"y": 1}}, "format": "999"}), READ, UNUSED),
        ("a rounding of infinity", of_bytes(path, b'{"rounding": [[1e999, -5]], "levels": {"bits": -3}}'), READ, UNUSED),
    ):  # fmt: skip
        yield made_case(f"fifth scene.json: {name}", change, command, accepted)
    for name, split, accepted in (
        ("a test view twice", {"test": ["v000", "v000"]}, SAME),
        ("all views", {"test": NAMES}, ""),
        ("none", {"test": []}, "a training may have no test views"),
        ("a way out", {"test": ["../polar/v000"]}, ""),
        ("numbers", {"test": [7, None]}, ""),
    ):  # fmt: skip
        yield made_case(f"fifth split.json: {name}", of_json("scene/split.json", split), TRAIN, accepted)
    yield made_case("fifth split.json: no number", of_bytes("scene/split.json", b"NaN"), TRAIN)
    head = "file,view,angle"
    for name, table, accepted in (
        ("an angle beyond floats", f"{head}\nv000_000.png,v000,1e400\n", ""),
        ("a file outside", f"{head}\n../../outside/victim.txt,v000,10\n", ""),
        ("the column of angles twice", f"{head},angle\nv000_000.png,v000,0,90\n", ""),
        ("an open quote over a megabyte", f'{head}\n"v000_000.png' + "x,y\n" * 250_000, ""),
        ("a gain of zero", f"{head},gain\nv000_000.png,v000,0,0\n", ""),
        ("a view called ..", f"{head}\nv000_000.png,..,0\n", ""),
        ("semicolons of a spreadsheet", f"\ufeff{head.replace(',', ';')}\r\nv000_000.png;v000;0\r\n", ""),
    ):  # fmt: skip
        yield made_case(
            f"fifth angles.csv: {name}", of_bytes("scene/angles.csv", table.encode()), READ, accepted
        )
    yield made_case("fifth angles.csv: UTF-16", of_bytes("scene/angles.csv", head.encode("utf-16")), READ)
    prepared = "prepared/scene.json"
    for name, fields in (
        ("gains of words", {"gains": {"0": 0, "45": "x"}}),
        ("a bit depth below zero", {"levels": {"bits": -3}}),
    ):
        yield made_case(
            f"fifth prepared scene: {name}", _fields(prepared, fields), [*INSPECT, "--fix", "fixed"], UNUSED
        )


def _fields(path: str, fields: dict[str, object]) -> Change:
    return text(path, lambda given: json.dumps({**json.loads(given), **fields}))


def model_cases() -> Iterator[MadeCase]:
    """COLMAP models, as text and as binary files."""
    lens = f"1 PINHOLE {WIDTH} {HEIGHT} 30 30 {WIDTH / 2} {HEIGHT / 2}\n"
    for name, cameras in {
        "an unknown model": lens.replace("PINHOLE", "MAGIC"),
        "a focal length of 1e-300": lens.replace("30 30", "1e-300 1e-300"),
        "a focal length far below a pixel": lens.replace("30 30", "1e-4 1e-4"),
        "a principal point at 1e9": lens.replace(f"{WIDTH / 2} {HEIGHT / 2}", "1e9 -1e9"),
        "strong distortion": f"1 SIMPLE_RADIAL {WIDTH} {HEIGHT} 30 12 10 0.7\n",
        "no pixels": lens.replace(f"{WIDTH} {HEIGHT}", "0 0"),
    }.items():
        lens_of = "principal point, at most" if "1e" in cameras else ""
        yield made_case(
            f"fifth cameras.txt: {name}", of_bytes(CAMERAS, cameras.encode()), TRAIN, says=lens_of
        )
    yield made_case(
        "fifth cameras.txt: one number twice",
        of_bytes(CAMERAS, (lens + lens.replace("30 30", "90 90")).encode()),
        READ,
    )
    for name, change, accepted in (
        ("quaternions of zero", lambda _, line: line.replace(" 1 0 0 0 ", " 0 0 0 0 "), ""),
        ("an image twice", lambda _, line: line.replace("v001.png", "v000.png"), ""),
        ("an image of camera 99", lambda _, line: line.replace(" 1 v003.png", " 99 v003.png"), ""),
        ("a point of number 10^30", lambda number, line: line if line or number != 1 else f"1 1 1{'0' * 30}", ""),
        ("NUL in a name", lambda _, line: line.replace("v002", "v0\x0002"), ""),
        ("all cameras in one place", lambda _, line: line and f"{line.split()[0]} 1 0 0 0 0 0 4 {' '.join(line.split()[8:])}", ""),
    ):  # fmt: skip
        yield made_case(f"fifth images.txt: {name}", text(IMAGES, lines(change)), TRAIN, accepted)
    many = range(1, 200)
    for name, points, accepted in (
        ("places at 1e38", "".join(f"{n} 1e38 -1e38 1e38 1 2 3 1\n" for n in many), ""),
        ("colors of 300 and an error of nan", "".join(f"{n} {n / 200} 0.1 0.2 300 -5 3 nan\n" for n in many), UNUSED),
        ("one place over and over", "".join(f"{n} 0.1 0.1 0.2 3 5 3 1\n" for n in many), SAME),
    ):  # fmt: skip
        yield made_case(f"fifth points3D.txt: {name}", of_bytes(POINTS, points.encode()), TRAIN, accepted)
    yield made_case(
        "fifth points3D.txt: Latin-1 in a comment",
        raw(POINTS, lambda data: b"# gr\xf6\xdfe\n" + data),
        READ,
        SAME,
    )
    yield made_case("fifth sparse/0: a link to itself", put("scene/sparse/0", "loop"), READ)
    nan = struct.pack("<d", float("nan"))
    command = [
        *["prepare", "mosaics", "--out", "new", "--sensor", "IMX250MYR", "--bits", "16", "--poses", "model"]
    ]
    for name, file, spoil in (
        ("2^63 cameras", "cameras", lambda data: struct.pack("<Q", 1 << 63) + data[8:]),
        ("a camera of 2^40 pixels a side", "cameras", lambda data: data[:16] + struct.pack("<QQ", 1 << 40, 1 << 40) + data[32:]),
        ("a name without an end", "images", lambda data: data.replace(b".png\0", b".pngX", 1)),
        ("a quaternion that is no number", "images", lambda data: data[:12] + 4 * nan + data[44:]),
        ("a track of 2^60", "points3D", lambda data: data[:51] + struct.pack("<Q", 1 << 60) + data[59:]),
        ("rubbish behind the end", "points3D", lambda data: data + bytes(100_000)),
    ):  # fmt: skip
        yield made_case(
            f"fifth {file}.bin: {name}",
            raw(f"model/sparse/0/{file}.bin", spoil),
            command,
            says=r"\.bin: expected a complete",
        )


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _unfolds(data: bytes) -> bytes:
    """With comments of a gigabyte."""
    packed = zlib.compressobj(9)
    bomb = b"".join(packed.compress(bytes(10_000_000)) for _ in range(100)) + packed.flush()
    return data[:33] + _chunk(b"zTXt", b"Comment\0\0" + bomb) + data[33:]


def picture_cases() -> Iterator[MadeCase]:
    """Pictures, masks and what is invalid."""
    gray = np.full((HEIGHT, WIDTH), 9000, np.uint16)
    color = np.dstack([gray] * 3)
    dark = np.zeros((HEIGHT, WIDTH), np.uint8)
    white = dark + 255
    for name, change, accepted in (
        ("a JPEG by another name", several(drawn("scene/x.jpg", white), lambda folder: os.replace(folder / "scene/x.jpg", folder / PICTURE)), ""),
        ("8 bits among 16", drawn(PICTURE, np.dstack([white] * 3)), ""),
        ("transparent everywhere", drawn(PICTURE, np.dstack([color, 0 * gray])), ""),
        ("a column less", drawn(PICTURE, color[:, 1:]), ""),
        ("comments that unfold to a gigabyte", raw(PICTURE, _unfolds), "comments are not read"),
        ("a head of 60000 pixels a side", raw(PICTURE, lambda data: data[:8] + _chunk(b"IHDR", struct.pack(">IIBBBBB", 60000, 60000, 16, 2, 0, 0, 0)) + data[33:]), ""),
        ("nothing in it", put(PICTURE, "empty"), ""),
        ("a device", put(PICTURE, "device"), ""),
        ("a link to nothing", put(PICTURE, "dangling"), ""),
        ("gone", lambda folder: (folder / PICTURE).unlink(), ""),
        ("half of it", raw(PICTURE, lambda data: data[: len(data) // 2]), ""),
        ("an angle too many", lambda folder: (folder / "scene/polar/v001_060.png").write_bytes((folder / PICTURE).read_bytes()), ""),
    ):  # fmt: skip
        yield made_case(
            f"fifth picture: {name}", change, READ, accepted, says="opaque" if "transparent" in name else ""
        )

    def all_views(of: str, pixels: object, views: list[str]) -> Change:
        return several(*(drawn(f"scene/{of}/{view}.png", pixels) for view in views))

    def alike(folder: Path) -> None:
        for angle in ("045", "090", "135"):
            (folder / f"scene/polar/v001_{angle}.png").write_bytes(
                (folder / "scene/polar/v001_000.png").read_bytes()
            )

    training = [view for view in NAMES if view not in ("v000", "v004")]
    masked = [*TRAIN, "--background", "masked"]
    all_dark = [f"{view}_{angle}" for view in NAMES for angle in ("000", "045", "090", "135")]
    for kind, change, command in (
        ("everything is black", all_views("polar", 0 * color, all_dark), TRAIN),
        ("four angles are one file", alike, TRAIN),
        ("masks of another size", drawn("scene/masks/v002.png", white[:10]), READ),
        ("a mask is a folder", put("scene/masks/v001.png", "folder"), READ),
        ("masks hide everything", all_views("masks", dark, NAMES), masked),
        ("masks of another scene", lambda folder: [(folder / f"scene/masks/{name}.png").rename(folder / f"scene/masks/x{name}.png") for name in NAMES], masked),
        ("all of every training view is invalid", all_views("invalid", white, training), TRAIN),
        ("all of one training view is invalid", all_views("invalid", white, training[:1]), TRAIN),
        ("invalid pixels are words", several(put("scene/invalid", "folder"), of_bytes("scene/invalid/v001.png", b"hello")), READ),
    ):  # fmt: skip
        yield made_case(f"fifth pictures: {kind}", change, command)


def _truth(**arrays: object) -> Change:
    def changed(folder: Path) -> None:
        path = folder / TRUTH
        given = dict(np.load(path))
        np.savez(path, **{**given, **arrays})  # type: ignore[arg-type]

    return changed


def _truth_lies(folder: Path) -> None:
    head = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000, 1000000), }".ljust(117) + b"\n"
    with zipfile.ZipFile(folder / TRUTH, "w") as archive:
        archive.writestr("normal.npy", b"\x93NUMPY\x01\0" + struct.pack("<H", len(head)) + head + bytes(100))


def _truth_twice(folder: Path) -> None:
    array = io.BytesIO()
    np.save(array, np.zeros((HEIGHT, WIDTH, 3)))
    with zipfile.ZipFile(folder / TRUTH, "a") as archive:
        archive.writestr("more/normal.npy", array.getvalue())
        archive.writestr("../../outside/evil.npy", array.getvalue())


def truth_cases() -> Iterator[MadeCase]:
    """Ground truth."""
    flat = np.ones((HEIGHT, WIDTH))
    for name, change, accepted in (
        ("a pickle", _truth(normal=np.array([{"a": 1}], object)), ""),
        ("normals of four numbers", _truth(normal=np.zeros((HEIGHT, WIDTH, 4))), ""),
        ("depth that is no number", _truth(depth=flat * np.nan), ""),
        ("an array of 10^12 numbers", _truth_lies, ""),
        ("objects of halves", _truth(objid=flat * 1.5), ""),
        ("a mask of words", _truth(mask=np.full((HEIGHT, WIDTH), "yes")), ""),
        ("complex light", _truth(diffuse=np.zeros((HEIGHT, WIDTH, 3), complex)), ""),
        ("normals without a length", _truth(normal=np.zeros((HEIGHT, WIDTH, 3)), mask=flat * 0), "there is nothing to score"),
        ("members of other names, one of which leads out", _truth_twice, UNUSED),
        ("a link out", link(TRUTH, "../../../outside/victim.txt"), ""),
    ):  # fmt: skip
        yield made_case(f"fifth truth: {name}", change, EVAL, accepted)
