"""Training a subject with nothing behind it."""

from dataclasses import replace

import pytest
import torch
from faults import Fault
from reference_rasterizer import rasterize_reference
from trainings import CPU, make_trainer, run

from polarguide.capture import Scene
from polarguide.methods import RECIPES
from polarguide.raster import Backend
from polarguide.shading.gbuffer import RenderRequest, render, splats
from polarguide.training.callbacks import LEAST_PIXELS, touched_pixels
from polarguide.training.loop import TrainingLoop
from polarguide.training.losses import Weights, coverage_loss
from polarguide.training.recipe import Recipe
from polarguide.training.settings import TrainSettings


@pytest.fixture
def black_scene(tiny_scene: Scene) -> Scene:
    """The tiny scene's pictures with black where they show their background alone."""
    background = torch.tensor([0.2, 0.25, 0.3])
    views = []
    for view in tiny_scene.views:
        shown = (view.photograph() - background).abs().amax(dim=-1) > 0.02
        shown[:2] = shown[-2:] = shown[:, :2] = shown[:, -2:] = False
        views.append(replace(view, pictures=view.codes * shown.to(view.codes)[None, ..., None]))
    return replace(tiny_scene, views=tuple(views))


def trainer(scene: Scene, background: str, recipe: Recipe = RECIPES["3dgs"], steps: int = 60) -> TrainingLoop:
    return make_trainer(scene, recipe, steps, background=background)


def test_the_mode_is_found_from_the_pictures_unless_it_is_given(
    tiny_scene: Scene, black_scene: Scene
) -> None:
    for scene, found in ((tiny_scene, False), (black_scene, True)):
        for background, black in (("auto", found), ("scene", False), ("black", True), ("masked", True)):
            made = trainer(scene, background)
            assert made.context.black == black
            if background == "auto":
                assert made.settings.background == ("black" if found else "scene")


@pytest.mark.parametrize("name", ["3dgs", "3dgs-dr", "ref-gs", "polarguide-stokes"])
def test_every_recipe_begins_without_far_gaussians(black_scene: Scene, name: str) -> None:
    for background, shell in (("auto", 0), ("scene", RECIPES[name].initialization.shell)):
        begun = trainer(black_scene, background, RECIPES[name])
        assert len(begun.state.gaussians) == len(black_scene.points) + shell


def test_empty_pixels_are_emptier_than_where_surroundings_are_trained(black_scene: Scene) -> None:
    outside = []
    for background in ("scene", "black"):
        made = trainer(black_scene, background, steps=150)
        run(made)
        camera = black_scene.views[0].camera
        alpha = render(made.state.gaussians, camera, CPU.rasterize, RenderRequest(normals=False)).alpha
        outside.append(float(torch.cat((alpha[:2], alpha[-2:])).mean().detach()))
    assert outside[1] < 0.5 * outside[0]


def test_coverage_counts_empty_pixels_alone() -> None:
    alpha = torch.tensor([[0.5, 0.25], [1.0, 1.0]]).requires_grad_()
    empty = torch.tensor([[1.0, 1.0], [0.0, 0.0]])
    loss = coverage_loss(alpha, empty)
    assert float(loss.detach()) == 0.375
    loss.backward()
    assert alpha.grad.tolist() == [[0.5, 0.5], [0.0, 0.0]]
    assert float(coverage_loss(alpha.detach(), torch.zeros(2, 2))) == 0


def test_a_step_is_pulled_to_emptiness_where_the_background_is_black(black_scene: Scene) -> None:
    """The loss of the first step, with and without the term on coverage, where masks leave Gaussians outside."""
    mask = torch.zeros(black_scene.views[0].codes.shape[1:3], dtype=torch.bool)
    mask[9:11, 11:13] = True
    masked = replace(black_scene, views=tuple(replace(view, mask=mask) for view in black_scene.views))
    losses = []
    recipe = RECIPES["3dgs"]
    for weight in (0.0, Weights().coverage):
        stages = tuple(replace(s, weights=replace(s.weights, coverage=weight)) for s in recipe.stages)
        losses.append(float(trainer(masked, "black", replace(recipe, stages=stages)).step().measured[2]))
    assert losses[1] > losses[0]


