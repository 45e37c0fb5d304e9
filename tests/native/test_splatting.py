"""Native passes over Gaussians, what is splatted and how flat they are: against the reference, forward and gradient."""

from collections.abc import Mapping
from typing import Any

import pytest
import torch
from faults import Fault
from torch import Tensor
from torch.testing import assert_close

from polarguide import _native
from polarguide.gaussians.geometry import (
    mirrored_directions,
    shortest_axis_normals,
    shortest_axis_normals_reference,
)
from polarguide.gaussians.harmonics import SH_C0, evaluate_sh
from polarguide.geometry.camera import Camera
from polarguide.raster.cpu import rasterize_cpu
from polarguide.raster.interface import Splats
from polarguide.shading.deferred import DeferredShading
from polarguide.shading.gbuffer import splatting, split, split_reference
from polarguide.shading.model import PLAIN, Channels, Parameters, ShadingModel, base_colors
from polarguide.shading.native import split_native
from polarguide.shading.result import ChannelSlices, channel_slices
from polarguide.training.losses import flatness_loss, flatness_loss_reference

TURN = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64))[0]
CAMERA = Camera(
    20, 16, 18.0, 18.0, 10.0, 8.0, TURN * TURN.det(), torch.tensor([0.2, -0.1, 4.0], dtype=torch.float64)
)
WHOLE = DeferredShading("fresnel", local=True, metal=True, indices=True)
MODELS: Mapping[str, ShadingModel] = {
    "plain": PLAIN,
    "lerp": DeferredShading("lerp"),
    "local": DeferredShading("fresnel", local=True),
    "metals and indices": WHOLE,
}
SHAPES = {
    "means": (3,), "quaternions": (4,), "log_scales": (3,), "opacity_logits": (), "sh_dc": (3,), "sh_rest": (15, 3),
    "outward": (3,), "strength_logits": (), "local_dc": (3,), "local_rest": (15, 3), "metalness": (),
    "reflectance_logits": (3,), "roughness_logits": (), "index_offset": (),
}  # fmt: skip


