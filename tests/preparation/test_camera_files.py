"""What cameras write beside the usual: exposures that differ, bits, mirrored mosaics, defects, and kinds of files."""

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
import tifffile
from camera_files import pack
from faults import Fault
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from polarguide.capture.calibration import Calibration
from polarguide.capture.checks import measured_gains, pair_moments
from polarguide.capture.develop import (
    BracketedShots,
    LinearShots,
    align_shots,
    estimate_shifts,
    exposures_of_view,
    stated_exposures,
)
from polarguide.capture.filter.camera_files import exif_data
from polarguide.capture.filter.encoding import (
    LOSSY,
    PLAIN,
    decide_transfer,
    slope_of_shots,
    stated_encoding,
    stated_transfer,
    transfer_of_pictures,
)
from polarguide.capture.filter.shots import Shots, read_stack, stacked
from polarguide.capture.formats.pictures import decode_mask, decode_picture
from polarguide.capture.sensor.demosaic import defects
from polarguide.capture.sensor.mosaics import PACKINGS, MosaicFiles, RawFormat, read_mosaic
from polarguide.capture.sensor.pattern import estimate_levels, sensor_pattern, tiled
from polarguide.optics.color import srgb_encode_array as srgb_encode
from polarguide.preparation.filter_source import SinglesSource
from polarguide.preparation.mosaic_source import MosaicSource
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings
from polarguide_shots.options import ShotOptions
from polarguide_shots.read import read_shot


def four(height=96, width=128):
    """Intensities [4, H, W] of light whose polarization differs in strength and direction."""
    y, x = np.mgrid[:height, :width] / 40.0
    s0 = 0.6 + 0.2 * np.sin(x + 2 * y)
    degree, angle = 0.25 + 0.2 * np.cos(y * 1.7), 1.3 * x + 0.9 * y
    return np.stack([s0 / 2 * (1 + degree * np.cos(2 * (angle - a))) for a in np.radians([0, 45, 90, 135])])


def test_pair_sums_measure_all_four_exposures():
    """Of every exposure, up to a common factor; and they name the one that EXIF is wrong about."""
    true = np.array([1.0, 1.25, 0.8, 0.9])
    light = four() * true[:, None, None]
    found = measured_gains(pair_moments(light, np.ones(light.shape[1:], bool)))
    assert np.exp(found.logs) == pytest.approx(true / true.prod() ** 0.25, rel=1e-3)
    assert found.pairing == 0
    assert found.deviating(np.log(true)) == {}
    assert set(found.deviating(np.log(true / [1, 1, 0.8, 1]))) == {90}
    swapped = measured_gains(pair_moments(light[[0, 2, 1, 3]], np.ones(light.shape[1:], bool)))
    assert swapped.pairing == 1


@pytest.mark.parametrize(
    ("tags", "iso"),
    [
        ({34855: 400}, 400),
        ({34855: 400, 34866: 800}, 400),
        ({34855: 65535, 34866: 102400}, 102400),
        ({34855: 65535, 34864: 1, 34865: 204800}, 204800),
        ({34855: 65535}, None),
        ({}, None),
    ],
)
def test_iso_beyond_its_tag_is_read_from_another(tags, iso):
    """65535 says that the number has more than 16 bits (EXIF 2.3)."""
    data, exif = io.BytesIO(), Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    Image.new("RGB", (8, 8)).save(data, "JPEG", exif=exif)
    assert exif_data(data.getvalue()).iso == iso


@pytest.mark.parametrize("stated", [(100, 100, 125, 100), (100, 80, 125, 90), (100, 100, 100, 100)])
def test_exposures_that_files_state_are_taken_back(tmp_path, stated):
    """The third row's files say that all are alike, and the pair sums that 90 degrees is not: a warning names it."""
    paths = []
    for angle, time in zip((0, 45, 90, 135), stated, strict=True):
        image = Image.new("RGB", (16, 16))
        exif = image.getexif()
        exif.get_ifd(0x8769)[0x829A] = IFDRational(1, time)
        paths.append(tmp_path / f"v_{angle}.jpg")
        image.save(paths[-1], exif=exif)
    light = stated_exposures({"v": paths}, lambda done: None)[0].get("v", [1.0] * 4)
    true = 1 / np.array(stated if light != [1.0] * 4 else (100, 100, 140, 100))
    gains, warning = exposures_of_view(
        [path.name for path in paths], four() * true[:, None, None] * 50, np.ones((96, 128), bool), light
    )
    assert np.array(gains) / gains[0] == pytest.approx(true / true[0], rel=2e-3)
    assert bool(warning) == (light == [1.0] * 4)
    assert not warning or ("v_90.jpg" in warning and "v_45.jpg" not in warning)


