"""Metals in the deferred shading model: what they reflect, what they leave as it was, and their gradients."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from instruction_sets import instruction_sets
from random_runs import random_state
from shaded_gaussians import (
    COUNT,
    RESOLUTION,
    camera,
    compare_native_polarization,
    gaussians,
    light,
    rendered,
)
from torch import Tensor

from polarguide import optics
from polarguide.gaussians.gaussians import Gaussians, any_nonzero
from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.gaussians.harmonics import evaluate_sh, sh_basis
from polarguide.gaussians.ply import read_ply
from polarguide.raster.cpu import rasterize_cpu
from polarguide.results.export.adapters import ply_fields
from polarguide.runs.model import gaussian_colors, write_run_ply
from polarguide.shading.cubemap import ggx_alpha, gltf_roughness
from polarguide.shading.deferred import DeferredShading
from polarguide.shading.gbuffer import render, single_colors
from polarguide.shading.metal import (
    convert,
    metal_pixels,
    mirror_base,
    reflectance,
    reflectance_logits,
    scale_light,
    spread_directions,
)
from polarguide.shading.model import mirrored

WITHOUT = DeferredShading("fresnel", local=True, rough=True)
SHADING = DeferredShading("fresnel", local=True, rough=True, metal=True)


def test_without_a_metal_every_bit_is_as_before() -> None:
    values = gaussians(metals=0)
    ours, before = rendered(SHADING, values, depth=True), rendered(WITHOUT, values, depth=True)
    for name in ("final", "specular", "diffuse", "reflection", "strength", "normal", "depth", "alpha"):
        assert torch.equal(getattr(ours, name), getattr(before, name))
    assert ours.metal is None
    assert not bool(ours.layers["metalness"].any())
    assert "metalness" not in before.layers


@pytest.mark.parametrize("depth", [False, True])
def test_layers_add_up_and_metals_have_no_body(depth: bool) -> None:
    result = rendered(SHADING, gaussians(metals=COUNT), depth=depth)
    assert result.metal is not None
    torch.testing.assert_close(result.final, result.specular + result.diffuse)
    assert not bool(result.diffuse.any())
    shown = result.alpha > 0.02
    torch.testing.assert_close(result.layers["metalness"][shown], result.alpha[shown])
    assert bool((result.specular[shown].amax(dim=-1) > 0).all())


def test_a_smooth_metal_shows_its_reflectance_times_the_light() -> None:
    values = gaussians(metals=COUNT)
    values["roughness_logits"].fill_(-30)
    values["reflectance_logits"][:] = torch.tensor([2.0, 0.0, -1.0])
    result = rendered(SHADING, values)
    assert result.metal is not None
    shown = result.alpha > 0.1
    facing = torch.nn.functional.normalize(result.normal, dim=-1)
    cosine = -(camera().world_rays() * facing).sum(-1, keepdim=True).clamp(-1, 0)
    mean, _ = optics.conductor(cosine, reflectance(torch.tensor([2.0, 0.0, -1.0])))
    expected = result.alpha[..., None] * mean * result.layers["reflection"]
    torch.testing.assert_close(result.specular[shown], expected[shown], rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("metals", [0, COUNT])
@pytest.mark.parametrize("rough", [False, True])
def test_rough_surfaces_mirror_a_blurred_light(rough: bool, metals: int) -> None:
    """Unless metals alone have a roughness."""
    values = gaussians(metals=metals)
    del values["local_dc"], values["local_rest"]
    shading = DeferredShading("fresnel", metal=True, rough=rough)
    reflections, spread = [], []
    for logit in (-30.0, 30.0):
        values["roughness_logits"].fill_(logit)
        result = rendered(shading, values)
        clear = result.alpha > 0.5
        reflections.append(result.layers["reflection"])
        spread.append(float(result.layers["reflection"][clear].std()))
        alpha = float(ggx_alpha(torch.tensor(float(logit > 0 and (rough or metals > 0))), 128))
        torch.testing.assert_close(
            result.layers["roughness"][clear], torch.full_like(result.layers["roughness"][clear], alpha**0.5)
        )
    if rough or metals:
        assert spread[1] < 0.5 * spread[0]
    else:
        assert torch.equal(*reflections)


def test_a_level_is_as_rough_as_its_texels_are_wide() -> None:
    """GGX's lobe around its mirror direction, at half its height, against 147 degrees times alpha; thin lobes."""
    alpha = torch.tensor([0.02, 0.05, 0.1], dtype=torch.float64)
    angle = torch.linspace(0, 0.4, 200_001, dtype=torch.float64)[:, None]  # of the half vector
    density = 1 / (angle.cos() ** 2 * (alpha**2 - 1) + 1) ** 2  # Walter et al. 2007, over its constant
    half = angle[(density > density[0] / 2).sum(dim=0), 0]
    torch.testing.assert_close(4 * half, math.radians(147) * alpha, rtol=0.01, atol=0)
    texels = math.pi / 2 / 32 * torch.tensor([1.0, 4.0, 16.0])
    torch.testing.assert_close(
        ggx_alpha(torch.tensor([0.0, 0.5, 1.0]), 32) * math.radians(147), texels, rtol=1e-5, atol=0
    )


