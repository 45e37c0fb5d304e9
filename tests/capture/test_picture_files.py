"""Kinds of picture files, and files that are damaged."""

from __future__ import annotations

import io
import struct
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from faults import Fault
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from tiny_capture import TinyCapture, encode_srgb, ideal_intensities, write_picture

from polarguide.capture import load_scene
from polarguide.capture.filter.camera_files import exif_data, orientation
from polarguide.capture.formats.pictures import decode_picture, linear_codes
from polarguide.capture.formats.stored import declared_size, decode_stored, find_damage
from polarguide.capture.view import FULL_CODE
from polarguide.capture.write import intensity_codes, rounding_of, write_png_file
from polarguide.geometry.polarizer import ANGLES
from polarguide.optics.color import srgb_decode_array

tifffile = pytest.importorskip("tifffile", reason="tifffile writes the unusual TIFF files")

COLORS = np.random.default_rng(0).integers(0, 65536, (20, 30, 3)).astype(np.uint16)


def encoded(suffix: str, picture: np.ndarray, *options: int) -> bytes:
    done, data = cv2.imencode(suffix, picture, options)
    assert done
    return data.tobytes()


JPEGS = {
    "baseline": encoded(".jpg", (COLORS >> 8).astype(np.uint8)),
    "progressive": encoded(".jpg", (COLORS >> 8).astype(np.uint8), cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "restarts": encoded(".jpg", (COLORS >> 8).astype(np.uint8), cv2.IMWRITE_JPEG_RST_INTERVAL, 1),
}
PNG = encoded(".png", COLORS)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".tiff", ".PNG"])
@pytest.mark.parametrize("bits", [8, 16])
def test_lossless_files(capture: TinyCapture, suffix: str, bits: int) -> None:
    capture.rewrite(lambda linear: linear, bits=bits, suffix=suffix)
    scene = load_scene(capture.root)
    for view in scene.views:
        half_a_step = 0.5 / (2**bits - 1) + 1e-6
        np.testing.assert_allclose(view.intensities().numpy(), capture.linear[view.name], atol=half_a_step)
    assert scene.warnings == ()


def test_eight_bits_are_exact_multiples_of_257(capture: TinyCapture) -> None:
    capture.rewrite(lambda linear: linear, bits=8)
    view = load_scene(capture.root).views[0]
    np.testing.assert_array_equal(view.codes.numpy(), np.rint(capture.linear["v000"] * 255) * 257)


def test_jpeg_is_read_within_its_loss(capture: TinyCapture) -> None:
    flat = np.full((4, 10, 12, 3), 0.4)
    flat[..., 1] = 0.5
    capture.linear = dict.fromkeys(capture.linear, flat)
    capture.rewrite(lambda linear: linear, bits=8, suffix=".jpg")
    np.testing.assert_allclose(load_scene(capture.root).views[0].intensities().numpy(), flat, atol=0.01)


@pytest.mark.parametrize("bits", [8, 16])
def test_gray_pictures_become_three_equal_channels(capture: TinyCapture, bits: int) -> None:
    capture.rewrite(lambda linear: linear[..., 0], bits=bits)
    view = load_scene(capture.root).views[0]
    gray = torch.from_numpy(capture.linear["v000"][..., :1]).float()
    torch.testing.assert_close(
        view.intensities(), gray.expand(-1, -1, -1, 3), atol=0.51 / (2**bits - 1), rtol=0
    )


@pytest.mark.parametrize(("bits", "rounding"), [(8, 64), (10, 16), (12, 4), (14, 1), (16, 1)])
def test_codes_are_rounded_to_less_than_a_fifth_of_a_step(bits: int, rounding: int) -> None:
    step = FULL_CODE / (2**bits - 1)
    bands = rounding_of(np.array([0.0, step]))
    assert bands == [(0, rounding)]
    values = np.random.default_rng(1).random((4, 40, 50, 3), np.float32)
    values[0, 0, :2] = 1.0
    invalid = np.zeros((40, 50), bool)
    invalid[0, 0] = True
    codes = intensity_codes(values, invalid, bands).astype(int)
    kept = ~invalid
    assert np.abs(codes - values * FULL_CODE)[:, kept].max() <= max(rounding / 2, 1) + 0.01
    assert rounding == 1 or rounding / 2 < step / 5
    assert not (codes[codes < FULL_CODE - 1] % rounding).any()
    assert codes[:, kept].max() < FULL_CODE
    assert (codes[0, 0, 0] == FULL_CODE).all()


