"""Meshes of users: what is damaged is named, and does not end the process."""

from __future__ import annotations

import contextlib
import random
import struct
from pathlib import Path

import pytest

from polarguide.core.errors import PolarguideError
from polarguide.synth.build import _user_mesh

HEAD = "ply\nformat binary_little_endian 1.0\nelement vertex {}\n" + "".join(
    f"property float {axis}\n" for axis in "xyz"
)
FACES = "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
PLACES = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)


pytestmark = pytest.mark.usefixtures("variant")


def ply(vertices: object, faces: object, body: bytes) -> bytes:
    return (HEAD.format(vertices) + FACES.format(faces)).encode() + body


def corners(*numbers: int) -> bytes:
    return bytes([len(numbers)]) + struct.pack(f"<{len(numbers)}i", *numbers)


def test_a_triangle(tmp_path: Path) -> None:
    (tmp_path / "m.ply").write_bytes(ply(3, 1, PLACES + corners(0, 1, 2)))
    mesh = _user_mesh(tmp_path / "m.ply")
    assert mesh.points.shape == (3, 3)
    assert mesh.faces.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("m.ply", ply(-5, 1, b"")),
        ("m.ply", ply("9" * 5000, 1, b"")),
        ("m.ply", ply(3, 1, PLACES + corners(0, 1, 99))),
        ("m.ply", ply(3, 1, PLACES + corners(0, 1, -1))),
        ("m.ply", ply(3, 1, PLACES + b"\xff")),
        ("m.ply", ply(3, 0, PLACES)),
        ("m.ply", b"ply\nformat"),
        ("m.ply", HEAD.format(3).encode() + b"\xffelement face 1\n"),
        ("m.obj", b""),
        ("m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"),
        ("m.obj", b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
    ],
)
def test_damaged_ones_are_named(tmp_path: Path, name: str, data: bytes) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(PolarguideError) as refused:
        _user_mesh(tmp_path / name)
    assert refused.value.where.endswith(name)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("seed", range(40))
def test_random_damage_is_read_or_named(tmp_path: Path, seed: int) -> None:
    """Corners beyond the points once made Mitsuba write where nothing was, which ended a later test or none."""
    draw = random.Random(seed)
    count = draw.choice([3, 40, 400])
    points = struct.pack(f"<{3 * count}f", *(draw.uniform(-1, 1) for _ in range(3 * count)))
    triangles = b"".join(corners(*(draw.randrange(count) for _ in range(3))) for _ in range(2 * count))
    data = bytearray(ply(count, 2 * count, points + triangles))
    for _ in range(draw.choice([1, 2, 20])):
        place = draw.randrange(len(data) - 4)
        data[place : place + 4] = struct.pack(
            "<i", draw.choice([-1, 99_999, 2**31 - 1, draw.randrange(2**31)])
        )
    (tmp_path / "m.ply").write_bytes(data)
    with contextlib.suppress(PolarguideError):
        mesh = _user_mesh(tmp_path / "m.ply")
        assert 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.points)
