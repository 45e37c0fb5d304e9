"""Refractive indices of single Gaussians in the deferred shading model: what they change, and what they leave."""

import pytest
import shaded_gaussians
import torch
from instruction_sets import instruction_sets
from shaded_gaussians import COUNT, RESOLUTION, camera, compare_native_polarization, rendered
from torch import Tensor
from torch.nn.functional import normalize
from torch.testing import assert_close
from trainings import make_trainer

from polarguide import optics
from polarguide.capture import Scene
from polarguide.methods import recipe_named
from polarguide.raster import choose_backend
from polarguide.raster.surface import surface_picture
from polarguide.results.export.adapters import INDEX_NOTE, page_shading, ply_fields
from polarguide.shading.deferred import DeferredShading
from polarguide.shading.gbuffer import RenderRequest, render, single_colors, splatting
from polarguide.shading.model import PLAIN
from polarguide.shading.result import RenderResult
from polarguide.training.callbacks import outward_directions
from polarguide.training.loop import TrainingLoop

SHADING = DeferredShading("fresnel", local=True, metal=True, indices=True)
WITHOUT = DeferredShading("fresnel", local=True, metal=True)
TRAINED = ("strength_logits", "local_dc", "sh_dc", "quaternions", "opacity_logits")


def gaussians(
    dtype: torch.dtype = torch.float32, *, metals: int = 0, others: int = COUNT // 2
) -> dict[str, Tensor]:
    """The last of them have other indices, from 1.33 to 1.9 where the run has 1.5."""
    offsets = torch.linspace(-0.17, 0.4, COUNT, dtype=torch.float64).to(dtype)
    offsets[: COUNT - others] = 0
    return {**shaded_gaussians.gaussians(dtype, metals=metals), "index_offset": offsets}


@pytest.mark.parametrize("metals", [0, 10])
def test_without_other_indices_every_bit_is_as_before(metals: int) -> None:
    values = gaussians(metals=metals, others=0)
    ours, before = rendered(SHADING, values, depth=True), rendered(WITHOUT, values, depth=True)
    for name in (
        "final",
        "specular",
        "diffuse",
        "reflection",
        "strength",
        "normal",
        "depth",
        "alpha",
        "metalness",
    ):
        assert torch.equal(getattr(ours, name), getattr(before, name))
    assert "index" not in ours.layers
    assert torch.equal(SHADING.predicted_stokes(ours, camera()), WITHOUT.predicted_stokes(before, camera()))


@pytest.mark.parametrize("metals", [0, 10])
@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("depth", [False, True])
def test_the_native_pass_agrees_with_the_reference(metals: int, held: bool, depth: bool) -> None:
    found = []
    for dtype in (torch.float32, torch.float64):
        values = gaussians(dtype, metals=metals)
        for name in TRAINED:
            values[name].requires_grad_()
        result = rendered(SHADING, values, layers_detached=held, depth=depth)
        assert not result.layers["index"].requires_grad
        loss = (result.final * result.final).sum() + result.specular.sum()
        if held:
            loss = loss + 2 * result.training["detached_specular"].sum()
        loss = loss + SHADING.predicted_stokes(result, camera()).square().sum()
        loss.backward()
        shown = [result.final, result.specular, result.layers["index"], loss]
        found.append([t.detach().double() for t in (*shown, *(values[name].grad for name in TRAINED))])
    for ours, exact in zip(*found, strict=True):
        assert_close(ours, exact, rtol=5e-3, atol=5e-3)


def test_the_index_of_a_pixel_is_that_of_what_it_shows() -> None:
    values = gaussians(others=COUNT)
    values["index_offset"].fill_(-0.17)
    result = rendered(SHADING, values)
    assert_close(result.layers["index"], 1.5 - 0.17 * result.alpha)
    # As bright as Fresnel's equations say: all that differs from the run's index is the reflectance.
    before = rendered(WITHOUT, values)
    cosine = (
        -(camera().world_rays() * torch.nn.functional.normalize(before.normal, dim=-1)).sum(-1).clamp(-1, 0)
    )
    ours, theirs = (
        sum(optics.reflectances_from_cosine(cosine, index)) for index in (result.layers["index"], 1.5)
    )
    lit = (result.alpha > 0.1) & (before.specular.amin(dim=-1) > 1e-4)
    assert int(lit.sum()) > 20
    assert_close(result.specular[lit] / before.specular[lit], (ours / theirs)[lit][:, None].expand(-1, 3))


@pytest.mark.parametrize("instructions", instruction_sets())
@pytest.mark.parametrize("metals", [0, 10])
def test_the_native_polarization_term_has_the_index_of_each_pixel(instructions: str, metals: int) -> None:
    compare_native_polarization(SHADING, lambda: gaussians(metals=metals), TRAINED, instructions)