def test_codes_of_srgb_pictures_are_rounded_by_the_step_at_their_value() -> None:
    steps = FULL_CODE * srgb_decode_array(np.arange(256) / 255)
    bands = rounding_of(steps)
    assert [multiple for _, multiple in bands] == [4, 8, 16, 32, 64, 128]
    values = np.linspace(0, 0.998, 4 * 50 * 50 * 3, dtype=np.float32).reshape(4, 50, 50, 3)
    codes = intensity_codes(values, np.zeros((50, 50), bool), bands).astype(int)
    step = np.interp(values * FULL_CODE, steps[:-1], np.diff(steps))
    assert (np.abs(codes - values * FULL_CODE) < 0.2 * step + 0.01).all()
    for start, multiple in bands:
        assert not (codes[codes > start + multiple] % multiple).any()


def test_pictures_are_written_with_the_filter_that_suits_them(tmp_path: Path) -> None:
    random = np.random.default_rng(2)
    few = (random.integers(0, 40, (100, 120, 3)) ** 2 * 40).astype(np.uint16)
    ramp = (np.arange(120)[:, None] * 500 + random.integers(0, 40, (100, 120, 3))).astype(np.uint16)
    smallest = []
    for pixels in (few, ramp):
        sizes = [
            len(
                cv2.imencode(".png", pixels, (cv2.IMWRITE_PNG_FILTER, way, cv2.IMWRITE_PNG_COMPRESSION, 6))[1]
            )
            for way in (cv2.IMWRITE_PNG_FILTER_NONE, cv2.IMWRITE_PNG_FILTER_SUB)
        ]
        smallest.append(int(np.argmin(sizes)))
        assert write_png_file(tmp_path / "a.png", pixels) <= min(sizes) * 1.01
        np.testing.assert_array_equal(cv2.imread(str(tmp_path / "a.png"), -1)[..., ::-1], pixels)
    assert smallest == [0, 1]


@pytest.mark.parametrize("bits", [8, 16])
def test_srgb_is_made_linear(capture: TinyCapture, bits: int) -> None:
    capture.rewrite(encode_srgb, bits=bits)
    view = load_scene(capture.root, transfer="srgb").views[0]
    # A step of the encoded value is at most 2.3 steps of the linear one.
    np.testing.assert_allclose(
        view.intensities().numpy(), capture.linear["v000"], atol=1.2 / (2**bits - 1) + 1e-5
    )


def test_srgb_curve_meets_its_known_points() -> None:
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=2)
    codes = linear_codes(ramp, "srgb")[0, :, 0]
    assert (codes[0], codes[255], codes[188] / 65535) == (0, 65535, pytest.approx(0.5029, abs=1e-4))
    assert codes[10] / 65535 == pytest.approx(10 / 255 / 12.92, abs=1e-5)
    assert (np.diff(codes.astype(int)) > 0).all()


def test_full_alpha_is_dropped_and_channels_are_in_rgb_order(tmp_path: Path) -> None:
    bgra = np.zeros((4, 5, 4), np.uint8)
    bgra[..., 0], bgra[..., 2], bgra[..., 3] = 10, 30, 255
    picture = decode_picture(tmp_path, encoded(".png", bgra))
    assert (picture.shape, picture[0, 0].tolist()) == ((4, 5, 3), [30, 0, 10])


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_transparent_pixel_is_refused(tmp_path: Path, kind: type) -> None:
    bgra = np.full((4, 5, 4), np.iinfo(kind).max, kind)
    bgra[2, 3, 3] = 7
    Fault(expected="an opaque picture", found="5.0% of it transparent", remedy="Save").raised_by(
        decode_picture, tmp_path, encoded(".png", bgra)
    )


