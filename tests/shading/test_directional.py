"""Ref-GS shading: the directional light against a plain evaluation, its layers, and degenerate G-buffers."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize
from torch.testing import assert_close

from polarguide import _native
from polarguide.geometry.camera import Camera
from polarguide.raster.cpu import rasterize_cpu
from polarguide.results.export.adapters import ply_fields
from polarguide.shading.cubemap import box_mips, cubemap_lookup_reference, mip_lookup, mip_lookup_reference
from polarguide.shading.directional import CHANNELS, FEATURES, DirectionalShading
from polarguide.shading.gbuffer import RenderRequest, render, single_colors
from polarguide.shading.model import MAXIMUM_LOG_LIGHT, PLAIN, GBuffer, base_colors, mirrored
from polarguide.shading.result import channel_slices

SHADING = DirectionalShading(width=8, environment_resolution=8, environment_spread=1.0)
LAYOUT = channel_slices({"color": 3, "normal": 3, "blur": 1, "feature": FEATURES, "surface": 1})
COUNT, RESOLUTION, LEVELS = 30, 8, 5


def camera() -> Camera:
    eye, back = torch.eye(3, dtype=torch.float64), torch.tensor([0.1, -0.2, 4.0], dtype=torch.float64)
    return Camera(24, 20, 30.0, 30.0, 12.0, 10.0, eye, back)


def normal(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def light(dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    near = torch.zeros(0, dtype=torch.bool)
    _, values = SHADING.initialize(torch.zeros(0, 3), near, torch.Generator().manual_seed(0))
    return {name: t.to(dtype) for name, t in values.items()}


@pytest.fixture
def gaussians() -> dict[str, Tensor]:
    core = {
        "means": 0.7 * normal(1, COUNT, 3),
        "quaternions": normal(2, COUNT, 4),
        "log_scales": -1.5 + 0.5 * normal(3, COUNT, 3),
        "opacity_logits": normal(4, COUNT),
        "sh_dc": 0.5 * normal(17, COUNT, 3),
        "sh_rest": 0.1 * normal(18, COUNT, 15, 3),
    }
    near = torch.zeros(COUNT, dtype=torch.bool)
    first, _ = SHADING.initialize(torch.rand(COUNT, 3), near, torch.Generator().manual_seed(5))
    return core | first


def plainly(values: dict[str, Tensor], ray: Tensor, roughness: Tensor, feature: Tensor) -> Tensor:
    """The formula for one pixel, loop by loop."""
    level = (LEVELS * roughness).clamp(max=LEVELS - 1)[None]
    h = mip_lookup(box_mips(values["texels"]), ray[None], level)[0]
    f = feature / feature.norm()
    outer = torch.stack([h[i] * f[j] for i in range(CHANNELS) for j in range(FEATURES)])
    x = torch.cat((h, outer))
    for layer in range(3):
        x = x @ values[f"mlp_weight_{layer}"] + values[f"mlp_bias_{layer}"]
        x = x.clamp(min=0) if layer < 2 else x
    return torch.exp(x.clamp(max=5.0))


def test_radiance_as_plainly_evaluated() -> None:
    values, rays = light(torch.float64), normal(6, 40, 3).double()
    roughness, features = torch.rand(40).double(), normal(7, 40, FEATURES).double()
    found = SHADING.radiance(values, rays, roughness, features)
    for i in range(40):
        assert_close(found[i], plainly(values, rays[i], roughness[i], features[i]))
    single = SHADING.radiance(light(), rays.float(), roughness.float(), features.float())
    assert_close(single.double(), found, rtol=1e-4, atol=1e-5)


def test_radiance_gradients_against_finite_differences() -> None:
    values = {name: t.requires_grad_() for name, t in light(torch.float64).items()}
    rays, features = normal(8, 6, 3).double(), normal(9, 6, FEATURES).double()
    roughness = torch.linspace(0.05, 0.75, 6, dtype=torch.float64)
    inputs = [t.requires_grad_() for t in (rays, roughness, features)]

    def function(*leaves: Tensor) -> Tensor:
        return SHADING.radiance(dict(zip(values, leaves[3:], strict=True)), *leaves[:3])

    assert torch.autograd.gradcheck(function, (*inputs, *values.values()), fast_mode=True)


def test_a_rough_surface_reads_the_mean_of_the_grid() -> None:
    """So its light does not depend on where it looks; a smooth one's does."""
    rays, features = normal(10, 50, 3), torch.ones(50, FEATURES)
    rough = SHADING.radiance(light(), rays, torch.ones(50), features)
    assert_close(rough, rough[:1].expand_as(rough), rtol=1e-5, atol=0)
    mean = light()["texels"].mean(dim=(0, 1, 2)).expand(6, 1, 1, CHANNELS)
    values = {**light(), "texels": mean}
    assert_close(rough, SHADING.radiance(values, rays, torch.zeros(50), features), rtol=1e-5, atol=0)
    smooth = SHADING.radiance(light(), rays, torch.zeros(50), features)
    assert float(smooth.std(dim=0).min()) > 100 * float(rough.std(dim=0).max())


