"""Shots at any set of angles: Stokes vectors, their uncertainty, residuals and outliers against a known truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from faults import Fault

from polarguide import optics
from polarguide.capture.calibration import Calibration
from polarguide_shots.maps import Reason, ShotMaps
from polarguide_shots.options import ShotOptions
from polarguide_shots.read import read_shot
from tests.helpers.picture_sets import READ, WELL, photographed, plate, sphere, write_set

SIX, ALL = range(10, 161, 30), range(0, 180, 5)
GIVEN = ShotOptions(transfer="linear", full_well=WELL, read_noise=READ)
ESTIMATED = ShotOptions(transfer="linear")


def read(
    folder: Path, pictures: np.ndarray, angles: Sequence[float], options: ShotOptions = ESTIMATED
) -> ShotMaps:
    write_set(folder / "ball", [f"ball_a{angle:g}.png" for angle in angles], pictures)
    return read_shot(folder / "ball", options)


def reduced_chi_square(maps: ShotMaps, stokes: np.ndarray) -> tuple[float, float]:
    """Return the values for DoLP and AoLP of pixels with a strong signal."""
    degree, angle = np.hypot(stokes[1], stokes[2]) / stokes[0], np.arctan2(stokes[2], stokes[1]) / 2
    good = maps.usable & (degree > 8 * maps.sigma_dolp)
    assert good.mean() > 0.4
    off = np.angle(np.exp(2j * (maps.aolp - angle))) / 2
    return tuple(float(np.mean((d / s)[good] ** 2)) for d, s in
                 ((maps.dolp - degree, maps.sigma_dolp), (off, maps.sigma_aolp)))  # fmt: skip


@pytest.mark.parametrize("options", [GIVEN, ESTIMATED], ids=["given", "estimated"])
@pytest.mark.parametrize(
    "angles",
    [SIX, ALL, (0, 60, 120), (0, 50, 90, 135), (0, 20, 45, 90, 130, 180, 200)],
    ids=["six", "36", "three", "four", "doubles"],
)
def test_maps_are_off_by_what_they_state(
    tmp_path: Path, angles: Sequence[float], options: ShotOptions
) -> None:
    stokes = sphere()
    maps = read(tmp_path, photographed(stokes, angles), angles, options)
    for value in reduced_chi_square(maps, stokes):
        assert 0.8 < value < 1.2
    if len(angles) == 3:
        assert maps.residual is None
        return
    assert maps.residual is not None
    # The mean square per degree of freedom of noise alone.
    assert float(np.mean(maps.residual**2)) == pytest.approx(1, abs=0.1)
    assert all(not fit.left_out for fit in maps.pictures)
    assert all(fit.looks_like == pytest.approx(fit.angle, abs=0.5) or fit.angle == 0 for fit in maps.pictures)


def test_the_fit_is_weighted_least_squares(tmp_path: Path) -> None:
    pictures = photographed(sphere(24), SIX)
    maps = read(tmp_path, pictures, SIX, GIVEN)
    turns = 2 * np.radians(SIX)
    rows = np.stack((np.ones(6), np.cos(turns), np.sin(turns)), axis=1) / 2
    row, column = 5, 7
    samples = pictures[:, row, column] / 65535
    fitted = rows @ np.linalg.lstsq(rows, samples, rcond=None)[0]
    weight = 1 / (READ**2 / WELL**2 + 1 / 65535**2 / 12 + np.maximum(fitted, 0) / WELL)
    covariance = np.linalg.inv(rows.T * weight @ rows)
    stokes = covariance @ rows.T @ (weight * samples)
    np.testing.assert_allclose(maps.stokes[:, row, column], stokes, rtol=1e-4)
    # By numerical derivatives of the DoLP and of the AoLP.
    for measure, stated in ((optics.dolp, maps.sigma_dolp), (optics.aolp, maps.sigma_aolp)):
        vector = torch.from_numpy(stokes).requires_grad_()
        (gradient,) = torch.autograd.grad(measure(vector), vector)
        sigma = float(np.sqrt(gradient.numpy() @ covariance @ gradient.numpy()))
        assert stated[row, column] == pytest.approx(sigma, rel=1e-3)


def test_the_usual_four_in_a_table_take_the_four_angle_path(tmp_path: Path) -> None:
    pictures = photographed(sphere(), (0, 45, 90, 135))
    names = [f"ball_{angle}.png" for angle in (0, 45, 90, 135)]
    write_set(tmp_path / "named", names, pictures)
    write_set(tmp_path / "listed", names, pictures)
    lines = "\n".join(f"{name},{name[5:-4]}" for name in names)
    (tmp_path / "listed" / "angles.csv").write_text(f"file,angle\n{lines}\n")
    named, listed = (read_shot(tmp_path / folder, ESTIMATED) for folder in ("named", "listed"))
    np.testing.assert_array_equal(named.stokes, listed.stokes)
    np.testing.assert_array_equal(named.sigma_aolp, listed.sigma_aolp)


@pytest.mark.parametrize("angles", [SIX, (0, 40, 70, 100, 150), ALL], ids=["six", "five", "36"])
def test_a_picture_at_a_wrong_angle_is_named_and_left_out(tmp_path: Path, angles: Sequence[float]) -> None:
    stokes, true = sphere(), list(angles)
    true[2] += 10
    maps = read(tmp_path, photographed(stokes, true), angles)
    assert [fit.label for fit in maps.pictures if fit.left_out] == [f"ball_a{angles[2]}.png"]
    assert maps.pictures[2].looks_like == pytest.approx(true[2], abs=0.5)
    assert any(f"{angles[2]} degrees) looks like {true[2]} degrees" in note for note in maps.notes)
    for value in reduced_chi_square(maps, stokes):
        assert 0.8 < value < 1.2
    assert maps.residual is not None
    polarized = np.hypot(stokes[1], stokes[2]) > 0.2
    assert np.median(maps.residual[polarized]) > 1.2


@pytest.mark.parametrize(
    ("stokes", "change", "words"),
    [
        (plate(), lambda p: p, "contradicts the others"),
        (sphere(), lambda p: (0.8 * p).astype(np.uint16), "20% darker than the others predict"),
        (sphere(), lambda p: np.roll(p, 25, axis=1), "contradicts|looks like"),
    ],
    ids=["an angle without a sign in the light", "exposure", "motion"],
)
def test_a_picture_that_contradicts_the_others_is_named(tmp_path: Path, stokes, change, words: str) -> None:
    true = [10, 40, 70 + 25 * (stokes is plate), 100, 130, 160]
    pictures = photographed(stokes, true)
    if np.ptp(stokes[0]) == 0:
        pictures[2] = photographed(stokes, [100], seed=1)[0]
    pictures[2] = change(pictures[2])
    maps = read(tmp_path, pictures, SIX)
    assert [fit.label for fit in maps.pictures if fit.left_out] == ["ball_a70.png"]
    assert any(word in note for note in maps.notes for word in words.split("|"))


def test_four_contradicting_angles_are_told(tmp_path: Path) -> None:
    maps = read(tmp_path, photographed(sphere(), (0, 50, 100, 135)), (0, 50, 90, 135))
    assert any("contradict" in note for note in maps.notes)
    assert not any(fit.left_out for fit in maps.pictures)


@pytest.mark.parametrize("angles", [SIX, (0, 45, 95, 135)], ids=["six", "four"])
def test_stray_light_is_no_wrong_angle(tmp_path: Path, angles: Sequence[float]) -> None:
    """A lamp in the picture, whose glare moves on the filter and does not follow Malus's law."""
    pictures = photographed(sphere(), angles).astype(np.float64)
    rows, columns = np.mgrid[:120, :120]
    for number, picture in enumerate(pictures):
        turn = 2.4 * number
        distance = np.hypot(rows - 20 - 9 * np.sin(turn), columns - 30 - 9 * np.cos(turn))
        picture += 30_000 * np.exp(-((distance / 12) ** 2))
    maps = read(tmp_path, np.minimum(pictures, 65535).astype(np.uint16), angles)
    assert not any("angle is probably wrong" in note or "angles contradict" in note for note in maps.notes)
    for fit in maps.pictures:
        assert fit.looks_like is None or fit.looks_like == pytest.approx(fit.angle, abs=2)
    assert any("motion" in note for note in maps.notes)