@pytest.mark.parametrize("data", JPEGS.values(), ids=JPEGS.keys())
def test_complete_jpegs_pass_and_every_cut_is_found(data: bytes) -> None:
    assert find_damage(data) is None
    assert find_damage(data + b"\0maker notes after the end") is None
    cuts = {length: find_damage(data[:length]) for length in range(2, len(data))}
    assert [length for length, damage in cuts.items() if damage is None] == []
    assert cuts[len(data) // 2] == f"a JPEG file cut short (it ends after {len(data) // 2} bytes)"


def test_a_thumbnail_inside_a_jpeg_does_not_end_it() -> None:
    data = JPEGS["baseline"]
    thumbnail = b"Exif\0\0" + data
    segment = b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail
    whole = data[:2] + segment + data[2:]
    assert find_damage(whole) is None
    assert find_damage(whole[: len(whole) - len(data) // 2]) is not None


@given(length=st.integers(1, len(PNG) - 1))
def test_png_cut_anywhere(length: int) -> None:
    assert find_damage(PNG[:length]) is not None


@given(at=st.integers(8, len(PNG) - 1), bit=st.integers(0, 7))
def test_png_with_one_flipped_bit(at: int, bit: int) -> None:
    data = bytearray(PNG)
    data[at] ^= 1 << bit
    assert find_damage(bytes(data)) is not None


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"byteorder": ">"},
        {"compression": "zlib"},
        {"rowsperstrip": 4},
        {"tile": (16, 16)},
        {"bigtiff": True},
    ],
    ids=str,
)
def test_tiff_variants(tmp_path: Path, options: dict[str, object]) -> None:
    path = tmp_path / "picture.tif"
    tifffile.imwrite(path, COLORS, photometric="rgb", **options)
    data = path.read_bytes()
    assert find_damage(data) is None
    np.testing.assert_array_equal(decode_picture(path, data), COLORS)
    name = "BigTIFF" if "bigtiff" in options else "TIFF"
    cuts = {find_damage(data[:length]) for length in (6, 100, int(len(data) * 0.97), len(data) - 1)}
    assert all(damage is not None and f"a {name} file cut short" in damage for damage in cuts)


def test_a_tiff_of_which_a_value_is_cut_off(tmp_path: Path) -> None:
    """Its pixels are whole, and its color profile, which stands at the end, is not."""
    path = tmp_path / "picture.tif"
    tifffile.imwrite(path, COLORS, photometric="rgb")
    data = bytearray(path.read_bytes())
    order, entries = 8, struct.unpack_from("<H", data, 8)[0]
    struct.pack_into("<HHII", data, order + 2 + 12 * (entries - 1), 34675, 7, 400, len(data))
    assert find_damage(bytes(data) + bytes(400)) is None
    assert "a TIFF file cut short" in str(find_damage(bytes(data) + bytes(399)))