def test_length_of_a_feature_does_not_matter_and_brightness_has_an_end() -> None:
    rays, roughness, features = normal(11, 20, 3), torch.rand(20), normal(12, 20, FEATURES)
    once = SHADING.radiance(light(), rays, roughness, features)
    assert_close(SHADING.radiance(light(), rays, roughness, 0.1 * features), once)
    bright = {**light(), "mlp_bias_2": torch.full((3,), 99.0)}
    brightest = torch.full((20, 3), math.exp(MAXIMUM_LOG_LIGHT))
    assert_close(SHADING.radiance(bright, rays, roughness, features), brightest)


def test_layers_add_up_to_the_final_picture(gaussians: dict[str, Tensor]) -> None:
    result = render(
        gaussians, camera(), rasterize_cpu, RenderRequest(depth=True), shading=SHADING, light=light()
    )
    assert torch.equal(result.specular + result.diffuse, result.final)
    assert torch.equal(result.diffuse, result.base)
    assert result.layers.keys().isdisjoint({"strength", "reflection"})
    assert float(result.specular.min()) >= 0
    assert not result.specular[result.alpha < 0.04].any(), "light without a surface"
    assert bool((result.specular[result.alpha > 0.06] > 0).all())
    assert result.depth is not None


def test_without_harmonics_the_view_changes_only_the_specular_layer(gaussians: dict[str, Tensor]) -> None:
    """Of one opaque Gaussian that fills the picture the albedo is its own, wherever the camera stands."""
    one = {name: t[:1].clone() for name, t in gaussians.items()}
    one["means"], one["log_scales"] = torch.zeros(1, 3), torch.full((1, 3), 3.0)
    result = render(one, camera(), rasterize_cpu, shading=SHADING, light=light())
    color = result.diffuse[10, 12] / result.alpha[10, 12]  # type: ignore[index]
    assert_close(color, SHADING.surface[0].values(one)[0], rtol=1e-4, atol=1e-5)


def test_first_values_are_those_asked_for() -> None:
    shading = replace(
        SHADING, first_albedo=0.4, first_roughness=0.3, first_light=0.1, environment_resolution=4
    )
    colors = torch.tensor([[0.5, 0.2, 0.1], [0.0, 1.0, 0.3]])
    near = torch.zeros(2, dtype=torch.bool)
    gaussians, values = shading.initialize(colors, near, torch.Generator().manual_seed(0))
    assert_close(shading.surface[0].values(gaussians), (0.4 * colors).clamp(min=1e-3))
    assert_close(torch.sigmoid(gaussians["roughness_logits"]), torch.full((2,), 0.3))
    assert values["texels"].shape == (6, 4, 4, CHANNELS)
    assert_close(values["mlp_bias_2"].exp(), torch.full((3,), 0.1))
    table = replace(shading, environment_rate=1.0).light_parameters
    assert {name: tuple(t.shape) for name, t in values.items()} == {n: p.shape for n, p in table.items()}
    assert table["texels"].rate == 1.0


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e-3])
def test_degenerate_normals_and_features_stay_finite_with_gradients(scale: float) -> None:
    size = (20, 24)
    albedo, alpha = torch.rand(*size, 3).requires_grad_(), torch.ones(size)
    direction = (scale * normalize(normal(13, *size, 3), dim=-1)).requires_grad_()
    further = torch.cat((torch.rand(*size, 1), scale * normal(14, *size, FEATURES)), dim=-1)
    further = torch.cat((further, torch.rand(*size, 1)), dim=-1).requires_grad_()
    values = {name: t.requires_grad_() for name, t in light().items()}
    layers = SHADING.shade(
        GBuffer(torch.cat((albedo, direction, further), dim=-1), alpha, LAYOUT), values, camera()
    )
    layers["final"].square().mean().backward()
    for tensor in (layers["final"], albedo.grad, direction.grad, further.grad, values["texels"].grad):
        assert bool(torch.isfinite(tensor).all())