COLORS = np.random.default_rng(1).integers(0, 1 << 16, (12, 10, 3)).astype(np.uint16)
KINDS = {
    "lzw.tif": (COLORS, {"photometric": "rgb", "compression": "lzw", "predictor": True}),
    "planes.tif": (COLORS.transpose(2, 0, 1), {"photometric": "rgb", "planarconfig": "separate"}),
    "half.tif": ((COLORS / 65535).astype(np.float16), {"photometric": "rgb"}),
    "big.tif": (COLORS, {"photometric": "rgb", "byteorder": ">", "bigtiff": True}),
}


@pytest.mark.parametrize("name", KINDS)
def test_tiff_is_read_with_all_of_its_bits(tmp_path, name):
    values, how = KINDS[name]
    path = tmp_path / name
    tifffile.imwrite(path, values, **how)
    off = np.abs(decode_picture(path, path.read_bytes()).astype(int) - COLORS)
    assert off.max() <= (32 if "half" in name else 0)  # half precision has 11 bits


@pytest.mark.parametrize("bits", [8, 16])
def test_uncompressed_and_lossless_kinds(tmp_path, bits):
    full = (1 << bits) - 1
    values = (COLORS >> (16 - bits)).astype(">u2" if bits == 16 else "u1")
    path = tmp_path / "v.ppm"
    path.write_bytes(b"P6\n# a comment\n10 12\n%d\n" % full + values.tobytes())
    assert (decode_picture(path, path.read_bytes()) == values).all()
    if bits == 8:
        for kind in ("bmp", "webp"):
            Image.fromarray(values).save(tmp_path / f"v.{kind}", lossless=True)
            stored = (tmp_path / f"v.{kind}").read_bytes()
            assert (decode_picture(path, stored) == values).all()
            Fault(found="cut short").raised_by(decode_picture, path, stored[:-9])