def test_moving_pixels_do_not_hide_a_wrong_angle(tmp_path: Path) -> None:
    pictures = photographed(sphere(), (10, 40, 82, 100, 130, 160))
    generator = np.random.default_rng(0)
    moving = generator.random(pictures[2].shape) < 0.12
    pictures[2][moving] = (pictures[2][moving] * generator.uniform(0, 2, moving.sum())).astype(np.uint16)
    maps = read(tmp_path, pictures, SIX)
    assert maps.pictures[2].looks_like == pytest.approx(82, abs=0.5)
    assert any("looks like 82 degrees: its angle is probably wrong" in note for note in maps.notes)


def test_outliers_and_clipped_samples_are_left_out_pixel_by_pixel(tmp_path: Path) -> None:
    stokes = sphere()
    pictures = photographed(stokes, SIX)
    pictures[3, 60, 40:60] = 65535 // 20  # a fly
    pictures[1, 70, 40:60] = 65535  # a reflex
    pictures[:, 80, 40:60] = 65535
    pictures[:, 90, 40:60] = 0
    maps = read(tmp_path, pictures, SIX, GIVEN)
    assert maps.left_out is not None
    assert maps.residual is not None
    for row in (60, 70):
        assert (maps.left_out[row, 40:60] == 1).mean() > 0.9
        assert (maps.residual[row, 40:60] > 3).all()
        assert np.abs(maps.s0 - stokes[0])[row, 40:60].max() < 0.05
        assert (maps.reason[row, 40:60] <= Reason.NOISE).all()
    assert (maps.reason[80, 40:60] == Reason.SATURATED).all()
    assert (maps.reason[90, 40:60] == Reason.DARK).all()
    assert (maps.left_out == 0).mean() > 0.98


