"""What does not fit into memory, or is not its camera's, is refused by its header: no picture is decoded."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_capture import NAMES, TinyCapture, write_tiny_capture

from polarguide.capture import load_scene, view_reader
from polarguide.capture.formats.integrity import declared_size
from polarguide.capture.memory import KEPT, READ, stated_size
from polarguide.errors import PolarguideError
from polarguide.system import free_memory


@pytest.fixture
def capture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> TinyCapture:
    made = write_tiny_capture(tmp_path / "tiny")

    def decode(*_: object) -> None:
        raise AssertionError("a picture was decoded")

    monkeypatch.setattr("polarguide.capture.view_reader.decode_picture", decode)
    return made


def png_of(width: int, height: int) -> bytes:
    """A PNG file that says how large it is, and is not."""
    head = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    parts = [(b"IHDR", head), (b"IDAT", zlib.compress(bytes(1000))), (b"IEND", b"")]
    chunks = [struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in parts]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def test_pictures_that_do_not_fit_are_refused(capture: TinyCapture) -> None:
    needed = (KEPT * len(NAMES) + 4 * READ) * 120 / 2**30
    with pytest.raises(
        PolarguideError, match=r"as --memory allows, found 9 views that take .* --downscale 2"
    ):
        load_scene(capture.root, memory=0.99 * needed)
    with pytest.raises(AssertionError):
        load_scene(capture.root, memory=1.01 * needed)
    # A quarter of the pixels is kept.
    with pytest.raises(AssertionError):
        load_scene(capture.root, memory=(KEPT * len(NAMES) / 4 + 4 * READ) * 121 / 2**30, downscale=2)


def test_without_a_wish_most_of_what_is_free_may_be_taken(
    capture: TinyCapture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("polarguide.capture.memory.free_memory", lambda: 1000)
    with pytest.raises(PolarguideError, match=r"80% of what is free"):
        load_scene(capture.root)


def test_24_huge_pictures_are_refused_by_their_camera(capture: TinyCapture) -> None:
    for path in (capture.root / "polar").iterdir():
        path.write_bytes(png_of(12_000, 12_000))
    with pytest.raises(PolarguideError, match="expected the size of the pictures, 12000x12000, found 12x10"):
        load_scene(capture.root)


def test_24_huge_pictures_of_their_camera_are_refused_by_their_memory(capture: TinyCapture) -> None:
    capture.write_cameras("1 PINHOLE 12000 12000 15500 15250 6000 6000")
    for path in (capture.root / "polar").iterdir():
        path.write_bytes(png_of(12_000, 12_000))
    with pytest.raises(PolarguideError, match=r"found 9 views that take .* GiB"):
        load_scene(capture.root, memory=8)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "polar/v003_090.png",
            r"v003_090\.png: expected the size of polar/v003_000\.png, 12x10, found 12000x12000",
        ),
        ("masks/v002.png", r"v002\.png: expected the size of the pictures, 12x10, found 12000x12000"),
        ("invalid/v002.png", r"v002\.png: expected the size of the pictures, 12x10, found 12000x12000"),
    ],
)
def test_one_huge_file_of_a_view_is_not_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, message: str
) -> None:
    capture = write_tiny_capture(tmp_path / "tiny")
    path = capture.root / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(png_of(12_000, 12_000))

    def sized(decode: Any) -> Any:
        def checked(of: Path, data: bytes, **given: Any) -> Any:
            assert of != path, "it was decoded"
            return decode(of, data, **given)

        return checked

    for function in ("decode_picture", "decode_mask"):
        monkeypatch.setattr(view_reader, function, sized(getattr(view_reader, function)))
    with pytest.raises(PolarguideError, match=message):
        load_scene(capture.root, memory=1000)


@pytest.mark.parametrize(("order", "mark"), [("<", b"II"), (">", b"MM")])
def test_a_big_tiff_says_its_size(tmp_path: Path, order: str, mark: bytes) -> None:
    entries = b"".join(
        struct.pack(order + "HHQ", tag, 4, 1) + struct.pack(order + "II", value, 0)
        for tag, value in ((256, 70_000), (257, 300))
    )
    data = mark + struct.pack(order + "HHHQQ", 43, 8, 0, 16, 2) + entries + bytes(8)
    assert declared_size(data) == (70_000, 300)
    (tmp_path / "a.tif").write_bytes(data)
    assert stated_size(tmp_path / "a.tif") == (70_000, 300)
    assert declared_size(data[:30]) is None


def test_the_system_says_what_is_free() -> None:
    free = free_memory()
    assert free is None or 0 <= free < 1 << 50
    assert np.isfinite(free or 0)
