"""The loss terms against slow loops over rays, and what the published angles do at 180 degrees."""

from __future__ import annotations

import math

import pytest
import torch

from polarguide import optics
from polarguide.fields import losses

GENERATOR = torch.Generator().manual_seed(2)
COUNT = 12


def normals(*shape: int) -> torch.Tensor:
    return torch.nn.functional.normalize(
        torch.randn(*shape, 3, generator=GENERATOR, dtype=torch.float64), dim=-1
    )


def uniform(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=GENERATOR, dtype=torch.float64)


RAYS = torch.nn.functional.normalize(
    torch.cat((0.3 * torch.randn(COUNT, 2, generator=GENERATOR), torch.ones(COUNT, 1)), dim=1).double(), dim=1
)


def predicted(normal: torch.Tensor, ray: torch.Tensor) -> float:
    """Angle of the electric field ``ray x normal`` in the lens frame, in [0, pi)."""
    return float(optics.azimuth(torch.linalg.cross(ray, normal), ray)) % math.pi


def test_the_color_counts_where_nothing_is_polarized() -> None:
    found, wanted, dolp = uniform(COUNT, 3), uniform(COUNT, 3), uniform(COUNT)
    slow = sum(
        float((1 - dolp[n]) * (found[n, c] - wanted[n, c]).abs()) for n in range(COUNT) for c in range(3)
    )
    assert float(losses.color_loss(found, wanted, dolp)) == pytest.approx(slow / (3 * COUNT))


@pytest.mark.parametrize("circular", [False, True])
def test_angles_against_a_loop(circular: bool) -> None:
    normal, aolp, dolp = normals(COUNT) * uniform(COUNT, 1), math.pi * uniform(COUNT), uniform(COUNT)
    slow = 0.0
    for n in range(COUNT):
        difference = predicted(normal[n], RAYS[n]) - float(aolp[n])
        slow += float(dolp[n]) * (0.5 - 0.5 * math.cos(2 * difference) if circular else abs(difference))
    found = losses.aolp_loss(normal, RAYS, aolp, dolp, circular=circular)
    assert float(found) == pytest.approx(slow / COUNT, rel=1e-6)


def test_the_published_difference_jumps_and_the_circular_one_does_not() -> None:
    """Angles of 179 and 1 degrees differ by 2, and by 178 as numbers."""
    ray, one = torch.tensor([[0.0, 0, 1]]).double(), torch.ones(1).double()
    normal = optics.normal_from_angles(one, torch.deg2rad(one * 89), ray)  # specular light of it: 179 degrees
    assert predicted(normal[0], ray[0]) == pytest.approx(math.radians(179))
    aolp = torch.deg2rad(one)
    published = losses.aolp_loss(normal, ray, aolp, one, circular=False)
    assert float(published) == pytest.approx(math.radians(178))
    circular = losses.aolp_loss(normal, ray, aolp, one, circular=True)
    assert float(circular) == pytest.approx(math.sin(math.radians(2)) ** 2)


@pytest.mark.parametrize("circular", [False, True])
def test_normals_toward_the_camera_keep_gradients_finite(circular: bool) -> None:
    normal = (-RAYS).clone().requires_grad_()
    loss = losses.aolp_loss(normal, RAYS, uniform(COUNT), uniform(COUNT), circular=circular)
    loss.backward()
    assert bool(normal.grad.isfinite().all())


def test_slopes_of_length_one_cost_nothing() -> None:
    assert float(losses.eikonal_loss(normals(COUNT))) < 1e-10
    assert float(losses.eikonal_loss(3 * normals(COUNT, 2))) == pytest.approx(4.0)


def doubled(vector: torch.Tensor) -> torch.Tensor:
    """A vector with twice its angle, by trigonometry."""
    angle = 2 * math.atan2(float(vector[1]), float(vector[0]))
    return float(vector.norm()) * torch.tensor([math.cos(angle), math.sin(angle)]).double()


@pytest.mark.parametrize("circular", [False, True])
def test_guidance_against_a_loop(circular: bool) -> None:
    samples = 3
    own, around, weights = normals(COUNT, samples), normals(COUNT, samples, 6), uniform(COUNT, samples)
    aolp, beside, dolp = math.pi * uniform(COUNT), math.pi * uniform(COUNT, 4), uniform(COUNT)
    turn = doubled if circular else lambda vector: vector
    slow = 0.0
    for n in range(COUNT):
        right, up = optics.lens_frame(RAYS[n])
        frame = torch.stack((right, up))
        cov = torch.zeros(2, 2).double()
        blended = torch.zeros(2).double()
        for k in range(samples):
            flat = frame @ own[n, k]
            blended += weights[n, k] * flat
            apart = [turn(frame @ around[n, k, m]) - turn(flat) for m in range(6)]
            cov += weights[n, k] * sum(torch.outer(a, a) for a in apart) / 5
        field = [turn(torch.tensor([math.sin(a), -math.cos(a)]).double()) for a in (aolp[n], *beside[n])]
        wanted = sum(torch.outer(f - field[0], f - field[0]) for f in field[1:]) / 3
        slow += float(dolp[n] * (cov - float(blended @ blended) * wanted).abs().sum()) / 4
    found = losses.guidance_loss(own, around, weights, RAYS, aolp, beside, dolp, circular=circular)
    assert float(found) == pytest.approx(slow / COUNT, rel=1e-6)


def test_the_published_covariance_jumps_at_180_degrees() -> None:
    """Neighbors that differ by two degrees across the jump look as if they were opposite."""
    one = torch.ones(1).double()
    flat, weight = torch.tensor([[[1.0, 0, 0]]]).double(), torch.ones(1, 1).double()
    ray, around = torch.tensor([[0.0, 0, 1]]).double(), flat[:, :, None].expand(1, 1, 6, 3)
    angles = torch.deg2rad(one * 179), torch.deg2rad(one).expand(1, 4)
    jump = losses.guidance_loss(flat, around, weight, ray, *angles, one, circular=False)
    smooth = losses.guidance_loss(flat, around, weight, ray, *angles, one, circular=True)
    assert float(jump) > 1.0
    assert float(smooth) < 0.01
