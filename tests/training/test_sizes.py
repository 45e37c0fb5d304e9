"""Large pictures are looked at in half their size first; what is found is the same after a stop, and in small ones."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch

from polarguide.capture import Scene
from polarguide.raster import choose_backend
from polarguide.recipes import RECIPES
from polarguide.runs.defaults import resolve
from polarguide.runs.folder import load_checkpoint, save_checkpoint
from polarguide.runs.forecast import _priors_made
from polarguide.training.feed import Feed, coarse_steps
from polarguide.training.recipe import Coarse
from polarguide.training.settings import ResolvedSettings, StepReport, TrainSettings
from polarguide.training.targets import StepTargets
from polarguide.training.trainer import Trainer
from polarguide.training.view_store import ViewStore

STOKES = RECIPES["polarguide-stokes"]
STEPS = 40
HALVED = dataclasses.replace(STOKES, coarse=Coarse(share=0.5, factor=2, pixels=1))
NEVER = dataclasses.replace(STOKES, coarse=Coarse(share=0.0))


def trained(
    scene: Scene,
    recipe: object,
    until: int | None = None,
    state: object = None,
    store: ViewStore | None = None,
) -> Trainer:
    reports: list[StepReport] = []
    trainer = Trainer(
        scene,
        recipe,
        resolve(TrainSettings(STEPS, 3), scene, recipe),
        choose_backend("cpu"),
        state,
        store=store,
    )  # type: ignore[arg-type]
    trainer.run(reports.append, until=until)
    return trainer


def bits(trainer: Trainer) -> dict[str, bytes]:
    return {name: values.numpy().tobytes() for name, values in trainer.state.tensors().items()}


def test_the_first_half_of_the_steps_looks_at_smaller_pictures(
    tiny_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[int, ...]] = []
    targets = Feed.targets

    def watched(self: Feed, *given: Any) -> StepTargets:
        found = targets(self, *given)
        seen.append(tuple(found.picture.shape[:2]))
        return found

    monkeypatch.setattr(Feed, "targets", watched)
    trained(tiny_scene, HALVED)
    height, width = tiny_scene.train_views[0].codes.shape[1:3]
    assert seen == [(height // 2, width // 2)] * (STEPS // 2) + [(height, width)] * (STEPS // 2)


def test_what_was_kept_of_smaller_pictures_goes(tiny_scene: Scene) -> None:
    store = ViewStore()
    trainer = trained(tiny_scene, HALVED, until=STEPS // 2, store=store)
    kinds = {kind for kind, _ in store._held}
    assert {"small photograph", "small priors"} <= kinds
    trainer.run(lambda _: None)
    kinds = {kind for kind, _ in store._held}
    assert not any(kind.startswith("small") for kind in kinds)
    assert {"photograph", "priors"} <= kinds


@pytest.mark.parametrize("stop", [13, 20, 27])
def test_going_on_gives_the_same_bits(tiny_scene: Scene, tmp_path: Path, stop: int) -> None:
    whole = trained(tiny_scene, HALVED)
    save_checkpoint(tmp_path, trained(tiny_scene, HALVED, until=stop).state)
    resumed = trained(tiny_scene, HALVED, state=load_checkpoint(tmp_path, HALVED, torch.device("cpu")))
    assert bits(resumed) == bits(whole)


def test_small_pictures_are_looked_at_whole(tiny_scene: Scene) -> None:
    assert coarse_steps(STOKES, tiny_scene.train_views, 5000) == 0
    assert coarse_steps(HALVED, tiny_scene.train_views, 5000) == 2500
    assert bits(trained(tiny_scene, STOKES)) == bits(trained(tiny_scene, NEVER))


def test_priors_are_counted_by_size() -> None:
    """Where the size changes they are all made once more."""
    settings = ResolvedSettings(steps=1000, refractive_index=1.5)
    assert _priors_made(STOKES, settings, 10, 0)[True] == 0
    whole = _priors_made(STOKES, settings, 10, 0)[False]
    halved = _priors_made(STOKES, settings, 10, 430)
    assert halved[True] > 0
    assert halved[True] + halved[False] == whole + 10
