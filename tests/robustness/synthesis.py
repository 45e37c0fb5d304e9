"""Descriptions of scenes that ``synth`` is to render, and damaged meshes."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any

from base import SYNTH
from case import Case, table
from changes import deferred, put, several, text_forms, write, write_json

CASES: list[Case] = []
LIGHT = {"position": [0, 0, 5], "toward": [0, 0, 0], "size": [1, 1], "radiance": [1, 1, 1]}
CAMERA = {"rings": [{"radius": 4.0, "height": 1.0}], "views": 3}
BALL = {"name": "ball", "shape": {"type": "ball", "radius": 0.8}}
SKY = {"type": "uniform", "radiance": [1, 1, 1]}
FEW = f"{SYNTH} --points 20"
SPEC = "spec.json"


def ball(**changed: Any) -> dict[str, Any]:
    """The smallest scene that can be rendered."""
    return {
        "name": "ball",
        "camera": CAMERA,
        "environment": SKY,
        "exposure": 0.9,
        "things": [BALL],
        **changed,
    }


def _shape(kind: str, **fields: Any) -> dict[str, Any]:
    return ball(things=[{**BALL, "shape": {"type": kind, **fields}}])


def _colored(color: Any) -> dict[str, Any]:
    return ball(things=[{**BALL, "material": {"color": color}}])


LEAVING = {**BALL, "name": "../../../outside/made"}
LINE = [[0, 0, 0.001 * k] for k in range(100_000)]
CASES += table(
    "scene file of", FEW,
    *(Case(name, write_json(SPEC, content), found=found, ci=ci) for name, content, found, ci in (
        ("a thing that leaves", ball(things=[LEAVING]), "", True),
        ("a name twice", ball(things=[BALL, BALL]), "", False),
        ("10^9 views", ball(camera={**CAMERA, "views": 10**9}), "", True),
        ("rings of nothing", ball(camera={**CAMERA, "rings": [{"radius": 0, "height": 0}]}), "", True),
        ("an unknown shape", _shape("teapot"), "", False),
        ("a ball of nothing", _shape("ball", radius=0), "", True),
        ("a ball of 1e300", _shape("ball", radius=1e300), "", False),
        ("a ball with a word too many", _shape("ball", radius=1, foo=2), "", False),
        ("waves of 10^9", _shape("waves", size=[1e9, 1e9], height=1, length=1e-9), "", False),
        ("a tube of 10^5 points", _shape("tube", radius=0.1, path=LINE), "", True),
        ("a mesh outside", _shape("mesh", file="../../outside/victim.txt"), "", True),
        ("a lathe of one point", _shape("lathe", profile=[[0, 0]]), r"array of shape \[1, 2\]", True),
        ("a lathe of lists of all lengths", _shape("lathe", profile=[[0, 0], [1]]), "not all 2 numbers", True),
        ("a color in words", _colored("red"), "", False),
        ("negative light", ball(environment={**SKY, "radiance": [-1, -1, -1]}), "", True),
        ("a light that looks at itself", ball(lights=[{**LIGHT, "toward": LIGHT["position"]}]), "", False),
    )),
    Case("a panorama that is a pipe", several(
        write_json(SPEC, ball(environment={"type": "image", "file": "pipe.hdr"})), put("pipe.hdr", "pipe")), ci=True),
    Case("a name that leaves", write_json(SPEC, ball(name="../../outside/x")), SYNTH, ci=True,
         passes="the folder is that of --out"),
) + [
    Case(f"scene file {name}", change, SYNTH, passes=reason, ci="mark" in name)
    for name, change, reason in text_forms(SPEC, ball(), "depth") if "Windows" not in name
]  # fmt: skip


def _ply(vertices: object, faces: object, body: bytes = b"") -> bytes:
    places = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {vertices}\n{places}"
    return f"{head}element face {faces}\nproperty list uchar int vertex_indices\nend_header\n".encode() + body


def _face(*corners: int) -> bytes:
    return PLACES + bytes([len(corners)]) + struct.pack(f"<{len(corners)}i", *corners)


@deferred
def _mesh(name: str, data: bytes, place: str = ".") -> None:
    """A scene with a mesh, in a folder."""
    Path(place).mkdir(exist_ok=True)
    write(f"{place}/{name}", data)()
    write_json(f"{place}/{SPEC}", _shape("mesh", file=name))()


PLACES = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)
CORNERS = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
NO_TEXT = os.fsdecode(b"sp\xff")
CASES += table(
    "mesh", FEW,
    Case("OBJ of a corner that is not there", _mesh("m.obj", CORNERS + b"f 1 2 9\n"), ci=True),
    Case("PLY of 10^15 points", _mesh("m.ply", _ply(10**15, 1)), ci=True),
    Case("PLY of a corner that is not there", _mesh("m.ply", _ply(3, 1, _face(0, 1, 99))), ci=True),
    Case("PLY cut short", _mesh("m.ply", _ply(3, 1, PLACES + b"\xff")), ci=True),
    Case("without a suffix", _mesh("mesh", b""), found="a name that ends in nothing", ci=True),
    Case("PLY in a folder whose name is no text", _mesh("m.ply", _ply(3, 1, _face(0, 1, 2)), NO_TEXT),
         ["synth", f"{NO_TEXT}/{SPEC}", *FEW.split()[2:]]),
) + table(
    "synth with", FEW,
    Case("10^18 samples", command=SYNTH.replace("--samples 1", f"--samples {10**18}")),
    Case("pictures of 10^8 columns", command="synth proof --out new --size 99999999x1"),
    change=write_json(SPEC, ball()),
)  # fmt: skip
