"""Normals of a depth picture: planes are exact, and the term is zero where normals and depth agree."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize
from torch.testing import assert_close

from polarguide.geometry.camera import Camera
from polarguide.shading.result import RenderResult
from polarguide.training.losses import consistency_loss, depth_normals

TURN = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)).Q
CAMERA = Camera(
    24, 20, 30.0, 28.0, 11.0, 10.5, TURN * torch.linalg.det(TURN), torch.zeros(3, dtype=torch.float64)
)
PLANES = ([0.0, 0.0, -1.0], [0.3, -0.2, -1.0], [-0.6, 0.5, -0.8])


def depth_of_plane(normal: Tensor, distance: float = 5.0) -> Tensor:
    """Camera depth of the plane ``normal . x = -distance`` in camera axes."""
    rays = CAMERA.rays(dtype=torch.float64)
    return -distance * rays[..., 2] / (rays @ normal)


def result(normal: Tensor, depth: Tensor, alpha: Tensor) -> RenderResult:
    empty = dict.fromkeys(("specular", "diffuse", "reflection", "strength"))
    picture = torch.zeros(20, 24, 3)
    return RenderResult(
        final=picture, base=picture, alpha=alpha, radii=torch.ones(1), normal=normal, depth=depth, **empty
    )


@pytest.mark.parametrize("plane", PLANES)
@pytest.mark.parametrize("distance", [0.01, 5.0, 1000.0])
def test_a_plane_has_its_own_normal_everywhere(plane: list[float], distance: float) -> None:
    normal = normalize(torch.tensor(plane, dtype=torch.float64), dim=0)
    found = depth_normals(depth_of_plane(normal, distance), CAMERA)
    assert_close(CAMERA.to_camera(found[1:-1, 1:-1]), normal.expand(18, 22, 3), rtol=0, atol=1e-6)
    for border in (found[0], found[-1], found[:, 0], found[:, -1]):
        assert not border.any()


def test_the_term_is_zero_where_all_agree_and_grows_with_the_angle() -> None:
    normal = normalize(torch.tensor(PLANES[1], dtype=torch.float64), dim=0)
    depth, alpha = depth_of_plane(normal), torch.full((20, 24), 0.7, dtype=torch.float64)
    world = CAMERA.to_world(normal.expand(20, 24, 3))
    same = consistency_loss(result(0.7 * world, depth, alpha), CAMERA)
    assert float(same) == pytest.approx(0.0, abs=1e-6)
    opposite = consistency_loss(result(-0.7 * world, depth, alpha), CAMERA)
    assert float(opposite) == pytest.approx(1.4, abs=1e-6)
    scattered = consistency_loss(result(0.3 * world, depth, alpha), CAMERA)
    assert float(scattered) == pytest.approx(0.4, abs=1e-6)


def test_gradients_against_finite_differences() -> None:
    generator = torch.Generator().manual_seed(0)
    depth = (3 + torch.rand(20, 24, generator=generator, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda d: depth_normals(d, CAMERA), (depth,), fast_mode=True)


@pytest.mark.parametrize("value", [0.0, 1e-8, 2.0])
def test_any_constant_depth_is_finite_with_gradients(value: float) -> None:
    depth = torch.full((20, 24), value, requires_grad=True)
    normals = depth_normals(depth, CAMERA)
    normals.sum().backward()
    assert depth.grad is not None
    assert bool(torch.isfinite(normals).all())
    assert bool(torch.isfinite(depth.grad).all())


def test_pixels_without_weight_do_not_count() -> None:
    normal = normalize(torch.tensor(PLANES[1], dtype=torch.float64), dim=0)
    depth, alpha = depth_of_plane(normal), torch.ones(20, 24, dtype=torch.float64)
    world = CAMERA.to_world(normal.expand(20, 24, 3)).clone()
    world[:, :12] = -world[:, :12]
    weight = torch.zeros(20, 24, dtype=torch.float64)
    weight[:, 12:] = 1
    assert float(consistency_loss(result(world, depth, alpha), CAMERA, weight)) == pytest.approx(0, abs=1e-6)
    assert float(consistency_loss(result(world, depth, alpha), CAMERA, 1 - weight)) > 0.5


def test_a_picture_without_an_inner_pixel_has_no_loss() -> None:
    normal, ones = torch.zeros(2, 30, 3), torch.ones(2, 30)
    assert float(consistency_loss(result(normal, ones, ones), CAMERA)) == 0