def test_metals_mirror_another_environment() -> None:
    """Twice the light from afar is twice what metals show, where they have no light of their own."""
    values = gaussians(metals=COUNT)
    del values["local_dc"], values["local_rest"]
    shading, here = DeferredShading("fresnel", metal=True), light()
    twice = {"texels": here["texels"] + math.log(2)}
    once, again = (
        render(values, camera(), rasterize_cpu, shading=shading, light=seen) for seen in (here, twice)
    )
    torch.testing.assert_close(again.final, 2 * once.final, rtol=1e-4, atol=1e-5)


def test_the_point_cloud_says_what_metals_are(tmp_path: Path) -> None:
    state, shading = random_state("polarguide-stokes", 40)
    metal = torch.arange(40) < 15
    state.gaussians.overwrite("metalness", metal.float())
    write_run_ply(tmp_path / "run.ply", state, shading, own_fields=ply_fields(shading, state.gaussians))
    read = read_ply(tmp_path / "run.ply")["extra"]
    assert torch.equal(read["metalness"] > 0, metal)
    expected = reflectance(state.gaussians["reflectance_logits"]).detach()
    torch.testing.assert_close(read["reflectance"], expected)
    rough = torch.sigmoid(state.gaussians["roughness_logits"])
    side = shading.environment_resolution
    torch.testing.assert_close(read["roughness"], gltf_roughness(rough, side))
    # Ordinary viewers show what the metals mirror, not the base color that does not count.
    directions = spread_directions(12).float()
    shown = gaussian_colors(state.gaussians, state.light, shading, directions)
    state.gaussians.overwrite("sh_dc", state.gaussians["sh_dc"] + 1.0)
    after = gaussian_colors(state.gaussians, state.light, shading, directions)
    assert torch.equal(after[metal], shown[metal])
    assert not torch.equal(after[~metal], shown[~metal])


def test_a_soft_metal_is_shown_as_a_mixture_of_both() -> None:
    """Before the last look: its color between those of a dielectric and of a metal, and its diffuse layer."""
    values, rays = gaussians(metals=COUNT), torch.nn.functional.normalize(torch.randn(COUNT, 3), dim=1)
    values = {name: value.float() for name, value in values.items()}
    normals = -rays
    colors, diffuse = [], []
    for metalness in (0.0, 0.25, 1.0):
        values["metalness"] = torch.full((COUNT,), metalness)
        values["metalness"][0] = 1.0  # one is a metal in all three
        colors.append(single_colors(values, light(), SHADING, rays, normals))
        diffuse.append(rendered(SHADING, values).diffuse)
    torch.testing.assert_close(colors[1], 0.75 * colors[0] + 0.25 * colors[2])
    torch.testing.assert_close(diffuse[1], 0.75 * diffuse[0] + 0.25 * diffuse[2], rtol=1e-3, atol=1e-5)
    assert not torch.allclose(colors[0][1:], colors[2][1:])


def test_polarization_of_a_metal_is_that_of_a_conductor() -> None:
    result = rendered(SHADING, gaussians(metals=COUNT))
    stokes = SHADING.predicted_stokes(result, camera()).flatten(1, 2)[:, result.metal.pixels]
    degree = stokes[1:].square().sum(dim=0).sqrt() / stokes[0].clamp(min=1e-9)
    facing = torch.nn.functional.normalize(result.normal, dim=-1)
    cosine = -(camera().world_rays() * facing).sum(-1).flatten()[result.metal.pixels].clamp(-1, 0)
    lit = (result.metal.specular > 1e-3) & (cosine > 0.02)[:, None]
    expected = result.metal.slope * (1 - cosine**2)[:, None]
    torch.testing.assert_close(degree[lit], expected[lit], rtol=2e-3, atol=1e-4)


