"""Demosaicing: exact where it must be, close where it interpolates, and honest about what clips."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from camera_files import COLOR, MONO, behind, busy_light, mosaic, smooth_light

from polarguide.capture.sensor.demosaic import DEMOSAIC_MODES, DemosaicedPicture, demosaic
from polarguide.capture.sensor.pattern import sensor_pattern

MODES = [
    ("half", "bilinear"),
    ("half", "guided"),
    ("quarter", "bilinear"),
    ("full", "bilinear"),
    ("full", "guided"),
]


def developed(
    intensities: np.ndarray, *, color: bool, mode: str, interpolation: str, offset: tuple[int, int] = (0, 0)
) -> DemosaicedPicture:
    values = mosaic(intensities, COLOR if color else MONO, offset).astype(np.float32)
    pattern = sensor_pattern("IMX250MYR" if color else "IMX250MZR").shifted(*offset)
    x, y = pattern.cell_corner()
    values = np.ascontiguousarray(values[y:, x:])
    bad = np.zeros(values.shape, bool)
    return demosaic(values, bad, pattern.shifted(x, y), mode=mode, interpolation=interpolation)


@pytest.mark.parametrize("color", [True, False])
@pytest.mark.parametrize(("mode", "interpolation"), MODES)
def test_uniform_light_comes_out_exactly_for_every_offset(color: bool, mode: str, interpolation: str) -> None:
    stokes = np.array([[0.8, 0.6, 0.4], [0.2, -0.1, 0.05], [-0.1, 0.2, 0.1]])
    if not color:
        stokes = np.repeat(stokes[:, :1], 3, axis=1)
    light = behind(np.broadcast_to(stokes[:, None, None, :], (3, 17, 18, 3)))
    for offset in product(range(4), range(4)):
        picture = developed(light, color=color, mode=mode, interpolation=interpolation, offset=offset)
        expected = np.broadcast_to(light[:, :1, :1], picture.intensities.shape)
        np.testing.assert_allclose(picture.intensities, expected, atol=1e-6)
        assert not picture.invalid.any()


@pytest.mark.parametrize("color", [True, False])
@pytest.mark.parametrize(("mode", "interpolation"), MODES)
def test_smooth_light_is_reproduced(color: bool, mode: str, interpolation: str) -> None:
    light = behind(smooth_light(color=color))
    picture = developed(light, color=color, mode=mode, interpolation=interpolation)
    step = DEMOSAIC_MODES[mode]
    expected = light.reshape(4, 48 // step, step, 64 // step, step, 3).mean(axis=(2, 4))
    margin = np.s_[:, 4:-4, 4:-4] if mode != "quarter" else np.s_[:]
    # Samples of a cell lie up to half a cell beside its center: that is what is left.
    bound = {"half": 0.012, "quarter": 0.025, "full": 0.002}[mode]
    assert np.abs(picture.intensities - expected)[margin].max() < bound


def footprint(
    color: bool, mode: str, interpolation: str, place: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Where one changed sample changes the picture, and where it makes it invalid."""
    rng = np.random.default_rng(0)
    values = rng.uniform(0.3, 0.6, (32, 32)).astype(np.float32)
    pattern = sensor_pattern("IMX250MYR" if color else "IMX250MZR")
    bad = np.zeros(values.shape, bool)
    bad[place] = True
    options = {"mode": mode, "interpolation": interpolation}
    before = demosaic(values, bad, pattern, **options)
    values[place] += 0.3
    after = demosaic(values, bad, pattern, **options)
    return np.abs(after.intensities - before.intensities).max(axis=(0, 3)) > 1e-7, before.invalid


@pytest.mark.parametrize("color", [True, False])
@pytest.mark.parametrize(("mode", "interpolation"), MODES)
def test_a_pixel_is_invalid_wherever_a_bad_sample_is_used(color: bool, mode: str, interpolation: str) -> None:
    for place in ((16, 16), (17, 14), (15, 19), (0, 0), (31, 3)):
        changed, invalid = footprint(color, mode, interpolation, place)
        assert not (changed & ~invalid).any()
        if interpolation == "bilinear":  # and nowhere else
            np.testing.assert_array_equal(changed, invalid)


@pytest.mark.parametrize("color", [True, False])
@pytest.mark.parametrize("interpolation", ["bilinear", "guided"])
def test_registered_angles_make_less_polarization_of_edges(color: bool, interpolation: str) -> None:
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
            mode="half", interpolation=interpolation, registered=registered,
        ).intensities  # fmt: skip
        s0 = found.sum(axis=0) / 2
        polarized = np.hypot(found[0] - found[2], found[1] - found[3]) / s0
        wrong[registered] = polarized[4:-4, 4:-4].mean()
        blur[registered] = np.sqrt(np.mean((s0 - true)[4:-4, 4:-4] ** 2))
    assert wrong[True] < 0.65 * wrong[False]
    assert blur[True] < (1.0001 if interpolation == "bilinear" else 1.3) * blur[False] + 0.004


def psnr(found: np.ndarray, true: np.ndarray) -> float:
    inside = np.s_[..., 8:-8, 8:-8, :]
    return float(-10 * np.log10(np.mean((found[inside] - true[inside]) ** 2)))


@pytest.mark.parametrize("color", [True, False])
@pytest.mark.parametrize("seed", [0, 1])
def test_guided_interpolation_beats_bilinear(color: bool, seed: int) -> None:
    light = busy_light(96, 128, seed)
    if not color:
        light = np.repeat(light[..., 1:2], 3, axis=-1)
    true = behind(light)
    gains = {}
    for name in ("bilinear", "guided"):
        found = developed(true, color=color, mode="full", interpolation=name).intensities
        s0, s1, s2 = found.sum(axis=0) / 2, found[0] - found[2], found[1] - found[3]
        gains[name] = [psnr(found, true), psnr(s0, light[0]), psnr(np.stack([s1, s2]), light[1:])]
    better = np.subtract(gains["guided"], gains["bilinear"])
    assert (better > 0.5).all(), (gains, better)


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
    ours = demosaic(
        values.astype(np.float32), bad, pattern, mode="full", interpolation="bilinear"
    ).intensities
    # It rounds after each of its two steps, and treats the border in another way.
    assert np.abs(ours - theirs)[:, 4:-4, 4:-4].max() <= 2.0
