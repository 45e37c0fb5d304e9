"""The cubemap: kernel against reference implementation, seams, orientation, finite differences."""

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize
from torch.testing import assert_close

from polarguide import _native
from polarguide.shading.cubemap import (
    cubemap_lookup,
    cubemap_lookup_reference,
    texel_directions,
)

resolutions = pytest.mark.parametrize("resolution", [1, 2, 3, 16])


def texture_of(resolution: int, channels: int = 3, dtype: torch.dtype = torch.float32) -> Tensor:
    generator = torch.Generator().manual_seed(resolution)
    return torch.randn(6, resolution, resolution, channels, generator=generator, dtype=dtype)


def some_directions(count: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """All over the sphere, of lengths from 0.1 to 10, many of them near edges and corners of the cube."""
    generator = torch.Generator().manual_seed(count)
    directions = torch.randn(count, 3, generator=generator, dtype=dtype)
    directions[::3] = directions[::3].sign() + 0.05 * directions[::3]
    directions[1::3, 1] = directions[1::3, 0].abs() * (1 + 0.02 * directions[1::3, 1])
    return directions * 10 ** (2 * torch.rand(count, 1, generator=generator, dtype=dtype) - 1)


def away_from_kinks(directions: Tensor, resolution: int) -> Tensor:
    """Which directions are not at a border between two cells, where the gradient jumps."""
    ratios = directions / directions.abs().max(dim=-1, keepdim=True).values
    cell = (ratios + 1) * resolution / 2 + 0.5
    near = (cell - cell.round()).abs() < 1e-3 * resolution
    sizes = directions.abs().sort(dim=-1).values
    return (near & (ratios.abs() < 1)).sum(dim=-1).eq(0) & (sizes[:, 2] - sizes[:, 1] > 1e-3 * sizes[:, 2])


def with_gradients(function, texture: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    leaves = texture.detach().clone().requires_grad_(), directions.detach().clone().requires_grad_()
    out = function(*leaves)
    weights = torch.linspace(-1, 2, out.numel(), dtype=out.dtype).reshape(out.shape)
    to_texture, to_directions = torch.autograd.grad((out * weights).sum(), leaves)
    return out.detach(), to_texture, to_directions


@resolutions
@pytest.mark.parametrize("channels", [1, 3, 5])
@pytest.mark.parametrize("count", [1, 15, 16, 17, 5000])
def test_kernel_agrees_with_the_reference(simd: str, resolution: int, channels: int, count: int) -> None:
    texture, directions = texture_of(resolution, channels), some_directions(count)
    found = with_gradients(cubemap_lookup, texture, directions)
    exact = with_gradients(cubemap_lookup_reference, texture.double(), directions.double())
    assert_close(found[0].double(), exact[0], rtol=0, atol=1e-5 * resolution)
    assert float((found[1] - exact[1]).norm()) <= 1e-4 * float(exact[1].norm())
    smooth = away_from_kinks(directions, resolution)
    error = (found[2] - exact[2])[smooth].norm(dim=-1)
    assert float((error * directions[smooth].norm(dim=-1)).max() if len(error) else 0) < 1e-3 * resolution


@resolutions
def test_gradient_of_the_reference(resolution: int) -> None:
    texture, directions = texture_of(resolution, 2, torch.float64), some_directions(60, torch.float64)
    directions = normalize(directions[away_from_kinks(directions, resolution)], dim=-1)[:8]
    assert len(directions) > 3
    inputs = texture.requires_grad_(), directions.requires_grad_()
    torch.autograd.gradcheck(cubemap_lookup_reference, inputs)


def test_faces_follow_opengl(simd: str) -> None:
    """Table 8.19 of the OpenGL 4.6 specification: the directions of each face's middle, right and lower neighbor."""
    texture = torch.zeros(6, 3, 3, 1)
    texture[:, 1, 1], texture[:, 1, 2], texture[:, 2, 1] = 1, 2, 3
    texture += 10 * torch.arange(6)[:, None, None, None]
    middles = torch.tensor([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]).float()
    rights = torch.tensor([[0, 0, -1], [0, 0, 1], [1, 0, 0], [1, 0, 0], [1, 0, 0], [-1, 0, 0]]).float()
    downs = torch.tensor([[0, -1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [0, -1, 0], [0, -1, 0]]).float()
    for value, step in ((1, torch.zeros(6, 3)), (2, rights), (3, downs)):
        found = cubemap_lookup(texture, middles + step * (2 / 3))[:, 0]
        assert_close(found, 10.0 * torch.arange(6) + value)


@resolutions
def test_texel_centers_read_their_texel(simd: str, resolution: int) -> None:
    texture = texture_of(resolution)
    found = cubemap_lookup(texture, 7 * texel_directions(resolution).reshape(-1, 3))
    assert_close(found, texture.reshape(-1, 3), rtol=0, atol=1e-5)


@resolutions
def test_no_seams(simd: str, resolution: int) -> None:
    """Two directions on either side of an edge, or three around a corner, read nearly the same."""
    texture = texture_of(resolution)
    generator = torch.Generator().manual_seed(0)
    on_edges = torch.rand(4000, 3, generator=generator) * 2 - 1
    axis = torch.randint(3, (4000, 1), generator=generator)
    for step in (0, 1):
        place = (axis + step) % 3
        on_edges.scatter_(1, place, on_edges.gather(1, place).sign())
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3).repeat(50, 1)
    points = torch.cat((on_edges, corners))
    step = 1e-4 * torch.randn(2, len(points), 3, generator=generator)
    a, b = (cubemap_lookup(texture, points + s) for s in step)
    assert float((a - b).abs().max()) < 1e-3 * 4 * resolution


def test_corner_is_the_mean_of_three_texels(simd: str) -> None:
    texture = texture_of(4)
    corner = cubemap_lookup(texture, torch.tensor([[1.0, 1.0, 1.0], [1, 0.99999, 0.99999]]))
    mean = (texture[0, 0, 0] + texture[2, 3, 3] + texture[4, 0, 3]) / 3
    assert_close(corner, mean.expand(2, 3), rtol=0, atol=1e-4)


def test_constant_light_looks_constant(simd: str) -> None:
    out, to_texture, to_directions = with_gradients(
        cubemap_lookup, torch.full((6, 5, 5, 3), 2.5), some_directions(300)
    )
    assert_close(out, torch.full((300, 3), 2.5))
    assert_close(to_directions, torch.zeros(300, 3), rtol=0, atol=1e-5)
    weights = torch.linspace(-1, 2, 900).reshape(300, 3)
    assert_close(to_texture.sum(dim=(0, 1, 2)), weights.sum(dim=0), rtol=1e-4, atol=1e-3)


def test_length_of_a_direction_does_not_matter(simd: str) -> None:
    texture, directions = texture_of(8), some_directions(500)
    assert_close(cubemap_lookup(texture, directions), cubemap_lookup(texture, 64 * directions))
    _, _, to_directions = with_gradients(cubemap_lookup, texture, directions)
    along = (to_directions * directions).sum(dim=-1)
    assert_close(along, torch.zeros(500), rtol=0, atol=1e-4)


@pytest.mark.parametrize("count", [1000, 70_000])
def test_threads_do_not_change_a_bit(simd: str, count: int) -> None:
    results = []
    for threads in (1, 2, 3):
        _native.set_thread_count(threads)
        results.append(with_gradients(cubemap_lookup, texture_of(32), some_directions(count)))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_many_directions_are_summed_in_slices(simd: str) -> None:
    texture, directions = texture_of(16), some_directions(70_000)
    _, found, _ = with_gradients(cubemap_lookup, texture, directions)
    _, exact, _ = with_gradients(cubemap_lookup_reference, texture.double(), directions.double())
    assert float((found - exact).norm()) <= 1e-4 * float(exact.norm())


def test_no_direction_and_not_a_number(simd: str) -> None:
    texture = texture_of(5)
    nan = torch.nan
    rows = [
        [0, 0, 0],
        [nan, 1, 0.5],
        [1, nan, 0.5],
        [1, 0.5, nan],
        [nan, nan, nan],
        [torch.inf, 1, 1],
        [1, 0, 0],
    ]
    directions = torch.tensor(rows)
    for function in (cubemap_lookup, cubemap_lookup_reference):
        out, _, to_directions = with_gradients(function, texture, directions)
        assert_close(out[[0, 6]], texture[0, 2, 2].expand(2, 3), rtol=0, atol=1e-6)
        assert not to_directions[0].any()
        assert out[1:5].isnan().any(dim=-1).all()


def test_no_directions(simd: str) -> None:
    out, to_texture, to_directions = with_gradients(cubemap_lookup, texture_of(4), torch.zeros(0, 3))
    assert out.shape == (0, 3)
    assert to_directions.shape == (0, 3)
    assert not to_texture.any()


def test_gradients_on_request_only(simd: str) -> None:
    texture, directions = texture_of(4), some_directions(9)
    both = with_gradients(cubemap_lookup, texture, directions)
    weights = torch.linspace(-1, 2, 27).reshape(9, 3)
    (alone,) = torch.autograd.grad(
        (cubemap_lookup(texture.requires_grad_(), directions) * weights).sum(), texture
    )
    assert torch.equal(alone, both[1])
    directions.requires_grad_()
    out = (cubemap_lookup(texture.detach(), directions) * weights).sum()
    assert torch.equal(torch.autograd.grad(out, directions)[0], both[2])


def test_errors_name_what_was_expected() -> None:
    with pytest.raises(ValueError, match=r"texture: .*\[6, R, R, C\].*\[6, 4, 5, 3\]"):
        cubemap_lookup(torch.zeros(6, 4, 5, 3), torch.zeros(2, 3))
    with pytest.raises(ValueError, match=r"directions: .*\[P, 3\].*\[2, 4\]"):
        cubemap_lookup(torch.zeros(6, 4, 4, 3), torch.zeros(2, 4))
    with pytest.raises(ValueError, match=r"out: .*\[2, 3\].*\[3, 3\]"):
        _native.cubemap_forward(torch.zeros(6, 4, 4, 3), torch.zeros(2, 3), torch.zeros(3, 3))
