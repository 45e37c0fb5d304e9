"""Encodings that files state, that the light tells, or that 8 bits imply."""

import struct
import subprocess
import zlib
from pathlib import Path

import cv2
import imageio_ffmpeg
import numpy as np
import pytest
import tifffile
from faults import Fault
from PIL import Image, ImageCms

from polarguide.capture.filter.encoding import stated_encoding, stated_transfer, stated_video_transfer
from polarguide.core.errors import PolarguideError, PolarguideWarning
from polarguide.optics.color import srgb_encode_array as srgb_encode
from polarguide.preparation.filter_source import SinglesSource
from polarguide.preparation.settings import PrepareSettings
from polarguide_shots.options import ShotOptions
from polarguide_shots.read import read_shot

SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def light(angles, height=96, width=128):
    """Intensities [K, H, W] of light whose polarization differs in strength and direction, and its DoLP [H, W]."""
    y, x = np.mgrid[:height, :width] / 40.0
    s0 = 0.6 + 0.2 * np.sin(x + 2 * y)
    degree, angle = 0.25 + 0.2 * np.cos(y * 1.7), 1.3 * x + 0.9 * y
    rows = [s0 / 2 * (1 + degree * np.cos(2 * (angle - a))) for a in np.radians(angles)]
    return np.stack(rows), degree


