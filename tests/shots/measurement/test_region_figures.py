"""Figures against NumPy and SciPy's circular statistics."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import stats

from polarguide_shots.maps import Reason
from polarguide_shots.measurement.regions import (
    Region,
    axial_mean,
    difference_figures,
    region_figures,
    subtract,
)
from polarguide_shots.measurement.table import FIELDS, KEYS

REGION = Region("part", 5, 7, 30, 21)


def cut(array: np.ndarray) -> np.ndarray:
    return array[7:28, 5:35].astype(np.float64)


def test_against_numpy_and_scipy(made_maps) -> None:
    maps = made_maps()
    found = region_figures(maps, REGION, 0.2)
    reason = cut(maps.reason)
    assert found["pixels"] == 30 * 21
    for kind, key in enumerate(("usable", "noise", "dark", "saturated", "masked")):
        assert found[key] == (reason == kind).sum()
    assert found["usable_share"] == pytest.approx((reason == 0).mean())
    for key, values in (
        ("s0", cut(maps.stokes[0])[reason <= 1]),
        ("dolp", cut(maps.dolp_debiased)[reason <= 1]),
    ):
        assert found[f"{key}_mean"] == pytest.approx(values.mean(), rel=1e-9)
        assert found[f"{key}_deviation"] == pytest.approx(values.std(), rel=1e-6)
        for p in (1, 5, 50, 95, 99):
            assert found[f"{key}_p{p}"] == pytest.approx(np.percentile(values, p), rel=1e-6)
    assert found["dolp_share"] == pytest.approx((cut(maps.dolp_debiased)[reason <= 1] > 0.2).mean())
    angles = cut(maps.aolp)[reason == 0]
    assert found["aolp_mean"] == pytest.approx(np.degrees(stats.circmean(angles, high=np.pi)), abs=1e-4)
    assert found["aolp_deviation"] == pytest.approx(np.degrees(stats.circstd(angles, high=np.pi)), rel=1e-5)
    assert found["aolp_concentration"] == pytest.approx(1 - stats.circvar(angles, high=np.pi), rel=1e-6)


def test_angles_about_zero_have_a_mean_there() -> None:
    angles = np.radians(np.array([178.0, 2.0, 179.0, 1.0]))
    mean, length = axial_mean(angles)
    assert mean == pytest.approx(0, abs=1e-12)
    assert 0.99 < length <= 1


def test_where_no_pixel_says_anything(made_maps) -> None:
    maps = made_maps()
    maps.reason[:] = Reason.SATURATED
    found = region_figures(maps, REGION, 0.05)
    assert found["saturated"] == found["pixels"]
    assert found["usable_share"] == 0
    empty = [key for key in found if key.startswith(("s0_", "aolp_", "dolp_")) and key != "dolp_threshold"]
    assert len(empty) == 8 + 9 + 4
    assert all(found[key] is None for key in empty)
    maps.reason[:] = Reason.NOISE
    found = region_figures(maps, REGION, 0.05)
    assert found["dolp_mean"] is not None
    assert found["aolp_mean"] is None


def test_differences_wrap_and_leave_out_what_either_lacks(made_maps) -> None:
    maps, golden = made_maps(1), made_maps(2)
    found = difference_figures(subtract(maps, golden), REGION)
    both = (cut(maps.reason) <= 1) & (cut(golden.reason) <= 1)
    angles = (cut(maps.reason) == 0) & (cut(golden.reason) == 0)
    assert found["compared"] == both.sum()
    assert found["compared_angles"] == angles.sum()
    for key, name in (("s0", "stokes"), ("dolp", "dolp_debiased")):
        a, b = getattr(maps, name), getattr(golden, name)
        difference = (cut(a[0] if name == "stokes" else a) - cut(b[0] if name == "stokes" else b))[both]
        assert found[f"{key}_difference"] == pytest.approx(difference.mean(), rel=1e-4, abs=1e-7)
        assert found[f"{key}_difference_rms"] == pytest.approx(np.sqrt((difference**2).mean()), rel=1e-5)
        assert found[f"{key}_difference_p99"] == pytest.approx(np.percentile(abs(difference), 99), rel=1e-5)
    turned = (cut(maps.aolp) - cut(golden.aolp))[angles]
    turned = np.degrees(np.angle(np.exp(2j * turned)) / 2)
    assert abs(turned).max() > 60  # some go round
    mean = stats.circmean(np.radians(turned), high=np.pi / 2, low=-np.pi / 2)
    assert found["aolp_difference"] == pytest.approx(np.degrees(mean), abs=1e-4)
    assert found["aolp_difference_rms"] == pytest.approx(np.sqrt((turned**2).mean()), rel=1e-4)
    assert found["aolp_difference_p99"] == pytest.approx(np.percentile(abs(turned), 99), rel=1e-4)


def test_a_shot_does_not_differ_from_itself(made_maps) -> None:
    maps = made_maps()
    found = difference_figures(subtract(dataclasses.replace(maps, name="again"), maps), REGION)
    assert found["compared"] > 0
    assert all(value == 0 for key, value in found.items() if "difference" in key)


def test_every_figure_has_a_field_and_every_field_a_figure(made_maps) -> None:
    figures = {**region_figures(made_maps(), REGION, 0.05), **difference_figures(None, REGION)}
    head = ["shot", "files", "taken", "region", "x", "y", "width", "height", "status", "why"]
    assert [*head, *figures] == list(KEYS)
    assert len({field.key for field in FIELDS}) == len(FIELDS)
