"""Behind the subject, terms on normals turn Gaussians, and neither move nor fade them."""

import pytest
import torch
from raster_scenes import difference
from reference_rasterizer import rasterize_reference
from torch import Tensor

from polarguide.geometry.camera import Camera
from polarguide.raster.cpu import rasterize_cpu
from polarguide.raster.interface import Rasterize
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.shading.result import RenderResult
from polarguide.training.behind import fade_behind, shares_before

CAMERA = Camera(
    32, 24, 40.0, 40.0, 16.0, 12.0, torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
)
GEOMETRY = ("means", "opacity_logits")


def gaussians(dtype: torch.dtype) -> dict[str, Tensor]:
    """Some near, to the left, and some far away, to the right, that overlap hardly."""
    generator = torch.Generator().manual_seed(2)

    def random(*size: int) -> Tensor:
        return torch.rand(*size, generator=generator, dtype=torch.float64) - 0.5

    left = torch.arange(40) < 20
    depth = torch.where(left, 2.0, 10.0).double() + 0.1 * random(40)
    x = torch.where(left, -0.2, 0.2).double() + 0.16 * random(40)
    means = torch.stack((x * depth, 0.4 * random(40) * depth, depth), dim=1)
    tensors = {
        "means": means,
        "quaternions": random(40, 4),
        "log_scales": torch.log(0.02 * depth)[:, None] + random(40, 3),
        "opacity_logits": 2 * random(40),
        "sh_dc": random(40, 3),
        "sh_rest": 0 * random(40, 15 * 3).reshape(40, 15, 3),
    }
    return {name: t.to(dtype).requires_grad_() for name, t in tensors.items()}


def rendered(of: dict[str, Tensor], rasterize: Rasterize) -> RenderResult:
    return render(of, CAMERA, rasterize, RenderRequest(sh_degree=0, depth=True, normal_rotation_only=True))


def gradients(
    behind: tuple[float, float] | None, rasterize: Rasterize, dtype: torch.dtype
) -> dict[str, Tensor]:
    """Of a loss on the normals and the depth of the right half, where all is far away."""
    of = gaussians(dtype)
    result = rendered(of, rasterize)
    if behind is not None:
        result = fade_behind(result, *behind)
    generator = torch.Generator().manual_seed(3)
    weight = torch.rand(24, 32, 4, generator=generator, dtype=torch.float64).to(dtype)
    weight[:, :17] = 0
    ((weight[..., :3] * result.normal).sum() + (weight[..., 3] * result.depth).sum()).backward()
    return {name: torch.zeros_like(t) if t.grad is None else t.grad for name, t in of.items()}


@pytest.mark.parametrize(
    ("rasterize", "dtype"), [(rasterize_cpu, torch.float32), (rasterize_reference, torch.float64)]
)
def test_far_gaussians_turn_and_neither_move_nor_fade(rasterize: Rasterize, dtype: torch.dtype) -> None:
    all_of_it, held = (gradients(behind, rasterize, dtype) for behind in (None, (3.0, 5.0)))
    for name in GEOMETRY:
        assert all_of_it[name].abs().max() > 1e-3
        assert held[name].abs().max() == 0
    # Rotations do two things: they turn normals, which stays, and shapes, which goes.
    assert held["quaternions"].abs().max() > 1e-3
    near = gradients((20.0, 30.0), rasterize, dtype)
    for name, gradient in all_of_it.items():
        assert difference(near[name], gradient) < 1e-5


def test_half_way_half_of_the_gradient_moves() -> None:
    # Depths are about 10: a share of one half lies where the inverse depth is midway.
    depth = rendered(gaussians(torch.float32), rasterize_cpu).depth
    shares = shares_before(depth.detach(), 5.0, 1e9)[:, 20:]
    whole, part = (gradients(behind, rasterize_cpu, torch.float32) for behind in (None, (5.0, 1e9)))
    ratio = float(part["means"].norm() / whole["means"].norm())
    assert float(shares.min()) < ratio < float(shares.max())


def test_native_and_reference_agree_on_what_is_held() -> None:
    native, reference = (
        gradients((5.0, 20.0), rasterize, dtype)
        for rasterize, dtype in ((rasterize_cpu, torch.float32), (rasterize_reference, torch.float64))
    )
    for name, gradient in reference.items():
        assert difference(native[name], gradient) < 1e-4, name


def test_pictures_are_the_same_to_the_bit() -> None:
    of = gaussians(torch.float32)
    result = rendered(of, rasterize_cpu)
    turned = fade_behind(result, 3.0, 5.0)
    assert torch.equal(result.training["rotation_only_normal"], result.normal)
    assert torch.equal(turned.normal, result.normal)
    assert torch.equal(turned.depth, result.depth)
    assert "rotation_only_normal" in rendered(of, rasterize_cpu).training
    assert (
        "rotation_only_normal" not in render(of, CAMERA, rasterize_cpu, RenderRequest(sh_degree=0)).training
    )


def test_shares_by_depth() -> None:
    depth = torch.full((5, 7), 1.0)
    depth[:, 4] = 3.0
    depth[:, 5] = 2.0
    depth[:, 6] = 9.0
    share = shares_before(depth, 2.0, 4.0)[2]
    third = (1 / 3 - 1 / 4) / (1 / 2 - 1 / 4)
    assert torch.allclose(share, torch.tensor([1, 1, 1, third, third, 0, 0]))


@pytest.mark.parametrize("size", [(1, 1), (1, 6), (7, 1), (5, 8)])
def test_a_pixel_is_as_far_as_the_farthest_of_its_neighbors(size: tuple[int, int]) -> None:
    near, far = 2.0, 5.0
    depth = 1 + 6 * torch.rand(size, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    farthest = torch.nn.functional.max_pool2d(depth[None], 3, 1, 1)[0]
    expected = ((1 / farthest - 1 / far) / (1 / near - 1 / far)).clamp(0, 1)
    torch.testing.assert_close(shares_before(depth, near, far), expected)
