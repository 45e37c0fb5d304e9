"""PolGS: its polarization against Fresnel's equations, its terms by hand, and the way of its recipe to a page."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize
from trainings import different, make_trainer, run, trained

from polarguide import optics
from polarguide.capture import Scene
from polarguide.gaussians.harmonics import SH_C0
from polarguide.gaussians.ply import read_ply
from polarguide.geometry.camera import Camera
from polarguide.methods import recipe_named
from polarguide.methods.registry import recipes
from polarguide.raster import choose_backend
from polarguide.results.evaluation.scores import score_view
from polarguide.results.evaluation.target import ViewTarget
from polarguide.results.export.adapters import ply_fields
from polarguide.results.export.web_page import BAKED, share_page
from polarguide.runs.folder import load_checkpoint, save_checkpoint
from polarguide.runs.model import write_run_ply
from polarguide.shading.cubemap import texel_directions
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.shading.model import GBuffer, radiance_cubemap
from polarguide.shading.result import RenderResult, channel_slices
from polarguide.training.targets import Step, StepTargets, ViewPriors
from polarguide_bench.polgs import (
    AdditiveShading,
    SurfelWeights,
    curvature_loss,
    opacity_loss,
    polarization_term,
)
from polarguide_bench.recipes import ablations_of

INDEX = 1.4
SHADING = AdditiveShading(environment_resolution=64, refractive_index=INDEX)
CAMERA = Camera(
    48, 36, 60.0, 60.0, 24.0, 18.0, torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
)
DIFFUSE = torch.tensor([0.3, 0.2, 0.05])
TOWARD = torch.tensor([[0.9, -0.2, 0.1], [0.1, 1.1, -0.3], [-0.5, 0.3, 0.8]])
STEPS = 60


def radiance(directions: Tensor) -> Tensor:
    """Light of the surroundings, smooth enough for the texels."""
    return torch.sigmoid(directions @ TOWARD.T)


def surroundings() -> dict[str, Tensor]:
    return {"texels": texel_directions(64).float() @ TOWARD.T}


def plane() -> Tensor:
    """Normals [H, W, 3] of a tilted plane."""
    return normalize(torch.tensor([0.5, -0.4, -1.0]), dim=0).expand(36, 48, 3)


def sphere() -> Tensor:
    """Normals of a sphere; where rays miss it, 0."""
    rays = CAMERA.rays()
    center = torch.tensor([0.1, -0.05, 4.0])
    along = rays @ center
    inside = along**2 - center @ center + 1.0
    points = (along - inside.clamp(min=0).sqrt())[..., None] * rays
    return (points - center) * (inside > 0.02)[..., None]


def shaded(normals: Tensor, share: float = 1.0) -> RenderResult:
    """The layers of surfaces with the color ``DIFFUSE``."""
    picture = torch.full((36, 48, 1), share)
    features = torch.cat((DIFFUSE.expand(36, 48, 3), normals, picture), dim=-1)
    layout = channel_slices({"color": 3, "normal": 3, "share": 1})
    layers = SHADING.shade(GBuffer(features, picture[..., 0], layout), surroundings(), CAMERA)
    return RenderResult({**layers, "normal": normals, "alpha": picture[..., 0]})


def expected_stokes(normals: Tensor) -> Tensor:
    """Stokes vectors [3, P, 3] of unit normals [P, 3] in view of rays [P, 3], lobe by lobe."""
    seen = normals.norm(dim=-1) > 0
    rays, normals = CAMERA.rays()[seen], normals[seen]
    mirrored = rays - 2 * (rays * normals).sum(dim=-1, keepdim=True) * normals
    zenith, azimuth = optics.zenith(normals, rays), optics.azimuth(normals, rays)
    total = torch.zeros(3, len(rays), 3)
    for light, dolp, aolp in (
        (2 * DIFFUSE.expand(len(rays), 3), optics.diffuse_dolp(zenith, INDEX), azimuth),
        (2 * radiance(mirrored), optics.specular_dolp(zenith, INDEX), azimuth + math.pi / 2),
    ):
        factors = (torch.ones_like(dolp), dolp * torch.cos(2 * aolp), dolp * torch.sin(2 * aolp))
        total += torch.stack(factors)[..., None] * light
    return total


@pytest.mark.parametrize("shape", [plane, sphere])
def test_the_polarization_is_that_of_both_lobes(shape) -> None:
    normals = shape()
    found = SHADING.predicted_stokes(shaded(normals), CAMERA)[:, normals.norm(dim=-1) > 0]
    expected = expected_stokes(normals)
    assert found.shape[1] > 150
    assert float(expected[1:].abs().max()) > 0.2
    torch.testing.assert_close(found, expected, atol=2e-3, rtol=0)  # the texels are interpolated


def flat_gaussians(normal: Tensor) -> dict[str, Tensor]:
    """A sheet of opaque Gaussians through (0, 0, 4)."""
    across = normalize(torch.linalg.cross(normal, torch.tensor([0.0, 1.0, 0.0])), dim=0)
    up = torch.linalg.cross(normal, across)
    steps = torch.linspace(-4, 4, 61)
    u, v = torch.meshgrid(steps, steps, indexing="ij")
    means = torch.tensor([0.0, 0.0, 4.0]) + u.reshape(-1, 1) * across + v.reshape(-1, 1) * up
    w = math.sqrt((1 + float(normal[2])) / 2)  # turns z to the normal
    axis = torch.stack((-normal[1], normal[0], torch.zeros(())))
    count = len(means)
    return {
        "means": means,
        "quaternions": torch.cat((torch.tensor([w]), axis / (2 * w))).expand(count, 4).clone(),
        "log_scales": torch.tensor([0.15, 0.15, 1e-3]).log().expand(count, 3).clone(),
        "opacity_logits": torch.full((count,), 6.0),
        "sh_dc": ((DIFFUSE - 0.5) / SH_C0).expand(count, 3).clone(),
        "sh_rest": torch.ones(count, 15, 3),
        "surface": torch.ones(count),
    }


def test_a_sheet_of_gaussians_is_rendered_with_this_polarization() -> None:
    normal = plane()[0, 0]
    result = render(
        flat_gaussians(normal),
        CAMERA,
        choose_backend("cpu").rasterize,
        shading=SHADING,
        light=surroundings(),
    )
    assert float(result.alpha.min()) > 0.98
    expected = result.alpha[..., None] * expected_stokes(plane()).reshape(3, 36, 48, 3)
    torch.testing.assert_close(SHADING.predicted_stokes(result, CAMERA), expected, atol=3e-3, rtol=0)


def test_surroundings_have_the_color_of_their_harmonics_and_do_not_reflect() -> None:
    gaussians = flat_gaussians(plane()[0, 0])
    gaussians["surface"] = torch.zeros(len(gaussians["means"]))
    gaussians["sh_rest"] = torch.zeros_like(gaussians["sh_rest"])
    rasterize = choose_backend("cpu").rasterize
    flat = render(gaussians, CAMERA, rasterize, shading=SHADING, light=surroundings())
    assert float(flat.layers["specular"].abs().max()) == 0
    gaussians["sh_rest"][:, 0] = 0.1
    tinted = render(gaussians, CAMERA, rasterize, shading=SHADING, light=surroundings())
    assert float((tinted.final - flat.final).abs().mean()) > 1e-3


def test_a_normal_that_faces_away_has_no_mirrored_light() -> None:
    assert float(shaded(-plane()).layers["specular"].abs().max()) == 0


def test_the_polarization_term_moves_normals_alone() -> None:
    gaussians = {name: t.requires_grad_() for name, t in flat_gaussians(plane()[0, 0]).items()}
    light = {"texels": surroundings()["texels"].requires_grad_()}
    rasterize = choose_backend("cpu").rasterize
    result = render(gaussians, CAMERA, rasterize, shading=SHADING, light=light)
    measured = torch.zeros(3, 36, 48, 3)
    priors = ViewPriors(CAMERA, stokes=measured, stokes_weight=torch.ones(36, 48))
    targets = StepTargets(CAMERA, result.final.detach(), priors=priors)
    loss = polarization_term(Step(result, targets, SHADING, gaussians, 1.0), SurfelWeights(polarization=3.0))
    assert loss is not None
    loss.backward()
    prediction = SHADING.predicted_stokes(result, CAMERA)
    assert loss.item() == pytest.approx(3 * prediction[1:].abs().mean().item(), rel=1e-5)
    assert float(gaussians["quaternions"].grad.abs().max()) > 0
    for unmoved in (gaussians["sh_dc"], gaussians["sh_rest"], light["texels"]):
        assert unmoved.grad is None or float(unmoved.grad.abs().max()) == 0


def test_uncertain_opacities_cost_most() -> None:
    opacities = torch.tensor([0.005, 0.1, 0.5, 0.9, 0.995])
    costs = [0, 0.01 * math.exp(-3.2), 1, 0.01 * math.exp(-3.2), 0]
    assert float(opacity_loss(opacities)) == pytest.approx(sum(costs) / 5, rel=1e-5)


def test_curvature_is_the_laplacian_of_the_covered_normals() -> None:
    normal = torch.zeros(5, 6, 3)
    normal[..., 2] = -3.0  # only the direction counts
    alpha = torch.ones(5, 6)
    assert float(curvature_loss(normal, alpha)) == 0
    normal[2, 3] = torch.tensor([0.0, 2.0, 0.0])
    # At the pixel itself 4 in two axes, and at each neighbor 1 in two axes.
    assert float(curvature_loss(normal, alpha)) == pytest.approx(16 / 30)
    alpha[2, 3] = 0
    assert float(curvature_loss(normal, alpha)) == 0


def test_the_recipe_is_found_by_its_name() -> None:
    recipe = recipe_named("polgs")
    assert {"polgs", "polgs:strength", "polgs:unpolarized"} <= recipes().keys()
    assert [each.name for each in ablations_of("polgs")] == ["polgs:strength", "polgs:unpolarized"]
    weights = [stage.weights for stage in recipe.stages if stage.reflection]
    assert {each.polarization for each in weights} != {0}
    slopes = [each.consistency for each in weights]
    assert slopes == sorted(slopes)
    bare = recipe_named("polgs:unpolarized")
    assert not any(stage.weights.priors for stage in bare.stages)


def test_without_a_degree_of_its_own_an_object_has_one_color_from_all_sides(tiny_scene: Scene) -> None:
    state = trained(tiny_scene, recipe_named("polgs"), STEPS)
    surface = state["gaussians.surface"] > 0
    assert 0 < int(surface.sum()) < len(surface)
    assert float(state["gaussians.sh_rest"][surface].abs().max()) == 0
    assert float(state["gaussians.sh_rest"][~surface].abs().max()) > 0


@pytest.mark.parametrize("name", ["polgs", "polgs:strength"])
def test_it_resumes_to_the_same_bits_and_is_scored_and_exported(
    tiny_scene: Scene, tmp_path: Path, name: str
) -> None:
    recipe = recipe_named(name)
    recipe = replace(recipe, densification=replace(recipe.densification, every=10, gradient=1e-5))
    trainer = make_trainer(tiny_scene, recipe, STEPS, gaussians=5000)
    before = len(trainer.state.gaussians)
    run(trainer)
    assert len(trainer.state.gaussians) != before
    first = make_trainer(tiny_scene, recipe, STEPS, gaussians=5000)
    run(first, 25)
    save_checkpoint(tmp_path, first.state)
    resumed = make_trainer(tiny_scene, recipe, STEPS, load_checkpoint(tmp_path, recipe), gaussians=5000)
    run(resumed)
    assert resumed.state.tensors().keys() == trainer.state.tensors().keys()
    for key, values in trainer.state.tensors().items():
        assert torch.equal(values, resumed.state.tensors()[key]), key

    gaussians, light, shading = trainer.state.gaussians, trainer.state.light, trainer.current.shading
    view = tiny_scene.train_views[0]
    rasterize = trainer.context.backend.rasterize
    with torch.no_grad():
        result = render(
            gaussians, view.camera, rasterize, RenderRequest(depth=True), shading=shading, light=light
        )
    assert set(shading.layers) <= result.layers.keys()
    target = ViewTarget.of(view.photograph(), view.invalid, view.ground_truth, torch.device("cpu"))
    assert score_view(target, result)["psnr"] > 10  # type: ignore[operator]

    write_run_ply(tmp_path / "run.ply", trainer.state, shading, own_fields=ply_fields(shading, gaussians))
    strength = {"strength"} if name == "polgs:strength" else set()
    assert set(read_ply(tmp_path / "run.ply")["extra"]) == {"linear_dc", "linear_rest", "surface"} | strength
    cameras = {each.name: each.camera for each in tiny_scene.views}
    page = share_page(gaussians, light, shading, cameras, first=view.name, title="PolGS")
    assert BAKED in page
    cubemap = radiance_cubemap(shading)
    assert cubemap is not None
    raw = torch.linspace(-5, 5, 11)
    torch.testing.assert_close(cubemap.raw(cubemap.radiance(raw)), raw)


def test_the_terms_change_a_training(tiny_scene: Scene) -> None:
    recipe = recipe_named("polgs")
    for name in ("polarization", "opacity", "curvature"):
        stages = tuple(
            replace(stage, weights=replace(stage.weights, **{name: 0.0})) if stage.reflection else stage
            for stage in recipe.stages
        )
        other = replace(recipe, stages=stages)
        assert different(trained(tiny_scene, recipe, 20), trained(tiny_scene, other, 20)), name
