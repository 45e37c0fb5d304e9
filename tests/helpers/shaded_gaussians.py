"""Thirty Gaussians of the deferred shading model before a small camera, some of them metals."""

from collections.abc import Callable, Sequence

import torch
from instruction_sets import selected
from reference_rasterizer import rasterize_reference
from torch import Tensor

from polarguide.geometry.camera import Camera
from polarguide.raster.cpu import rasterize_cpu
from polarguide.shading.deferred import DeferredShading
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.shading.result import RenderResult
from polarguide.training.losses import S1_AND_S2, PolarizationTerm, Terms, pixel_terms

COUNT = 30
RESOLUTION = 8


def camera() -> Camera:
    eye, back = torch.eye(3, dtype=torch.float64), torch.tensor([0.1, -0.2, 4.0], dtype=torch.float64)
    return Camera(24, 20, 30.0, 30.0, 12.0, 10.0, eye, back)


def gaussians(dtype: torch.dtype = torch.float32, *, metals: int = COUNT // 2) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64).to(dtype)

    return {
        "means": 0.7 * normal(COUNT, 3),
        "quaternions": normal(COUNT, 4),
        "log_scales": -1.5 + 0.5 * normal(COUNT, 3),
        "opacity_logits": 1 + normal(COUNT),
        "sh_dc": normal(COUNT, 3),
        "sh_rest": 0.1 * normal(COUNT, 15, 3),
        "strength_logits": normal(COUNT),
        "local_dc": 0.3 * normal(COUNT, 3),
        "local_rest": 0.1 * normal(COUNT, 15, 3),
        "metalness": (torch.arange(COUNT) < metals).to(dtype),
        "reflectance_logits": normal(COUNT, 3),
        "roughness_logits": normal(COUNT),
    }


def light(dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(1)
    texels = 0.1 * torch.randn(6, RESOLUTION, RESOLUTION, 3, generator=generator, dtype=torch.float64)
    return {"texels": texels.to(dtype)}


def rendered(shading: DeferredShading, values: dict[str, Tensor], **options: bool) -> RenderResult:
    """By the kernels in single precision, by the reference in double."""
    dtype = values["means"].dtype
    rasterize = rasterize_cpu if dtype == torch.float32 else rasterize_reference
    request = RenderRequest(**options)
    return render(values, camera(), rasterize, request, shading=shading, light=light(dtype))


def compare_native_polarization(
    shading: DeferredShading, make: Callable[[], dict[str, Tensor]], names: Sequence[str], instructions: str
) -> None:
    """The native term of S1 and S2, and its gradients by some tensors, are those of PyTorch."""
    generator = torch.Generator().manual_seed(5)
    measured = 0.3 * torch.randn(2, 20, 24, 3, generator=generator)
    weight = torch.rand(20, 24, generator=generator)
    found = []
    for native in (True, False):
        values = make()
        for name in names:
            values[name].requires_grad_()
        result = rendered(shading, values)
        if native:
            index_layer = result.layers.get("index")
            term = PolarizationTerm(measured, S1_AND_S2, weight, 0.7, shading.refractive_index, index_layer)
            with selected(instructions):
                loss = pixel_terms(result, camera(), Terms(term, [], None))
        else:
            predicted = shading.predicted_stokes(result, camera())[1:]
            loss = 0.7 * (weight[..., None] * (predicted - measured).abs()).sum()
        loss.backward()
        found.append([loss.detach(), *(values[name].grad for name in names)])
    for ours, reference in zip(*found, strict=True):
        torch.testing.assert_close(ours, reference, rtol=2e-3, atol=2e-3)
