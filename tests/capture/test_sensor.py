"""Raw mosaics of polarization sensors: files, color filters, demosaicing."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from camera_files import COLOR, MONO, behind, busy_light, mosaic, pack, smooth_light, write_mosaic
from faults import Fault

from polarguide.capture.sensor.demosaic import DEMOSAIC_MODES, DemosaicedPicture, demosaic
from polarguide.capture.sensor.mosaics import (
    PACKINGS,
    RawFormat,
    packed_size,
    read_mosaic,
    sample_blocks,
    unpack,
)
from polarguide.capture.sensor.pattern import (
    SENSORS,
    SIDE,
    MosaicOptions,
    color_filters,
    estimate_levels,
    sensor_pattern,
    unusable_samples,
)
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings
from polarguide_shots.calibration.settings import CalibrateSettings
from polarguide_shots.options import ShotOptions
from polarguide_synth.settings import SynthSettings


@pytest.mark.parametrize("packing", PACKINGS)
@pytest.mark.parametrize(("width", "height"), [(8, 4), (7, 3), (5, 1)])
def test_packings_round_trip(packing: str, width: int, height: int) -> None:
    values = np.random.default_rng(0).integers(0, 2 ** PACKINGS[packing][2], (height, width))
    data = pack(values, packing)
    assert len(data) == packed_size(width, height, packing)
    np.testing.assert_array_equal(unpack(data, width, height, packing), values)


def test_packings_of_equal_size_differ_in_their_bytes() -> None:
    # 0xABC and 0x123, by the words of the two standards.
    np.testing.assert_array_equal(unpack(b"\xbc\x3a\x12", 2, 1, "12p"), [[0xABC, 0x123]])
    np.testing.assert_array_equal(unpack(b"\xab\x3c\x12", 2, 1, "12packed"), [[0xABC, 0x123]])
    np.testing.assert_array_equal(unpack(b"\xab\x12\x3c", 2, 1, "12mipi"), [[0xABC, 0x123]])
    np.testing.assert_array_equal(unpack(b"\xff\x03\x00\x00\xc0", 4, 1, "10p"), [[1023, 0, 0, 768]])
    np.testing.assert_array_equal(unpack(b"\xff\x00\x00\xc0\x43", 4, 1, "10mipi"), [[1023, 0, 0, 769]])
    np.testing.assert_array_equal(unpack(b"\xff\x23\xc0", 2, 1, "10packed"), [[1023, 770]])


@pytest.mark.parametrize(
    ("name", "bits"),
    [("a.png", 8), ("a.png", 16), ("a.tif", 8), ("a.tiff", 16), ("a.npy", 8), ("a.npy", 16)],
)
def test_files_that_know_their_size(tmp_path: Path, name: str, bits: int) -> None:
    values = np.random.default_rng(1).uniform(0, 1, (6, 8))
    write_mosaic(tmp_path / name, values, bits=bits)
    stored = read_mosaic(tmp_path / name, RawFormat())
    assert stored.dtype == (np.uint8 if bits == 8 else np.uint16)
    np.testing.assert_array_equal(stored, np.rint(values * (2**bits - 1)))


@pytest.mark.parametrize(
    ("sensor", "rows"), [("IMX250MYR", COLOR), ("IMX264MYR", COLOR), ("IMX250MZR", MONO)]
)
def test_patterns_and_their_offsets(sensor: str, rows: tuple[str, ...]) -> None:
    pattern = sensor_pattern(sensor)
    assert tuple(pattern.rows()) == rows
    period = len(rows)
    for x in range(6):
        for y in range(6):
            moved = [row.split() for row in pattern.shifted(x, y).rows()]
            first = [row.split() for row in rows]
            for row in range(period):
                for column in range(period):
                    assert moved[row][column] == first[(row + y) % period][(column + x) % period]
            assert pattern.shifted(x, y).cell_corner() == ((x % 2, y % 2) if period == 4 else (0, 0))


@pytest.mark.parametrize("settings", [PrepareSettings, ShotOptions, CalibrateSettings])
def test_a_sensor_is_named_in_any_case(settings: type[MosaicOptions]) -> None:
    for name in SENSORS:
        assert settings(sensor=name.lower()).checked().sensor == name  # type: ignore[arg-type, attr-defined]
    unknown = Fault("--sensor", found="'imx'", expected="TRI050S-P", remedy="IMX250MZR has the pattern")
    unknown.raised_by(settings(sensor="imx").checked)  # type: ignore[arg-type, attr-defined]


@pytest.mark.parametrize(
    ("model", "sensor"),
    [
        ("imx253mzr", "IMX253MZR"),
        ("BFS-U3-51S5P-C", "IMX250MZR"),
        ("BFS-U3-51S5P-BD2", "IMX250MZR"),
        ("BFS-U3-51S5PC-C", "IMX250MYR"),
        ("BFS-PGE-123S6P-C", "IMX253MZR"),
        ("PHX050S1-PC", "IMX264MZR"),
        ("tri050s-qc", "IMX250MYR"),
        ("DZK 33UX250", "IMX250MZR"),
        ("dyk_33ux250", "IMX250MYR"),
        ("GO-5100MP-USB", "IMX250MZR"),
        ("Sony imx264mzr", "IMX264MZR"),
        ("Lucid Phoenix PHX050S-QC", "IMX250MYR"),
        ("The Imaging Source DZK 33UX250", "IMX250MZR"),
    ],
)
def test_a_camera_is_read_as_its_sensor(model: str, sensor: str) -> None:
    assert PrepareSettings(sensor=model).checked().sensor == sensor  # type: ignore[arg-type]


def test_simulated_sensors_are_named_and_recorded_alike() -> None:
    for name in SENSORS:
        settings = SynthSettings(sensor=name.lower())  # type: ignore[arg-type]
        settings.check()
        assert (settings.sensor, settings.data()["sensor"]) == (name, name.lower())


@pytest.mark.parametrize(
    ("largest", "used", "container", "bits", "found"),
    [
        (255, 255, 8, None, (8, 255)),
        (4000, 4095, 16, None, (12, 4095)),
        (4096, 8191, 16, None, (16, 65535)),
        (65520, 0xFFF0, 16, None, (16, 65520)),
        (1023, 1023, 16, 10, (10, 1023)),
        (700, 1023, 10, None, (10, 1023)),
        (4095, 4095, 12, None, (12, 4095)),
    ],
)
def test_full_scale(
    largest: int, used: int, container: int, bits: int | None, found: tuple[int, int]
) -> None:
    levels = estimate_levels(largest, used, container, bits=bits, black=0.0, saturation=None)
    assert ((levels.bits, levels.white), levels.saturation) == (found, levels.white)
    np.testing.assert_array_equal(levels.linear(np.array([[0, levels.white]], np.uint16)), [[0.0, 1.0]])


def test_levels_out_of_order_are_refused() -> None:
    for changes in ({"black": 300.0}, {"saturation": 300}, {"black": 100.0, "saturation": 90}):
        asked = {"bits": 8, "black": 0.0, "saturation": None, **changes}
        Fault(expected="0 <= black level < saturation <= 255").raised_by(
            estimate_levels, 200, 255, 8, **asked
        )
    Fault(expected="values below 1024 for 10 bits", found="1025").raised_by(
        estimate_levels, 1025, 2047, 16, bits=10, black=0.0, saturation=None
    )


def test_saturated_and_dark_samples() -> None:
    levels = estimate_levels(255, 255, 8, bits=None, black=10.0, saturation=250)
    values = np.full((4, 4), 100, np.uint8)
    values[0, 0], values[0, 1] = 250, 249
    values[2:, 2:] = [[10, 9], [9, 10]]  # a cell without light, with noise
    values[3, 1] = 0  # clipped below the black level
    saturated, dark = unusable_samples(values, levels)
    assert np.argwhere(saturated).tolist() == [[0, 0]]
    assert np.argwhere(dark).tolist() == [[3, 1]]
    frame = np.full((4, 4), 10, np.float32)
    frame[0, 2:] = 100
    assert np.argwhere(unusable_samples(values, levels, frame)[1]).tolist() == [[3, 1]]
    assert levels.linear(values, frame)[0, 2] == 0.0


def test_zeros_without_a_black_level_are_dark_if_their_cell_is() -> None:
    levels = estimate_levels(255, 255, 8, bits=None, black=0.0, saturation=250)
    values = np.full((4, 4), 100, np.uint8)
    values[2:, 2:] = 0
    values[0, 1] = 0  # a single angle without light: Brewster's angle
    cell = [[2, 2], [2, 3], [3, 2], [3, 3]]
    assert np.argwhere(unusable_samples(values, levels)[1]).tolist() == cell
    frame = np.zeros((4, 4), np.float32)
    assert np.argwhere(unusable_samples(values, levels, frame)[1]).tolist() == cell


def codes(light: np.ndarray, pattern: tuple[str, ...], noise: float = 0.0) -> np.ndarray:
    values = mosaic(behind(light), pattern) + np.random.default_rng(1).normal(0, noise, light.shape[1:3])
    return np.rint(np.clip(values, 0, 1) * 4095).astype(np.uint16)


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize(
    ("light", "fine"), [(smooth_light(128, 192), False), (busy_light(128, 192, 3), True)]
)
def test_filters_are_told_apart(light: np.ndarray, fine: bool, noise: float) -> None:
    """Rings as fine as the cells may leave it open; they are never taken for filters."""
    colored = light * np.array([0.55, 1.0, 0.7])  # as silicon sees daylight
    assert color_filters(sample_blocks(codes(colored, COLOR, noise), SIDE), 4095) == "color"
    gray = light.mean(axis=-1, keepdims=True).repeat(3, axis=-1)
    found = color_filters(sample_blocks(codes(gray, MONO, noise), SIDE), 4095)
    assert found in (("monochrome", None) if fine else ("monochrome",))


def test_darkness_does_not_tell() -> None:
    assert color_filters(sample_blocks(codes(smooth_light(128, 192) * 0.001, COLOR), SIDE), 4095) is None


@pytest.mark.parametrize(
    ("pattern", "named", "right", "found"),
    [
        (COLOR, "IMX250MZR", "IMX250MYR", "the Bayer pattern of color filters"),
        (MONO, "IMX250MYR", "IMX250MZR", "no sign of color filters"),
    ],
)
def test_the_wrong_kind_of_sensor_is_refused(tmp_path: Path, pattern, named, right, found: str) -> None:
    color = pattern is COLOR
    write_mosaic(
        tmp_path / "in" / "v.png", mosaic(behind(smooth_light(128, 192, color=color)), pattern), bits=12
    )
    Fault(found=found, remedy=f"Use --sensor {right}").raised_by(
        prepare_scene, tmp_path / "in", tmp_path / "out", PrepareSettings(sensor=named, poses="none")
    )
    prepare_scene(tmp_path / "in", tmp_path / "out2", PrepareSettings(sensor=right, poses="none"))


MODES = ("half", "quarter", "full")


def developed(
    intensities: np.ndarray, *, color: bool, mode: str, offset: tuple[int, int] = (0, 0)
) -> DemosaicedPicture:
    values = mosaic(intensities, COLOR if color else MONO, offset).astype(np.float32)
    pattern = sensor_pattern("IMX250MYR" if color else "IMX250MZR").shifted(*offset)
    x, y = pattern.cell_corner()
    values = np.ascontiguousarray(values[y:, x:])
    bad = np.zeros(values.shape, bool)
    return demosaic(values, bad, pattern.shifted(x, y), mode=mode)


@pytest.mark.parametrize("color", [True, False])
@pytest.mark.parametrize("mode", MODES)
def test_uniform_light_comes_out_exactly_for_every_offset(color: bool, mode: str) -> None:
    stokes = np.array([[0.8, 0.6, 0.4], [0.2, -0.1, 0.05], [-0.1, 0.2, 0.1]])
    if not color:
        stokes = np.repeat(stokes[:, :1], 3, axis=1)
    light = behind(np.broadcast_to(stokes[:, None, None, :], (3, 17, 18, 3)))
    for offset in product(range(4), range(4)):
        picture = developed(light, color=color, mode=mode, offset=offset)
        expected = np.broadcast_to(light[:, :1, :1], picture.intensities.shape)
        np.testing.assert_allclose(picture.intensities, expected, atol=1e-6)
        assert not picture.invalid.any()


@pytest.mark.parametrize("color", [True, False])
@pytest.mark.parametrize("mode", MODES)
def test_smooth_light_is_reproduced(color: bool, mode: str) -> None:
    light = behind(smooth_light(color=color))
    picture = developed(light, color=color, mode=mode)
    step = DEMOSAIC_MODES[mode]
    expected = light.reshape(4, 48 // step, step, 64 // step, step, 3).mean(axis=(2, 4))
    margin = np.s_[:, 4:-4, 4:-4] if mode != "quarter" else np.s_[:]
    # Samples of a cell lie up to half a cell beside its center: that is what is left.
    bound = {"half": 0.012, "quarter": 0.025, "full": 0.002}[mode]
    assert np.abs(picture.intensities - expected)[margin].max() < bound


def footprint(color: bool, mode: str, place: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Where one changed sample changes the picture, and where it makes it invalid."""
    values = np.random.default_rng(0).uniform(0.3, 0.6, (32, 32)).astype(np.float32)
    pattern = sensor_pattern("IMX250MYR" if color else "IMX250MZR")
    bad = np.zeros(values.shape, bool)
    bad[place] = True
    options = {"mode": mode}
    before = demosaic(values, bad, pattern, **options)
    values[place] += 0.3
    after = demosaic(values, bad, pattern, **options)
    return np.abs(after.intensities - before.intensities).max(axis=(0, 3)) > 1e-7, before.invalid


