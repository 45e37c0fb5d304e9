"""Deferred reflection: the native pass against its reference implementation, forward and gradient."""

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from polarguide import _native
from polarguide.geometry.camera import Camera
from polarguide.shading.deferred import DeferredShading
from polarguide.shading.gbuffer import shaded
from polarguide.shading.model import GBuffer
from polarguide.shading.native import (
    DETACHED,
    ReflectArguments,
    reflect_native,
    world_rays_native,
)
from polarguide.shading.result import channel_slices

HEIGHT, WIDTH, RESOLUTION = 20, 24, 8
MODELS = [
    DeferredShading(),
    DeferredShading(blend="fresnel", refractive_index=1.4),
    DeferredShading(blend="fresnel", local=True),
    DeferredShading(local=True),
]
LAYERS = ("final", "specular", "diffuse", "reflection")


def camera() -> Camera:
    rotation = torch.linalg.qr(
        torch.randn(3, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    )[0]
    return Camera(WIDTH, HEIGHT, 20.0, 21.0, 12.0, 10.0, rotation, torch.zeros(3, dtype=torch.float64))


def buffers(spare: int = 1) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(HEIGHT, WIDTH, 10 + spare, generator=generator)
    rays = camera().world_rays()
    toward = (features[..., 3:6] * rays).sum(-1, keepdim=True) < 0
    features[..., 3:6] = torch.where(toward, features[..., 3:6], -features[..., 3:6])  # most face the camera
    features[0, :, 3:6] *= -1
    features[1, :, 3:6] *= 1e-4  # below the shortest length
    features[2, :, 3:6] = 0
    features[..., 6] = features[..., 6].sigmoid()
    texels = 3 * torch.randn(6, RESOLUTION, RESOLUTION, 3, generator=generator)
    return features, texels


def native(features: Tensor, texels: Tensor, shading: DeferredShading) -> tuple[Tensor, ...]:
    return reflect_native(
        features.flatten(0, 1),
        camera().world_rays().flatten(0, 1),
        shading.light_levels(texels, rough=False),
        ReflectArguments(shading.blend == "fresnel", shading.local, shading.refractive_index),
    )


def reference(features: Tensor, texels: Tensor, shading: DeferredShading) -> tuple[Tensor, ...]:
    local = features[..., 7:10] if shading.local else None
    layers = shading.reflect(features[..., :3], features[..., 3:6], features[..., 6], texels, camera(), local)
    return tuple(layers[name].flatten(0, 1) for name in LAYERS)


def with_gradients(function, shading: DeferredShading, dtype: torch.dtype, wanted: tuple[int, ...]):
    leaves = [t.to(dtype).requires_grad_() for t in buffers()]
    layers = function(*leaves, shading)
    weights = torch.linspace(-1, 2, layers[0].numel(), dtype=dtype).reshape(layers[0].shape)
    total = sum(((i + 1) * weights * layers[i]).sum() for i in wanted)
    return [layer.detach() for layer in layers], torch.autograd.grad(total, leaves)


@pytest.mark.parametrize("wanted", [(0,), (1, 2), (0, 1, 2, 3), (3,)])
@pytest.mark.parametrize("shading", MODELS, ids=str)
def test_native_agrees_with_the_reference(
    simd: str, shading: DeferredShading, wanted: tuple[int, ...]
) -> None:
    found, gradients = with_gradients(native, shading, torch.float32, wanted)
    exact, exact_gradients = with_gradients(reference, shading, torch.float64, wanted)
    for name, mine, theirs in zip(LAYERS, found, exact, strict=True):
        assert_close(mine.double(), theirs, rtol=2e-4, atol=2e-4, msg=lambda m, name=name: f"{name}: {m}")
    by_features, by_features_exact = gradients[0].double(), exact_gradients[0]
    # Where the mirrored ray passes from one cell of texels to the next, the gradient by the normal jumps.
    off = (by_features - by_features_exact).abs() > 2e-3 * (1 + by_features_exact.abs())
    off[1] = (by_features - by_features_exact)[1].abs() > 2e-3 * (1 + by_features_exact[1].abs().max())
    assert float(off.float().mean()) < 0.002
    assert not off[..., :3].any()
    assert not off[..., 6:].any()
    assert not gradients[0][..., 10:].any()
    assert_close(gradients[1].double(), exact_gradients[1], rtol=2e-3, atol=2e-3)


def test_threads_do_not_change_the_result() -> None:
    results = []
    for threads in (1, 2):
        _native.set_thread_count(threads)
        layers, gradients = with_gradients(native, MODELS[2], torch.float32, (0, 1, 2, 3))
        results.append([*layers, *gradients])
    for one, other in zip(*results, strict=True):
        assert torch.equal(one, other)


def test_layers_without_gradients_have_the_same_bits(simd: str) -> None:
    """Many times as many pixels as are worked on at once, and some: then mirrored rays are kept of those alone."""
    features, texels = buffers()
    many = features.flatten(0, 1).repeat(15, 1)[:-3]
    rays = camera().world_rays().flatten(0, 1).repeat(15, 1)[:-3]

    def layers(texels: Tensor) -> tuple[Tensor, ...]:
        return reflect_native(many, rays, [texels], ReflectArguments(True, True, 1.5))

    learning = layers(texels.clone().requires_grad_())
    assert learning[0].requires_grad
    for one, other in zip(layers(texels), learning, strict=True):
        assert torch.equal(one, other.detach())


def test_world_rays_in_one_pass(simd: str) -> None:
    exact = camera().world_rays(dtype=torch.float64).flatten(0, 1)
    assert_close(world_rays_native(camera()).double(), exact, rtol=0, atol=3e-7)


def test_a_cubemap_of_other_colors_is_refused() -> None:
    features, texels = buffers()
    with pytest.raises(ValueError, match="textures: expected three channels, found 4"):
        native(features, torch.cat((texels, texels[..., :1]), dim=-1), MODELS[0])


def test_too_few_channels_are_refused() -> None:
    features, texels = buffers()
    with pytest.raises(ValueError, match="features: "):
        native(features[..., :8], texels, MODELS[2])


@pytest.mark.parametrize("wanted", [(1,), (2,), (1, 2), (0, 1, 2, 3)])
@pytest.mark.parametrize("shading", MODELS, ids=str)
def test_held_layers_are_those_of_normals_without_a_gradient(
    simd: str, shading: DeferredShading, wanted: tuple[int, ...]
) -> None:
    """Against shading a second time, both with a gradient of the picture that does reach the normals."""
    layout = channel_slices({"color": 3, "normal": 3, "strength": 1, "local": 3})
    grid = torch.linspace(-1, 2, HEIGHT * WIDTH * 3).reshape(HEIGHT, WIDTH, 3)
    results = []
    for native in (True, False):
        features, texels = (t.requires_grad_() for t in buffers())
        splatted = GBuffer(features, torch.ones(HEIGHT, WIDTH), layout, detached=True)
        layers = shaded(shading, splatted, {"texels": texels}, camera(), native=native)
        assert layers.pop("metal") is None
        specular, diffuse = (layers.pop(name) for name in DETACHED)
        terms = (layers["final"], specular, diffuse, layers["specular"])
        total = (grid * layers["final"]).sum() + sum(
            ((i + 2) * grid.flip(0) * terms[i]).sum() for i in wanted
        )
        results.append((*layers.values(), specular, diffuse, *torch.autograd.grad(total, (features, texels))))
    for mine, theirs in zip(*results, strict=True):
        assert_close(mine, theirs, rtol=1e-4, atol=1e-4)


def test_a_gradient_by_held_layers_needs_room_for_the_texels() -> None:
    flat, rays = buffers()[0].flatten(0, 1), camera().world_rays().flatten(0, 1)
    given = [torch.zeros_like(rays) for _ in range(3)]
    with pytest.raises(ValueError, match="grad_texels"):
        _native.reflect_backward_layers(
            flat,
            rays,
            given[0],
            True,
            True,
            1.5,
            -1,
            None,
            None,
            None,
            None,
            given[1],
            None,
            given[2],
            None,
            flat,
        )
