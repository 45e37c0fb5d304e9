"""What does not fit into memory, or is not its camera's, is refused by its header: no picture is decoded."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from dataset_files import WRITERS
from faults import Fault
from hostile_files import deflated_tiff, exr, header, two_sizes_hdr
from tiny_capture import NAMES, TinyCapture, write_tiny_capture

from polarguide.capture import load_scene, view_reader
from polarguide.capture.formats.stored import declared_size, decode_stored, read_picture, stated_size
from polarguide.capture.layout import KEPT, READ, SHARE
from polarguide.capture.sensor.mosaics import WORKED
from polarguide.core.system import free_memory
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings
from polarguide_shots.options import ShotOptions
from polarguide_shots.read import read_shot


@pytest.fixture
def capture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> TinyCapture:
    made = write_tiny_capture(tmp_path / "tiny")

    def decode(*_: object, **__: object) -> None:
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
    Fault(expected="--memory", found="9 views that take", remedy="--downscale 2").raised_by(
        load_scene, capture.root, memory=0.99 * needed
    )
    with pytest.raises(AssertionError):
        load_scene(capture.root, memory=1.01 * needed)
    # A quarter of the pixels is kept.
    with pytest.raises(AssertionError):
        load_scene(capture.root, memory=(KEPT * len(NAMES) / 4 + 4 * READ) * 121 / 2**30, downscale=2)


def test_without_a_wish_most_of_what_is_free_may_be_taken(
    capture: TinyCapture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("polarguide.capture.layout.free_memory", lambda: 1000)
    Fault(expected="80%").raised_by(load_scene, capture.root)


def test_24_huge_pictures_are_refused_by_their_camera(capture: TinyCapture) -> None:
    for path in (capture.root / "polar").iterdir():
        path.write_bytes(png_of(12_000, 12_000))
    Fault(expected="the size of the pictures, 12000x12000", found="12x10").raised_by(load_scene, capture.root)


def test_24_huge_pictures_of_their_camera_are_refused_by_their_memory(capture: TinyCapture) -> None:
    capture.write_cameras("1 PINHOLE 12000 12000 15500 15250 6000 6000")
    for path in (capture.root / "polar").iterdir():
        path.write_bytes(png_of(12_000, 12_000))
    Fault(found="9 views that take").raised_by(load_scene, capture.root, memory=8)


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        (
            "polar/v003_090.png",
            Fault("v003_090.png", "the size of polar/v003_000.png, 12x10", "12000x12000"),
        ),
        ("masks/v002.png", Fault("v002.png", "the size of the pictures, 12x10", "12000x12000")),
        ("invalid/v002.png", Fault("v002.png", "the size of the pictures, 12x10", "12000x12000")),
    ],
)
def test_one_huge_file_of_a_view_is_not_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, fault: Fault
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
    fault.raised_by(load_scene, capture.root, memory=1000)


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
    assert 0 < free_memory() < 1 << 50


def test_headers_of_every_kind_state_a_size(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((5, 7, 3), np.float32))
    np.save(tmp_path / "b.npy", np.zeros(9))
    two_sizes_hdr(tmp_path / "a.hdr", 300)
    exr(tmp_path / "a.exr", 40)
    (tmp_path / "b.exr").write_bytes(b"junk")
    deflated_tiff(tmp_path / "a.tif", 60)
    (tmp_path / "b.tif").write_bytes(b"II*\0\xf0\xff\xff\xff")
    for name, head in (("c.npy", "{'descr': ("), ("d.npy", "{{}: 1}"), ("e.npy", "-" * 9000 + "1")):
        (tmp_path / name).write_bytes(header(head))
    sizes = {path.name: stated_size(path) for path in sorted(tmp_path.iterdir())}
    assert sizes == {
        "a.npy": (7, 5), "b.npy": None, "a.hdr": (300, 300), "a.exr": (40, 40), "b.exr": None, "a.tif": (60, 60),
        "b.tif": None, "c.npy": None, "d.npy": None, "e.npy": None,
    }  # fmt: skip


@pytest.mark.parametrize("big", [False, True])
def test_a_tiff_is_not_read_whole_for_its_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, big: bool
) -> None:
    """Its directory may stand behind the pixels, as libtiff writes it."""
    read: list[int] = []

    class Counted(io.FileIO):
        def read(self, size: int = -1) -> bytes:
            data = super().read(size)
            read.append(len(data))
            return data

    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.zeros((700, 900), np.uint16), bigtiff=big)
    data = bytearray(path.read_bytes())
    at = 8 if big else 4
    (start,) = struct.unpack_from("<Q" if big else "<I", data, at)
    struct.pack_into("<Q" if big else "<I", data, at, len(data))
    path.write_bytes(bytes(data) + bytes(data[start : start + 400]))
    monkeypatch.setattr("polarguide.capture.formats.stored.open", lambda p, mode: Counted(p), raising=False)
    assert stated_size(path) == (900, 700)
    assert 0 < sum(read) < 2000


def test_a_picture_file_far_larger_than_its_pixels_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    for content in (b"II*\0", None):
        if content is None:
            tifffile.imwrite(path, np.zeros((8, 8), np.uint16))
        else:
            path.write_bytes(content)
        with open(path, "r+b") as file:
            file.truncate((1 << 31) - 1)
        Fault(found="more than 64 MiB").raised_by(read_picture, path)


def test_tiff_files_that_decoders_take_in_part_are_refused(tmp_path: Path) -> None:
    pixels = np.zeros((2, 8, 8), np.uint16)
    tifffile.imwrite(tmp_path / "two.tif", pixels, photometric="minisblack")
    tifffile.imwrite(tmp_path / "white.tif", pixels[0], photometric="miniswhite")
    for name, words in (("two.tif", "of 2 pictures"), ("white.tif", "whose white is 0")):
        Fault(name, found=words).raised_by(decode_stored, tmp_path / name, (tmp_path / name).read_bytes())
    with tifffile.TiffWriter(tmp_path / "small.tif") as file:
        file.write(pixels[0])
        file.write(pixels[0, ::2, ::2], subfiletype=1)  # a smaller copy, for lists of files
    assert decode_stored(tmp_path / "small.tif", (tmp_path / "small.tif").read_bytes()).shape == (8, 8)


@pytest.mark.parametrize("mode", ["quarter", "half", "full"])
def test_mosaics_that_do_not_fit_are_refused_by_their_headers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: Any
) -> None:
    (tmp_path / "raw").mkdir()
    for name in ("a", "b"):
        (tmp_path / "raw" / f"{name}.png").write_bytes(png_of(4000, 3000))
    free = int(WORKED[mode] * 12e6 / SHARE)
    settings = PrepareSettings(sensor="IMX250MYR", poses="none", demosaic=mode)
    for room, words in (
        (0.99 * free, "a mosaic of 4000x3000 that take"),
        (1.01 * free, "one that cannot be decoded"),
    ):
        monkeypatch.setattr("polarguide.capture.layout.free_memory", lambda room=room: int(room))
        Fault(found=words).raised_by(prepare_scene, tmp_path / "raw", tmp_path / "out", settings)
    monkeypatch.setattr("polarguide.capture.layout.free_memory", lambda: 1000)
    Fault(found="a mosaic of 4000x3000").raised_by(
        read_shot, tmp_path / "raw/a.png", ShotOptions(sensor="IMX250MYR", demosaic=mode)
    )


def test_datasets_that_do_not_fit_are_refused_by_their_headers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    WRITERS["nersp"](tmp_path / "data")
    monkeypatch.setattr("polarguide.capture.layout.free_memory", lambda: 100_000)
    Fault(".npy", found="Stokes vectors of 64x48").raised_by(
        prepare_scene, tmp_path / "data", tmp_path / "out", PrepareSettings(format="nersp")
    )
