"""What blending means, in closed form."""

import math

import pytest
import torch
from raster_scenes import in_view, looking_ahead, posed
from reference_rasterizer import rasterize_reference

from polarguide.raster import Rasterize, Splats
from polarguide.raster.cpu import rasterize_cpu

BOTH = pytest.mark.parametrize("rasterize", [rasterize_cpu, rasterize_reference], ids=["cpu", "reference"])


def at_depths(depths: list[float], opacities: list[float], colors: list[list[float]]) -> Splats:
    """Round Gaussians on the optical axis, each of 2 pixels' spread for a focal length of 20 pixels."""
    depth = torch.tensor(depths)
    return Splats(
        torch.stack((0 * depth, 0 * depth, depth), dim=1),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(depths), 1),
        (depth / 10)[:, None].repeat(1, 3),
        torch.tensor(opacities),
        torch.tensor(colors),
    )


@BOTH
@pytest.mark.parametrize("opacity", [0.05, 0.5, 0.98])
def test_one_round_gaussian_in_closed_form(rasterize: Rasterize, opacity: float) -> None:
    camera = looking_ahead(21, 15, focal=20.0)
    picture = rasterize(at_depths([4.0], [opacity], [[2.0, -1.0]]), camera)
    assert float(picture.alpha[7, 10]) == pytest.approx(opacity, rel=1e-5)
    y, x = torch.meshgrid(torch.arange(15.0) - 7, torch.arange(21.0) - 10, indexing="ij")
    alpha = opacity * torch.exp(-(x**2 + y**2) / (2 * (2.0**2 + 0.1)))
    alpha[alpha < 1 / 255] = 0
    torch.testing.assert_close(picture.alpha, alpha, atol=2e-6, rtol=1e-5)
    torch.testing.assert_close(picture.features, alpha[..., None] * torch.tensor([2.0, -1.0]))


@BOTH
def test_alpha_never_exceeds_its_cap(rasterize: Rasterize) -> None:
    picture = rasterize(at_depths([4.0], [0.9999], [[1.0]]), looking_ahead(21, 15, focal=20.0))
    assert float(picture.alpha.max()) == pytest.approx(0.99, abs=1e-6)


@BOTH
@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_nearer_gaussian_is_in_front_whatever_its_index(
    rasterize: Rasterize, order: tuple[int, int]
) -> None:
    near, far, red, blue = 0.6, 0.9, [1.0, 0.0], [0.0, 1.0]
    gaussians = at_depths([3.0, 5.0], [near, far], [red, blue])
    shuffled = Splats(*(t[list(order)] for t in gaussians))
    center = rasterize(shuffled, looking_ahead(21, 15, focal=20.0)).features[7, 10]
    torch.testing.assert_close(center, torch.tensor([near, (1 - near) * far]), atol=1e-6, rtol=1e-5)


@BOTH
def test_equal_depths_blend_by_index(rasterize: Rasterize) -> None:
    gaussians = at_depths([4.0, 4.0, 4.0], [0.5, 0.5, 0.5], [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    center = rasterize(gaussians, looking_ahead(21, 15, focal=20.0)).features[7, 10]
    torch.testing.assert_close(center, torch.tensor([0.5, 0.25, 0.125]), atol=1e-6, rtol=1e-5)


@BOTH
def test_order_is_depth_along_the_axis_of_the_camera(rasterize: Rasterize) -> None:
    """A Gaussian farther from the camera's center but at less depth is in front."""
    camera = looking_ahead(41, 15, focal=20.0)
    gaussians = Splats(
        torch.tensor([[0.0, 0.0, 4.0], [3.9, 0.0, 3.9]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2),
        torch.full((2, 3), 2.0),
        torch.tensor([0.9, 0.9]),
        torch.tensor([[1.0, 0.0], [0.0, 1.0]]),
    )
    assert gaussians.means[1].norm() > gaussians.means[0].norm()
    row = rasterize(gaussians, camera).features[7]
    alone = [rasterize(Splats(*(t[i : i + 1] for t in gaussians)), camera).alpha[7] for i in range(2)]
    torch.testing.assert_close(row[:, 1], alone[1], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(row[:, 0], alone[0] * (1 - alone[1]), atol=1e-5, rtol=1e-4)


def test_any_permutation_of_the_gaussians_gives_the_same_picture() -> None:
    camera = posed(33, 20)
    gaussians = in_view(camera, 50, 5, seed=8)
    order = torch.randperm(50, generator=torch.Generator().manual_seed(1))
    straight = rasterize_cpu(gaussians, camera)
    shuffled = rasterize_cpu(Splats(*(t[order] for t in gaussians)), camera)
    assert torch.equal(shuffled.features, straight.features)
    assert torch.equal(shuffled.radii, straight.radii[order])


@BOTH
def test_constant_features_blend_to_alpha(rasterize: Rasterize) -> None:
    camera = posed(33, 20)
    gaussians = in_view(camera, 50, 5, seed=8)
    picture = rasterize(gaussians._replace(features=torch.full((50, 5), 3.0)), camera)
    expected = 3 * picture.alpha[..., None].expand(-1, -1, 5)
    torch.testing.assert_close(picture.features, expected, atol=1e-5, rtol=1e-5)


def test_moving_camera_and_gaussians_together_changes_nothing() -> None:
    camera = posed(24, 24)
    gaussians = in_view(camera, 30, 3, seed=12)
    local = (gaussians.means.double() @ camera.rotation.T + camera.translation).float()
    w, x, y, z = (0.9, 0.2, -0.3, 0.1)  # the rotation of `posed`
    length = math.sqrt(w * w + x * x + y * y + z * z)
    a = torch.tensor([w, x, y, z]) / length
    b = gaussians.rotations
    turned = torch.stack(
        (
            a[0] * b[:, 0] - a[1] * b[:, 1] - a[2] * b[:, 2] - a[3] * b[:, 3],
            a[0] * b[:, 1] + a[1] * b[:, 0] + a[2] * b[:, 3] - a[3] * b[:, 2],
            a[0] * b[:, 2] - a[1] * b[:, 3] + a[2] * b[:, 0] + a[3] * b[:, 1],
            a[0] * b[:, 3] + a[1] * b[:, 2] - a[2] * b[:, 1] + a[3] * b[:, 0],
        ),
        dim=1,
    )
    eye, zero = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    still = type(camera)(24, 24, camera.fx, camera.fy, camera.cx, camera.cy, eye, zero)
    expected = rasterize_cpu(gaussians, camera)
    moved = rasterize_cpu(gaussians._replace(means=local, rotations=turned), still)
    torch.testing.assert_close(moved.features, expected.features, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(moved.radii, expected.radii, atol=1e-3, rtol=1e-4)
