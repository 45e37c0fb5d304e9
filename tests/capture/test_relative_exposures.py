"""Exposures of pictures from points that they share, and from what their files say."""

from __future__ import annotations

import numpy as np
import pytest

from polarguide.preparation.exposure_table import exposures_of_points, reconciled


def made(pictures: int, points: int, seed: int, *, share: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Intensities [points, pictures], and the logarithms of the exposures, mean 0."""
    rng = np.random.default_rng(seed)
    logs = rng.normal(0, 0.3, pictures)
    values = rng.uniform(0.05, 0.8, points)[:, None] * np.exp(logs)
    values[rng.uniform(size=values.shape) > share] = np.nan
    return values, logs - logs.mean()


def test_exact_intensities_give_exact_exposures() -> None:
    values, logs = made(12, 300, 0)
    found, numbers = exposures_of_points(values)
    np.testing.assert_allclose(found, logs, atol=1e-6)
    assert (numbers > 100).all()


def test_polarized_and_mirroring_points_are_outvoted() -> None:
    values, logs = made(20, 400, 1)
    rng = np.random.default_rng(2)
    angles = rng.uniform(0, np.pi, 20)
    polarized = values[:160]  # all alike, as the surface of a table
    polarized *= 1 + 0.4 * np.cos(2 * angles)
    values[160:200] *= np.exp(rng.normal(0, 1.0, (40, 20)))
    values *= np.exp(rng.normal(0, 0.02, values.shape))
    found, _ = exposures_of_points(values)
    assert np.abs(found - logs).max() < 0.02
    plain = np.nanmean(np.log(values) - np.nanmean(np.log(values), axis=1, keepdims=True), axis=0)
    assert np.abs(plain - plain.mean() - logs).max() > 0.1


def test_pictures_without_points_in_common_are_not_compared() -> None:
    values, logs = made(9, 300, 3, share=0.9)
    values[:200, 6:] = np.nan  # two groups that nothing links, and one picture that sees next to nothing
    values[200:, :6] = np.nan
    values[10:, 0] = np.nan
    found, numbers = exposures_of_points(values)
    assert np.isnan(found[[0, 6, 7, 8]]).all()
    assert numbers[0] < 20
    np.testing.assert_allclose(found[1:6], logs[1:6] - logs[1:6].mean(), atol=1e-6)
    alone, _ = exposures_of_points(values[:, :1])
    assert np.isnan(alone).all()


def test_files_are_corrected_a_little_and_only_a_little() -> None:
    rng = np.random.default_rng(4)
    logs = rng.normal(0, 0.2, 60)
    points = logs + rng.normal(0, 0.05, 60) + 3.0
    points[:2] += 0.4  # a reflection that all points are in
    found = reconciled(points, logs, np.zeros(60, bool))
    off = found.logs - logs - np.median(found.logs - logs)
    assert np.abs(off).max() < 0.03
    assert found.contradicted == ()
    assert found.scatter == pytest.approx(0.05, abs=0.025)


def test_a_file_that_is_contradicted_by_far_is_not_believed() -> None:
    rng = np.random.default_rng(5)
    logs = rng.normal(0, 0.2, 20)
    files = logs.copy()
    files[7] -= np.log(4)
    found = reconciled(logs + rng.normal(0, 0.03, 20), files, np.zeros(20, bool))
    assert found.contradicted == (7,)
    assert found.logs[7] == pytest.approx(logs[7], abs=0.1)


def test_the_filter_takes_a_share_that_points_tell() -> None:
    """A real filter leaves 0.38, not half: photographs without it are 2.6 times as bright at one exposure."""
    rng = np.random.default_rng(6)
    bare = np.arange(24) % 4 == 0
    files = rng.normal(0, 0.2, 24)
    logs = files + np.where(bare, 0.0, np.log(0.38))
    found = reconciled(logs + rng.normal(0, 0.02, 24), files, bare)
    assert np.abs(found.logs - logs - np.median(found.logs - logs)).max() < 0.03
    ideal = reconciled(np.full(24, np.nan), files, bare)
    np.testing.assert_allclose(ideal.logs, files + np.where(bare, np.log(2), 0))


def test_what_one_source_lacks_the_other_gives() -> None:
    logs = np.linspace(-0.4, 0.4, 9)
    points, files = logs + 1.0, logs.copy()
    points[3], files[5], points[7], files[7] = (np.nan,) * 4
    found = reconciled(points, files, np.zeros(9, bool)).logs
    assert np.isnan(found[7])
    known = np.arange(9) != 7
    np.testing.assert_allclose((found - found[0])[known], (logs - logs[0])[known], atol=1e-9)