REFUSED = {
    "four": (np.zeros((8, 8, 4), np.uint8), {"photometric": "minisblack"}, "4 samples"),
    "two": (np.zeros((8, 8, 2), np.uint8), {"photometric": "minisblack"}, "2 samples"),
    "ink": (np.zeros((8, 8, 4), np.uint8), {"photometric": "separated"}, "color model"),
    "signed": (np.zeros((8, 8), np.int16), {"photometric": "minisblack"}, "int16"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_samples_that_are_no_picture_are_refused(tmp_path, kind):
    values, how, found = REFUSED[kind]
    path = tmp_path / "v.tif"
    tifffile.imwrite(path, values, planarconfig="contig" if values.ndim == 3 else None, **how)
    Fault(found=found).raised_by(read_mosaic, path, RawFormat())


def test_transparent_gray_tiff_is_refused(tmp_path):
    path = tmp_path / "v.tif"
    alpha = {"photometric": "minisblack", "planarconfig": "contig", "extrasamples": ["unassalpha"]}
    tifffile.imwrite(path, np.zeros((8, 8, 2), np.uint8), **alpha)
    Fault(found="transparent").raised_by(decode_picture, path, path.read_bytes())


@pytest.mark.parametrize("levels", [(1, 2, 3), (80, 160, 240)])
def test_labels_of_objects_are_no_mask(tmp_path, levels):
    """The lower half of them would be taken for background; soft edges are none."""
    path = tmp_path / "v.png"
    discs = [np.hypot(*(np.mgrid[:60, :90] - np.array([[[30]], [[15 + 30 * k]]]))) < 9 for k in range(3)]
    cv2.imwrite(str(path), np.sum([d * v for d, v in zip(discs, levels, strict=True)], 0).astype(np.uint8))
    Fault(found=f"areas of {levels[0]} and a maximum of {levels[2]}").raised_by(
        decode_mask, path, path.read_bytes(), any_value=False
    )
    cv2.imwrite(str(path), cv2.GaussianBlur(np.any(discs, 0) * np.uint8(255), (0, 0), 3))
    off = decode_mask(path, path.read_bytes(), any_value=False) ^ np.any(discs, 0)
    assert off.mean() < 0.04


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_clipped_samples_tell_the_bits(bits):
    counts = np.zeros(1 << 16, np.int64)
    counts[100 : (1 << bits) - 1] = 2
    rest = (1 << bits) - 1, 0xFFFF, 16
    counts[rest[0]] = 500
    levels = estimate_levels(*rest, bits=None, black=0, saturation=None, counts=counts)
    assert (levels.bits, levels.white, levels.saturation) == (bits, rest[0], rest[0])


def mosaic(light, sensor="IMX250MZR"):
    """Intensities [4, H, W] as the sensor samples them."""
    places = tiled(sensor_pattern(sensor).angles, light.shape[1:]) // 45
    return np.take_along_axis(light, places[None], 0)[0]


@pytest.mark.parametrize("flip", ["x", "y", "xy"])
def test_mirrored_mosaics_are_turned_back(tmp_path, flip):
    values = np.rint(mosaic(four()) * 4095).astype(np.uint16)
    stored = values[:, ::-1] if "x" in flip else values
    np.save(tmp_path / "v.npy", stored[::-1] if "y" in flip else stored)
    files = MosaicFiles(PrepareSettings(sensor="IMX250MZR", flip=flip))
    assert (files.read(tmp_path / "v.npy") == values).all()


@pytest.mark.parametrize(("flip", "turns"), [("90", 1), ("270", 3)])
@pytest.mark.parametrize("sensor", ["IMX250MZR", "IMX250MYR"])
def test_mosaics_turned_by_a_quarter_are_turned_back(tmp_path, flip, turns, sensor):
    """They are developed as the sensor saw them; their size in headers is exchanged, too."""
    values = np.rint(mosaic(four(), sensor) * 4095).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "v.png"), np.ascontiguousarray(np.rot90(values, turns)))
    settings = PrepareSettings(sensor=sensor, flip=flip)
    assert (MosaicFiles(settings).read(tmp_path / "v.png") == values).all()
    stored = MosaicSource(tmp_path, settings).stored("v")
    assert (stored.size, stored.developed) == ((128, 96), (64, 48))


def test_a_mosaic_larger_than_the_sensor_is_refused(tmp_path):
    np.save(tmp_path / "v.npy", np.random.default_rng(0).integers(0, 4096, (2100, 2500), np.uint16))
    fault = Fault(str(tmp_path / "v.npy"), expected="2464x2056", found="2500x2100", remedy="--sensor")
    settings = PrepareSettings(sensor="IMX250MZR", poses="none")
    fault.raised_by(prepare_scene, tmp_path, tmp_path / "out", settings)
    fault.raised_by(read_shot, tmp_path / "v.npy", ShotOptions(sensor="IMX250MZR"))


def test_gains_of_a_calibration_are_not_measured_again():
    """Pair sums would take them for exposures, and the pictures would be divided by both."""
    gains = np.array([1.0, 1.15, 1.0, 1.0])
    light = np.repeat((0.6 * four() * gains[:, None, None])[..., None], 3, axis=3)
    shots = LinearShots.of(
        BracketedShots.single(stacked(np.rint(light * 65535).astype(np.uint16))), "linear", align=False
    )
    names = ["a", "b", "c", "d"]
    for calibration, exposures in ((Calibration(), gains), (Calibration(gains=(1, 1.15, 1, 1)), np.ones(4))):
        values, found, _ = shots.evenly_exposed(names, [1.0] * 4, PrepareSettings(calibration=calibration))
        assert np.ptp(np.log(found) - np.log(exposures)) < 1e-2
        assert values == pytest.approx(light / np.array(found)[:, None, None, None], rel=1e-3)


def test_a_whole_sensor_that_stands_upright_is_refused(tmp_path):
    np.save(tmp_path / "v.npy", np.random.default_rng(0).integers(0, 4096, (2448, 2048), np.uint16))
    fault = Fault(found="2048x2448", remedy="--flip 90")
    fault.raised_by(MosaicFiles(PrepareSettings(sensor="IMX250MZR")).read, tmp_path / "v.npy")
    fault.raised_by(read_shot, tmp_path / "v.npy", ShotOptions(sensor="IMX250MZR"))
    assert MosaicFiles(PrepareSettings(sensor="IMX253MZR")).read(tmp_path / "v.npy").shape == (2448, 2048)


