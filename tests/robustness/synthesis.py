"""Descriptions of scenes that ``synth`` is to render, and damaged meshes."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any

from base import SYNTH
from case import Case, nothing, table
from changes import put, several, write, write_json
from raw import text_forms

CASES: list[Case] = []

LIGHT = {"position": [0, 0, 5], "toward": [0, 0, 0], "size": [1, 1], "radiance": [1, 1, 1]}
CAMERA = {"rings": [{"radius": 4.0, "height": 1.0}], "views": 3}
BALL = {"name": "ball", "shape": {"type": "ball", "radius": 0.8}}
FEW = f"{SYNTH} --points 20"


def ball(**changed: Any) -> dict[str, Any]:
    """The smallest scene that can be rendered."""
    environment = {"type": "uniform", "radiance": [1, 1, 1]}
    return {"name": "ball", "camera": CAMERA, "environment": environment, "exposure": 0.9, "things": [BALL], **changed}


def _thing(**changed: Any) -> dict[str, Any]:
    return ball(things=[{**BALL, **changed}])


def _shape(kind: str, **fields: Any) -> dict[str, Any]:
    return _thing(shape={"type": kind, **fields})


def _camera(**changed: Any) -> dict[str, Any]:
    return ball(camera={**CAMERA, **changed})


def _lamp(**changed: Any) -> dict[str, Any]:
    return ball(lights=[{**LIGHT, **changed}])


def _ring(radius: object, height: float = 1) -> dict[str, Any]:
    return _camera(rings=[{"radius": radius, "height": height}])


def _sky(**changed: Any) -> dict[str, Any]:
    return ball(environment=changed)


def _described(*rows: tuple[str, dict[str, Any], bool]) -> list[Case]:
    return table("scene file", FEW, *(Case(f"of {n}", write_json("spec.json", c), ci=ci) for n, c, ci in rows))

leaving = {**BALL, "name": "../../../outside/made"}
many = [{**BALL, "name": f"b{k}"} for k in range(300)]
CASES += _described(
    ("a thing that leaves", ball(things=[leaving]), True),
    ("a name twice", ball(things=[BALL, BALL]), False),
    ("300 things", ball(things=many), False),
    ("10^9 views", _camera(views=10**9), True),
    ("rings of nothing", _ring(0, 0), True),
) + [
    Case("scene file of a name that leaves", write_json("spec.json", ball(name="../../outside/x")), SYNTH,
         passes="the folder is that of --out"),
    *(Case(f"scene file {name}", change, SYNTH, passes=reason, ci="mark" in name)
      for name, change, reason in text_forms("spec.json", ball(), "depth") if "Windows" not in name),
    Case("scene file of a folder", nothing, SYNTH.replace("spec.json", "scene")),
    Case("scene file of a preset that leaves", nothing, SYNTH.replace("spec.json", "../../synth/presets/proof")),
]  # fmt: skip

line = [[0, 0, 0.001 * k] for k in range(100_000)]
device = {"type": "image", "file": "/dev/zero"}
CASES += _described(
    ("an unknown shape", _shape("teapot"), False),
    ("a ball of nothing", _shape("ball", radius=0), True),
    ("a ball with a word too many", _shape("ball", radius=1, foo=2), False),
    ("waves of 10^9", _shape("waves", size=[1e9, 1e9], height=1, length=1e-9), False),
    ("a tube of 10^5 points", _shape("tube", radius=0.1, path=line), True),
    ("a mesh outside", _shape("mesh", file="../../outside/victim.txt"), True),
    ("a mesh that is a device", _shape("mesh", file="/dev/zero"), False),
    ("a color in words", _thing(material={"color": "red"}), False),
    ("a color of 2", _thing(material={"color": [2, 0, 0]}), False),
    ("a color that is a device", _thing(material={"color": device}), False),
) + table(
    "scene file of", FEW,
    Case("a lathe of one point", write_json("spec.json", _shape("lathe", profile=[[0, 0]])),
         found=r"array of shape \[1, 2\]", ci=True),
    Case("a lathe of lists of all lengths", write_json("spec.json", _shape("lathe", profile=[[0, 0], [1]])),
         found="not all 2 numbers", ci=True),
    Case("a mesh without a suffix", several(write("mesh", "no mesh"), write_json("spec.json", _shape("mesh", file="mesh"))),
         found="a name that ends in nothing", ci=True),
)  # fmt: skip

CASES += _described(
    ("negative light", _sky(type="uniform", radiance=[-1, -1, -1]), True),
    ("a panorama that is a device", _sky(type="image", file="/dev/zero"), False),
    ("a panorama of words", _sky(type="image", file="spec.json"), False),
    ("a light that looks at itself", _lamp(toward=LIGHT["position"]), False),
    ("negative light of a lamp", _lamp(radiance=[-1, 0, 0]), False),
) + [
    Case("scene file of a panorama that is a pipe",
         several(write_json("spec.json", _sky(type="image", file="pipe.hdr")), put("pipe.hdr", "pipe")), FEW, ci=True)
]  # fmt: skip


def _ply(vertices: object, faces: object, body: bytes, form: str = "binary_little_endian") -> bytes:
    places = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat {form} 1.0\nelement vertex {vertices}\n{places}"
    return f"{head}element face {faces}\nproperty list uchar int vertex_indices\nend_header\n".encode() + body


def _face(*corners: int) -> bytes:
    return bytes([len(corners)]) + struct.pack(f"<{len(corners)}i", *corners)


PLACES = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)


def _elsewhere() -> None:
    place = Path(os.fsdecode(b"sp\xff"))
    place.mkdir()
    (place / "m.ply").write_bytes(_ply(3, 1, PLACES + _face(0, 1, 2)))
    write_json(str(place / "spec.json"), ball(things=[{"name": "a", "shape": {"type": "mesh", "file": "m.ply"}}]))()

corner = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
obj = {
    "of a corner that is not there": corner + b"f 1 2 9\n",
    "of a corner of 5000 digits": corner + b"f 1 2 " + b"9" * 5000 + b"\n",
    "of other bytes": b"\xff\xfe\0" * 100,
}
ply = {
    "of 10^15 points": _ply(10**15, 1, b""),
    "of a corner that is not there": _ply(3, 1, PLACES + _face(0, 1, 99)),
    "cut short": _ply(3, 1, PLACES + b"\xff"),
    "without a triangle": _ply(3, 0, PLACES),
    "of places that are no numbers": _ply(3, 1, b"nan 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "ascii"),
}
CASES += [
    *(Case(f"mesh {kind} {name}", several(write(file, data), write_json("spec.json", _shape("mesh", file=file))), FEW,
           ci=name.startswith(("of a corner that", "cut short", "of 10")))
      for kind, file, meshes in (("OBJ", "m.obj", obj), ("PLY", "m.ply", ply)) for name, data in meshes.items()),
    Case("mesh PLY in a folder whose name is no text", _elsewhere,
         ["synth", os.fsdecode(b"sp\xff/spec.json"), *FEW.split()[2:]]),
]  # fmt: skip

proof = "synth proof --out new"
sized = SYNTH.replace("--size 16x16 ", "")
CASES += table(
    "synth with", FEW,
    Case("a sweep of NaN", more="--sweep noise=nan", ci=True),
    Case("a sweep of words", more="--sweep views=3,abc"),
    Case("a sweep of 5000", more="--sweep views=" + ",".join(map(str, range(3, 5000)))),
    Case("10^18 samples", command=SYNTH.replace("--samples 1", f"--samples {10**18}")),
    Case("pictures of 10^8 columns", command=f"{proof} --size 99999999x1"),
    Case("a size of a million", command=f"{sized} --size 1000000x1000000"),
    change=write_json("spec.json", ball()),
)  # fmt: skip
