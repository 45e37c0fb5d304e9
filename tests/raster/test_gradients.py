"""Gradients of the reference implementation against finite differences, without cut-off, cap or clamp."""

from collections.abc import Callable

import pytest
import torch
from raster_scenes import looking_ahead, posed
from reference_rasterizer import rasterize_reference
from torch import Tensor

from polarguide.geometry.camera import Camera
from polarguide.raster import ScreenStatistic, Splats


def smooth(camera: Camera, count: int = 4, channels: int = 2) -> Splats:
    """Float64 Gaussians so wide that they cover every pixel, too transparent to end one."""
    generator = torch.Generator().manual_seed(3)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    depth = 3 + torch.arange(count, dtype=torch.float64)[torch.randperm(count, generator=generator)]
    local = torch.cat((0.6 * (uniform(count, 2) - 0.5), torch.ones(count, 1)), dim=1) * depth[:, None]
    return Splats(
        (local - camera.translation) @ camera.rotation,
        2 * uniform(count, 4) - 1,
        (0.5 + uniform(count, 3)) * depth[:, None] * 0.8,
        0.3 + 0.4 * uniform(count),
        uniform(count, channels),
    )


def test_the_smooth_scene_is_far_from_every_cut_off() -> None:
    camera = posed(5, 4)
    gaussians = smooth(camera)
    for index in range(len(gaussians.means)):
        alone = Splats(*(t[index : index + 1] for t in gaussians))
        alpha = rasterize_reference(alone, camera).alpha
        assert float(alpha.min()) > 2 / 255
        assert float(alpha.max()) < 0.9
    assert float(rasterize_reference(gaussians, camera).alpha.max()) < 0.99


@pytest.mark.parametrize("name", Splats._fields)
@pytest.mark.parametrize("camera", [looking_ahead(5, 4), posed(5, 4)], ids=["ahead", "posed"])
def test_each_gradient_against_finite_differences(camera: Camera, name: str) -> None:
    gaussians = smooth(camera)

    def pictures(values: Tensor) -> tuple[Tensor, Tensor]:
        return rasterize_reference(gaussians._replace(**{name: values}), camera)[:2]

    values = getattr(gaussians, name).clone().requires_grad_()
    assert torch.autograd.gradcheck(pictures, (values,), eps=1e-6, atol=1e-7, rtol=1e-5)


def test_all_gradients_together() -> None:
    camera = posed(4, 3)
    inputs = tuple(t.clone().requires_grad_() for t in smooth(camera, count=3))

    def pictures(*values: Tensor) -> tuple[Tensor, Tensor]:
        return rasterize_reference(Splats(*values), camera)[:2]

    assert torch.autograd.gradcheck(pictures, inputs, eps=1e-6, atol=1e-7, rtol=1e-5)


def test_length_of_a_quaternion_does_not_matter_and_has_no_gradient() -> None:
    camera = posed(5, 4)
    gaussians = smooth(camera)
    rotations = gaussians.rotations.clone().requires_grad_()
    picture = rasterize_reference(gaussians._replace(rotations=rotations), camera).features
    longer = rasterize_reference(gaussians._replace(rotations=3.7 * gaussians.rotations), camera).features
    torch.testing.assert_close(longer, picture.detach())
    (gradient,) = torch.autograd.grad(picture.square().sum(), rotations)
    assert float(gradient.norm()) > 1e-3
    torch.testing.assert_close((gradient * rotations.detach()).sum(dim=1), torch.zeros(4).double())


def shifted(camera: Camera, direction: Tensor, pixels: float) -> Callable[[Tensor], Tensor]:
    """Moves world points [N, 3] by some pixels along a direction [2] of the picture, keeping their depth."""

    def move(means: Tensor) -> Tensor:
        local = means @ camera.rotation.T + camera.translation
        step = pixels * direction / torch.tensor([camera.fx, camera.fy]).double() * local[:, 2:]
        local = torch.cat((local[:, :2] + step, local[:, 2:]), dim=1)
        return (local - camera.translation) @ camera.rotation

    return move


def test_statistic_is_the_derivative_by_the_projected_mean() -> None:
    """Round Gaussians near the axis hardly change shape, so moving the mean moves the splat alone."""
    camera = looking_ahead(12, 10, focal=4000.0)
    generator = torch.Generator().manual_seed(2)
    depth = torch.tensor([40.0, 50.0, 60.0], dtype=torch.float64)
    across = 5 * torch.rand(3, 2, generator=generator, dtype=torch.float64) - 2.5
    size = depth / camera.fx
    gaussians = Splats(
        torch.cat((across * size[:, None], depth[:, None]), dim=1),
        torch.tensor([[1.0, 0, 0, 0]]).double().repeat(3, 1),
        6 * size[:, None].repeat(1, 3),
        torch.tensor([0.3, 0.5, 0.4]).double(),
        torch.rand(3, 4, generator=generator, dtype=torch.float64),
    )
    statistic = ScreenStatistic((1, 2))
    weights = torch.rand(10, 12, 4, generator=generator, dtype=torch.float64)
    watched = gaussians._replace(means=gaussians.means.clone().requires_grad_())
    picture = rasterize_reference(watched, camera, statistic=statistic)
    (picture.features * weights).sum().backward()

    def loss(means: Tensor) -> float:
        shown = rasterize_reference(gaussians._replace(means=means), camera).features
        return float((shown * weights)[..., [1, 2]].sum())

    for index in range(3):
        for axis in range(2):
            direction = torch.eye(2, dtype=torch.float64)[axis]
            ahead, behind = gaussians.means.clone(), gaussians.means.clone()
            ahead[index] = shifted(camera, direction, 1e-3)(ahead)[index]
            behind[index] = shifted(camera, direction, -1e-3)(behind)[index]
            slope = (loss(ahead) - loss(behind)) / 2e-3
            assert slope == pytest.approx(float(statistic.gradient[index, axis]), rel=2e-3, abs=2e-3)