@pytest.mark.parametrize(
    ("stored", "asked"),
    [("12p", "12packed"), ("12packed", "12p"), ("12mipi", "12packed"), ("10mipi", "10p"), ("16be", "16")],
)
def test_wrong_packing_is_refused(tmp_path, stored, asked):
    values = np.rint(mosaic(four()) * ((1 << PACKINGS[stored][2]) - 1)).astype(np.uint16)
    path = tmp_path / "v.raw"
    path.write_bytes(pack(values, stored))
    assert (read_mosaic(path, RawFormat(128, 96, stored)) == values).all()
    Fault(remedy=f"--packing {stored}").raised_by(read_mosaic, path, RawFormat(128, 96, asked))


def test_four_pictures_side_by_side_are_no_mosaic(tmp_path):
    """What viewers of polarization cameras show, of one view, behind 0 and 45, 90 and 135 degrees, with noise."""
    rng = np.random.default_rng(4)
    texture = 0.5 + 8 * (cv2.GaussianBlur(rng.random((192, 256)), (0, 0), 3) - 0.5)
    light = four(192, 256) * np.clip(texture, 0.05, 1)
    small = light[:, ::2, ::2]
    for name, picture in (
        ("quarters", np.block([[small[0], small[1]], [small[2], small[3]]])),
        ("mosaic", mosaic(light)),
    ):
        noisy = rng.poisson(np.clip(picture, 0, 1) * 4095)
        np.save(tmp_path / f"{name}.npy", np.minimum(noisy, 4095).astype(np.uint16))
    assert read_mosaic(tmp_path / "mosaic.npy", RawFormat()).shape == (192, 256)
    Fault(found="four times").raised_by(read_mosaic, tmp_path / "quarters.npy", RawFormat())


def test_hot_pixels_are_found_and_noise_is_not():
    rng = np.random.default_rng(2)
    hot = rng.random((96, 128)) < 0.003
    views = [mosaic(np.roll(four(), 7 * k, axis=2)) * 4095 + rng.normal(0, 8, hot.shape) for k in range(3)]
    assert defects(views, 2).sum() == 0
    found = defects([view + 800 * hot for view in views], 2)
    assert found[hot].mean() > 0.8  # one beside another may be missed
    assert not found[~hot].any()


@pytest.mark.filterwarnings("error")
def test_hot_pixels_are_found_on_black():
    rng = np.random.default_rng(3)
    hot = rng.random((96, 128)) < 0.003
    black = [64.0 + rng.integers(0, 3, hot.shape) for _ in range(3)]
    assert defects(black, 2).sum() == 0
    found = defects([view + 800 * hot for view in black], 2)
    assert found[hot].mean() > 0.8
    assert not found[~hot].any()


def test_a_turned_camera_is_turned_back():
    """By 0.4 degrees about the middle, from shot to shot."""
    texture = cv2.GaussianBlur(np.random.default_rng(3).random((160, 200)), (0, 0), 1.5) * 2
    light = np.clip(four(160, 200) * (0.2 + texture), 0, 1).astype(np.float32)
    matrices = [cv2.getRotationMatrix2D((100, 80), 0.4 * k, 1.0) for k in range(4)]
    shots = np.stack(
        [
            cv2.warpAffine(shot, matrix, (200, 160), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
            for shot, matrix in zip(light, matrices, strict=True)
        ]
    )
    stack = np.repeat(shots[..., None], 3, axis=3)
    motions = estimate_shifts(stack)
    turns = [np.degrees(np.arcsin(motion.warp[1])) for motion in motions[1:]]
    assert turns == pytest.approx([0.4, 0.8, 1.2], abs=0.06)
    moved, _, outside = align_shots(stack, (), motions)
    off = np.abs(moved[..., 0] - light)[:, ~outside]
    assert np.median(off) < 0.3 * np.median(np.abs(shots - light))


def s15(number):
    return struct.pack(">i", round(number * 65536))


def profile(kind, *numbers):
    """An ICC profile with one curve: curveType of one exponent or of none, or parametricCurveType."""
    curve = kind + bytes(4)
    if kind == b"curv":
        curve += struct.pack(">I", len(numbers)) + b"".join(
            struct.pack(">H", round(n * 256)) for n in numbers
        )
    else:
        form = {1: 0, 3: 1, 4: 2, 5: 3, 7: 4}[len(numbers)]
        curve += struct.pack(">Hxx", form) + b"".join(map(s15, numbers))
    white = (0.9642, 1.0, 0.8249)
    colors = {
        b"rXYZ": (0.4361, 0.2225, 0.0139),
        b"gXYZ": (0.3851, 0.7169, 0.0971),
        b"bXYZ": (0.1431, 0.0606, 0.7139),
        b"wtpt": white,
    }
    tags = {name: b"XYZ " + bytes(4) + b"".join(map(s15, xyz)) for name, xyz in colors.items()}
    tags |= dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve + bytes(-len(curve) % 4))
    at, entries = 132 + 12 * len(tags), b""
    for name, content in tags.items():
        entries += struct.pack(">4sII", name, at, len(content))
        at += len(content)
    head = struct.pack(">I4xI4s4s4s", at, 0x02400000, b"mntr", b"RGB ", b"XYZ ").ljust(36, b"\0") + b"acsp"
    head = (head.ljust(68, b"\0") + b"".join(map(s15, white))).ljust(128, b"\0")
    return head + struct.pack(">I", len(tags)) + entries + b"".join(tags.values())


