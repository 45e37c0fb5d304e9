"""COLMAP models: those of a scene, as text and as binary files, and those that are given with ``--poses``."""

from __future__ import annotations

import importlib
import struct
from collections.abc import Callable
from typing import Any

import hostile_files as made
import spoil
from base import HEIGHT, READ, TRAIN, WIDTH, posed
from case import Case, Change, table
from changes import OF_FILES, PLAUSIBLE, edit, edit_bytes, put, remove, several, write

CASES: list[Case] = []
MODEL, GIVEN = "scene/sparse/0", "model/sparse/0"
CAMERAS, IMAGES, POINTS = (f"{MODEL}/{name}.txt" for name in ("cameras", "images", "points3D"))
POSE = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.5)
CAMERA = (1, 1, WIDTH, HEIGHT, [30.0, 30.0, WIDTH / 2, HEIGHT / 2])
PLACES = [(7, (0.5, 0.25, 0.5), []), (2, (-0.4, 0, 0), []), (3, (0, 0, 0.3), []), (4, (0.2, 0.2, 0), [])]
UNSEEN = "a point or an image that no view needs is not looked at"


def _as_binary() -> None:
    """The scene's model in COLMAP's other format."""
    model = importlib.import_module("pycolmap").Reconstruction()
    model.read_text(MODEL)
    model.write_binary(MODEL)
    remove(CAMERAS, IMAGES, POINTS)()


for path in (CAMERAS, IMAGES, POINTS):
    CASES += [
        Case(f"{path} {how}", spoil.bytes_of(path, how), READ, passes=PLAUSIBLE, seeds=2, ci=how in ("cut", "fill"))
        for how in spoil.BYTES
    ]  # fmt: skip
CASES += [Case(f"{CAMERAS} is a {how}", put(CAMERAS, how), READ, ci=how == "pipe") for how in OF_FILES]
for name in ("cameras", "images", "points3D", "rigs", "frames"):
    path = f"{MODEL}/{name}.bin"
    CASES += [
        Case(f"{path} {how}", several(_as_binary, spoil.bytes_of(path, how)), READ, ci=how in ("cut", "flip"),
             passes="" if how == "cut" else PLAUSIBLE, seeds=4 if how in ("cut", "fill") else 2)
        for how in spoil.BYTES
    ]  # fmt: skip
for name in ("cameras", "images", "points3D"):
    path = f"{GIVEN}/{name}.bin"
    CASES += [
        Case(f"{path} {how}", spoil.bytes_of(path, how), posed("model"), passes=PLAUSIBLE, seeds=1, ci=how == "cut")
        for how in ("cut", "flip", "fill", "append")
    ]  # fmt: skip
