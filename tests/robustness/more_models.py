# ruff: noqa: E501
"""COLMAP models whose structure is whole and whose numbers are not."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hostile_files as made
from base import HEIGHT, READ, TRAIN, WIDTH
from forked import Case
from making import SAME, UNUSED, Change, of_bytes
from making import more_case as case

_POSE = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.5)


def colmap_cases() -> Iterator[Case]:
    """Binary models whose structure is whole and whose numbers are not."""
    lens = [30.0, 30.0, WIDTH / 2, HEIGHT / 2]
    camera = (1, 1, WIDTH, HEIGHT, lens)
    names = [f"v00{k}.png".encode() for k in range(9)]

    def images(**of_first: Any) -> list[Any]:
        rows = [
            [k + 1, (1.0, 0, 0, 0, 0.1 * k - 0.4, 0.05 * (k % 3), 2.5), 1, names[k], []] for k in range(9)
        ]
        for key, value in of_first.items():
            rows[1][("number", "pose", "camera", "name", "points").index(key)] = value
        return rows

    places = [(7, (0.5, 0.25, 0.5), []), (2, (-0.4, 0, 0), []), (3, (0, 0, 0.3), []), (4, (0.2, 0.2, 0), [])]

    def model(cameras: Any = (camera,), rows: Any = None, points: Any = places) -> Change:
        def change(folder: Path) -> None:
            sparse = folder / "scene/sparse/0"
            for path in sparse.iterdir():
                path.unlink()
            (sparse / "cameras.bin").write_bytes(made.cameras_bin(cameras))
            (sparse / "images.bin").write_bytes(made.images_bin(images() if rows is None else rows))
            (sparse / "points3D.bin").write_bytes(made.points_bin(points))

        return change

    nan, inf, top = float("nan"), float("inf"), 0xFFFFFFFF
    for name, change in {
        "a camera twice": model([camera, camera]),
        "a camera of number -1": model([(top, 1, WIDTH, HEIGHT, lens)], [[*row[:2], top, *row[3:]] for row in images()]),
        "a model -1": model([(1, 0xFFFFFFFF - (1 << 32), WIDTH, HEIGHT, lens)]),
        "a model 1000": model([(1, 1000, WIDTH, HEIGHT, lens)]),
        "an image twice": model(rows=images(number=1)),
        "an image of number -1": model(rows=images(number=top)),
        "an image of no camera": model(rows=images(camera=99)),
        "an image of camera -1": model(rows=images(camera=top)),
        "a rotation of length 0": model(rows=images(pose=(0.0, 0, 0, 0, 0, 0, 2.5))),
        "a rotation of length 7": model(rows=images(pose=(7.0, 0, 0, 0, 0, 0, 2.5))),
        "a rotation that is none": model(rows=images(pose=(nan, 0, 0, 0, 0, 0, 2.5))),
        "a place that is none": model(rows=images(pose=(1.0, 0, 0, 0, inf, 0, 2.5))),
        "a focal length of nothing": model([(1, 1, WIDTH, HEIGHT, [0.0, 30, 12, 10])]),
        "a negative focal length": model([(1, 1, WIDTH, HEIGHT, [-30.0, 30, 12, 10])]),
        "a focal length that is none": model([(1, 1, WIDTH, HEIGHT, [nan, 30, 12, 10])]),
        "a center that is none": model([(1, 1, WIDTH, HEIGHT, [30.0, 30, inf, 10])]),
        "a center far away": model([(1, 1, WIDTH, HEIGHT, [30.0, 30, 1e308, 10])]),
        "an empty name": model(rows=images(name=b"")),
        "a name that is no UTF-8": model(rows=images(name=b"\xff\xfe.png")),
        "a name of 4000 letters": model(rows=images(name=b"x" * 4000)),
        "a name that leaves": model(rows=images(name=b"../../../outside/victim.png")),
        "a name with control characters": model(rows=images(name=b"\x1b[2J\x1b]0;mine\x07\xe2\x80\xae.png")),
        "a name twice": model(rows=images(name=b"sub/v000.jpg")),
        "an image that sees no such point": model(rows=images(points=[(1.0, 1.0, 999)])),
        "an image that sees a point twice": model(rows=images(points=[(1.0, 1.0, 7), (2.0, 2.0, 7)])),
        "a point twice": model(points=[*places, places[0]]),
        "a point of number -1": model(points=[((1 << 64) - 1, (0, 0, 0), [])]),
        "a point that is seen by no such image": model(points=[(7, (0, 0, 0), [(99, 0)])]),
        "a point that is seen where there is nothing": model(points=[(7, (0, 0, 0), [(1, 4000000000)])]),
        "a point that is none": model(points=[(7, (nan, 0, 0), [])]),
        "one point": model(points=places[:1]),
        "points in one place": model(points=[(k, (0.1, 0.1, 0.1), []) for k in range(50)]),
        "points at the edge": model(points=[(k, (1e9, -1e9, 1e9 * (k % 2)), []) for k in range(50)]),
    }.items():  # fmt: skip
        reason = {
            "a camera of number -1": "", "a rotation of length 7": "", "one point": "one point is enough to begin with",
            "points in one place": "points may coincide", "points at the edge": "any finite place will do",
        }.get(name, "a point or an image that no view needs is not looked at")  # fmt: skip
        yield case(f"model of {name}", change, TRAIN if "point" in name else READ, reason)

    def crowd(folder: Path) -> None:
        long = "x" * 230
        rows = [[k + 1, _POSE, 1, f"{long}{k:06d}.png".encode(), []] for k in range(20000)]
        model(rows=rows)(folder)
        for path in sorted((folder / "scene/polar").glob("v00*")):
            path.rename(path.with_name(long + path.name[1:]))

    yield case("model of 20000 long names that are nearly the views'", crowd, READ)

    def rigs(frames: bytes, rig: bytes) -> Change:
        def change(folder: Path) -> None:
            model()(folder)
            (folder / "scene/sparse/0/rigs.bin").write_bytes(rig)
            (folder / "scene/sparse/0/frames.bin").write_bytes(frames)

        return change

    one = struct.pack("<QIIiI", 1, 1, 1, 0, 1)  # a rig of one sensor, camera 1
    frame = struct.pack("<II7dIiIQ", 1, 1, *_POSE, 1, 0, 1, 1)
    for name, rig, frames in (
        ("of no such rig", one, struct.pack("<Q", 1) + struct.pack("<II", 1, 77) + frame[8:]),
        ("of no such image", one, struct.pack("<Q", 1) + frame[:-8] + struct.pack("<Q", 999)),
        ("of no such sensor", one, struct.pack("<Q", 1) + frame[:-12] + struct.pack("<IQ", 55, 1)),
        ("of an unknown kind", one, struct.pack("<Q", 1) + frame[:-16] + struct.pack("<iIQ", 99, 1, 1)),
        ("twice", one, struct.pack("<Q", 2) + frame + frame),
        ("whose rig has no such camera", struct.pack("<QIIiI", 1, 1, 1, 0, 44), struct.pack("<Q", 1) + frame),
        (
            "whose rig stands there twice",
            struct.pack("<Q", 2) + one[8:] + one[8:],
            struct.pack("<Q", 1) + frame,
        ),
        ("whose rig has no sensor", struct.pack("<QII", 1, 1, 0), struct.pack("<Q", 1) + frame),
        ("that is none", struct.pack("<Q", 0), struct.pack("<Q", 0)),
    ):
        yield case(f"frame {name}", rigs(frames, rig), READ, UNUSED if name == "that is none" else "")

    def text(file: str, content: str | bytes) -> Change:
        data = content if isinstance(content, bytes) else content.encode()
        return of_bytes(f"scene/sparse/0/{file}.txt", data)

    good = f"1 PINHOLE {WIDTH} {HEIGHT} 30 30 12 10\n"
    for name, content in {
        "of two lines alike": good + good,
        "of a negative size": f"1 PINHOLE -24 {HEIGHT} 30 30 12 10\n",
        "of a huge number": f"99999999999999999999 PINHOLE {WIDTH} {HEIGHT} 30 30 12 10\n",
        "of too many numbers": good[:-1] + " 1" * 10 + "\n",
        "of too few numbers": f"1 PINHOLE {WIDTH} {HEIGHT} 30\n",
        "of words": f"1 PINHOLE {WIDTH} {HEIGHT} thirty 30 12 10\n",
        "in UTF-16": good.encode("utf-16"),
        "of lines as Windows has them": good.replace("\n", "\r\n"),
        "in hexadecimal": f"1 PINHOLE {WIDTH} {HEIGHT} 0x1e 30 12 10\n",
        "of an unknown model": f"1 NO_SUCH {WIDTH} {HEIGHT} 30 30 12 10\n",
        "of a fisheye": f"1 OPENCV_FISHEYE {WIDTH} {HEIGHT} 30 30 12 10 0 0 0 0\n",
        "of comments": "# none\n" * 1000,
        "of one line of 20 MB": "1 " * 10_000_000,
    }.items():
        reason = SAME if name in ("of lines as Windows has them", "in hexadecimal") else ""
        yield case(f"cameras.txt {name}", text("cameras", content), READ, reason)
    yield case("images.txt of 400000 empty lines", text("images", "\n" * 400_000), READ)
    yield case(
        "images.txt of one line",
        lambda f: (f / "scene/sparse/0/images.txt").write_text(
            (f / "scene/sparse/0/images.txt").read_text().replace("\n", " ")
        ),
        READ,
    )
    yield case(
        "points3D.txt of a negative number",
        text("points3D", "-1 0 0 0 1 2 3 0.5\n"),
        READ,
        "numbers are names",
    )
    yield case(
        "points3D.txt of colors beyond bytes",
        text("points3D", "1 0 0 0 300 -2 3 0.5\n"),
        READ,
        "COLMAP takes their lowest bytes",
    )