def finite_differences(loss: Callable[..., Tensor], tensors: list[Tensor]) -> None:
    """Compare the gradient by each tensor, along a random direction, with a difference quotient."""
    generator = torch.Generator().manual_seed(2)
    inputs = [tensor.clone().requires_grad_() for tensor in tensors]
    loss(*inputs).backward()
    for place, tensor in enumerate(inputs):
        along = torch.randn(tensor.shape, generator=generator, dtype=torch.float64)
        ends = [
            float(loss(*[t.detach() + (step * along if k == place else 0) for k, t in enumerate(inputs)]))
            for step in (1e-6, -1e-6)
        ]
        slope = (ends[0] - ends[1]) / 2e-6
        assert float((tensor.grad * along).sum()) == pytest.approx(slope, rel=1e-5, abs=1e-7)


def test_gradients_of_gaussians_follow_finite_differences() -> None:
    values = gaussians(torch.float64)
    names = ("reflectance_logits", "roughness_logits", "local_dc", "local_rest", "sh_dc", "strength_logits")

    def loss(*tensors: Tensor) -> Tensor:
        result = rendered(SHADING, {**values, **dict(zip(names, tensors, strict=True))})
        return SHADING.predicted_stokes(result, camera()).square().sum() + result.final.sum()

    finite_differences(loss, [values[name] for name in names])


def test_gradients_of_pixels_follow_finite_differences() -> None:
    generator = torch.Generator().manual_seed(3)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    rays = torch.nn.functional.normalize(uniform(40, 3) - 0.5, dim=1)
    normals = 0.7 * torch.nn.functional.normalize(-rays + 0.8 * (uniform(40, 3) - 0.5), dim=1)
    share = 0.2 + 0.8 * uniform(40, 1)
    features = torch.cat((share * (0.3 + 0.6 * uniform(40, 3)), share), dim=1)

    def loss(features: Tensor, normals: Tensor, light: Tensor) -> Tensor:
        metal = metal_pixels(features, 0, rays, normals, light)
        return metal.specular.sin().sum() + (metal.slope * metal.specular).sum()

    finite_differences(loss, [features, normals, 0.5 + uniform(40, 3)])


def test_single_precision_agrees_with_the_reference() -> None:
    for name in ("final", "specular", "diffuse", "metalness"):
        ours, exact = (
            getattr(rendered(SHADING, gaussians(dtype)), name) for dtype in (torch.float32, torch.float64)
        )
        torch.testing.assert_close(ours.double(), exact, rtol=1e-3, atol=1e-4)


def test_held_layers_send_normals_nothing() -> None:
    values = gaussians()
    values["quaternions"].requires_grad_()
    result = rendered(SHADING, values, layers_detached=True)
    specular, diffuse = (result.training[f"detached_{name}"] for name in ("specular", "diffuse"))
    assert torch.equal(specular, result.specular)
    (specular.sum() + diffuse.sum() + result.metal.specular.sum()).backward()
    rotated = values["quaternions"].grad
    values["quaternions"].grad = None
    rendered(SHADING, values).final.sum().backward()
    assert not torch.allclose(rotated, values["quaternions"].grad)


def test_whether_there_is_metal_follows_every_change() -> None:
    values = {"means": torch.zeros(5, 3), "metalness": torch.zeros(5)}
    assert not any_nonzero(values, "metalness")
    trained = Gaussians(values, {})
    assert not any_nonzero(trained, "metalness")
    trained.overwrite("metalness", torch.arange(5) / 4)
    assert any_nonzero(trained, "metalness")
    assert not any_nonzero(trained, "index_offset")
    trained.keep(torch.tensor([0]))
    assert not any_nonzero(trained, "metalness")
    trained.append({"means": torch.zeros(1, 3), "metalness": torch.ones(1)})
    assert any_nonzero(trained, "metalness")


def test_reflectances_come_back_from_their_parameter() -> None:
    values = torch.tensor([0.3, 0.5, 0.9, 0.95])
    torch.testing.assert_close(reflectance(reflectance_logits(values)), values)
    ends = reflectance(reflectance_logits(torch.tensor([0.0, 1.0])))
    assert 0.2 < float(ends[0]) < float(ends[1]) < 0.985


