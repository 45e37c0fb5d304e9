"""Native passes over Gaussians, what is splatted and how flat they are: against the reference, forward and gradient."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from polarguide import _native
from polarguide.core.errors import PolarguideError
from polarguide.gaussians.harmonics import SH_C0, evaluate_sh
from polarguide.geometry.camera import Camera
from polarguide.raster.cpu import rasterize_cpu
from polarguide.raster.interface import Splats
from polarguide.shading.deferred import DeferredShading
from polarguide.shading.gbuffer import splatting, splatting_reference
from polarguide.shading.model import PLAIN, Parameters, ShadingModel, base_colors
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
    exact, reference = with_gradients(
        splatting_reference, {k: t.double() for k, t in given.items()}, shading, **how
    )
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
    found, expected = (f(given, CAMERA, PLAIN, **how)[0] for f in (splatting, splatting_reference))
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
        with pytest.raises(PolarguideError, match="Gaussian 7"):
            rasterize_cpu(splatting(given, CAMERA, DeferredShading("fresnel", local=True), **how)[0], CAMERA)


def test_a_model_with_channels_of_its_own_is_asked_for_them() -> None:
    class Doubled(DeferredShading):
        def channels(
            self, gaussians: Parameters, normals: Tensor, center: Tensor, degree: int
        ) -> dict[str, Tensor]:
            color = 2 * base_colors(gaussians, center, degree)
            return {"color": color, "strength": self.strength(gaussians)[:, None]}

    given, how = gaussians(10), {"sh_degree": 3, "normals": True, "depth": False}
    twice, once = (splatting(given, CAMERA, model, **how)[0] for model in (Doubled(), DeferredShading()))
    assert_close(twice.features[:, :3], 2 * once.features[:, :3], rtol=1e-5, atol=3e-6)


def test_wrong_shapes_are_refused() -> None:
    given = gaussians(4)
    given["local_rest"] = given["local_rest"][:, :8]
    with pytest.raises(ValueError, match=r"rest: expected shape \[4, 15, 3\], found \[4, 8, 3\]"):
        splatting(given, CAMERA, WHOLE, sh_degree=3, normals=True, depth=False)
    with pytest.raises(ValueError, match="degree: expected 0 to 3, found 4"):
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
    assert mine.grad is not None
    assert_close(mine.grad.double(), theirs.grad, rtol=2e-6, atol=1e-12)
