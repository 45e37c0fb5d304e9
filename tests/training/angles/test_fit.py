"""Angle, gain and modulation of a picture behind a polarizer, from what was predicted of it."""

import math

import pytest
import torch
from torch import Tensor

from polarguide import optics
from polarguide.geometry.camera import Camera
from polarguide.optics import Mount
from polarguide.training.angles.polarizers import FLOOR, fit_angle

HEIGHT, WIDTH = 48, 64
EYE = torch.eye(3, dtype=torch.float64)
RAYS = Camera(WIDTH, HEIGHT, 60.0, 60.0, 32.0, 24.0, EYE, torch.zeros(3, dtype=torch.float64)).rays()
ALL = torch.ones(HEIGHT, WIDTH)


def light(seed: int = 0) -> Tensor:
    """Partly polarized light of all directions, [3, H, W, 3]."""
    generator = torch.Generator().manual_seed(seed)
    s0 = 0.4 + 0.6 * torch.rand(HEIGHT, WIDTH, 3, generator=generator)
    degree = 0.4 * torch.rand(HEIGHT, WIDTH, 1, generator=generator)
    angle = math.pi * torch.rand(HEIGHT, WIDTH, 1, generator=generator)
    return torch.stack((s0, s0 * degree * torch.cos(2 * angle), s0 * degree * torch.sin(2 * angle)))


def behind(stokes: Tensor, degrees: float, mount: Mount = "sensor") -> Tensor:
    cosine, sine = optics.analyzer(math.radians(degrees), RAYS, mount)[..., None].unbind(0)
    return (stokes[0] + stokes[1] * cosine + stokes[2] * sine) / 2


@pytest.mark.parametrize("mount", ["sensor", "filter"])
@pytest.mark.parametrize("degrees", [0.0, 44.0, 91.0, 170.0])
def test_angle_and_gain_are_found(degrees: float, mount: Mount) -> None:
    found = fit_angle(1.3 * behind(light(), degrees, mount), light(), ALL, RAYS, mount)
    assert (found.angle - degrees + 90) % 180 - 90 == pytest.approx(0, abs=1e-2)
    assert found.gain == pytest.approx(1.3, rel=1e-4)
    assert found.modulation == pytest.approx(1, abs=1e-3)
    assert found.spread < 0.1


@pytest.mark.parametrize("mount", ["sensor", "filter"])
def test_misfits_are_those_of_the_angle_and_of_a_quarter_turn(mount: Mount) -> None:
    """Against the differences written out, of a picture with light that the prediction lacks."""
    stokes, degrees = light(), 30.0
    picture = 0.8 * behind(stokes, degrees, mount) + 0.02 * torch.rand(
        HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(3)
    )
    found = fit_angle(picture, stokes, ALL, RAYS, mount)

    def misfit(angle: float) -> float:
        cosine, sine = optics.analyzer(math.radians(angle), RAYS, mount)[..., None].unbind(0)
        shown = stokes[0] + found.modulation * (stokes[1] * cosine + stokes[2] * sine)
        fair = (1 / (stokes[0].mean(dim=-1) + FLOOR))[..., None]
        return float((fair * (picture - found.gain * shown / 2).abs()).sum() / (fair * picture).sum())

    assert found.misfit == pytest.approx(misfit(found.angle), rel=1e-2)
    assert found.misfit_across == pytest.approx(misfit(found.angle + 90), rel=2e-2)
    assert found.misfit < 0.05 < found.misfit_across


def test_what_is_not_explained_does_not_pull() -> None:
    """A quarter of the picture has a highlight that the prediction lacks."""
    picture = behind(light(), 30.0)
    picture[: HEIGHT // 2, : WIDTH // 2] += 0.5
    found = fit_angle(picture, light(), ALL, RAYS, "sensor")
    assert found.angle == pytest.approx(30, abs=1)
    assert found.gain == pytest.approx(1, abs=0.02)


def test_masked_pixels_do_not_count() -> None:
    picture, weight = behind(light(), 30.0), ALL.clone()
    picture[:10], weight[:10] = 1.0, 0.0
    found = fit_angle(picture, light(), weight, RAYS, "sensor")
    assert found.angle == pytest.approx(30, abs=1e-2)


def test_without_a_filter_the_certainty_is_zero() -> None:
    found = fit_angle(0.8 * light()[0] / 2, light(), ALL, RAYS, "sensor")
    assert found.modulation < 1e-3
    assert found.gain == pytest.approx(0.8, rel=1e-4)


def test_the_spread_tells_how_far_off_the_angle_may_be() -> None:
    """Predictions whose errors are as large as the polarization: of many pictures the errors spread as is stated."""
    errors, spreads = [], []
    for seed in range(24):
        noise = 0.15 * torch.randn(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(100 + seed))
        found = fit_angle(behind(light(seed), 70.0) + noise, light(seed), ALL, RAYS, "sensor")
        errors.append(found.angle - 70)
        spreads.append(found.spread)
    size = math.sqrt(sum(error**2 for error in errors) / len(errors))
    assert 0.4 < size / (sum(spreads) / len(spreads)) < 2.5


def test_unpolarized_light_tells_nothing() -> None:
    stokes = light()
    stokes[1:] = 0
    assert fit_angle(stokes[0] / 2, stokes, ALL, RAYS, "sensor") is None
    assert fit_angle(stokes[0] / 2, light(), torch.zeros(HEIGHT, WIDTH), RAYS, "sensor") is None
