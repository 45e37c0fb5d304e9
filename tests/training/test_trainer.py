"""Every recipe trains; going on from a checkpoint gives the same bits as never having stopped."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from polarguide.capture import Scene
from polarguide.core.errors import PolarguideError
from polarguide.raster import choose_backend
from polarguide.recipes import RECIPES
from polarguide.runs.defaults import resolve
from polarguide.runs.folder import load_checkpoint, save_checkpoint
from polarguide.shading.directional import DirectionalShading
from polarguide.training.recipe import Recipe
from polarguide.training.settings import TrainSettings
from polarguide.training.trainer import StepReport, Trainer, first_state

OF_GAUSSIANS = [name for name, recipe in RECIPES.items() if isinstance(recipe, Recipe)]

STEPS, STOP = 60, 25
DIRECTIONAL = ("log_albedo", "roughness_logits", "features")


def train(
    scene: Scene, recipe: Recipe, *, until: int | None = None, steps: int = STEPS, seed: int = 3
) -> tuple[Trainer, list[StepReport]]:
    reports: list[StepReport] = []
    trainer = Trainer(
        scene, recipe, resolve(TrainSettings(steps, seed), scene, recipe), choose_backend("cpu")
    )
    trainer.run(reports.append, until=until)
    return trainer, reports


def different(a: dict[str, Tensor], b: dict[str, Tensor]) -> list[str]:
    """Names of the tensors that are not the same bits."""
    missing = set(a) ^ set(b)
    return sorted(missing | {name for name in a if name not in missing and not same_bits(a[name], b[name])})


def same_bits(a: Tensor, b: Tensor) -> bool:
    return a.dtype == b.dtype and a.shape == b.shape and a.numpy().tobytes() == b.numpy().tobytes()


@pytest.mark.parametrize("name", OF_GAUSSIANS)
def test_every_recipe_trains(tiny_scene: Scene, name: str) -> None:
    trainer, reports = train(tiny_scene, RECIPES[name], steps=30)
    assert [report.step for report in reports] == list(range(30))
    assert all(math.isfinite(report.loss) and math.isfinite(report.psnr) for report in reports)
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
    _, reports = train(tiny_scene, RECIPES[name], steps=200)
    views = len(tiny_scene.train_views)
    first = sum(report.psnr for report in reports[:views]) / views
    last = sum(report.psnr for report in reports[-views:]) / views
    assert last > first + 3


def test_the_busy_recipe_is_busy_on_both_sides_of_the_stop(tiny_scene: Scene, busy_recipe: Recipe) -> None:
    trainer, reports = train(tiny_scene, busy_recipe)
    actions = [trainer.schedule.at(step).actions for step in range(STEPS)]
    for side in (range(STOP), range(STOP, STEPS)):
        seen = {action for step in side for action in actions[step]}
        assert seen == {"reset_opacity", "propagate_normals", "refresh_priors"}
        counts = [reports[step].gaussians for step in side]
        assert len(set(counts)) > 1, "the density control did nothing"
    huge = [busy_recipe.densification.prunes_large(step, STEPS) for step in range(STEPS)]
    assert not huge[STOP - 8]
    assert huge[STOP + 8]


def test_resumed_is_uninterrupted_bit_by_bit(tiny_scene: Scene, busy_recipe: Recipe, tmp_path: Path) -> None:
    whole, reports = train(tiny_scene, busy_recipe)
    begun, first = train(tiny_scene, busy_recipe, until=STOP)
    save_checkpoint(tmp_path, begun.state)
    state = load_checkpoint(tmp_path, busy_recipe)
    assert different(state.tensors(), begun.state.tensors()) == []
    rest: list[StepReport] = []
    Trainer(
        tiny_scene,
        busy_recipe,
        resolve(TrainSettings(STEPS, 3), tiny_scene, busy_recipe),
        choose_backend("cpu"),
        state,
    ).run(rest.append)
    assert first + rest == reports
    assert different(state.tensors(), whole.state.tensors()) == []


def test_a_directional_light_is_resumed_bit_by_bit(
    tiny_scene: Scene, busy_recipe: Recipe, tmp_path: Path
) -> None:
    """Parameters of the model follow the density control, and the grid and the MLP keep their moments."""
    stop = 14  # between two rounds of the density control that add Gaussians
    recipe = dataclasses.replace(
        RECIPES["ref-gs"],
        densification=dataclasses.replace(busy_recipe.densification, every=4, pixels_each=1.0),
        initialization=busy_recipe.initialization,
        shading=DirectionalShading(width=64, environment_spread=0.5, environment_resolution=8),
    )
    whole, reports = train(tiny_scene, recipe)
    assert len({report.gaussians for report in reports[stop : STEPS // 2]}) > 1
    begun, _ = train(tiny_scene, recipe, until=stop)
    save_checkpoint(tmp_path, begun.state)
    state = load_checkpoint(tmp_path, recipe)
    assert different(state.tensors(), begun.state.tensors()) == []
    Trainer(
        tiny_scene, recipe, resolve(TrainSettings(STEPS, 3), tiny_scene, recipe), choose_backend("cpu"), state
    ).run(lambda _: None)
    assert different(state.tensors(), whole.state.tensors()) == []
    tensors = state.tensors()
    moved = [f"adam.{name}.exp_avg" for name in DIRECTIONAL]
    moved += [f"environment.adam.mlp_weight_{layer}.exp_avg" for layer in range(3)]
    assert all(bool(tensors[name].any()) for name in (*moved, "environment.adam.exp_avg"))
    assert all(tensors[f"gaussians.{name}"].shape[0] == len(state.gaussians) for name in DIRECTIONAL)


@pytest.mark.parametrize("stop", [1, 6, 7, 16, 24, 40, 59])
def test_any_step_can_be_resumed_from(
    tiny_scene: Scene, busy_recipe: Recipe, tmp_path: Path, stop: int
) -> None:
    """Also just before and just after stage changes, refreshes, rounds of densification and propagations."""
    ahead = min(stop + 9, STEPS)
    whole, _ = train(tiny_scene, busy_recipe, until=ahead)
    begun, _ = train(tiny_scene, busy_recipe, until=stop)
    save_checkpoint(tmp_path, begun.state)
    state = load_checkpoint(tmp_path, busy_recipe)
    settings = resolve(TrainSettings(STEPS, 3), tiny_scene, busy_recipe)
    Trainer(tiny_scene, busy_recipe, settings, choose_backend("cpu"), state).run(lambda _: None, until=ahead)
    assert different(state.tensors(), whole.state.tensors()) == []


def test_what_a_stage_gives_no_rate_rests_in_it(tiny_scene: Scene) -> None:
    recipe = RECIPES["3dgs"]
    first, last = recipe.stages
    resting = dataclasses.replace(last, rate_factors={"quaternions": 0.0, "means": 0.0})
    recipe = dataclasses.replace(recipe, stages=(first, resting))
    trainer, _ = train(tiny_scene, recipe, until=STEPS // 2)
    before = trainer.state.gaussians.snapshot()
    trainer.run(lambda _: None, until=STEPS // 2 + 3)
    after = trainer.state.gaussians.snapshot()
    assert sorted(set(before) - set(different(before, after))) == ["means", "quaternions"]


def test_the_seed_decides(tiny_scene: Scene, busy_recipe: Recipe) -> None:
    first, _ = train(tiny_scene, busy_recipe, until=20)
    again, _ = train(tiny_scene, busy_recipe, until=20)
    other, _ = train(tiny_scene, busy_recipe, until=20, seed=4)
    assert different(first.state.tensors(), again.state.tensors()) == []
    assert "gaussians.means" in different(first.state.tensors(), other.state.tensors())


def test_global_random_state_neither_matters_nor_changes(tiny_scene: Scene, busy_recipe: Recipe) -> None:
    torch.manual_seed(1)
    before = torch.get_rng_state()
    first, _ = train(tiny_scene, busy_recipe, until=30)
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(2)
    second, _ = train(tiny_scene, busy_recipe, until=30)
    assert different(first.state.tensors(), second.state.tensors()) == []


def test_every_epoch_visits_every_training_view_once(tiny_scene: Scene) -> None:
    trainer = Trainer(
        tiny_scene,
        RECIPES["3dgs"],
        resolve(TrainSettings(100, 0), tiny_scene, RECIPES["3dgs"]),
        choose_backend("cpu"),
    )
    names = sorted(view.name for view in tiny_scene.train_views)
    count = len(names)
    epochs = [
        [trainer._view_of(step).name for step in range(begin, begin + count)]
        for begin in range(0, 8 * count, count)
    ]
    assert all(sorted(epoch) == names for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) > 1


def test_test_views_are_never_trained_on(tiny_scene: Scene) -> None:
    recipe = RECIPES["polarguide"]
    blackened = dataclasses.replace(
        tiny_scene,
        views=tuple(
            dataclasses.replace(view, pictures=torch.zeros_like(view.codes))
            if view.name in tiny_scene.test_names
            else view
            for view in tiny_scene.views
        ),
    )
    shown, _ = train(tiny_scene, recipe, steps=20)
    hidden, _ = train(blackened, recipe, steps=20)
    assert different(shown.state.tensors(), hidden.state.tensors()) == []


def test_the_first_state_has_one_gaussian_per_point_and_added_one(
    tiny_scene: Scene, busy_recipe: Recipe
) -> None:
    state = first_state(tiny_scene, busy_recipe, resolve(TrainSettings(10, 0), tiny_scene, busy_recipe))
    count = len(tiny_scene.points) + busy_recipe.initialization.shell
    assert len(state.gaussians) == count
    assert state.step == 0
    assert state.statistics.seen.shape == (count,)
    assert torch.equal(state.gaussians["means"][: len(tiny_scene.points)].detach(), tiny_scene.points)


def test_a_loss_that_is_not_finite_stops_the_training(tiny_scene: Scene) -> None:
    trainer = Trainer(
        tiny_scene,
        RECIPES["polarguide"],
        resolve(TrainSettings(30, 0), tiny_scene, RECIPES["polarguide"]),
        choose_backend("cpu"),
    )
    with torch.no_grad():
        trainer.state.gaussians["sh_dc"][0, 0] = math.nan
    with pytest.raises(PolarguideError, match="finite"):
        trainer.step()


@pytest.mark.parametrize(("consistency", "moved"), [(0.1, True), (0.0, False)])
def test_behind_the_subject_the_consistency_moves_nothing(
    tiny_scene: Scene, consistency: float, moved: bool
) -> None:
    states = []
    for behind in ((1e-6, 2e-6), (1e6, 2e6)):
        stages = tuple(
            dataclasses.replace(
                stage, weights=dataclasses.replace(stage.weights, consistency=consistency), behind=behind
            )
            for stage in RECIPES["3dgs-dr"].stages
        )
        recipe = dataclasses.replace(RECIPES["3dgs-dr"], stages=stages)
        states.append(train(tiny_scene, recipe, steps=10)[0].state.tensors())
    assert ("gaussians.means" in different(*states)) == moved
    assert ("gaussians.opacity_logits" in different(*states)) == moved