def trained(metals: int) -> Gaussians:
    return Gaussians(gaussians(metals=metals), {"sh_dc": 0.1})


def test_what_becomes_a_metal_looks_as_before() -> None:
    values, fresh = trained(0), torch.arange(COUNT) < 10
    assert torch.equal(convert(values, fresh, torch.full((COUNT, 3), 0.8)), fresh)
    texels = torch.full((6, RESOLUTION, RESOLUTION, 3), -1.0)
    mirror_base(values, texels, fresh, torch.exp)
    toward = spread_directions(40).float()
    normals = shortest_axis_normals(
        values["means"], values["quaternions"], values["log_scales"], torch.zeros(3), None
    ).detach()
    for k in (0, 7):
        rays = mirrored(toward, normals[k].expand_as(toward))
        base = sh_basis(rays, 3) @ torch.cat((values["sh_dc"][k][None], values["sh_rest"][k])) + 0.5
        origin = torch.zeros(3)
        own = evaluate_sh(
            toward,
            origin,
            *(values[n][k].expand(40, *values[n][k].shape) for n in ("local_dc", "local_rest")),
            3,
        )
        torch.testing.assert_close(0.8 * (own + math.exp(-1)), base, rtol=1e-4, atol=1e-4)
    assert torch.equal(values["local_dc"][10:], trained(0)["local_dc"][10:])


def test_brighter_light_leaves_dielectrics_as_they_were() -> None:
    values, seen = trained(0), light()
    before = render(values, camera(), rasterize_cpu, shading=SHADING, light=seen)
    scale_light(values, seen["texels"], 1.3)
    after = render(values, camera(), rasterize_cpu, shading=SHADING, light=seen)
    torch.testing.assert_close(after.final, before.final, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(
        after.layers["reflection"], 1.3 * before.layers["reflection"], rtol=1e-3, atol=1e-4
    )


def test_old_and_new_metals_are_told_apart() -> None:
    values = trained(5)
    logits = values["reflectance_logits"].detach().clone()
    fresh = convert(values, torch.arange(COUNT) < 8, torch.full((COUNT, 3), 0.5))
    assert fresh.nonzero()[:, 0].tolist() == [5, 6, 7]
    assert torch.equal(values["reflectance_logits"][:5], logits[:5])
    torch.testing.assert_close(reflectance(values["reflectance_logits"][5:8]), torch.full((3, 3), 0.5))
    assert not bool(convert(values, torch.arange(COUNT) < 8, torch.full((COUNT, 3), 0.7)).any())


def test_what_stays_keeps_all_that_was_learned_of_it() -> None:
    """Metals 3 and 4 become dielectrics again, 5 becomes a metal: nothing else changes, nor do Adam's moments."""
    names = ("local_dc", "local_rest", "reflectance_logits", "roughness_logits")
    values = Gaussians(gaussians(metals=5), dict.fromkeys(names, 0.01))
    sum(values[name].square().sum() for name in names).backward()
    values.step()
    before = {name: value.clone() for name, value in values.state().items()}
    metal = torch.tensor([k in (0, 1, 2, 5) for k in range(COUNT)])
    fresh = convert(values, metal, torch.full((COUNT, 3), 0.5))
    mirror_base(values, torch.zeros(6, RESOLUTION, RESOLUTION, 3), fresh, torch.exp)
    kept = torch.tensor([k not in (3, 4, 5) for k in range(COUNT)])
    for name, value in values.state().items():
        if value.ndim and name != "gaussians.metalness":
            assert torch.equal(value[kept], before[name][kept]), name
    assert not bool(values["local_dc"][3:5].any())
    assert not bool(values["local_rest"][3:5].any())
    for name in ("sh_dc", "strength_logits", "reflectance_logits", "roughness_logits"):
        assert torch.equal(values[name][3:5], before[f"gaussians.{name}"][3:5])


@pytest.mark.parametrize("instructions", instruction_sets())
def test_the_native_polarization_term_knows_metals(instructions: str) -> None:
    names = ("reflectance_logits", "roughness_logits", "strength_logits", "sh_dc", "quaternions")
    compare_native_polarization(SHADING, gaussians, names, instructions)