@pytest.mark.parametrize(
    ("bits", "options", "shape"),
    [
        (8, {}, (20, 30)),
        (8, {"palette": range(255, -1, -1)}, (20, 30)),
        (24, {}, (20, 30, 3)),
        (32, {}, (20, 30, 3)),
    ],
)
def test_bmp_variants(tmp_path: Path, bits: int, options: dict[str, range], shape: tuple[int, ...]) -> None:
    """Rows rise from the last; palettes of gray give gray, and the fourth byte of 32 bits is padding."""
    light = (COLORS >> 8).astype(np.uint8)
    channels = bits // 8
    stored = light[..., 0] if channels == 1 else np.dstack([light, light[..., :1]])[..., :channels]
    rows = np.zeros((20, -(-30 * channels // 4) * 4), np.uint8)
    rows[:, : 30 * channels] = stored[::-1].reshape(20, -1)
    levels = options.get("palette", range(256)) if bits == 8 else ()
    palette = b"".join(bytes([level, level, level, 0]) for level in levels)
    head = struct.pack("<IiiHHIIiiII", 40, 30, 20, 1, bits, 0, 0, 0, 0, 0, 0)
    data = struct.pack("<2sIHHI", b"BM", 0, 0, 0, 54 + len(palette)) + head + palette + rows.tobytes()
    expected = stored[..., :3] if channels > 1 else np.array(levels, np.uint8)[stored]
    found = decode_stored(tmp_path / "a.bmp", data)
    assert (found.shape, declared_size(data)) == (shape, (30, 20))
    np.testing.assert_array_equal(found, expected)
    for length in (20, 60, len(data) - 1):
        assert "a BMP file cut short" in str(find_damage(data[:length]))
    assert "place of its pixels" in str(find_damage(data[:10] + bytes(4) + data[14:]))


@pytest.mark.parametrize(("kind", "channels"), [(b"P5", 1), (b"P6", 3)])
@pytest.mark.parametrize("full", [3, 200, 255, 1023, 65535])
def test_pgm_and_ppm_keep_their_numbers(tmp_path: Path, kind: bytes, channels: int, full: int) -> None:
    """They are not scaled by the full scale that the header states."""
    stored = (COLORS[..., :channels].astype(np.float64) * full / 65535).astype(
        np.uint8 if full < 256 else ">u2"
    )
    data = b"%s\n# a comment\n30 20\n%d\n" % (kind, full) + stored.tobytes()
    found = decode_stored(tmp_path / "a.pgm", data)
    np.testing.assert_array_equal(found, stored[..., ::-1] if channels == 3 else stored[..., 0])
    assert "cut short" in str(find_damage(data[:-1]))


@pytest.mark.parametrize("quality", [80, 101])  # 101 is without loss
def test_webp_cut_anywhere(quality: int) -> None:
    data = encoded(".webp", (COLORS >> 8).astype(np.uint8), cv2.IMWRITE_WEBP_QUALITY, quality)
    assert (find_damage(data), declared_size(data)) == (None, (30, 20))
    for length in range(12, len(data)):
        assert "a WebP file cut short" in str(find_damage(data[:length]))


def cut(end: int, suffix: str = ".png") -> Callable[[TinyCapture], None]:
    """Cut a picture short, after all were written with a suffix."""

    def damage(capture: TinyCapture) -> None:
        if suffix != ".png":
            capture.rewrite(lambda linear: linear, bits=8, suffix=suffix)
        path = capture.picture("v002", 90, suffix)
        path.write_bytes(path.read_bytes()[:end])

    return damage


def folder_of_a_picture(capture: TinyCapture) -> None:
    capture.picture("v001", 0).unlink()
    capture.picture("v001", 0).mkdir()


def other_picture(
    values: Callable[[TinyCapture], np.ndarray], bits: int = 16
) -> Callable[[TinyCapture], None]:
    return lambda capture: write_picture(capture.picture("v003", 135), values(capture), bits=bits)


PICTURES: dict[str, tuple[Callable[[TinyCapture], object], Fault]] = {
    "empty": (cut(0), Fault("v002_090.png", "a complete PNG, JPEG or TIFF file", "an empty file", "Copy or export")),
    "cut": (cut(300), Fault("v002_090.png", "a complete PNG", "a PNG file cut short", "Copy or export")),
    "without its end": (cut(-1), Fault("v002_090.png", found="a PNG file cut short")),
    "a cut JPEG": (cut(-3, ".jpg"), Fault("v002_090.jpg", found="file cut short")),
    "a cut TIFF": (cut(-3, ".tif"), Fault("v002_090.tif", found="file cut short")),
    "another kind": (
        lambda capture: capture.picture("v001", 0).write_bytes(b"GIF89a and so on"),
        Fault("v001_000.png", found="a file of another kind"),
    ),
    "a folder": (folder_of_a_picture, Fault("v001_000.png", "a readable file", "Is a directory")),
    "another size": (
        other_picture(lambda _: ideal_intensities(0, height=8, width=12)[3]),
        Fault("v003_135.png", "the size of polar/v003_000.png, 12x10", "12x8"),
    ),
    "another depth": (
        other_picture(lambda capture: capture.linear["v003"][3], bits=8),
        Fault("v003_135.png", found="12x10 with 8 bits", remedy="Export all pictures of a view"),
    ),
    "another size than its camera": (
        lambda capture: capture.write_view("v003", ideal_intensities(0, height=8, width=12)),
        Fault("camera of view v003", "the size of the pictures, 12x8", "12x10", "crop"),
    ),
    "a view of another depth": (
        lambda capture: capture.write_view("v003", capture.linear["v003"], bits=8),
        Fault(expected="the same bit depth in all views", found="8 bits in view v003 and 16 bits in view v000"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", PICTURES)
def test_each_fault_of_a_picture_is_named(capture: TinyCapture, case: str) -> None:
    damage, fault = PICTURES[case]
    damage(capture)
    fault.raised_by(load_scene, capture.root)


def test_a_png_that_is_whole_but_makes_no_sense(capture: TinyCapture) -> None:
    header = struct.pack(">IIBBBBB", 12, 10, 16, 2, 0, 0, 0)
    chunks = b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in ((b"IHDR", header), (b"IDAT", b"no zlib stream"), (b"IEND", b""))
    )
    capture.picture("v001", 0).write_bytes(b"\x89PNG\r\n\x1a\n" + chunks)
    Fault("v001_000.png", found="one that cannot be decoded").raised_by(load_scene, capture.root)


def test_floating_point_pictures(capture: TinyCapture) -> None:
    for angle in ANGLES:
        capture.picture("v001", angle).unlink()
        path = capture.picture("v001", angle, ".tif")
        assert cv2.imwrite(str(path), np.full((10, 12, 3), 900.0, np.float32))
    Fault(
        "v001_000.tif", expected="floating-point values from 0 to 1", found="up to 900", remedy="16-bit"
    ).raised_by(load_scene, capture.root)


@pytest.mark.parametrize("folder", ["masks", "invalid"])
def test_mask_of_another_size_or_damaged(capture: TinyCapture, folder: str) -> None:
    path = capture.root / folder / "v002.png"
    write_picture(path, np.ones((12, 10)), bits=8)
    Fault(f"{folder}/v002.png", "the size of the pictures, 12x10", "10x12", "for these pictures").raised_by(
        load_scene, capture.root
    )
    write_picture(path, np.ones((10, 12)), bits=8)
    path.write_bytes(path.read_bytes()[:-1])
    Fault(f"{folder}/v002.png", found="a PNG file cut short").raised_by(load_scene, capture.root)


def test_a_lack_of_memory_is_told_from_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = cv2.imencode(".png", np.zeros((40, 50), np.uint16))[1].tobytes()
    monkeypatch.setattr(cv2, "imdecode", lambda *_: None)
    Fault(found="one that cannot be decoded").raised_by(decode_stored, tmp_path / "a.png", data)

    def none_left(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(np, "empty", none_left)
    Fault(expected="memory for a picture of 50x40 pixels", found="less").raised_by(
        decode_stored, tmp_path / "a.png", data
    )


@pytest.mark.parametrize("code", [1, 2, 3, 6])
@pytest.mark.parametrize("big", [False, True])
def test_pixels_are_as_stored_whatever_the_orientation_and_never_from_pillow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, big: bool
) -> None:
    """Pillow would give color of 16 bits a channel with 8, without a word; OpenCV turns TIFF files by itself."""

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("Pillow opened a picture")

    monkeypatch.setattr(Image, "open", refuse)
    path, tags = tmp_path / "a.tif", [(274, "H", 1, code, True)]
    tifffile.imwrite(path, COLORS, photometric="rgb", bigtiff=big, extratags=tags)
    np.testing.assert_array_equal(decode_picture(path, path.read_bytes()), COLORS)
    assert orientation(path.read_bytes()) == (1 if big else code)
    np.testing.assert_array_equal(decode_picture(path, PNG), COLORS[..., ::-1])


def heic(light: np.ndarray, bits: int, turn: int, profile: int = 13) -> bytes:
    """A HEIC file of light in [0, 1], without loss of color resolution, turned for display as a telephone does."""
    pillow_heif = pytest.importorskip("pillow_heif", reason="the extra heic")
    kind, mode = (np.uint8, "RGB") if bits == 8 else (np.uint16, "RGB;16")
    values = np.rint(light * np.iinfo(kind).max).astype(kind)
    tags = Image.Exif()
    tags[274], tags.get_ifd(34665)[33434] = turn, 0.02
    file = pillow_heif.from_bytes(mode, values.shape[1::-1], values.tobytes())
    out = io.BytesIO()
    file.save(
        out,
        quality=-1,
        chroma=444,
        exif=tags.tobytes(),
        matrix_coefficients=0,
        transfer_characteristics=profile,
    )
    return out.getvalue()


@pytest.mark.parametrize("bits", [8, 10])
@pytest.mark.parametrize("turn", [1, 3, 6, 8])
def test_heic_is_read_as_stored_with_its_turn_and_its_exposure(tmp_path: Path, bits: int, turn: int) -> None:
    down, across = np.mgrid[:48, :64]
    light = np.stack([across / 63, down / 47, np.full(down.shape, 0.9)], -1)
    light[:4, :4] = 1.0
    data = heic(light, bits, turn)
    found = decode_picture(tmp_path / "a.heic", data)
    assert found.dtype == (np.uint8 if bits == 8 else np.uint16)
    full = np.iinfo(found.dtype).max
    assert found.max() == full  # of 10 bits, too
    np.testing.assert_allclose(found / full, light, atol=1.01 / ((1 << bits) - 1))
    assert (orientation(data), declared_size(data), exif_data(data).light) == (
        turn,
        (64, 48),
        pytest.approx(2.0),
    )


def test_heic_that_is_not_read_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = heic(np.full((48, 64, 3), 0.5), 8, 6)
    turned = b"\0\0\0\x09irot\3"
    assert whole.count(turned) == 1
    for data, part in (
        (whole[:-1], "cut short"),
        (whole[: len(whole) // 2], "cut short"),
        (whole[:100], "cut short"),
        (whole.replace(b"irot", b"imir"), "mirrored for display"),
        (whole + turned.replace(b"\3", b"\1"), "rotated differently"),
        (whole.replace(b"ftypheix", b"ftypavif"), "AVIF"),
    ):
        Fault(found=part).raised_by(decode_picture, tmp_path / "a.heic", data)
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    assert (declared_size(whole), orientation(whole)) == (None, 6)
    Fault(found="not installed").raised_by(decode_picture, tmp_path / "a.heic", whole)


def test_heic_of_high_dynamic_range_is_refused(tmp_path: Path) -> None:
    Fault(found="HLG").raised_by(
        decode_picture, tmp_path / "a.heic", heic(np.full((48, 64, 3), 0.5), 10, 1, profile=18)
    )
