# ruff: noqa: E501
"""Poses of COLMAP, nerfstudio, Metashape and IDR that are wrong in ways that their programs, or people, bring about."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from base import MOSAICS
from making import SAME, UNUSED, Change, MadeCase, made_case, nothing, of_bytes, put

POSED = MOSAICS[:-1]
TURNED = [[1, 0, 0, 0.1], [0, -1, 0, 0], [0, 0, -1, -2.5], [0, 0, 0, 1]]
LENS: dict[str, Any] = {"w": 32, "h": 24, "fl_x": 40.0, "fl_y": 40.0, "cx": 16.0, "cy": 12.0}


def _frames(names: tuple[str, ...] = ("v000", "v001", "v002"), **of_first: Any) -> list[dict[str, Any]]:
    rows = []
    for k, name in enumerate(names):
        matrix = [list(row) for row in TURNED]
        matrix[0][3] = 0.1 * k
        rows.append({"file_path": f"images/{name}.png", "transform_matrix": matrix})
    rows[0] |= of_first
    return rows


def nerfstudio_cases() -> Iterator[MadeCase]:
    """``transforms.json``."""
    plain = json.dumps({**LENS, "frames": _frames()})
    sheared = [[1, 0.5, 0, 0], *TURNED[1:]]
    for name, data, reason in (
        ("with a mark of its bytes", b"\xef\xbb\xbf" + plain.encode(), SAME),
        ("in UTF-16", plain.encode("utf-16"), SAME),
        ("with NaN in a matrix", plain.replace("-2.5", "NaN", 1).encode(), ""),
        ("with numbers as text", plain.replace("-2.5", '"-2.5"', 1).encode(), ""),
        ("with its frames twice", (plain[:-1] + ', "frames": []}').encode(), ""),
        ("of a frame without a matrix", json.dumps({**LENS, "frames": [{"file_path": "v000.png"}, *_frames()[1:]]}).encode(), ""),
        ("of a frame without a name", json.dumps({**LENS, "frames": _frames(file_path="")}).encode(), ""),
        ("of three rows", json.dumps({**LENS, "frames": _frames(transform_matrix=TURNED[:3])}).encode(), SAME),
        ("of a last row that is none", json.dumps({**LENS, "frames": _frames(transform_matrix=[*TURNED[:3], [1, 2, 3, 4]])}).encode(), ""),
        ("of a sheared matrix", json.dumps({**LENS, "frames": _frames(transform_matrix=sheared)}).encode(), ""),
        ("of a matrix twice as large", json.dumps({**LENS, "frames": _frames(transform_matrix=[[2 * x for x in row[:3]] + row[3:] for row in TURNED])}).encode(), ""),
        ("of strangers alone", json.dumps({**LENS, "frames": _frames(("a", "b", "c"))}).encode(), ""),
        ("of paths of Windows", json.dumps({**LENS, "frames": _frames(file_path="C:\\x\\v000.png")}).encode(), SAME),
        ("of names in capitals", json.dumps({**LENS, "frames": _frames(("V000", "V001", "V002"))}).encode(), ""),
        ("of another size for one frame", json.dumps({**LENS, "frames": _frames(w=64, h=48)}).encode(), ""),
        ("of twice the pictures' size", json.dumps({**LENS, "w": 6400, "h": 4800, "frames": _frames()}).encode(), ""),
        ("of another shape than the pictures'", json.dumps({**LENS, "w": 24, "h": 32, "frames": _frames()}).encode(), ""),
        ("of 100000 frames", json.dumps({**LENS, "frames": _frames(tuple(f"w{k}" for k in range(100_000)))}).encode(), ""),
        ("as a list", b"[1, 2, 3]", ""),
    ):  # fmt: skip
        yield made_case(
            f"further transforms.json {name}", of_bytes("poses.json", data), [*POSED, "poses.json"], reason
        )


def metashape_cases() -> Iterator[MadeCase]:
    """``cameras.xml``."""
    lens = '<sensors><sensor id="0" type="{kind}"><resolution width="{w}" height="24"/><calibration class="adjusted"><resolution width="{w}" height="24"/><f>40</f></calibration></sensor></sensors>'

    def xml(
        head: str = "",
        kind: str = "frame",
        w: object = 32,
        numbers: str = "1 0 0 {x} 0 -1 0 0 0 0 -1 2.5 0 0 0 1",
        more: str = "",
        chunks: int = 1,
    ) -> bytes:
        rows = "".join(
            f'<camera id="{k}" sensor_id="0" label="v00{k}"><transform>{numbers.format(x=0.1 * k)}</transform></camera>'
            for k in range(3)
        )
        chunk = f"<chunk>{lens.format(kind=kind, w=w)}<cameras>{rows}</cameras>{more}</chunk>"
        return f'{head}<document version="2.0">{chunk * chunks}</document>'.encode()  # fmt: skip

    for name, data, reason in (
        ("with a mark of its bytes", b"\xef\xbb\xbf" + xml('<?xml version="1.0" encoding="UTF-8"?>\r\n'), SAME),
        ("in Latin-1", xml('<?xml version="1.0" encoding="ISO-8859-1"?>', more="<a>\u00ef</a>").replace("\u00ef".encode(), b"\xef"), SAME),
        ("in UTF-7", b'<?xml version="1.0" encoding="UTF-7"?>' + xml(), ""),
        ("of a file outside by a public name", xml('<!DOCTYPE x PUBLIC "a" "file:///etc/passwd">'), ""),
        ("of entities of entities", xml('<!DOCTYPE x [<!ENTITY % a "<!ENTITY b SYSTEM \'file:///etc/passwd\'>"> %a;]>'), ""),
        ("of an include", xml(more='<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="/etc/passwd" parse="text"/>'), UNUSED),
        ("of two chunks", xml(chunks=2), ""),
        ("of a fisheye", xml(kind="fisheye"), ""),
        ("of a mirror", xml(numbers="-1 0 0 {x} 0 -1 0 0 0 0 -1 2.5 0 0 0 1"), ""),
        ("of nothing but zeros", xml(numbers="0 0 0 {x} 0 0 0 0 0 0 0 0 0 0 0 1"), ""),
        ("of NaN", xml(numbers="nan 0 0 {x} 0 -1 0 0 0 0 -1 2.5 0 0 0 1"), ""),
        ("of numbers with commas", xml(numbers="1,0 0 0 {x} 0 -1 0 0 0 0 -1 2,5 0 0 0 1"), ""),
        ("of another size than the pictures", xml(w=99), ""),
        ("of an attribute of 8 MB", xml(more=f'<a b="{"x" * (8 << 20)}"/>'), UNUSED),
        ("of a million attributes", b"<a " + b" ".join(b'a%d="1"' % k for k in range(300_000)) + b"/>", ""),
    ):  # fmt: skip
        yield made_case(
            f"further cameras.xml {name}", of_bytes("poses.xml", data), [*POSED, "poses.xml"], reason
        )


def idr_cases() -> Iterator[MadeCase]:
    """``cameras.npz``."""
    eye, good = np.eye(4), np.array([[40.0, 0, 16, 0], [0, 40, 12, 0], [0, 0, 1, 2.5], [0, 0, 0, 1]])

    def arrays(*names: str, **more: Any) -> Change:
        whole = {f"{kind}_{k}": v for k in names for kind, v in (("world_mat", good), ("scale_mat", eye))}
        return lambda folder: np.savez(folder / "poses.npz", **{**whole, **more})

    for name, change, reason in (
        ("of two cameras for three views", arrays("0", "1"), ""),
        ("of a number of 30 digits", arrays("0", "1", "9" * 30), ""),
        ("of a negative number", arrays("0", "1", "-1"), ""),
        ("of a number in words", arrays("0", "1", "x"), ""),
        ("of a number in other digits", arrays("0", "1", "\u0662"), ""),
        ("of a scale of zeros", arrays("0", "1", "2", scale_mat_1=np.zeros((4, 4))), ""),
        ("of a mirrored camera", arrays("0", "1", "2", world_mat_1=np.diag([-1.0, 1, 1, 1]) @ good), ""),
        ("of floats of 16 bits", arrays("0", "1", "2", world_mat_1=good.astype(np.float16)), ""),
        (
            "that is a picture",
            lambda f: (f / "poses.npz").write_bytes((f / "mosaics/v000.png").read_bytes()),
            "",
        ),
    ):
        yield made_case(f"further cameras.npz {name}", change, [*POSED, "poses.npz"], reason)


def colmap_cases() -> Iterator[MadeCase]:
    """A model that is given with ``--poses``."""
    sparse = "model/sparse/0"

    def changed(file: str, edit: Any) -> Change:
        return lambda f: (f / sparse / file).write_bytes(edit((f / sparse / file).read_bytes()))

    def count(value: int) -> Any:
        return lambda data: struct.pack("<Q", value) + data[8:]

    model = [*POSED, "model"]
    for name, change, command, reason in (
        ("of 2^63 cameras", changed("cameras.bin", count(1 << 63)), model, ""),
        ("of 2^40 images", changed("images.bin", count(1 << 40)), model, ""),
        ("of 2^64 - 1 points", changed("points3D.bin", count((1 << 64) - 1)), model, ""),
        ("of no image", changed("images.bin", lambda d: bytes(8)), model, ""),
        ("of names without an end", changed("images.bin", lambda d: d[:72] + d[72:].replace(b"\0", b"x")), model, ""),
        ("given as its file", nothing, [*POSED, "model/sparse/0/cameras.bin"], ""),
        ("given as the mosaics", nothing, [*POSED, "mosaics"], ""),
        ("given as a scene of other views", nothing, [*POSED, "run"], ""),
        ("given as the root", nothing, [*POSED, "/"], ""),
        ("in a folder that is a loop", put("model/sparse", "itself"), model, ""),
        ("with a text model beside it", of_bytes(f"{sparse}/images.txt", b"junk"), model, UNUSED),
        ("with a mark of its bytes", _as_text(lambda text: "\ufeff" + text), model, ""),
        ("in UTF-16", _as_text(lambda text: text, "utf-16"), model, ""),
        ("with lines of an old Mac", _as_text(lambda text: text.replace("\n", "\r")), model, ""),
        ("with folders of Windows in its names", _as_text(lambda text: text.replace("v001", "images\\v001")), model, SAME),
        ("with names in capitals", _as_text(lambda text: text.replace("v00", "V00")), model, ""),
        ("with numbers with commas", _as_text(lambda text: text.replace("2.5", "2,5")), model, ""),
        ("with quaternions of zeros", _as_text(lambda text: text.replace(" 1 0 0 0 ", " 0 0 0 0 ")), model, ""),
    ):  # fmt: skip
        yield made_case(f"further model {name}", change, command, reason)


def _as_text(edit: Any, encoding: str = "utf-8") -> Change:
    def change(folder: Path) -> None:
        sparse = folder / "model/sparse/0"
        for path in sparse.iterdir():
            path.unlink()
        rows = "".join(f"{k + 1} 1 0 0 0 {0.1 * k} 0 2.5 1 v00{k}.png\n\n" for k in range(3))
        (sparse / "cameras.txt").write_text("1 PINHOLE 32 24 40 40 16 12\n")
        (sparse / "images.txt").write_bytes(edit(rows).encode(encoding))
        (sparse / "points3D.txt").write_text(
            "7 0.1 0.1 0.1 1 2 3 0.5\n2 -0.4 0 0 25 0 1 0.5\n3 0 0 0.3 1 2 3 0.5\n"
        )

    return change
