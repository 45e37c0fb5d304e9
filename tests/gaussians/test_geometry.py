"""Normals of flat Gaussians."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from polarguide.gaussians.geometry import quaternions_to_rotations, shortest_axis_normals

COUNT = 50


def shapes(dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    means, quaternions, log_scales = (
        torch.randn(COUNT, size, generator=generator, dtype=dtype) for size in (3, 4, 3)
    )
    return means, quaternions, log_scales, torch.tensor([0.3, -2.0, 1.0], dtype=dtype)


def test_the_normal_is_the_shortest_axis() -> None:
    means, quaternions, log_scales, center = shapes()
    normals = shortest_axis_normals(means, quaternions, log_scales, center)
    axes = quaternions_to_rotations(quaternions)
    shortest = axes[torch.arange(COUNT), :, log_scales.argmin(dim=1)]
    torch.testing.assert_close((normals * shortest).sum(dim=1).abs(), torch.ones(COUNT))
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(COUNT))
    assert set(log_scales.argmin(dim=1).tolist()) == {0, 1, 2}


def test_the_normal_faces_the_camera() -> None:
    means, quaternions, log_scales, center = shapes()
    normals = shortest_axis_normals(means, quaternions, log_scales, center)
    toward = torch.nn.functional.normalize(center - means, dim=1)
    assert float((normals * toward).sum(dim=1).min()) >= -1e-6
    opposite = shortest_axis_normals(means, quaternions, log_scales, 2 * means.mean(dim=0) - center)
    assert float((opposite * normals).sum(dim=1).min()) == pytest.approx(-1.0, abs=1e-5), "some turn over"


@pytest.mark.parametrize("factor", [0.01, -3.0])
def test_length_and_sign_of_the_quaternion_do_not_matter(factor: float) -> None:
    means, quaternions, log_scales, center = shapes()
    torch.testing.assert_close(
        shortest_axis_normals(means, factor * quaternions, log_scales, center),
        shortest_axis_normals(means, quaternions, log_scales, center),
    )


def test_gradient_in_the_quaternions_against_finite_differences() -> None:
    means, quaternions, log_scales, center = shapes(torch.float64)
    facing = torch.randn(COUNT, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    away = ((center - means) * shortest_axis_normals(means, quaternions, log_scales, center)).sum(1) > 0.1
    few = away.nonzero()[:6, 0]
    assert len(few) == 6

    def normals(q: Tensor) -> Tensor:
        return shortest_axis_normals(means[few], q, log_scales[few], center) * facing[few]

    assert torch.autograd.gradcheck(normals, (quaternions[few].clone().requires_grad_(),), atol=1e-7)


def test_means_and_scales_get_no_gradient() -> None:
    means, quaternions, log_scales, center = shapes()
    inputs = [t.clone().requires_grad_() for t in (means, quaternions, log_scales)]
    shortest_axis_normals(*inputs, center).sum().backward()
    assert inputs[0].grad is None
    assert inputs[1].grad is not None
    assert inputs[2].grad is None