SRGB = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg", ".webp"])
@pytest.mark.parametrize(
    ("curve", "exponent"),
    [
        (profile(b"curv", 1.8), 1.8),
        (profile(b"curv"), 1.0),
        (profile(b"para", 2.2), 2.2),
        (profile(b"para", *SRGB), 2.224),
        (profile(b"para", *SRGB, 0.0, 0.0), 2.224),
        (None, None),
    ],
)
def test_profiles_state_how_a_picture_is_encoded(tmp_path, suffix, curve, exponent):
    path = tmp_path / f"v{suffix}"
    Image.new("RGB", (16, 16), (90, 120, 60)).save(path, **({} if curve is None else {"icc_profile": curve}))
    found = stated_encoding(path.read_bytes())
    assert (found and found.exponent) == (None if exponent is None else pytest.approx(exponent, abs=0.01))
    if exponent == 1.8:
        Fault(str(path), found="1.80").raised_by(stated_transfer, [path])
    else:
        known = None if exponent is None else "linear" if exponent == 1 else "srgb"
        assert (stated_transfer([path]) or (None,))[0] == known


def test_damaged_profiles_state_nothing():
    whole = profile(b"para", *SRGB)
    image = io.BytesIO()
    Image.new("RGB", (16, 16)).save(image, "JPEG", icc_profile=whole)
    data, at = image.getvalue(), image.getvalue().index(whole)
    for place in range(at + 36, at + len(whole), 3):
        found = stated_encoding(data[:place] + b"\xff" + data[place + 1 :])
        assert found is None or found.exponent > 0


def decided(pictures, kind=LOSSY):
    """The transfer that is decided for four gray pictures [4, H, W] in [0, 1] without a statement."""
    codes = np.rint(np.clip(pictures, 0, 1) * 65535).astype(np.uint16)
    stack, none = np.repeat(codes[..., None], 3, axis=3), np.zeros(codes.shape, bool)
    slope = slope_of_shots([Shots(stack, 1, none, none[0])], [(0, 45, 90, 135)])
    return decide_transfer(kind, None, eight=False, slope=slope)


@pytest.mark.parametrize(
    ("encode", "transfer", "doubtful"),
    [
        (lambda light: light, "linear", False),
        (srgb_encode, "srgb", False),
        (lambda light: srgb_encode(light) ** 1.6, "srgb", True),
        (lambda light: light ** (1 / 1.5), "srgb", True),
        (lambda light: 1.099 * (light / 3) ** 0.45 - 0.099, "srgb", True),
        (lambda light: light**1.1, "linear", False),
        (lambda light: light**1.5, "linear", True),
        (lambda light: light**2.2, "linear", True),
    ],
)
@pytest.mark.parametrize("exposures", [(1, 1, 1, 1), (1, 0.8, 1, 1)])
def test_a_tone_curve_that_is_neither_is_doubted(encode, transfer, doubtful, exposures):
    """Also one that bends upward, as of linear light that a program took for sRGB; and the curve of BT.709 in the dark,
    which puts DoLP off by a fifth.
    """
    found = decided(encode(four() * np.reshape(exposures, (4, 1, 1))))
    assert (found.transfer, bool(found.doubt)) == (transfer, doubtful)