def test_colors_attributes_and_the_page() -> None:
    values = gaussians()
    rays = torch.nn.functional.normalize(torch.tensor([[0.3, 0.1, 1.0]]), dim=-1).expand(COUNT, 3)
    light = {"texels": torch.zeros(6, RESOLUTION, RESOLUTION, 3)}
    ours, before = (single_colors(values, light, shading, rays, -rays) for shading in (SHADING, WITHOUT))
    other = values["index_offset"] != 0
    assert torch.equal(ours[~other], before[~other])
    assert bool((ours[other] != before[other]).any(dim=1).all())
    assert_close(ply_fields(SHADING, values)["refractive_index"], 1.5 + values["index_offset"])
    assert "refractive_index" not in ply_fields(SHADING, gaussians(others=0))
    values["index_offset"].requires_grad_()  # as in a run that is opened
    page, plain = (page_shading(model, values, light) for model in (SHADING, WITHOUT))
    values["index_offset"].requires_grad_(False)
    assert INDEX_NOTE in page.notes
    # Whatever the index that the page draws with, surfaces reflect as much at 45 degrees as with their own.
    cosine = torch.tensor(0.5).sqrt()
    drawn, own = (
        sum(optics.reflectances_from_cosine(cosine, index))
        for index in (page.constants["index"], 1.5 + values["index_offset"])
    )
    assert_close(page.values["share"] * drawn, plain.values["share"] * own)
    assert float(page.values["share"].max()) <= 1


@pytest.fixture(scope="module")
def trainer(tiny_scene: Scene) -> TrainingLoop:
    recipe = recipe_named("polarguide-stokes")
    made = make_trainer(tiny_scene, recipe, 60, seed=0)
    made.run(30)
    return made


def seen(trainer: TrainingLoop, **asked: bool) -> RenderResult:
    state, camera = trainer.state, trainer.context.scene.test_views[0].camera
    with torch.no_grad():
        return render(
            state.gaussians,
            camera,
            trainer.context.backend.rasterize,
            RenderRequest(**asked),
            shading=trainer.current.shading,
            light=state.light,
        )


def test_the_layers_and_the_polarization_stay(trainer: TrainingLoop) -> None:
    camera = trainer.context.scene.test_views[0].camera
    blended, found = seen(trainer, depth=True), seen(trainer, depth=True, at_median_depth=True)
    for name in blended.layers.keys() - {"normal", "depth"}:
        assert torch.equal(blended.layers[name], found.layers[name]), name
    assert torch.equal(found.shaded_normal, blended.normal)
    assert blended.shaded_normal is blended.normal
    predicted = [trainer.current.shading.predicted_stokes(result, camera) for result in (blended, found)]
    assert torch.equal(*predicted)


def test_normals_and_depth_are_those_around_the_median(trainer: TrainingLoop) -> None:
    found, gaussians = seen(trainer, depth=True, at_median_depth=True), trainer.state.gaussians
    camera = trainer.context.scene.test_views[0].camera
    with torch.no_grad():
        given, _ = splatting(gaussians, camera, PLAIN, sh_degree=0, normals=False, depth=False)
    assert torch.equal(found.depth, surface_picture(given, camera).depth)
    assert bool((found.normal.norm(dim=-1) <= found.alpha + 1e-5).all())
    blended = seen(trainer, depth=True)
    assert float((found.depth - blended.depth).abs().max()) > 1e-3, "they are not the same thing"


def test_what_is_not_asked_for_is_not_there(trainer: TrainingLoop) -> None:
    assert "depth" not in seen(trainer, at_median_depth=True).layers
    state, camera = trainer.state, trainer.context.scene.test_views[0].camera
    plain = render(
        state.gaussians,
        camera,
        trainer.context.backend.rasterize,
        RenderRequest(normals=False, depth=True, at_median_depth=True),
        shading=PLAIN,
    )
    assert "normal" not in plain.layers
    assert "shaded_normal" not in plain.layers
    assert not plain.depth.requires_grad


def test_a_wall_is_seen_from_the_side_of_the_cameras_and_what_is_behind_it_is_not(tiny_scene: Scene) -> None:
    """A dense opaque patch before one camera, and one Gaussian well behind it."""
    view = tiny_scene.train_views[0]
    camera = view.camera
    center = camera.center.float()
    ahead = camera.rotation[2].float()
    across = camera.rotation[:2].float()
    steps = torch.linspace(-1.5, 1.5, 25)
    grid = torch.stack(torch.meshgrid(steps, steps, indexing="ij"), dim=-1).reshape(-1, 2)
    wall = center + 2 * ahead + grid @ across
    means = torch.cat((wall, (center + 4 * ahead)[None]))
    count = len(means)
    rows = {
        "means": means,
        "quaternions": torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4),
        "log_scales": torch.full((count, 3), 0.08).log(),
        "opacity_logits": torch.full((count,), 4.0),
        "sh_dc": torch.zeros(count, 3),
        "sh_rest": torch.zeros(count, 15, 3),
    }
    outward = outward_directions(rows, [view], choose_backend("cpu").rasterize)
    middle = grid.norm(dim=1) < 0.5
    toward = normalize(center - wall, dim=-1)
    torch.testing.assert_close(outward[:-1][middle], toward[middle], atol=1e-5, rtol=1e-5)
    assert torch.equal(outward[-1], torch.zeros(3))
