"""Polarizers at any angle, behind the lens and before it, in float64."""

from __future__ import annotations

import math

import pytest
import torch

from polarguide import optics
from polarguide.camera import Camera

EYE = torch.eye(3, dtype=torch.float64)
CAMERA = Camera(40, 30, 52.0, 52.0, 20.0, 15.0, EYE, torch.zeros(3, dtype=torch.float64))
RAYS = CAMERA.rays(dtype=torch.float64)
AXIS = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


@pytest.mark.parametrize("degrees", [0.0, 17.0, 45.0, 90.0, 133.0])
def test_on_the_axis_a_filter_is_what_its_angle_says(degrees: float) -> None:
    twice = math.radians(2 * degrees)
    expected = torch.tensor([math.cos(twice), math.sin(twice)], dtype=torch.float64)
    assert torch.allclose(optics.filter_analyzer(math.radians(degrees), AXIS), expected, atol=1e-12)
    assert torch.allclose(optics.analyzer(math.radians(degrees), AXIS), expected, atol=1e-12)


@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0, 135.0])
def test_a_filter_passes_the_field_across_ray_and_absorption_axis(degrees: float) -> None:
    """Light polarized along the field that it passes is passed whole, light along the sheet's absorption axis, as far
    as a field across the ray can lie along it, not at all."""
    theta = math.radians(degrees)
    absorbing = torch.tensor([-math.sin(theta), -math.cos(theta), 0.0], dtype=torch.float64)
    absorbed = absorbing - (RAYS @ absorbing)[..., None] * RAYS
    passed = torch.linalg.cross(RAYS, absorbing.expand_as(RAYS))
    analyzer = optics.filter_analyzer(theta, RAYS)
    for field, share in ((passed, 1.0), (absorbed, 0.0)):
        azimuth = optics.azimuth(field, RAYS)
        stokes = torch.stack((torch.ones_like(azimuth), torch.cos(2 * azimuth), torch.sin(2 * azimuth)))
        through = (stokes[0] + stokes[1] * analyzer[0] + stokes[2] * analyzer[1]) / 2
        assert torch.allclose(through, torch.full_like(through, share), atol=1e-12)


def test_off_the_axis_a_filter_turns_by_half_of_x_y() -> None:
    cosine, sine = optics.filter_analyzer(0.0, RAYS)
    turned = torch.atan2(sine, cosine) / 2
    x, y = RAYS[..., 0] / RAYS[..., 2], RAYS[..., 1] / RAYS[..., 2]
    assert float(turned.abs().max()) > math.radians(2)
    assert torch.allclose(turned.abs(), (x * y / 2).abs(), atol=0.15 * float(turned.abs().max()))
    other = optics.filter_analyzer(math.pi / 2, RAYS)
    across = torch.atan2(other[1], -other[0]) / -2
    assert torch.allclose(
        turned, -across, atol=0.2 * float(turned.abs().max())
    )  # they turn against each other


@pytest.mark.parametrize("mount", ["sensor", "filter"])
@pytest.mark.parametrize("degrees", [(0.0, 60.0, 120.0), (10.0, 35.0, 80.0, 100.0), (0.0, 45.0, 90.0, 135.0)])
def test_least_squares_give_back_stokes_vectors(mount: optics.Mount, degrees: tuple[float, ...]) -> None:
    generator = torch.Generator().manual_seed(0)
    stokes = torch.randn(3, 30, 40, 3, generator=generator, dtype=torch.float64)
    analyzers = torch.stack([optics.analyzer(math.radians(angle), RAYS, mount) for angle in degrees])
    spread = analyzers if mount == "filter" else analyzers[..., None, None]
    parts = [(stokes[0] + stokes[1] * c[..., None] + stokes[2] * s[..., None]) / 2 for c, s in spread]
    found = optics.fitted_stokes(torch.stack(parts), analyzers)
    assert torch.allclose(found, stokes, atol=1e-10)


def test_four_angles_give_what_the_closed_form_gives() -> None:
    four = torch.rand(4, 5, 6, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    analyzers = torch.stack([optics.analyzer(k * math.pi / 4, AXIS) for k in range(4)])
    assert torch.allclose(optics.fitted_stokes(four, analyzers), optics.stokes(four), atol=1e-12)


def test_as_many_analyzers_as_intensities_are_asked_for() -> None:
    with pytest.raises(ValueError, match="intensities"):
        optics.fitted_stokes(torch.rand(3, 2, 2, 3), torch.zeros(4, 2))