@pytest.mark.parametrize(("encode", "transfer"), [(lambda light: light, "linear"), (srgb_encode, "srgb")])
@pytest.mark.parametrize("times", [(100, 100, 100, 100), (100, 50, 100, 100), (200, 100, 50, 100)])
@pytest.mark.parametrize("stating", [True, False])
def test_the_encoding_is_measured_whatever_the_exposures(tmp_path, encode, transfer, times, stating):
    """Whether files state them (EXIF) or not, as after editing."""
    paths = []
    for angle, light, time in zip((0, 45, 90, 135), four(), times, strict=True):
        image = Image.fromarray(np.rint(encode(light * 50 / time) * 255).astype(np.uint8))
        exif = image.getexif()
        if stating:
            exif.get_ifd(0x8769)[0x829A] = IFDRational(1, time)
        paths.append(tmp_path / f"v_{angle}.jpg")
        image.save(paths[-1], quality=100, exif=exif)
    found = transfer_of_pictures(paths, "auto", lambda: [(read_stack(paths), (0, 45, 90, 135))])
    assert (found.transfer, found.doubt) == (transfer, "")
    assert "curvature" in found.note


@pytest.mark.parametrize("encode", [lambda light: light, srgb_encode])
@pytest.mark.parametrize("exposures", [(1, 1, 1, 1), (1, 0.8, 1, 1)])
def test_one_direction_of_polarization_does_not_mislead(encode, exposures):
    """Exposures and polarization of one direction look alike: the pictures tell the right encoding, or none."""
    y, x = np.mgrid[:96, :128] / 40.0
    angles = np.radians([0, 45, 90, 135])
    degree = 0.25 + 0.2 * np.cos(y * 1.7)
    light = np.stack([(0.6 + 0.2 * np.sin(x)) / 2 * (1 + degree * np.cos(2 * (0.3 - a))) for a in angles])
    found = decided(encode(light * np.reshape(exposures, (4, 1, 1))))
    told = "curvature" in found.note
    assert found.transfer == ("linear" if told and encode is not srgb_encode else "srgb")
    assert found.doubt == ""


def test_light_that_drifts_from_place_to_place_is_no_tone_curve():
    """A lamp that moved between the shots: bright and dark sums agree nowhere, and no two parts say one curvature."""
    y, x = np.mgrid[:96, :128]
    moved = 1 + 0.1 * np.sin(x / 9.0) * np.cos(y / 7.0)
    found = decided(four() * np.stack([np.ones_like(moved), moved, np.ones_like(moved), moved]), PLAIN)
    assert (found.transfer, found.doubt) == ("linear", "")


def _stating(folder, kind, values, full):
    """A file that states the full scale of gray ``values``, in one of four ways."""
    path = folder / f"v.{kind}"
    if kind == "pgm":
        head = b"P5\n%d %d\n%d\n" % (values.shape[1], values.shape[0], full)
        path.write_bytes(head + values.astype(">u2" if full > 255 else "u1").tobytes())
    elif kind == "tif":
        tifffile.imwrite(path, values, extratags=[(281, "H", 1, full, True)], metadata=None)
    else:
        chunk = b"sBIT" + bytes([full.bit_length()])
        data = cv2.imencode(".png", values)[1].tobytes()
        body = struct.pack(">I", 1) + chunk + struct.pack(">I", zlib.crc32(chunk))
        path.write_bytes(data[:33] + body + data[33:])
    return path


