"""Metals and rough surfaces in the deferred picture: the native pass against its reference, forward and gradient."""

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from polarguide import _native
from polarguide.geometry.camera import Camera
from polarguide.shading.deferred import DeferredShading
from polarguide.shading.gbuffer import shaded
from polarguide.shading.metal import where_metal
from polarguide.shading.model import GBuffer
from polarguide.shading.native import DETACHED, MetalArguments, ReflectArguments, reflect_native
from polarguide.shading.result import ChannelSlices, channel_slices

HEIGHT, WIDTH, RESOLUTION = 20, 24, 32
MODELS = [
    DeferredShading(blend="fresnel", local=True, metal=True, rough=True),
    DeferredShading(blend="fresnel", metal=True, rough=True),
]


def camera() -> Camera:
    turn = torch.linalg.qr(
        torch.randn(3, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    )[0]
    return Camera(WIDTH, HEIGHT, 20.0, 21.0, 12.0, 10.0, turn, torch.zeros(3, dtype=torch.float64))


def buffers(shading: DeferredShading) -> tuple[Tensor, Tensor]:
    """Pixels without metal, with too little, with some and of nothing else, of every reflectance and roughness."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    rays = camera().world_rays()
    normals = torch.nn.functional.normalize(-rays + 0.9 * (uniform(HEIGHT, WIDTH, 3) - 0.5), dim=-1)
    normals[1] *= 1e-4  # below the shortest length
    normals[2] *= -1  # away from the camera
    share = uniform(HEIGHT, WIDTH, 1)
    share[3], share[4], share[5] = 0, 0.005, 1
    metal = torch.cat((share * uniform(HEIGHT, WIDTH, 3), share), dim=-1)
    metal[6, :, :3] = 1.2  # beyond what metals reflect
    own = [uniform(HEIGHT, WIDTH, 3) - 0.6] if shading.local else []
    parts = [
        uniform(HEIGHT, WIDTH, 3),
        normals,
        uniform(HEIGHT, WIDTH, 1),
        *own,
        uniform(HEIGHT, WIDTH, 1),
        metal,
    ]
    texels = torch.randn(6, RESOLUTION, RESOLUTION, 3, generator=generator)
    return torch.cat([*parts, uniform(HEIGHT, WIDTH, 1)], dim=-1), texels


def layout(shading: DeferredShading, *, metal: bool = True) -> ChannelSlices:
    own = {"local": 3} if shading.local else {}
    return channel_slices(
        {"color": 3, "normal": 3, "strength": 1, **own, "blur": 1}
        | ({"reflectance": 3, "metalness": 1, "depth": 1} if metal else {})
    )


def results(shading: DeferredShading, dtype: torch.dtype, *, held: bool) -> list[Tensor]:
    """Layers and what metals reflect, then the gradients of a random sum of them by features and texels."""
    features, texels = (t.to(dtype).requires_grad_() for t in buffers(shading))
    alpha = torch.linspace(0, 1, HEIGHT * WIDTH, dtype=dtype).reshape(HEIGHT, WIDTH)
    splatted = GBuffer(features, alpha, layout(shading), detached=held)
    layers = shaded(shading, splatted, {"texels": texels}, camera())
    again = [layers[name] for name in DETACHED] if held else []
    metal: Any = layers["metal"]
    shown = [layers["final"], layers["specular"], metal.specular, metal.slope, *again]
    generator = torch.Generator().manual_seed(1)
    total = sum((t * torch.randn(t.shape, generator=generator).to(t)).sum() for t in shown)
    total.backward()
    assert features.grad is not None
    assert texels.grad is not None
    found = [layers["metalness"], *(t.detach() for t in shown), features.grad, texels.grad]
    return [t.double() for t in found]


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("shading", MODELS, ids=["local", "far"])
def test_as_the_reference_has_it(shading: DeferredShading, held: bool, simd: str) -> None:
    found, exact = (results(shading, dtype, held=held) for dtype in (torch.float32, torch.float64))
    for ours, theirs in zip(found, exact, strict=True):
        assert theirs.abs().max() > 0
        assert_close(ours, theirs, rtol=2e-3, atol=2e-3)


def test_threads_do_not_change_a_bit() -> None:
    found = []
    for threads in (1, 2, 3):
        _native.set_thread_count(threads)
        found.append(results(MODELS[0], torch.float32, held=True))
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_where_no_pixel_shows_metal_the_layers_are_those_of_dielectrics() -> None:
    shading = MODELS[0]
    features, texels = buffers(shading)
    features[..., 11:15] = 0
    alpha, light = torch.ones(HEIGHT, WIDTH), {"texels": texels}
    with_channels = shading.shade(GBuffer(features, alpha, layout(shading)), light, camera())
    without = shading.shade(
        GBuffer(features[..., :11].contiguous(), alpha, layout(shading, metal=False)), light, camera()
    )
    assert torch.equal(with_channels["final"], without["final"])
    assert len(with_channels["metal"].pixels) == 0
    assert without["metal"] is None


def test_a_view_without_metal_has_the_gradients_of_one_of_dielectrics() -> None:
    shading = MODELS[0]
    alpha, found = torch.ones(HEIGHT, WIDTH), []
    for channels in (16, 11):
        features, texels = buffers(shading)
        features[..., 11:15] = 0
        features = features[..., :channels].contiguous().requires_grad_()
        texels.requires_grad_()
        shading.shade(
            GBuffer(features, alpha, layout(shading, metal=channels > 11)), {"texels": texels}, camera()
        )["final"].square().sum().backward()
        found.append((features.grad[..., :11], texels.grad))
    for ours, theirs in zip(*found, strict=True):
        assert_close(ours, theirs, rtol=0, atol=0)


def test_light_that_is_not_trained_gets_no_gradient() -> None:
    shading = MODELS[0]
    features, texels = buffers(shading)
    features.requires_grad_()
    layers = shading.shade(
        GBuffer(features, torch.ones(HEIGHT, WIDTH), layout(shading)), {"texels": texels}, camera()
    )
    layers["final"].sum().backward()
    trained, (_, light) = features.grad, buffers(shading)
    features.grad = None
    layers = shading.shade(
        GBuffer(features, torch.ones(HEIGHT, WIDTH), layout(shading)),
        {"texels": light.requires_grad_()},
        camera(),
    )
    layers["final"].sum().backward()
    assert texels.grad is None
    assert torch.equal(trained, features.grad)


@pytest.mark.parametrize(
    ("name", "changed"),
    [
        ("pixels", {"pixels": torch.tensor([3, 3])}),
        ("pixels", {"pixels": torch.tensor([3, HEIGHT * WIDTH])}),
        ("pixels", {"pixels": torch.tensor([-1, 3])}),
        ("features", {"first": 13}),
        ("features", {"first": 5}),
    ],
)
def test_what_does_not_fit_is_refused(name: str, changed: dict[str, Any]) -> None:
    features, texels = buffers(MODELS[0])
    flat = features.flatten(0, 1)
    given = MetalArguments(where_metal(flat, 11), 11)._replace(**changed)
    rays = camera().world_rays().flatten(0, 1)
    with pytest.raises(ValueError, match=name):
        reflect_native(flat, rays, [texels.exp()], ReflectArguments(True, True, 1.5, metal=given))
