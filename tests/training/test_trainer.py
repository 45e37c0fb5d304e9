"""Every recipe trains; going on from a checkpoint gives the same bits as never having stopped."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from faults import Fault
from tiny import make_busy_recipe
from trainings import different, make_trainer, run, trained

from polarguide.capture import Scene
from polarguide.geometry.camera import Camera
from polarguide.methods import RECIPES
from polarguide.runs.folder import load_checkpoint, save_checkpoint
from polarguide.runs.model import GaussianModel
from polarguide.shading.directional import DirectionalShading
from polarguide.training.loop import TrainingLoop
from polarguide.training.recipe import Recipe
from polarguide.training.settings import StepReport

OF_GAUSSIANS = [name for name, recipe in RECIPES.items() if isinstance(recipe, Recipe)]

STEPS, STOP = 60, 25
DIRECTIONAL = ("log_albedo", "roughness_logits", "features")


@pytest.mark.parametrize("name", OF_GAUSSIANS)
def test_every_recipe_trains(tiny_scene: Scene, name: str) -> None:
    trainer = make_trainer(tiny_scene, RECIPES[name], 30)
    reports = run(trainer)
    assert [report.step for report in reports] == list(range(30))
    assert all(bool(report.measured.isfinite().all()) for report in reports)
    assert {report.stage for report in reports} == {stage.name for stage in RECIPES[name].stages}
    floats = {k: t for k, t in trainer.state.tensors().items() if t.is_floating_point()}
    assert all(bool(torch.isfinite(t).all()) for t in floats.values())
    shapes = {
        n.removeprefix("gaussians."): tuple(t.shape[1:]) for n, t in floats.items() if "gaussians." in n
    }
    assert shapes == RECIPES[name].shapes
    assert set(trainer.state.light) == set(RECIPES[name].shading.light_parameters)


@pytest.mark.parametrize("name", ["3dgs", "polarguide"])
def test_training_brings_the_picture_closer(tiny_scene: Scene, name: str) -> None:
    reports = run(make_trainer(tiny_scene, RECIPES[name], 200))
    views = len(tiny_scene.train_views)
    first = sum(float(report.measured[1]) for report in reports[:views]) / views
    last = sum(float(report.measured[1]) for report in reports[-views:]) / views
    assert last > first + 3


@pytest.fixture(scope="module")
def whole(tiny_scene: Scene) -> tuple[TrainingLoop, list[StepReport]]:
    """The busy recipe, without a stop."""
    trainer = make_trainer(tiny_scene, make_busy_recipe(), STEPS)
    return trainer, run(trainer)


def test_the_busy_recipe_is_busy_on_both_sides_of_the_stop(
    whole: tuple[TrainingLoop, list[StepReport]], busy_recipe: Recipe
) -> None:
    trainer, reports = whole
    actions = [trainer.schedule.at(step).actions for step in range(STEPS)]
    for side in (range(STOP), range(STOP, STEPS)):
        seen = {action for step in side for action in actions[step]}
        assert seen == {"reset_opacity", "propagate_normals", "refresh_priors"}
        counts = [reports[step].gaussians for step in side]
        assert len(set(counts)) > 1, "the density control did nothing"
    huge = [busy_recipe.densification.prunes_large(step, STEPS) for step in range(STEPS)]
    assert not huge[STOP - 8]
    assert huge[STOP + 8]


def test_a_finished_training_draws_larger_pictures_with_its_own_blur(
    whole: tuple[TrainingLoop, list[StepReport]],
) -> None:
    trainer = whole[0]
    model = GaussianModel(trainer.state, trainer.current.shading, trainer.context.backend)
    plain = GaussianModel(
        replace(trainer.state, footprints=None), trainer.current.shading, trainer.context.backend
    )
    camera = trainer.context.scene.train_views[0].camera
    larger = camera.scaled(4, 4 * camera.width, 4 * camera.height)

    def apart(view: Camera) -> float:
        return float((model.render(view).final - plain.render(view).final).abs().mean())

    assert apart(larger) > 2 * apart(camera)
    depth = model.render(larger, depth=True).depth
    assert depth is not None
    difference = model.alpha_in_front(larger, depth) - plain.alpha_in_front(larger, depth)
    assert float(difference.abs().max()) > 1e-3


def plain(report: StepReport) -> tuple[object, ...]:
    """The values of a report, to compare them."""
    return report.step, report.stage, report.gaussians, report.done, report.measured.tolist()


@pytest.mark.parametrize("stop", [1, 6, 7, 16, 24, STOP, 40, 59])
def test_any_step_can_be_resumed_from(
    tiny_scene: Scene,
    busy_recipe: Recipe,
    tmp_path: Path,
    whole: tuple[TrainingLoop, list[StepReport]],
    stop: int,
) -> None:
    """Also just before and just after stage changes, refreshes, rounds of densification and propagations."""
    begun = make_trainer(tiny_scene, busy_recipe, STEPS)
    first = run(begun, until=stop)
    assert begun.state.footprints is None  # of a finished training alone
    save_checkpoint(tmp_path, begun.state)
    state = load_checkpoint(tmp_path, busy_recipe)
    assert different(state.tensors(), begun.state.tensors()) == []
    reports = first + run(make_trainer(tiny_scene, busy_recipe, STEPS, state))
    assert list(map(plain, reports)) == list(map(plain, whole[1]))
    assert different(state.tensors(), whole[0].state.tensors()) == []


def test_a_directional_light_is_resumed_bit_by_bit(
    tiny_scene: Scene, busy_recipe: Recipe, tmp_path: Path
) -> None:
    """Parameters of the model follow the density control, and the grid and the MLP keep their moments."""
    stop = 14  # between two rounds of the density control that add Gaussians
    recipe = replace(
        RECIPES["ref-gs"],
        densification=replace(busy_recipe.densification, every=4, pixels_each=1.0),
        initialization=busy_recipe.initialization,
        shading=DirectionalShading(width=64, environment_spread=0.5, environment_resolution=8),
    )
    whole = make_trainer(tiny_scene, recipe, STEPS)
    assert len({report.gaussians for report in run(whole)[stop : STEPS // 2]}) > 1
    begun = make_trainer(tiny_scene, recipe, STEPS)
    run(begun, until=stop)
    save_checkpoint(tmp_path, begun.state)
    state = load_checkpoint(tmp_path, recipe)
    run(make_trainer(tiny_scene, recipe, STEPS, state))
    tensors = state.tensors()
    assert different(tensors, whole.state.tensors()) == []
    moved = [f"adam.{name}.exp_avg" for name in DIRECTIONAL]
    moved += [f"environment.adam.mlp_weight_{layer}.exp_avg" for layer in range(3)]
    assert all(bool(tensors[name].any()) for name in (*moved, "environment.adam.exp_avg"))
    assert all(tensors[f"gaussians.{name}"].shape[0] == len(state.gaussians) for name in DIRECTIONAL)


def test_what_a_stage_gives_no_rate_rests_in_it(tiny_scene: Scene) -> None:
    recipe = RECIPES["3dgs"]
    first, last = recipe.stages
    resting = replace(last, rate_factors={"quaternions": 0.0, "means": 0.0})
    trainer = make_trainer(tiny_scene, replace(recipe, stages=(first, resting)), STEPS)
    run(trainer, until=STEPS // 2)
    before = trainer.state.gaussians.snapshot()
    run(trainer, until=STEPS // 2 + 3)
    changed = different(before, trainer.state.gaussians.snapshot())
    assert sorted(set(before) - set(changed)) == ["means", "quaternions"]


def test_the_seed_decides_and_global_random_state_neither_matters_nor_changes(
    tiny_scene: Scene, busy_recipe: Recipe
) -> None:
    torch.manual_seed(1)
    before = torch.get_rng_state()
    first = trained(tiny_scene, busy_recipe, STEPS, until=30)
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(2)
    assert different(first, trained(tiny_scene, busy_recipe, STEPS, until=30)) == []
    assert "gaussians.means" in different(first, trained(tiny_scene, busy_recipe, STEPS, until=30, seed=4))


def test_every_epoch_visits_every_training_view_once(tiny_scene: Scene) -> None:
    trainer = make_trainer(tiny_scene, RECIPES["3dgs"], 100, seed=0)
    names = sorted(view.name for view in tiny_scene.train_views)
    count = len(names)
    epochs = [
        [trainer.feed.view_at(step).name for step in range(begin, begin + count)]
        for begin in range(0, 8 * count, count)
    ]
    assert all(sorted(epoch) == names for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) > 1


def test_test_views_are_never_trained_on(tiny_scene: Scene) -> None:
    blackened = tuple(
        replace(view, pictures=torch.zeros_like(view.codes)) if view.name in tiny_scene.test_names else view
        for view in tiny_scene.views
    )
    scenes = (tiny_scene, replace(tiny_scene, views=blackened))
    assert different(*(trained(scene, RECIPES["polarguide"], 20) for scene in scenes)) == []


def test_the_first_state_has_one_gaussian_per_point_and_added_one(
    tiny_scene: Scene, busy_recipe: Recipe
) -> None:
    state = make_trainer(tiny_scene, busy_recipe, 10, seed=0).state
    count = len(tiny_scene.points) + busy_recipe.initialization.shell
    assert len(state.gaussians) == count
    assert state.step == 0
    assert state.tensors()["statistics.seen"].shape == (count,)
    assert torch.equal(state.gaussians["means"][: len(tiny_scene.points)].detach(), tiny_scene.points)


def test_a_loss_that_is_not_finite_stops_the_training(tiny_scene: Scene) -> None:
    trainer = make_trainer(tiny_scene, RECIPES["polarguide"], 30)
    with torch.no_grad():
        trainer.state.gaussians["sh_dc"][0, 0] = math.nan
    Fault("rasterize(features)", "finite", "Gaussian 0").raised_by(trainer.step)


@pytest.mark.parametrize(("consistency", "moved"), [(0.1, True), (0.0, False)])
def test_behind_the_subject_the_consistency_moves_nothing(
    tiny_scene: Scene, consistency: float, moved: bool
) -> None:
    states = []
    for behind in ((1e-6, 2e-6), (1e6, 2e6)):
        stages = tuple(
            replace(stage, weights=replace(stage.weights, consistency=consistency), behind=behind)
            for stage in RECIPES["3dgs-dr"].stages
        )
        states.append(trained(tiny_scene, replace(RECIPES["3dgs-dr"], stages=stages), 10))
    changed = different(*states)
    assert ("gaussians.means" in changed) == ("gaussians.opacity_logits" in changed) == moved