def gaussians(count: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    made = {name: torch.randn(count, *shape, generator=generator) for name, shape in SHAPES.items()}
    made["metalness"] = (made["metalness"] > 0).float()
    made["outward"][::3] = 0
    return {name: t.to(dtype) for name, t in made.items()}


def with_gradients(
    function: Any, given: dict[str, Tensor], shading: ShadingModel, **how: Any
) -> tuple[Splats, dict[str, Tensor]]:
    """What is splatted, and the gradients of a fixed weighted sum of all of it."""
    leaves = {name: t.clone().requires_grad_() for name, t in given.items()}
    found, _ = function(leaves, CAMERA, shading, **how)
    total = sum(
        (t * torch.linspace(-1, 2, t.numel(), dtype=t.dtype).reshape(t.shape)).sum()
        for t in found
        if t.numel()
    )
    if isinstance(total, Tensor):
        total.backward()
    return found, {name: torch.zeros_like(t) if t.grad is None else t.grad for name, t in leaves.items()}


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(
    ("count", "degree", "depth"), [(1, 3, True), (17, 0, False), (16, 1, True), (2500, 3, True)]
)
def test_kernel_agrees_with_the_reference(
    simd: str, model: str, count: int, degree: int, depth: bool
) -> None:
    shading, how = MODELS[model], {"sh_degree": degree, "normals": True, "depth": depth}
    given = gaussians(count)
    found, gradients = with_gradients(splatting, given, shading, **how)
    exact, reference = with_gradients(splatting, {k: t.double() for k, t in given.items()}, shading, **how)
    assert found.features.grad_fn is not None
    assert type(found.features.grad_fn).__name__ == "_SplattingBackward"
    for name, mine, theirs in zip(Splats._fields, found, exact, strict=True):
        assert_close(mine.double(), theirs, rtol=2e-6, atol=5e-6, msg=lambda m, name=name: f"{name}: {m}")
    for name, mine in gradients.items():
        scale = 1 + float(reference[name].abs().max())
        assert_close(
            mine.double(),
            reference[name],
            rtol=1e-5,
            atol=3e-6 * scale,
            msg=lambda m, name=name: f"{name}: {m}",
        )


@pytest.mark.parametrize("oriented", [False, True])
@pytest.mark.parametrize("normals", [False, True])
def test_plain_splats_with_and_without_normals(normals: bool, oriented: bool) -> None:
    given = gaussians(40)
    if not oriented:
        del given["outward"]
    how = {"sh_degree": 2, "normals": normals, "depth": False}
    found, expected = (splatting(given, CAMERA, PLAIN, **how, native=native)[0] for native in (True, False))
    assert found.features.shape == (40, 6 if normals else 3)
    assert_close(found.features, expected.features, rtol=1e-5, atol=3e-6)


def test_a_color_of_exactly_zero_has_a_gradient_and_one_cut_off_has_none() -> None:
    """Black Gaussians begin exactly at zero; without a gradient they would stay black."""
    near = (-0.5 / SH_C0 * (1 + torch.arange(-8, 9) * 2**-23)).float()[:, None].expand(-1, 3)
    at = torch.zeros(len(near), 3), torch.ones(3), near, torch.zeros(len(near), 15, 3)
    zero = near[(evaluate_sh(*at, 0) == -0.5).all(dim=1)][0, 0]
    given = gaussians(3)
    given["sh_dc"] = zero * torch.tensor([1.0, 1.1, 0.9])[:, None].expand(3, 3)
    given["metalness"] = torch.zeros(3)
    found, gradients = with_gradients(splatting, given, WHOLE, sh_degree=0, normals=True, depth=False)
    assert torch.equal(found.features[:2, :3], torch.zeros(2, 3))
    assert (found.features[2, :3] > 0).all()
    assert (gradients["sh_dc"][::2] != 0).all()
    assert (gradients["sh_dc"][1] == 0).all()


def test_threads_do_not_change_the_result() -> None:
    results = []
    for threads in (1, 2):
        _native.set_thread_count(threads)
        found, gradients = with_gradients(
            splatting, gaussians(5000), WHOLE, sh_degree=3, normals=True, depth=True
        )
        results.append([*found, *gradients.values()])
    _native.set_thread_count(0)
    for one, other in zip(*results, strict=True):
        assert torch.equal(one, other)


def test_no_gradient_is_kept_where_none_is_wanted() -> None:
    given, how = gaussians(100), {"sh_degree": 3, "normals": True, "depth": True}
    with torch.no_grad():
        still, _ = splatting(given, CAMERA, WHOLE, **how)
    moving, _ = with_gradients(splatting, given, WHOLE, **how)
    assert still.features.grad_fn is None
    for mine, theirs in zip(still, moving, strict=True):
        assert torch.equal(mine, theirs)


def test_not_a_number_and_too_much_are_not_hidden() -> None:
    how = {"sh_degree": 3, "normals": True, "depth": True}
    for name, value in (
        ("log_scales", 200.0),
        *(
            (name, float("nan"))
            for name in ("log_scales", "opacity_logits", "sh_dc", "strength_logits", "means")
        ),
    ):
        given = gaussians(20)
        given[name].view(20, -1)[7, 0] = value
        broken, *_ = splatting(given, CAMERA, DeferredShading("fresnel", local=True), **how)
        Fault("rasterize(", "finite", "Gaussian 7").raised_by(rasterize_cpu, broken, CAMERA)


def test_a_model_with_its_own_color_uses_the_reference() -> None:
    class Doubled(DeferredShading):
        def channels(self, gaussians: Parameters, center: Tensor, degree: int) -> Channels:
            color = 2 * base_colors(gaussians, center, degree)
            return super().channels(gaussians, center, degree)._replace(color=color)

    given, how = gaussians(10), {"sh_degree": 3, "normals": True, "depth": False}
    twice, once = (splatting(given, CAMERA, model, **how)[0] for model in (Doubled(), DeferredShading()))
    assert_close(twice.features[:, :3], 2 * once.features[:, :3], rtol=1e-5, atol=3e-6)
    assert_close(twice.features[:, 3:], once.features[:, 3:], rtol=1e-5, atol=3e-6)


def test_wrong_shapes_are_refused() -> None:
    given = gaussians(4)
    given["local_rest"] = given["local_rest"][:, :8]
    with pytest.raises(ValueError, match=r"rest: .*\[4, 15, 3\].*\[4, 8, 3\]"):
        splatting(given, CAMERA, WHOLE, sh_degree=3, normals=True, depth=False)
    with pytest.raises(ValueError, match="degree"):
        splatting(gaussians(4), CAMERA, WHOLE, sh_degree=4, normals=True, depth=False)


def test_flatness_natively_is_that_of_the_reference(simd: str) -> None:
    generator = torch.Generator().manual_seed(4)
    scales = torch.randn(10_001, 3, generator=generator)
    scales[::7, 1] = scales[::7, 0]  # two that are as short
    radii = torch.randn(10_001, generator=generator).clamp(min=0)
    mine, theirs = (scales.clone().to(dtype).requires_grad_() for dtype in (torch.float32, torch.float64))
    found, expected = flatness_loss(mine, radii, 2.0), flatness_loss_reference(theirs, radii.double(), 2.0)
    (2 * found).backward()
    (2 * expected).backward()
    assert type(found.grad_fn).__name__ == "_FlatnessBackward"
    assert float(found.detach()) == pytest.approx(float(expected.detach()), rel=1e-6)
    assert_close(mine.grad.double(), theirs.grad, rtol=2e-6, atol=1e-12)


HEIGHT, WIDTH, CHANNELS = 40, 61, 11
SIZE = (HEIGHT, WIDTH)


def layout(*, depth: bool) -> ChannelSlices:
    return channel_slices(
        {"color": 3, "normal": 3, "own": CHANNELS - 6 - depth, **({"depth": 1} if depth else {})}
    )


def buffers(dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(*SIZE, CHANNELS, generator=generator)
    alpha = torch.rand(SIZE, generator=generator)
    alpha[3], alpha[4], alpha[5] = 0.0, 1e-7, 2e-6
    return features.to(dtype).requires_grad_(), alpha.to(dtype).requires_grad_()


def split_gradients(function, dtype: torch.dtype, read: str, depth: bool) -> list[Tensor]:
    features, alpha = buffers(dtype)
    given = dict(zip("fnd", function(features, alpha, layout(depth=depth)), strict=True))
    seed = torch.Generator().manual_seed(1)
    sum((torch.randn(given[k].shape, generator=seed) * given[k]).sum() for k in read).backward()
    gradients = [torch.zeros_like(t) if t.grad is None else t.grad for t in (features, alpha)]
    return [t.detach() for t in given.values() if t is not None] + gradients


@pytest.mark.parametrize("read", ["f", "n", "fn", "d", "fnd", "nd"])
def test_native_agrees_with_the_slices(simd: str, read: str) -> None:
    for depth in (True,) if "d" in read else (True, False):
        found = split_gradients(split, torch.float32, read, depth)
        exact = split_gradients(split_reference, torch.float64, read, depth)
        assert len(found) == len(exact)
        for mine, theirs in zip(found, exact, strict=True):
            assert bool(torch.isfinite(mine).all())
            assert_close(mine.double(), theirs, rtol=2e-6, atol=2e-6)


def test_threads_do_not_change_the_split() -> None:
    results = []
    for threads in (1, 3):
        _native.set_thread_count(threads)
        results.append(split_gradients(split, torch.float32, "fnd", True))
    for one, other in zip(*results, strict=True):
        assert torch.equal(one, other)


def test_without_further_channels_the_slices_do() -> None:
    features, alpha = torch.rand(*SIZE, 6), torch.rand(SIZE)
    _, normal, depth = split(features, alpha, channel_slices({"color": 3, "normal": 3}))
    assert torch.equal(normal, features[..., 3:6])
    assert depth is None
    assert split(features, alpha, channel_slices({"color": 3, "own": 3}))[1] is None
    with pytest.raises(ValueError, match="features: "):
        split_native(features, alpha, depth=True)


CENTER = torch.tensor([0.3, -0.2, 1.1])


def rotations_and_scales(count: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(count)
    means, quaternions, log_scales, outward = (
        torch.randn(count, size, generator=generator) for size in (3, 4, 3, 3)
    )
    outward[::3] = 0  # not known
    return means, quaternions, log_scales, outward


def with_gradient(function, shape: tuple[Tensor, ...], center: Tensor) -> tuple[Tensor, Tensor]:
    means, quaternions, *others = (t.detach().clone() for t in shape)
    quaternions.requires_grad_()
    out = function(means, quaternions, others[0], center, *others[1:])
    weights = torch.linspace(-1, 1, out.numel(), dtype=out.dtype).reshape(out.shape)
    (out * weights).sum().backward()
    assert quaternions.grad is not None
    return out.detach(), quaternions.grad


@pytest.mark.parametrize("oriented", [False, True])
@pytest.mark.parametrize("count", [1, 17, 10_000])
def test_shortest_axes_agree_with_the_reference(simd: str, count: int, oriented: bool) -> None:
    shape = rotations_and_scales(count)[: 4 if oriented else 3]
    found = with_gradient(shortest_axis_normals, shape, CENTER)
    exact = with_gradient(shortest_axis_normals_reference, tuple(t.double() for t in shape), CENTER.double())
    for name, mine, reference in zip(("normals", "gradient"), found, exact, strict=True):
        scale = 1 + float(reference.abs().max()) if name == "gradient" else 1.0
        assert_close(mine.double(), reference, rtol=1e-5, atol=2e-6 * scale)


def test_threads_do_not_change_the_axes() -> None:
    shape = rotations_and_scales(20_000)
    results = []
    for threads in (1, 2):
        _native.set_thread_count(threads)
        results.append(with_gradient(shortest_axis_normals, shape, CENTER))
    for one, other in zip(*results, strict=True):
        assert torch.equal(one, other)


def test_no_gaussian_and_no_length_are_no_trouble() -> None:
    none = shortest_axis_normals(torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), CENTER)
    assert none.shape == (0, 3)
    flat = (torch.zeros(1, 3), torch.zeros(1, 4), torch.tensor([[0.0, 0.0, -1.0]]))
    normal, gradient = with_gradient(shortest_axis_normals, flat, CENTER)
    assert_close(normal, torch.tensor([[0.0, 0.0, 1.0]]))
    assert torch.isfinite(gradient).all()


def test_mirrored_directions_agree_with_the_reference(simd: str) -> None:
    means, quaternions, log_scales, _ = rotations_and_scales(1000)
    means[5] = CENTER
    normals = shortest_axis_normals(means, quaternions, log_scales, CENTER)
    found = mirrored_directions(means, CENTER, normals)
    reference = mirrored_directions(means.double(), CENTER.double(), normals.double())
    assert_close(found.double(), reference, rtol=1e-5, atol=2e-6)
    assert_close(found[5], torch.zeros(3))
    others = torch.arange(1000) != 5
    assert_close(found[others].norm(dim=1), torch.ones(999))
    rays = torch.nn.functional.normalize(means - CENTER, dim=1)
    assert_close((found * normals).sum(1)[others], -(rays * normals).sum(1)[others], atol=1e-5, rtol=1e-5)


def test_wrong_shapes_of_axes_are_refused() -> None:
    means, quaternions, log_scales, _ = rotations_and_scales(4)
    with pytest.raises(ValueError, match=r"quaternions: .*\[4, 4\].*\[3, 4\]"):
        shortest_axis_normals(means, quaternions[:3], log_scales, CENTER)
