"""What cameras write beside the usual: exposures that differ, bits, mirrored mosaics, defects, and kinds of files."""

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from polarguide.capture.filter.develop import align_shots, estimate_shifts
from polarguide.capture.formats.pictures import decode_mask, decode_picture
from polarguide.capture.pair_sums import measured_gains, pair_moments
from polarguide.capture.sensor.defects import defects
from polarguide.capture.sensor.pattern import estimate_levels, sensor_pattern, tiled
from polarguide.capture.sensor.raw_file import RawFormat, read_mosaic
from polarguide.core.errors import PolarguideError
from polarguide.preparation.mosaic_source import MosaicFiles
from polarguide.preparation.settings import PrepareSettings
from polarguide.preparation.shot_exposures import exposures_of_view, stated_exposures


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
    light = stated_exposures({"v": paths}, lambda done: None).get("v", [1.0] * 4)
    true = 1 / np.array(stated if light != [1.0] * 4 else (100, 100, 140, 100))
    found = exposures_of_view(paths, four() * true[:, None, None] * 50, np.ones((96, 128), bool), light)
    assert np.array(found.gains) / found.gains[0] == pytest.approx(true / true[0], rel=2e-3)
    assert bool(found.warning) == (light == [1.0] * 4)
    assert not found.warning or ("v_90.jpg" in found.warning and "v_45.jpg" not in found.warning)


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
            with pytest.raises(PolarguideError, match="cut short"):
                decode_picture(path, stored[:-9])


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
    with pytest.raises(PolarguideError) as caught:
        read_mosaic(path, RawFormat())
    assert found in caught.value.found


def test_transparent_gray_tiff_is_refused(tmp_path):
    path = tmp_path / "v.tif"
    alpha = {"photometric": "minisblack", "planarconfig": "contig", "extrasamples": ["unassalpha"]}
    tifffile.imwrite(path, np.zeros((8, 8, 2), np.uint8), **alpha)
    with pytest.raises(PolarguideError) as caught:
        decode_picture(path, path.read_bytes())
    assert "transparent" in caught.value.found


@pytest.mark.parametrize("levels", [(1, 2, 3), (80, 160, 240)])
def test_labels_of_objects_are_no_mask(tmp_path, levels):
    """The lower half of them would be taken for background; soft edges are none."""
    path = tmp_path / "v.png"
    discs = [np.hypot(*(np.mgrid[:60, :90] - np.array([[[30]], [[15 + 30 * k]]]))) < 9 for k in range(3)]
    cv2.imwrite(str(path), np.sum([d * v for d, v in zip(discs, levels, strict=True)], 0).astype(np.uint8))
    with pytest.raises(PolarguideError) as caught:
        decode_mask(path, path.read_bytes(), any_value=False)
    assert f"areas of {levels[0]} beside a maximum of {levels[2]}" in caught.value.found
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


def test_wrong_packing_is_refused(tmp_path):
    values = np.rint(mosaic(four()) * 4095).astype(np.uint16).reshape(-1, 2)
    packed = np.stack(
        [values[:, 0] & 255, values[:, 0] >> 8 | (values[:, 1] & 15) << 4, values[:, 1] >> 4], 1
    )
    path = tmp_path / "v.raw"
    path.write_bytes(packed.astype(np.uint8).tobytes())
    assert (read_mosaic(path, RawFormat(128, 96, "12p")).reshape(-1, 2) == values).all()
    with pytest.raises(PolarguideError) as caught:
        read_mosaic(path, RawFormat(128, 96, "12packed"))
    assert "12p" in caught.value.remedy


def test_hot_pixels_are_found_and_noise_is_not():
    rng = np.random.default_rng(2)
    hot = rng.random((96, 128)) < 0.003
    views = [mosaic(np.roll(four(), 7 * k, axis=2)) * 4095 + rng.normal(0, 8, hot.shape) for k in range(3)]
    assert defects(views, 2).sum() == 0
    found = defects([view + 800 * hot for view in views], 2)
    assert found[hot].mean() > 0.8  # one beside another may be missed
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
    moved, bad = align_shots(stack, np.zeros(stack.shape[:3], bool), motions)
    off = np.abs(moved[..., 0] - light)[:, ~bad.any(axis=0)]
    assert np.median(off) < 0.3 * np.median(np.abs(shots - light))
