"""The search for metals in a training, and what the user says of materials."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from polarguide.capture import Scene
from polarguide.raster import choose_backend
from polarguide.raster.cpu import rasterize_cpu
from polarguide.recipes import RECIPES
from polarguide.runs.defaults import resolve
from polarguide.runs.folder import load_checkpoint, save_checkpoint
from polarguide.shading.metal import any_nonzero
from polarguide.training.metals.evidence import evidence
from polarguide.training.metals.observations import contradicted, label_weights
from polarguide.training.metals.search import decide
from polarguide.training.rules import MetalRules
from polarguide.training.settings import TrainSettings
from polarguide.training.trainer import Trainer, warn_of_unused_materials
from tests.helpers.metal_balls import gaussians_of_the_ball, views_of

RULES = MetalRules()

RECIPE = RECIPES["polarguide-stokes"]


def with_materials(scene: Scene, kind: int) -> Scene:
    """The scene with everything of one material."""
    views = tuple(
        dataclasses.replace(view, materials=torch.full(view.invalid.shape, kind, dtype=torch.uint8))
        for view in scene.views
    )
    return dataclasses.replace(scene, views=views)


def trainer_of(scene: Scene, settings: TrainSettings, warn: list[str]) -> Trainer:
    repeats = tuple(
        dataclasses.replace(stage, repeats=tuple(dataclasses.replace(r, minimum=1) for r in stage.repeats))
        for stage in RECIPE.stages
    )
    recipe = dataclasses.replace(RECIPE, stages=repeats)
    return Trainer(scene, recipe, resolve(settings, scene, recipe), choose_backend("cpu"), warn=warn.append)


@pytest.mark.parametrize("until", [32, 45])
def test_training_makes_metals_of_what_the_user_says(tiny_scene: Scene, tmp_path: Path, until: int) -> None:
    """And goes on from between two looks, or from after the last, with the same bits."""
    scene, heard = with_materials(tiny_scene, 2), []
    settings = TrainSettings(60, 3)
    whole = trainer_of(scene, settings, heard)
    whole.run(lambda _: None, until=until)
    assert any_nonzero(whole.state.gaussians["metalness"])
    assert not heard
    save_checkpoint(tmp_path, whole.state)
    whole.run(lambda _: None)
    state = load_checkpoint(tmp_path, RECIPE)
    resumed = trainer_of(scene, settings, heard)
    resumed.state = state
    resumed.run(lambda _: None)
    expected, found = whole.state.tensors(), resumed.state.tensors()
    assert expected.keys() == found.keys()
    assert [name for name in expected if not torch.equal(expected[name], found[name])] == []


def test_dielectric_turns_the_search_off(tiny_scene: Scene) -> None:
    trainer = trainer_of(with_materials(tiny_scene, 2), TrainSettings(60, 3, materials="dielectric"), [])
    trainer.run(lambda _: None)
    assert not any_nonzero(trainer.state.gaussians["metalness"])


@pytest.mark.parametrize("minimum", [1, 1000])
def test_too_few_steps_to_heed_materials_are_told_of(tiny_scene: Scene, minimum: int) -> None:
    heard: list[str] = []
    stages = tuple(
        dataclasses.replace(s, repeats=tuple(dataclasses.replace(r, minimum=minimum) for r in s.repeats))
        for s in RECIPE.stages
    )
    recipe, scene = dataclasses.replace(RECIPE, stages=stages), with_materials(tiny_scene, 2)
    for given in (scene, tiny_scene):
        settings = resolve(TrainSettings(60, 3), given, recipe)
        warn_of_unused_materials(given, recipe, settings, choose_backend("cpu"), heard.append)
    if minimum == 1:
        assert not heard
    else:
        (words,) = heard
        assert words.startswith(
            "materials/ is read at refreshes of the priors between 40 and 72 % of the steps"
        )


def test_contradicting_files_are_named_once(tiny_scene: Scene) -> None:
    scene, heard = with_materials(tiny_scene, 2), []
    wrong = scene.train_views[1]
    views = tuple(
        dataclasses.replace(view, materials=torch.ones_like(view.materials))
        if view.name == wrong.name and view.materials is not None
        else view
        for view in scene.views
    )
    trainer = trainer_of(dataclasses.replace(scene, views=views), TrainSettings(60, 3), heard)
    trainer.run(lambda _: None)
    assert len(heard) == 1
    assert f"materials/{wrong.name}.png" in heard[0]
    assert "in one view, metal in another" in heard[0]


def test_who_contradicts_whom() -> None:
    """Of a ball that is metal in all files: one calls its right half dielectric, another says nothing."""
    views = [
        dataclasses.replace(view, materials=torch.where(view.invalid, 0, 2).to(torch.uint8))
        for view in views_of("gold")
    ]
    half = views[3].materials
    assert half is not None
    half[:, half.shape[1] // 2 :][half[:, half.shape[1] // 2 :] == 2] = 1
    views[4] = dataclasses.replace(views[4], materials=None)
    of_the_ball = gaussians_of_the_ball()
    found = contradicted(
        of_the_ball, views, rasterize_cpu, label_weights(of_the_ball, views, rasterize_cpu), RULES
    )
    assert list(found) == ["v03"]
    assert 0.35 < found["v03"] < 0.65
    # Of two that say opposite things, each is contradicted by the other wherever both see the ball.
    opposed = [
        dataclasses.replace(views[k], materials=torch.where(views[k].invalid, 0, kind).to(torch.uint8))
        for k, kind in ((0, 1), (1, 2))
    ]
    found = contradicted(
        of_the_ball, opposed, rasterize_cpu, label_weights(of_the_ball, opposed, rasterize_cpu), RULES
    )
    assert min(found["v00"], found["v01"]) > 0.99


def test_the_users_words_need_no_polarization(tiny_scene: Scene) -> None:
    """Single pictures do not determine the Stokes vector; what the user calls metal is one all the same."""
    views = [
        dataclasses.replace(
            view,
            pictures=view.codes[:1],
            exposures=view.exposures[:1],
            materials=torch.where(view.invalid, 0, 2).to(torch.uint8),
        )
        for view in views_of("gold")[:6]
    ]
    assert not any(view.is_determined for view in views)
    found = evidence(gaussians_of_the_ball(), views, rasterize_cpu, 1.5, RULES)
    nothing = torch.zeros(900, dtype=torch.bool)
    metal = decide(found, nothing, ~nothing, RULES)
    assert float(metal[gaussians_of_the_ball()["means"][:, 2] > 0.3].float().mean()) > 0.9
    views = [dataclasses.replace(view, materials=None) for view in views]
    assert not bool(
        decide(
            evidence(gaussians_of_the_ball(), views, rasterize_cpu, 1.5, RULES), nothing, ~nothing, RULES
        ).any()
    )