def test_every_parameter_gets_a_gradient(gaussians: dict[str, Tensor]) -> None:
    surface = gaussians.pop("surface")
    surface[::4] = 0
    trained = {name: t.clone().requires_grad_() for name, t in gaussians.items()}
    values = {name: t.requires_grad_() for name, t in light().items()}
    result = render(trained | {"surface": surface}, camera(), rasterize_cpu, shading=SHADING, light=values)
    result.final.square().mean().backward()
    for name, tensor in (trained | values).items():
        assert tensor.grad is not None, name
        assert bool(torch.isfinite(tensor.grad).all()), name
        assert bool(tensor.grad.any()), name


def test_a_gaussian_alone_is_its_albedo_and_the_light_in_its_mirror(gaussians: dict[str, Tensor]) -> None:
    rays = normalize(normal(15, COUNT, 3), dim=-1)
    normals = normalize(normal(16, COUNT, 3), dim=-1)
    normals = torch.where((normals * rays).sum(-1, keepdim=True) > 0, -normals, normals)
    fields = ply_fields(SHADING, gaussians)
    assert {name: tuple(t.shape[1:]) for name, t in fields.items()} == {
        "linear_dc": (3,),
        "linear_rest": (45,),
        "albedo": (3,),
        "roughness": (),
        "feature": (FEATURES,),
        "surface": (),
    }
    expected = fields["albedo"] + SHADING.radiance(
        light(), mirrored(rays, normals), fields["roughness"], fields["feature"]
    )
    assert_close(single_colors(gaussians, light(), SHADING, rays, normals), expected)


def test_surroundings_are_their_harmonics_without_a_specular_layer(gaussians: dict[str, Tensor]) -> None:
    gaussians["surface"] = torch.zeros(COUNT)
    found = render(gaussians, camera(), rasterize_cpu, shading=SHADING, light=light())
    plain = render(gaussians, camera(), rasterize_cpu, shading=PLAIN)
    assert_close(found.final, plain.final)
    assert not found.specular.any()
    assert float(found.final.max()) > 0.1
    rays = normalize(normal(15, COUNT, 3), dim=-1)
    harmonics = base_colors(gaussians | {"means": rays}, torch.zeros(3), 3)
    assert_close(single_colors(gaussians, light(), SHADING, rays, -rays), harmonics)


def test_a_pixel_reflects_by_the_share_of_its_alpha_that_has_a_surface() -> None:
    size = (20, 24)
    shown, further = torch.rand(*size, 6), torch.rand(*size, 1 + FEATURES)
    alpha = torch.full(size, 0.8)

    def specular(surface: float) -> Tensor:
        splatted = torch.cat((shown, further, torch.full((*size, 1), surface)), dim=-1)
        return SHADING.shade(GBuffer(splatted, alpha, LAYOUT), light(), camera())["specular"]

    whole = specular(0.8)
    assert float(whole.min()) > 0
    assert_close(specular(0.2), whole / 4)
    assert_close(specular(0.0), torch.zeros(*size, 3))
    assert_close(specular(0.81), whole)  # rounding of a blend


def test_what_begins_beyond_the_cameras_has_no_surface() -> None:
    far = torch.tensor([False, True])
    first, _ = SHADING.initialize(torch.zeros(2, 3), far, torch.Generator())
    assert first["surface"].tolist() == [1.0, 0.0]


MIPS = 5  # of resolution 8: 8, 4, 2, 1, and the mean


def texture(dtype: torch.dtype = torch.float64, channels: int = 5) -> Tensor:
    return torch.randn(6, 8, 8, channels, generator=torch.Generator().manual_seed(0), dtype=dtype)


def directions(count: int = 60) -> Tensor:
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def one_by_one(levels: list[Tensor], rays: Tensor, level: Tensor) -> Tensor:
    """Every level for every direction, weighted by its distance."""
    stack = torch.stack([cubemap_lookup_reference(t, rays) for t in levels])
    distance = (torch.arange(len(levels)).to(level)[:, None] - level.clamp(0, len(levels) - 1)).abs()
    return ((1 - distance).clamp(min=0)[..., None] * stack).sum(dim=0)


def test_levels_halve_and_end_in_the_mean() -> None:
    levels = box_mips(texture())
    assert [t.shape[1] for t in levels] == [8, 4, 2, 1, 1]
    assert_close(levels[1][2, 3, 0], texture()[2, 6:8, 0:2].mean(dim=(0, 1)))
    assert_close(levels[-1], texture().mean(dim=(0, 1, 2)).expand(6, 1, 1, 5))
    for level in levels:
        assert_close(level.mean(dim=(0, 1, 2)), texture().mean(dim=(0, 1, 2)))


def test_the_smallest_texture_has_itself_and_its_mean() -> None:
    assert [t.shape[1] for t in box_mips(texture()[:, :1, :1])] == [1, 1]


