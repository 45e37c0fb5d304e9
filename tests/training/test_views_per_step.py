"""A step of several views: its rates, its mean gradient, and the resumed training."""

from pathlib import Path

import pytest
import torch
from trainings import different, make_trainer, run, trained

from polarguide.capture import Scene
from polarguide.runs.folder import load_checkpoint, save_checkpoint
from polarguide.training.recipe import Recipe


def test_several_views_a_step_are_resumed_bit_by_bit(
    tiny_scene: Scene, busy_recipe: Recipe, tmp_path: Path
) -> None:
    """Also between two rounds of the density control, when the statistics are under way."""
    begun = make_trainer(tiny_scene, busy_recipe, 30, views_per_step=3)
    run(begun, until=21)
    save_checkpoint(tmp_path, begun.state)
    state = load_checkpoint(tmp_path, busy_recipe)
    resumed = trained(tiny_scene, busy_recipe, 30, state=state, views_per_step=3)
    assert different(resumed, trained(tiny_scene, busy_recipe, 30, views_per_step=3)) == []


def test_rates_follow_the_square_root_of_the_views(tiny_scene: Scene, busy_recipe: Recipe) -> None:
    trainings = []
    for views in (1, 4):
        trainer = make_trainer(tiny_scene, busy_recipe, 30, views_per_step=views)
        trainer.step()
        trainings.append(trainer.state.gaussians)
    one, four = trainings
    assert four.rates == pytest.approx({name: 2 * rate for name, rate in one.rates.items()})
    assert four.betas == pytest.approx((0.9**4, 0.999**4))


def test_the_gradient_of_a_step_is_the_mean_over_its_views(
    tiny_scene: Scene, busy_recipe: Recipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = make_trainer(tiny_scene, busy_recipe, 30, views_per_step=2)
    monkeypatch.setattr(trainer, "update_parameters", lambda: None)
    means = trainer.state.gaussians["means"]
    trainer.prepare()
    trainer.optimize()
    mean = means.grad
    single = []
    for slot in range(2):
        means.grad = None
        trainer.backpropagate(slot)
        single.append(means.grad)
    torch.testing.assert_close(mean, (single[0] + single[1]) / 2)
    assert not torch.allclose(single[0], single[1])
