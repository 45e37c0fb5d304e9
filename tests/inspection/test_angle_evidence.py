"""Order, sense and zero of a glossy ball, by its points and by its normals."""

from __future__ import annotations

import math

import pytest
import torch
from glossy_ball import INDEX, mistaken, model_of, surfaces, views_around

from polarguide.capture.angle_evidence import ORDERS, PAIRINGS, posterior
from polarguide.capture.calibration import Calibration
from polarguide.inspection.angles import AngleFindings, angle_checks, combine_evidence
from polarguide.inspection.capture import measure_view
from polarguide.inspection.evidence import normal_evidence, point_evidence, sample_surfaces
from polarguide.inspection.picture_checks import dielectric_check, exceeds_dielectric
from polarguide.inspection.settings import Check

FIRST = ORDERS[0].files()


def order_check(angles: AngleFindings) -> Check:
    return angle_checks(angles)[0]


def handedness_check(angles: AngleFindings) -> Check:
    return angle_checks(angles)[1]


def zero_check(angles: AngleFindings) -> Check:
    return angle_checks(angles)[2]


@pytest.mark.parametrize("order", ORDERS)
def test_points_find_every_order(ball_views, order) -> None:
    views = tuple(mistaken(view, files=order.files()) for view in ball_views)
    evidence, _ = point_evidence(views, model_of(views), INDEX)
    check = order_check(combine_evidence([evidence], 0))
    assert check.verdict == ("ok" if order is ORDERS[0] else "wrong")
    assert check.figures["order"] == list(order.files())
    sense = handedness_check(combine_evidence([evidence], 0))
    assert sense.verdict == ("ok" if order.sense > 0 else "wrong")


@pytest.mark.parametrize("order", ORDERS)
def test_normals_find_every_order(ball_views, order) -> None:
    views = tuple(mistaken(view, files=order.files()) for view in ball_views)
    check = order_check(combine_evidence([normal_evidence(sample_surfaces(surfaces(views)), INDEX)], 0))
    assert check.verdict == ("ok" if order is ORDERS[0] else "wrong")
    assert check.figures["order"] == list(order.files())


def test_another_pairing_is_read_through(ball_views) -> None:
    files = ORDERS[6].files(PAIRINGS[2])
    views = tuple(mistaken(view, files=files) for view in ball_views)
    evidence, _ = point_evidence(views, model_of(views), INDEX, pairing=2)
    assert order_check(combine_evidence([evidence], 2)).figures["order"] == list(files)
    pixels = sample_surfaces(surfaces(views), pairing=2)
    assert order_check(combine_evidence([normal_evidence(pixels, INDEX)], 2)).figures["order"] == list(files)


@pytest.mark.parametrize("zero", [10.0, -17.0, 1.0])
@pytest.mark.parametrize("source", ["points", "normals"])
def test_the_zero_is_measured(ball_views, zero: float, source: str) -> None:
    views = tuple(mistaken(view, zero=zero) for view in ball_views)
    if source == "points":
        evidence, _ = point_evidence(views, model_of(views), INDEX)
    else:
        evidence = normal_evidence(sample_surfaces(surfaces(views)), INDEX)
    check = zero_check(combine_evidence([evidence], 0))
    assert check.figures["offset_degrees"] == pytest.approx(zero, abs=0.5)
    assert check.verdict == ("ok" if zero == 1.0 else "wrong")


def test_without_pixels_that_must_be_specular_the_quarter_turn_stays_open() -> None:
    # A matte ball: DoLP as diffuse light has it, so specular light at another zenith explains it as well.
    views = views_around(specular=0.0, diffuse=0.5, noise=0.0)
    pixels = sample_surfaces(surfaces(views))
    assert not pixels.certainly_specular(INDEX).any()
    angles = combine_evidence([normal_evidence(pixels, INDEX)], 0)
    assert angles.posterior is not None
    assert angles.posterior.probabilities[0] == pytest.approx(angles.posterior.probabilities[2], abs=0.01)
    assert angles.posterior.probabilities[0] > 0.45
    assert angles.order is None
    assert order_check(angles).verdict == "warning"
    assert handedness_check(angles).verdict == "ok"  # the sense is decided all the same


def test_wrong_normals_are_not_used(ball_views) -> None:
    generator = torch.Generator().manual_seed(0)
    pairs = []
    for view, surface in surfaces(ball_views):
        normal = torch.nn.functional.normalize(torch.randn(surface.normal.shape, generator=generator), dim=-1)
        facing = torch.where((normal * surface.camera.rays()).sum(-1, keepdim=True) > 0, -normal, normal)
        surface.normal.copy_(facing)
        pairs.append((view, surface))
    evidence = normal_evidence(sample_surfaces(pairs), INDEX)
    assert not evidence.usable
    check = order_check(combine_evidence([evidence], 0))
    assert check.verdict == "not verified"
    assert evidence.note in check.finding