@pytest.mark.parametrize("shape", [(6, 6, 6, 2), (6, 4, 8, 2), (5, 4, 4, 2), (6, 4, 4), (6, 0, 0, 2)])
def test_other_shapes_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="power of two"):
        box_mips(torch.zeros(shape))


@pytest.mark.parametrize("level", [0.0, 0.7, 2.0, 3.5, 4.0, 9.0, -1.0])
def test_a_constant_texture_stays_constant(level: float) -> None:
    levels = box_mips(torch.full((6, 8, 8, 2), 1.5))
    found = mip_lookup(levels, directions().float(), torch.full((60,), level))
    assert_close(found, torch.full((60, 2), 1.5))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_between_levels_as_plainly_evaluated(dtype: torch.dtype) -> None:
    level = torch.linspace(-0.5, MIPS, 60, dtype=torch.float64)
    level[::7] = level[::7].round()
    exact = one_by_one(box_mips(texture()), directions(), level)
    found = mip_lookup(box_mips(texture().to(dtype)), directions().to(dtype), level.to(dtype))
    tolerance = 1e-5 if dtype == torch.float32 else 1e-12
    assert_close(found.double(), exact, rtol=0, atol=tolerance)


def test_gradients_against_finite_differences() -> None:
    level = torch.linspace(0.1, MIPS - 1.1, 12, dtype=torch.float64)
    inputs = (texture(channels=2).requires_grad_(), directions(12).requires_grad_(), level.requires_grad_())
    assert torch.autograd.gradcheck(lambda t, d, m: mip_lookup(box_mips(t), d, m), inputs, fast_mode=True)


def test_the_sharpest_level_still_says_what_blurring_would_change() -> None:
    """At level 0, where every roughness may begin, the gradient is that toward level 1."""
    levels = box_mips(texture())
    level = torch.zeros(60, dtype=torch.float64, requires_grad=True)
    mip_lookup(levels, directions(), level).sum().backward()
    step = mip_lookup(levels, directions(), level + 1) - mip_lookup(levels, directions(), level)
    assert_close(level.grad, step.detach().sum(dim=1))


def test_no_directions() -> None:
    levels = box_mips(texture())
    assert mip_lookup(levels, torch.zeros(0, 3).double(), torch.zeros(0).double()).shape == (0, 5)


@pytest.mark.parametrize("count", [1, 2, MIPS])
@pytest.mark.parametrize("channels", [1, 3, 5])
def test_the_native_look_up_is_the_reference(count: int, channels: int) -> None:
    rays = directions(200)
    rays[:8] = torch.tensor([[s, t, 1.0] for s in (-1, 1) for t in (-1, 0.99, 1, 0)])  # at edges and corners
    # Not at whole levels, where the gradient by the level jumps.
    level = torch.linspace(-0.55, count + 0.55, len(rays), dtype=torch.float64)
    weights = torch.randn(
        len(rays), channels, generator=torch.Generator().manual_seed(3), dtype=torch.float64
    )
    found = []
    for look_up, dtype in ((mip_lookup, torch.float32), (mip_lookup_reference, torch.float64)):
        levels = [t.to(dtype).requires_grad_() for t in box_mips(texture(channels=channels).detach())[:count]]
        inputs = (*levels, rays.to(dtype).requires_grad_(), level.to(dtype).requires_grad_())
        seen = look_up(levels, *inputs[count:])
        gradients = torch.autograd.grad((seen * weights.to(dtype)).sum(), inputs, allow_unused=count == 1)
        found.append([t.detach().double() for t in (seen, *gradients) if t is not None])
    if count == 1:  # a single level has no gradient by the level
        found = [of[:3] for of in found]
    for ours, exact in zip(*found, strict=True):
        assert_close(ours, exact, rtol=1e-3, atol=1e-4)


def test_threads_do_not_change_a_bit() -> None:
    found = []
    for threads in (1, 2, 3):
        _native.set_thread_count(threads)
        levels = [t.float().requires_grad_() for t in box_mips(texture())]
        rays, level = (
            directions(9000).float().requires_grad_(),
            4 * torch.rand(9000, generator=torch.Generator().manual_seed(4)),
        )
        seen = mip_lookup(levels, rays, level)
        found.append([seen.detach(), *torch.autograd.grad(seen.square().sum(), [*levels, rays])])
    _native.set_thread_count(0)
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_a_texture_of_many_channels_goes_by_the_reference() -> None:
    levels = box_mips(texture(torch.float32, channels=65))
    level = torch.linspace(0, 4, 60)
    found = mip_lookup(levels, directions().float(), level)
    assert_close(found, mip_lookup_reference(levels, directions().float(), level))
