"""Descriptions of scenes that make no sense, and meshes that are damaged."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fourth_names import ball
from further_folders import SYNTH
from making import Change, MadeCase, made_case

WORDS = ["--points", "20", "--views", "3"]
COMMAND = [*SYNTH, *WORDS[:2]]


def _described(**changed: Any) -> Change:
    return lambda folder: (folder / "spec.json").write_text(json.dumps(ball(**changed)))


def _thing(**changed: Any) -> Change:
    return _described(things=[{"name": "ball", "shape": {"type": "ball", "radius": 0.8}, **changed}])


def description_cases() -> Iterator[MadeCase]:
    """Descriptions."""
    light = {"position": [0, 0, 5], "toward": [0, 0, 0], "size": [1, 1], "radiance": [1, 1, 1]}
    camera: dict[str, Any] = {"rings": [{"radius": 4.0, "height": 1.0}], "views": 3}
    for name, change in {
        "of a color in words": _thing(material={"color": "red"}),
        "of a color of four": _thing(material={"color": [1, 1, 1, 1]}),
        "of a color of 2": _thing(material={"color": [2, 0, 0]}),
        "of a color of truths": _thing(material={"color": [True, True, False]}),
        "of a color of null": _thing(material={"color": None}),
        "of a metal of negative index": _thing(
            material={"type": "metal", "eta": [-1, -1, -1], "k": [1, 1, 1]}
        ),
        "of a metal of negative extinction": _thing(
            material={"type": "metal", "eta": [1, 1, 1], "k": [-1, 1, 1]}
        ),
        "of a ball with a word too many": _thing(shape={"type": "ball", "radius": 1, "foo": 2}),
        "of a mesh with a word too many": _thing(shape={"type": "mesh", "file": "m.ply", "foo": 2}),
        "of a lathe of negative radius": _thing(shape={"type": "lathe", "profile": [[-1, 0], [1, 1]]}),
        "of a bevel larger than the box": _thing(shape={"type": "box", "size": [1, 1, 1], "bevel": 5}),
        "of a light that looks at itself": _described(lights=[{**light, "toward": light["position"]}]),
        "of a light of no size": _described(lights=[{**light, "size": [0, 1]}]),
        "of a light of two places": _described(lights=[{**light, "position": [0, 0]}]),
        "of negative light of a lamp": _described(lights=[{**light, "radiance": [-1, 0, 0]}]),
        "of an exposure of 1e-30": _described(exposure=1e-30),
        "of an exposure of 1e30": _described(exposure=1e30),
        "of a clamp of 1e30": _described(clamp=1e30),
        "of views all in one place": _described(camera={**camera, "spacing": 0}),
        "of views 400 degrees apart": _described(camera={**camera, "spacing": 400}),
    }.items():
        yield made_case(f"fourth description {name}", change, COMMAND)


def _mesh(data: bytes, name: str = "m.obj") -> Change:
    def change(folder: Path) -> None:
        (folder / name).write_bytes(data)
        _thing(shape={"type": "mesh", "file": name})(folder)

    return change


def _ply(vertices: object, faces: object, body: bytes, form: str = "binary_little_endian") -> bytes:
    places = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat {form} 1.0\nelement vertex {vertices}\n{places}"
    return f"{head}element face {faces}\nproperty list uchar int vertex_indices\nend_header\n".encode() + body


def mesh_cases() -> Iterator[MadeCase]:
    """Meshes."""
    corner = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
    places = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)

    def face(*corners: int) -> bytes:
        return bytes([len(corners)]) + struct.pack(f"<{len(corners)}i", *corners)

    for name, data in {
        "of nothing": b"",
        "of a corner that is not there": corner + b"f 1 2 9\n",
        "of corner 0": corner + b"f 0 1 2\n",
        "of corners from the end": corner + b"f -1 -2 -3\n",
        "of places that are none": b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        "of a corner of 5000 digits": corner + b"f 1 2 " + b"9" * 5000 + b"\n",
        "of other bytes": b"\xff\xfe\0" * 100,
        "without a triangle": corner,
    }.items():
        yield made_case(f"fourth OBJ {name}", _mesh(data), COMMAND)
    for name, data in {
        "of 10^15 points": _ply(10**15, 1, b""),
        "of -5 points": _ply(-5, 1, b""),
        "of 5000 digits": _ply("9" * 5000, 1, b""),
        "of a corner that is not there": _ply(3, 1, places + face(0, 1, 99)),
        "of a corner before the first": _ply(3, 1, places + face(0, 1, -1)),
        "cut short": _ply(3, 1, places + b"\xff"),
        "without a triangle": _ply(3, 0, places),
        "cut in its head": b"ply\nformat",
        "of places that are none": _ply(3, 1, b"nan 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "ascii"),
        "of nothing": b"",
    }.items():
        yield made_case(f"fourth PLY {name}", _mesh(data, "m.ply"), COMMAND)

    def elsewhere(folder: Path) -> None:
        place = os.fsdecode(b"sp\xff")
        (folder / place).mkdir()
        (folder / place / "m.ply").write_bytes(_ply(3, 1, places + face(0, 1, 2)))
        described = ball(things=[{"name": "a", "shape": {"type": "mesh", "file": "m.ply"}}])
        (folder / place / "spec.json").write_text(json.dumps(described))

    yield made_case(
        "fourth PLY in a folder whose name is no text",
        elsewhere,
        ["synth", os.fsdecode(b"sp\xff/spec.json"), *COMMAND[2:]],
    )


def option_cases() -> Iterator[MadeCase]:
    """Options of ``synth``."""
    for name, words in {
        "a sweep of NaN": ["--sweep", "noise=nan"],
        "a sweep of infinity": ["--sweep", "noise=inf"],
        "a spacing of nothing": ["--spacing", "0"],
        "a spacing of 400": ["--spacing", "400"],
    }.items():
        yield made_case(f"fourth synth of {name}", _described(), [*COMMAND, *words])