def summed_weights(made: TrainingLoop, number: int) -> list[float]:
    """What one Gaussian adds to each training view, by pictures with it white among black ones."""
    given = splats(made.state.gaussians)
    features = torch.zeros(len(given.means), 1)
    features[number] = 1.0
    fixed = type(given)(*(tensor.detach() for tensor in given))._replace(features=features)
    return [
        float(rasterize_reference(fixed, view.camera).features.sum())
        for view in made.context.scene.train_views
    ]


def test_pictures_that_a_gaussian_adds_to_are_counted(black_scene: Scene) -> None:
    made = trainer(black_scene, "black")
    with torch.no_grad():
        made.state.gaussians["means"][0] = torch.tensor([0.0, 0.0, 50.0])
        made.state.gaussians["opacity_logits"][1] = -12.0
    cameras = [view.camera for view in black_scene.train_views]
    counts, most = touched_pixels(made.state.gaussians, cameras, CPU.rasterize)
    for number in (0, 1, 2, 7):
        weights = summed_weights(made, number)
        assert counts[number] == sum(w >= LEAST_PIXELS for w in weights)
        assert float(most[number]) == pytest.approx(max(weights), rel=1e-4, abs=1e-6)
    assert counts[1] == 0
    assert counts[2] > 0


def test_what_no_view_sees_goes_when_the_density_control_ends(black_scene: Scene) -> None:
    made = trainer(black_scene, "black", steps=40)  # too few for a round of the density control
    with torch.no_grad():
        made.state.gaussians["means"][0] = torch.tensor([0.0, -500.0, 0.0])
    count = len(made.state.gaussians)
    run(made, 19)
    assert len(made.state.gaussians) == count
    run(made, 21)
    assert len(made.state.gaussians) < count
    assert float(made.state.gaussians["means"].detach().abs().max()) < 100
    assert len(made.state.tensors()["statistics.gradient"]) == len(made.state.gaussians)


def test_surroundings_keep_what_no_view_sees(black_scene: Scene) -> None:
    made = trainer(black_scene, "scene", steps=40)
    count = len(made.state.gaussians)
    run(made)
    assert len(made.state.gaussians) == count


def test_what_is_faint_in_all_views_goes_where_the_recipe_says_so(black_scene: Scene) -> None:
    stages, recipe = {}, RECIPES["polarguide-stokes"]
    assert recipe.densification.faint_pixels == 0.1
    for faint in (0.0, 0.1):
        changed = replace(recipe, densification=replace(recipe.densification, faint_pixels=faint))
        made = trainer(black_scene, "scene", recipe=changed, steps=40)
        with torch.no_grad():
            made.state.gaussians["opacity_logits"][1] = -5.4  # over the least opacity, and hardly to be seen
        run(made, 19)
        before = len(made.state.gaussians)
        run(made, 20)
        stages[faint] = before, len(made.state.gaussians)
    assert stages[0.0][0] == stages[0.0][1] == stages[0.1][0]
    assert 0 < stages[0.1][1] < stages[0.1][0]


def test_all_stays_where_no_view_sees_anything(black_scene: Scene) -> None:
    def nothing(splats, camera, **asked):  # type: ignore[no-untyped-def]
        return rasterize_reference(splats._replace(opacities=splats.opacities * 0), camera, **asked)

    backend = Backend(CPU.device, nothing)
    made = make_trainer(black_scene, RECIPES["3dgs"], 40, backend=backend, background="black")
    run(made)
    assert len(made.state.gaussians) == len(black_scene.points)


def test_a_mode_that_there_is_not_is_refused() -> None:
    Fault("background", "auto, scene, black, masked", "white").raised_by(TrainSettings, background="white")