def test_doubles_count_with_their_weight(tmp_path: Path) -> None:
    once, twice = (0, 60, 120), (0, 180, 60, 240, 120, 300)
    single = read(tmp_path / "a", photographed(sphere(), once), once, GIVEN)
    double = read(tmp_path / "b", photographed(sphere(), twice), twice, GIVEN)
    ratio = np.median(single.sigma_aolp[single.usable & double.usable]) / np.median(
        double.sigma_aolp[single.usable & double.usable]
    )
    assert ratio == pytest.approx(np.sqrt(2), rel=0.03)


def test_colors_and_turned_angles(tmp_path: Path) -> None:
    stokes = sphere()
    gray = photographed(stokes, SIX, noisy=False)
    colored = np.stack([(gray * share).astype(np.uint16) for share in (0.7, 1.0, 0.8)], axis=-1)
    calibration = Calibration(sense="cw", zero=30.0)
    maps = read(tmp_path, colored, [(30 - angle) % 180 for angle in SIX],
                ShotOptions(transfer="linear", calibration=calibration))  # fmt: skip
    assert maps.intensities.shape[-1] == 3
    np.testing.assert_allclose(maps.intensities[..., 0] * 0.7, maps.intensities[..., 2] * 0.8, atol=1e-3)
    np.testing.assert_allclose(maps.dolp, np.hypot(stokes[1], stokes[2]) / stokes[0], atol=1e-3)
    good = np.hypot(stokes[1], stokes[2]) > 0.05
    assert np.abs(np.sin(maps.aolp - np.arctan2(stokes[2], stokes[1]) / 2))[good].max() < 2e-3
    np.testing.assert_allclose(optics.luminance(optics.stokes(maps.intensities)), maps.stokes, atol=1e-5)


def test_gains_of_a_table(tmp_path: Path) -> None:
    stokes = sphere()
    pictures = photographed(stokes, SIX)
    pictures[4] = (pictures[4] * 0.5).astype(np.uint16)
    write_set(tmp_path, [f"{k}.png" for k in range(6)], pictures)
    lines = "\n".join(f"{k}.png,{angle},{0.5 if k == 4 else ''}" for k, angle in enumerate(SIX))
    (tmp_path / "angles.csv").write_text(f"file,angle,gain\n{lines}\n")
    maps = read_shot(tmp_path, ESTIMATED)
    assert not any(fit.left_out for fit in maps.pictures)
    assert np.median(np.abs(maps.s0 - stokes[0])) < 0.01


def test_a_calibration_of_the_usual_four_is_refused(tmp_path: Path) -> None:
    for field, calibration in (
        ("gains", Calibration(gains=(1.0, 1.1, 1.0, 1.0))),
        ("order", Calibration(order=(90, 45, 0, 135))),
    ):
        Fault(f"calibration ({field})").raised_by(
            read, tmp_path, photographed(sphere(24), SIX), SIX, ShotOptions(calibration=calibration)
        )


def test_pictures_of_other_sizes_are_refused(tmp_path: Path) -> None:
    write_set(tmp_path, [f"ball_a{angle}.png" for angle in SIX], photographed(sphere(24), SIX))
    cv2.imwrite(str(tmp_path / "ball_a70.png"), np.zeros((24, 25), np.uint16))
    Fault("ball_a70.png", found="25x24").raised_by(read_shot, tmp_path)


def test_a_picture_that_clips_everywhere_is_left_out(tmp_path: Path) -> None:
    stokes = sphere()
    pictures = photographed(stokes, SIX)
    pictures[1] = np.iinfo(pictures.dtype).max
    maps = read(tmp_path, pictures, SIX)
    assert maps.left_out is not None
    assert (maps.left_out >= 1).all()
    assert np.abs(maps.dolp - np.hypot(stokes[1], stokes[2]) / stokes[0])[maps.usable].mean() < 0.02