def test_points_that_do_not_belong_to_the_pictures_are_not_used(ball_views) -> None:
    model = model_of(ball_views)
    model.points.mul_(0.4)  # inside the ball: every view sees another place of its surface there
    evidence, pixels = point_evidence(ball_views, model, INDEX)
    assert not evidence.usable
    assert pixels is None


def test_too_few_points_and_pixels_say_so(ball_views) -> None:
    evidence, _ = point_evidence(ball_views, model_of(ball_views, count=10), INDEX)
    assert not evidence.usable
    assert "points have 4 observations" in evidence.note
    none = normal_evidence(sample_surfaces(surfaces(ball_views[:1])), INDEX)
    assert not none.usable
    assert "are needed" in none.note


def test_zeniths_of_points_are_those_of_the_ball(ball_views) -> None:
    model = model_of(ball_views)
    _, pixels = point_evidence(ball_views, model, INDEX)
    assert pixels is not None
    assert not exceeds_dielectric(pixels, INDEX).any()
    # The normal of a point of the unit ball is its place.
    centers = torch.stack([view.camera.center.float() for view in ball_views if view.camera])
    toward = torch.nn.functional.normalize(centers[None] - pixels.position[:, None], dim=-1)
    zeniths = torch.acos((toward * pixels.position[:, None]).sum(-1).clamp(-1, 1))
    nearest = (zeniths - pixels.zenith[:, None]).abs().amin(dim=1)
    assert math.degrees(float(nearest.quantile(0.9))) < 3


def test_polarization_beyond_any_dielectric_is_flagged(ball_views) -> None:
    shares = [measure_view(view, INDEX).above_limit for view in ball_views]
    pixels = sample_surfaces(surfaces(ball_views))
    assert dielectric_check(shares, pixels, INDEX).verdict == "ok"
    strong = type(pixels)(
        pixels.aolp, torch.full_like(pixels.dolp, 0.9), pixels.noise, pixels.azimuth,
        torch.full_like(pixels.zenith, 0.3), position=pixels.position,
    )  # fmt: skip
    check = dielectric_check(shares, strong, INDEX)
    assert check.verdict == "warning"
    assert check.figures["unexplained"] == 1.0


def test_evidence_is_not_certain_beyond_its_failures(ball_views) -> None:
    evidence, _ = point_evidence(ball_views, model_of(ball_views), INDEX)
    assert max(posterior(evidence).probabilities) < 0.995


@pytest.mark.parametrize(
    ("applied", "true", "expected"),
    [
        # Read as clockwise, and rightly so: nothing to do. Read as clockwise, and wrongly: the sense goes back.
        (Calibration(sense="cw"), Calibration(sense="ccw"), "--order 0,45,90,135 --sense ccw --zero 0"),
        (Calibration(sense="ccw"), Calibration(sense="cw"), "--order 0,45,90,135 --sense cw --zero 0"),
        (
            Calibration(sense="cw"),
            Calibration(sense="ccw", zero=45),
            "--order 0,45,90,135 --sense ccw --zero 45",
        ),
        (Calibration(zero=90), Calibration(sense="cw", zero=90), "--order 0,45,90,135 --sense cw --zero 90"),
    ],
)
def test_the_remedy_is_the_whole_calibration(
    ball_views, applied: Calibration, true: Calibration, expected: str
) -> None:
    """Pictures of an instrument that counts as ``true``, prepared as if it counted as ``applied``."""
    named = [true.true_angles()[0][applied.true_angles()[0].index(angle)] for angle in ORDERS[0].files()]
    views = tuple(mistaken(view, files=tuple(named)) for view in ball_views)
    evidence, _ = point_evidence(views, model_of(views), INDEX)
    angles = combine_evidence([evidence], 0, applied)
    checks = [order_check(angles), handedness_check(angles)]
    assert {check.verdict for check in checks} <= {"wrong", "ok"}
    for check in checks:
        assert check.verdict == "ok" or f"Repeat prepare with {expected} " in check.remedy
    assert checks[0].verdict == "wrong"
    assert f"was prepared with {applied.options()}" in checks[0].remedy


def test_a_scene_of_another_origin_gets_a_command(ball_views) -> None:
    views = tuple(mistaken(view, files=ORDERS[4].files()) for view in ball_views)
    evidence, _ = point_evidence(views, model_of(views), INDEX)
    remedy = order_check(combine_evidence([evidence], 0)).remedy
    command = "polarguide prepare SCENE/polar --out NEW --poses SCENE --order 0,45,90,135 --sense cw --zero 0"
    assert remedy.startswith(f"Write a corrected scene: {command}. Then copy split.json")