CASES += [
    Case(f"{part}/8 of {file}", several(
        _as_binary, edit_bytes(f"{MODEL}/{file}", lambda data, part=part: data[: part * len(data) // 8])), READ,
         where=f"{MODEL}/{file}", expected=f"a complete COLMAP {file}", ci=True)
    for file in ("frames.bin", "rigs.bin") for part in range(8)
]  # fmt: skip


def _cameras(*changes: str) -> Change:
    """The lens of all views, with words replaced."""
    good = f"1 PINHOLE {WIDTH} {HEIGHT} 30 30 12 10\n"
    return write(CAMERAS, good.replace(*changes) if changes else "")


FAR = "principal point, at most"
CASES += table(
    "cameras.txt", TRAIN,
    Case("empty", _cameras(), expected=r"a complete COLMAP cameras\.txt", found="an empty file", ci=True),
    Case("of one number twice", edit(CAMERAS, lambda line: line + line.replace("30 30", "90 90")), ci=True),
    Case("of an unknown model", _cameras("PINHOLE", "MAGIC"), ci=True),
    Case("of strong distortion", write(CAMERAS, f"1 SIMPLE_RADIAL {WIDTH} {HEIGHT} 30 12 10 0.7\n")),
    Case("of no pixels", _cameras("24 20", "0 0"), ci=True),
    Case("of a focal length far below a pixel", _cameras("30 30", "1e-4 1e-4"), expected=FAR, ci=True),
    Case("of a principal point at 1e9", _cameras("12 10", "1e9 -1e9"), expected=FAR, ci=True),
    Case("of one focal length a million times the other", _cameras("30 30", "30 30000000"),
         expected="100 times one another", ci=True),
)  # fmt: skip


def _images(*changes: str) -> Change:
    return edit(IMAGES, lambda given: given.replace(*changes))


CASES += table(
    "images.txt", TRAIN,
    *(Case(f"of a camera at {x}", _images(" -0.4 ", f" {x} "), ci=x == "1e30") for x in ("1e30", "nan")),
    Case("of a quaternion of 1e200", _images("1 1 0 0 0", "1 1e200 1e200 0 0"), ci=True,
         prints=r"\A(?!.*RuntimeWarning)"),
    Case("that is a link to nothing", put(IMAGES, "dangling")),
)  # fmt: skip


def _color(value: str) -> Change:
    return edit(POINTS, lambda given: given.replace("10 20 30", f"{value} 20 30"))


BEHIND = "".join(f"{n} {n} {-n} -900 1 2 3 0.5\n" for n in range(1, 30))
CASES += table(
    "points3D.txt", TRAIN,
    Case("of a color of 256", _color("256"), found="256, 20, 30", ci=True),
    Case("of a color of -1", _color("-1"), found="-1, 20, 30", ci=True),
    Case("of points behind the cameras", write(POINTS, BEHIND), prints="None of the 29 points", ci=True),
)  # fmt: skip


def _model(cameras: Any = (CAMERA,), points: Any = PLACES, **of_second: Any) -> Change:
    """A binary model; of the second image some fields are others."""

    def change() -> None:
        fields = ("number", "pose", "camera", "name", "points")
        images = [
            [k + 1, (*POSE[:4], 0.1 * k - 0.4, 0.05 * (k % 3), 2.5), 1, b"v00%d.png" % k, []]
            for k in range(9)
        ]
        for key, value in of_second.items():
            images[1][fields.index(key)] = value
        remove(CAMERAS, IMAGES, POINTS)()
        write(f"{MODEL}/cameras.bin", made.cameras_bin(cameras))()
        write(f"{MODEL}/images.bin", made.images_bin(images))()
        write(f"{MODEL}/points3D.bin", made.points_bin(points))()

    return change


COUNT = struct.pack("<Q", 1)
RIG = struct.pack("<QIIiI", 1, 1, 1, 0, 1)  # of one sensor, camera 1
FRAME = struct.pack("<II7dIiIQ", 1, 1, *POSE, 1, 0, 1, 1)


def _rigs(frames: bytes, rig: bytes = RIG) -> Change:
    return several(_model(), write(f"{MODEL}/rigs.bin", rig), write(f"{MODEL}/frames.bin", frames))


CASES += table(
    "model of", TRAIN,
    Case("a model 1000", _model([(1, 1000, *CAMERA[2:])]), ci=True),
    Case("a name that is no UTF-8", _model(name=b"\xff\xfe.png")),
    Case("a name twice", _model(name=b"sub/v000.jpg")),
    Case("a name that leaves", _model(name=b"../../../outside/victim.png"), passes=UNSEEN, ci=True),
    Case("one point", _model(points=PLACES[:1]), passes="one point is enough to begin with"),
    Case("a frame of no such image", _rigs(COUNT + FRAME[:-8] + struct.pack("<Q", 999)), ci=True),
)  # fmt: skip


def _given(file: str, change: Callable[[bytes], bytes]) -> Change:
    return edit_bytes(f"{GIVEN}/{file}.bin", change)


NAN = 4 * struct.pack("<d", float("nan"))
CASES += table(
    "given model", posed("model"),
    Case("of 2^63 cameras", _given("cameras", lambda data: struct.pack("<Q", 1 << 63) + data[8:]), ci=True),
    Case("of a quaternion that is no number", _given("images", lambda d: d[:12] + NAN + d[44:]), expected="a complete",
         ci=True),
    Case("of no image", write(f"{GIVEN}/images.bin", bytes(8))),
    Case("as the mosaics", command=posed("mosaics"), ci=True),
)  # fmt: skip