def write(path: Path, picture, bits=8):
    """Gray intensities [H, W] as an RGB file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    codes = np.rint(picture * (2**bits - 1)).astype(f"u{bits // 8}")
    cv2.imwrite(str(path), np.repeat(codes[..., None], 3, axis=2))
    return path


def with_chunk(path: Path, kind: bytes, content: bytes):
    """The PNG file with one more chunk behind its header."""
    data = path.read_bytes()
    chunk = struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
    path.write_bytes(data[:33] + chunk + data[33:])
    return path


def measured(folder: Path, **options):
    """What ``prepare`` finds of a folder of photographs."""
    return SinglesSource(folder, PrepareSettings(poses="none", **options)).measure(lambda done: None)


@pytest.mark.parametrize(
    ("kind", "content", "transfer"),
    [
        (b"sRGB", b"\0", "srgb"),
        (b"gAMA", struct.pack(">I", 45455), "srgb"),
        (b"gAMA", struct.pack(">I", 100000), "linear"),
        (b"cICP", bytes([1, 13, 0, 1]), "srgb"),
        (b"cICP", bytes([9, 8, 0, 1]), "linear"),
        (b"iCCP", b"icc\0\0" + zlib.compress(SRGB), "srgb"),
        (b"tEXt", b"Comment\0none", None),
    ],
)
@pytest.mark.parametrize("bits", [8, 16])
def test_chunks_of_png_state_the_encoding(tmp_path, kind, content, transfer, bits):
    path = with_chunk(write(tmp_path / "v.png", light([0])[0][0], bits), kind, content)
    stated = stated_transfer([path])
    assert (stated and stated[0]) == transfer
    assert measured(tmp_path, angles="none").transfer == (transfer or {8: "srgb", 16: "linear"}[bits])


@pytest.mark.parametrize(
    ("kind", "content", "found"),
    [
        (b"cICP", bytes([9, 16, 0, 1]), "PQ"),
        (b"cICP", bytes([9, 18, 0, 1]), "HLG"),
        (b"cICP", bytes([1, 9, 0, 1]), "number 9"),
        (b"cICP", bytes([1, 13, 0, 0]), "narrow range"),
        (b"gAMA", struct.pack(">I", 55556), "1.80"),
    ],
)
def test_other_encodings_of_png_are_refused(tmp_path, kind, content, found):
    path = with_chunk(write(tmp_path / "v.png", light([0])[0][0]), kind, content)
    Fault(str(path), found=found).raised_by(measured, tmp_path, angles="none")
    assert measured(tmp_path, angles="none", transfer="srgb").transfer == "srgb"


@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg", ".webp"])
def test_profiles_state_the_encoding(tmp_path, suffix):
    path = tmp_path / f"v{suffix}"
    Image.fromarray(np.full((16, 16, 3), 90, np.uint8)).save(path, icc_profile=SRGB)
    assert stated_transfer([path]) == ("srgb", "a color profile (ICC)")


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("colors", [1, 3])
@pytest.mark.parametrize(("exponent", "transfer"), [(1.0, "linear"), (2.2, "srgb"), (1.8, None)])
def test_transfer_functions_of_tiff_state_the_encoding(tmp_path, bits, colors, exponent, transfer):
    """One curve, or one for each color; and a profile beside it goes first."""
    path = tmp_path / "v.tif"
    curve = np.rint(65535 * np.linspace(0, 1, 1 << bits) ** exponent).astype(int)
    tag = (301, "H", colors * len(curve), tuple(curve.tolist()) * colors, True)
    picture = np.full((16, 16, 3), 90, f"u{bits // 8}")
    tifffile.imwrite(path, picture, photometric="rgb", extratags=[tag], metadata=None)
    assert stated_encoding(path.read_bytes()).exponent == pytest.approx(exponent, abs=0.02)
    if transfer is None:
        Fault(str(path), found="a TransferFunction, gamma 1.80").raised_by(stated_transfer, [path])
    else:
        assert stated_transfer([path]) == (transfer, "a TransferFunction")
    profile = (34675, "B", len(SRGB), SRGB, True)
    tifffile.imwrite(path, picture, photometric="rgb", extratags=[profile, tag], metadata=None)
    assert stated_transfer([path]) == ("srgb", "a color profile (ICC)")


def test_more_specific_statements_go_first(tmp_path):
    """As the standard of PNG orders them: cICP, ICC, sRGB, gAMA."""
    path = with_chunk(write(tmp_path / "v.png", light([0])[0][0]), b"gAMA", struct.pack(">I", 100000))
    for kind, content in ((b"sRGB", b"\0"), (b"iCCP", b"icc\0\0" + zlib.compress(SRGB))):
        with_chunk(path, kind, content)
        assert stated_encoding(path.read_bytes()).exponent == pytest.approx(2.2, abs=0.05)
    with_chunk(path, b"cICP", bytes([1, 8, 0, 1]))
    assert stated_encoding(path.read_bytes()).exponent == 1.0


def test_pictures_that_state_different_encodings_are_refused(tmp_path):
    first = write(tmp_path / "a.png", light([0])[0][0])
    second = with_chunk(write(tmp_path / "b.png", light([0])[0][0]), b"sRGB", b"\0")
    Fault(found="without a stated encoding").raised_by(stated_transfer, [first, second])
    with_chunk(first, b"gAMA", struct.pack(">I", 100000))
    Fault(str(second), found="srgb").raised_by(stated_transfer, [first, second])


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tif"])
def test_photographs_of_8_bits_are_srgb(tmp_path, suffix):
    for number in range(2):
        write(tmp_path / f"v{number}{suffix}", srgb_encode(light([0])[0][0]))
    found = measured(tmp_path, angles="none")
    assert found.transfer == "srgb"
    assert sum("Transfer srgb, as 8-bit" in note for note in found.notes) == 1


SIX, THREE = (10, 40, 70, 100, 130, 160), (0, 60, 120)


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".jpg"])
@pytest.mark.parametrize("encode", [srgb_encode, lambda light: light])
def test_pairs_at_right_angles_tell_the_encoding(tmp_path, suffix, encode):
    """Any set with two pairs is enough: three pairs of six angles, in ``priors`` and in ``prepare``."""
    pictures, degree = light(SIX)
    for angle, picture in zip(SIX, pictures, strict=True):
        write(tmp_path / f"cup_a{angle}{suffix}", encode(picture))
    maps = read_shot(tmp_path, ShotOptions())
    assert np.median(np.abs(maps.dolp - degree)) < 0.01
    assert measured(tmp_path).transfer == ("srgb" if encode is srgb_encode else "linear")


def test_three_angles_of_8_bits_are_linear_with_a_warning(tmp_path):
    """Nothing tells: they have no pair at right angles. A statement does."""
    for angle, picture in zip(THREE, light(THREE)[0], strict=True):
        write(tmp_path / f"cup_a{angle}.png", srgb_encode(picture))
    with pytest.warns(PolarguideWarning, match="state no encoding"):
        assert measured(tmp_path).transfer == "linear"
    assert any("state no encoding" in note for note in read_shot(tmp_path, ShotOptions()).notes)
    for path in tmp_path.iterdir():
        with_chunk(path, b"sRGB", b"\0")
    assert measured(tmp_path).transfer == "srgb"


def test_pair_sums_are_believed_against_a_statement(tmp_path):
    """Some programs write gAMA into every file, linear ones, too."""
    for angle, picture in zip(SIX, light(SIX)[0], strict=True):
        with_chunk(write(tmp_path / f"cup_a{angle}.png", picture), b"gAMA", struct.pack(">I", 45455))
    with pytest.warns(PolarguideWarning, match="state srgb .a gAMA chunk"):
        assert measured(tmp_path).transfer == "linear"


@pytest.mark.parametrize(
    ("codec", "transfer", "stated"),
    [
        ("libx264", "bt709", "srgb"),
        ("libx264", "bt2020-10", "srgb"),
        ("libx264", "linear", "linear"),
        ("libx264", None, None),
        ("libx265", "arib-std-b67", PolarguideError),
        ("libx265", "smpte2084", PolarguideError),
        ("libx264", "bt470bg", PolarguideError),
        ("libx264", "smpte428", PolarguideError),
        ("libx264", "log100", PolarguideError),
        ("libx264", "log316", PolarguideError),
    ],
)
def test_videos_state_their_transfer(tmp_path, codec, transfer, stated):
    """Logarithmic ones, too, which ffmpeg does not convert, and those of cinema."""
    path = tmp_path / "turn.mp4"
    named = "" if transfer is None else f":transfer={transfer}"
    options = [f"-{codec.removeprefix('lib')}-params", f"log-level=error{named}"]
    run = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-f", "lavfi", "-i", "color=gray:s=64x48:d=0.5"]
    subprocess.run([*run, "-c:v", codec, *options, str(path)], check=True)
    if stated is PolarguideError:
        Fault(str(path), found=f"transfer {transfer}").raised_by(stated_video_transfer, path)
    else:
        assert (stated_video_transfer(path) or (None,))[0] == stated