@pytest.mark.parametrize("color", [True, False])
@pytest.mark.parametrize("mode", MODES)
def test_a_pixel_is_invalid_wherever_a_bad_sample_is_used(color: bool, mode: str) -> None:
    for place in ((16, 16), (17, 14), (15, 19), (0, 0), (31, 3)):
        changed, invalid = footprint(color, mode, place)
        np.testing.assert_array_equal(changed, invalid)


@pytest.mark.parametrize("color", [True, False])
def test_registered_angles_make_less_polarization_of_edges(color: bool) -> None:
    """Unpolarized light with edges: what comes out polarized is wrong, and S0 may not suffer for it."""
    light = busy_light(96, 128, 2)
    light[1:] = 0
    if not color:
        light = np.repeat(light[..., 1:2], 3, axis=-1)
    true = light[0].reshape(48, 2, 64, 2, 3).mean(axis=(1, 3))
    pattern = sensor_pattern("IMX250MYR" if color else "IMX250MZR")
    values = mosaic(behind(light), COLOR if color else MONO).astype(np.float32)
    wrong, blur = {}, {}
    for registered in (False, True):
        found = demosaic(
            values, np.zeros(values.shape, bool), pattern,
            mode="half", registered=registered,
        ).intensities  # fmt: skip
        s0 = found.sum(axis=0) / 2
        wrong[registered] = (np.hypot(found[0] - found[2], found[1] - found[3]) / s0)[4:-4, 4:-4].mean()
        blur[registered] = np.sqrt(np.mean((s0 - true)[4:-4, 4:-4] ** 2))
    assert wrong[True] < 0.65 * wrong[False]
    assert blur[True] < 1.0001 * blur[False] + 0.004


@pytest.mark.parametrize("color", [True, False])
def test_polanalyser_agrees(color: bool) -> None:
    reference = pytest.importorskip("polanalyser")
    light = behind(smooth_light(color=color))
    values = np.rint(mosaic(light, COLOR if color else MONO) * 65535).astype(np.uint16)
    code = reference.COLOR_PolarRGB if color else reference.COLOR_PolarMono
    theirs = np.stack([picture.astype(float) for picture in reference.demosaicing(values, code)])
    theirs = theirs[..., ::-1] if color else np.repeat(theirs[..., None], 3, axis=-1)
    pattern = sensor_pattern("IMX250MYR" if color else "IMX250MZR")
    bad = np.zeros(values.shape, bool)
    ours = demosaic(values.astype(np.float32), bad, pattern, mode="full").intensities
    # It rounds after each of its two steps, and treats the border in another way.
    assert np.abs(ours - theirs)[:, 4:-4, 4:-4].max() <= 2.0