@pytest.mark.parametrize(
    ("kind", "full"),
    [("pgm", 127), ("pgm", 1023), ("pgm", 16383), ("tif", 1023), ("tif", 127), ("png", 1023), ("png", 63)],
)
def test_the_full_scale_that_a_file_states_is_used(tmp_path, kind, full):
    """In mosaics and photographs, values at full scale are saturated, and the others are shares of it."""
    ramp = np.random.default_rng(3).permutation(np.linspace(1, full, 64 * 64)).reshape(64, 64)
    values = ramp.round().astype(np.uint8 if full < 256 else np.uint16)
    path = _stating(tmp_path, kind, values, full)
    picture = decode_picture(path, path.read_bytes())
    assert picture[..., 0] / np.iinfo(picture.dtype).max == pytest.approx(values / full, abs=2e-3)
    settings = PrepareSettings(sensor="IMX250MZR", poses="none", gains="none", calibration=Calibration())
    source = MosaicSource(tmp_path, settings)
    measured = source.measure(lambda done: None)
    assert (measured.levels.white, measured.levels.saturation) == (full, full)
    assert f"{full} is full scale" in measured.notes[-1]
    shot = read_shot(path, ShotOptions(sensor="IMX250MZR"))
    assert any("full scale" in note for note in shot.notes)


def test_significant_bits_of_png_may_be_at_the_top(tmp_path):
    """As the standard has them: ten of sixteen bits, the lowest six empty or copies of the highest."""
    ramp = np.random.default_rng(3).permutation(np.linspace(1, 1023, 64 * 64)).reshape(64, 64)
    values = ramp.round().astype(np.uint16)
    for name, stored in (("empty", values << 6), ("copies", values << 6 | values >> 4)):
        folder = tmp_path / name
        folder.mkdir()
        path = _stating(folder, "png", stored, 1023)
        assert decode_picture(path, path.read_bytes())[..., 0] / 65535 == pytest.approx(
            values / 1023, abs=2e-3
        )
        settings = PrepareSettings(sensor="IMX250MZR")
        levels = MosaicSource(folder, settings).measure(lambda done: None).levels
        assert levels.saturation == 65472


def test_full_scales_that_contradict_one_another_or_the_values_are_refused(tmp_path):
    values = np.full((64, 64), 1000, np.uint16)
    path = _stating(tmp_path, "pgm", values, 511)
    Fault(str(path), found="1000", expected="511").raised_by(decode_picture, path, path.read_bytes())
    _stating(tmp_path, "pgm", values, 1023)
    (tmp_path / "w.png").write_bytes(cv2.imencode(".png", values)[1].tobytes())
    source = MosaicSource(tmp_path, PrepareSettings(sensor="IMX250MZR"))
    Fault(str(tmp_path / "w.png"), found="no full scale").raised_by(source.measure, lambda done: None)


TIME, F_NUMBER, ISO = 0x829A, 0x829D, 0x8827
EXPOSED = {TIME: IFDRational(1, 100), F_NUMBER: IFDRational(8, 1), ISO: 400}


def exposed(path, **changes):
    """A picture that states its exposure, with some tags changed, or left out where None."""
    image = Image.new("RGB", (16, 16), (90, 90, 90))
    exif = image.getexif()
    tags = {**EXPOSED, **{globals()[name]: value for name, value in changes.items()}}
    exif.get_ifd(0x8769).update({tag: value for tag, value in tags.items() if value is not None})
    image.save(path, exif=exif)
    return path


@pytest.mark.parametrize("name", ["TIME", "F_NUMBER", "ISO"])
@pytest.mark.parametrize("value", [None, 0])
def test_a_tag_that_one_file_of_several_lacks_corrects_nothing(tmp_path, name, value):
    """It does not count as f/1, ISO 100, or as no exposure of this file alone; of all files alike, it is equal."""
    files = [exposed(tmp_path / f"cup_a{angle}.jpg") for angle in (0, 60, 120)]
    value = IFDRational(0, 1) if value == 0 and name != "ISO" else value
    exposed(files[1], **{name: value})
    gains, missing = stated_exposures({"cup": files[:1], "other": files[1:]})
    assert not gains
    assert "1 of 3 files have no" in missing
    assert "not corrected by EXIF" in missing
    assert missing in read_shot(tmp_path, ShotOptions()).notes
    measured = SinglesSource(tmp_path, PrepareSettings(poses="none")).measure(lambda done: None)
    assert (measured.light, measured.notes[-1]) == ({}, missing)
    for path, time in zip(files, (100, 100, 50), strict=True):
        exposed(path, **{"TIME": IFDRational(1, time), name: value})
    gains, missing = stated_exposures({"cup": files})
    assert missing == ""
    assert gains == (
        {} if name == "TIME" else {"cup": pytest.approx([2 ** (-1 / 3), 2 ** (-1 / 3), 2 ** (2 / 3)])}
    )
