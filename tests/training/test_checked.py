"""Checkpoints of every recipe with one tensor spoiled: refused by name, before anything computes with them."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

import polarguide
from polarguide.capture import Scene
from polarguide.core.errors import PolarguideError
from polarguide.core.options import SceneOptions, SessionOptions
from polarguide.recipes import RECIPES, recipe_named
from polarguide.runs.defaults import resolve
from polarguide.runs.folder import CHECKPOINT, load_checkpoint
from polarguide.training.checked import refuse_foreign
from polarguide.training.recipe import Recipe
from polarguide.training.settings import TrainSettings
from polarguide.training.state import TrainingState, first_state


def stepped(scene: Scene, recipe: Recipe) -> TrainingState:
    """A state with moments of everything, and the copy from which priors are computed."""
    state = first_state(scene, recipe, resolve(TrainSettings(10, 0), scene, recipe))
    for trained in (state.gaussians, state.environment):
        if trained is not None:
            for values in trained.trained():
                values.grad = torch.ones_like(values)
            trained.step()
    state.frozen = state.gaussians.snapshot()
    return state


def filled(value: float) -> Callable[[Tensor], Tensor]:
    def change(values: Tensor) -> Tensor:
        spoiled = values.clone()
        spoiled.view(-1)[-1] = value
        return spoiled

    return change


SPOILED: dict[str, Callable[[Tensor], Tensor]] = {
    "not a number": filled(math.nan),
    "infinite": filled(math.inf),
    "longer": lambda t: torch.cat((t.reshape(t.shape or (1,)), t.reshape(t.shape or (1,)))),
    "shorter": lambda t: t.reshape(-1)[:-1].clone() if t.numel() > 1 else t.reshape(1, 1, 1),
    "wider": lambda t: torch.cat([t.reshape(t.shape or (1,))] * 2, dim=-1),
    "one axis more": lambda t: t[None].clone(),
    "flat": lambda t: t.reshape(-1).clone() if t.ndim > 1 else t.reshape(1, 1, -1).clone(),
    "halves": lambda t: t.to(torch.float16),
    "doubles": lambda t: t.to(torch.float64),
    "whole numbers": lambda t: t.to(torch.int32),
    "huge": filled(1e30),
}


OF_GAUSSIANS = [name for name, recipe in sorted(RECIPES.items()) if isinstance(recipe, Recipe)]


@pytest.fixture(scope="module", params=OF_GAUSSIANS)
def whole(request: pytest.FixtureRequest, tiny_scene: Scene) -> tuple[Recipe, dict[str, Tensor]]:
    recipe = recipe_named(request.param)
    assert isinstance(recipe, Recipe)
    return recipe, stepped(tiny_scene, recipe).tensors()


def test_the_state_itself_is_taken_back(whole: tuple[Recipe, dict[str, Tensor]]) -> None:
    recipe, tensors = whole
    back = TrainingState.from_tensors(tensors, recipe).tensors()
    assert back.keys() == tensors.keys()


@pytest.mark.parametrize("spoiled", SPOILED)
def test_every_spoiled_tensor_is_refused_by_name(
    whole: tuple[Recipe, dict[str, Tensor]], spoiled: str
) -> None:
    recipe, tensors = whole
    free = ("exp_avg", "exp_avg_sq", "step", "statistics")  # sums may be as large as they come
    for name, values in tensors.items():
        if values.dtype != torch.float32 and spoiled in ("not a number", "infinite", "huge", "whole numbers"):
            continue
        if spoiled == "huge" and any(part in name for part in free):
            continue
        named = (
            None if name.endswith(".means") else name.replace(".", r"\.")
        )  # means state the number of the others
        with pytest.raises(ValueError, match=named):
            refuse_foreign({**tensors, name: SPOILED[spoiled](values)}, recipe)


def test_every_missing_tensor_is_named(whole: tuple[Recipe, dict[str, Tensor]]) -> None:
    recipe, tensors = whole
    for name in tensors:
        some = {key: values for key, values in tensors.items() if key != name}
        with pytest.raises(ValueError, match=name.replace(".", r"\.")):
            refuse_foreign(some, recipe)


@pytest.mark.parametrize(
    ("name", "values"),
    [("stranger", torch.zeros(2)), ("scalars", torch.tensor([-1, 0, 0])), ("scalars", torch.tensor([1, 0, 2])),
     ("scalars", torch.tensor([2**62, 0])), ("scalars", torch.tensor([1, 0, 0, 0])), ("scalars", torch.tensor([1]))],
)  # fmt: skip
def test_what_no_training_leaves_is_refused(
    tiny_scene: Scene, busy_recipe: Recipe, name: str, values: Tensor
) -> None:
    tensors = stepped(tiny_scene, busy_recipe).tensors()
    with pytest.raises(ValueError, match=name):
        refuse_foreign({**tensors, name: values}, busy_recipe)


def test_the_third_scalar_of_the_first_checkpoints_is_let_through(
    tiny_scene: Scene, busy_recipe: Recipe
) -> None:
    tensors = stepped(tiny_scene, busy_recipe).tensors()
    for flag in (0, 1):
        older = {**tensors, "scalars": torch.cat((tensors["scalars"], torch.tensor([flag])))}
        refuse_foreign(older, busy_recipe)
        loaded = TrainingState.from_tensors(older, busy_recipe).tensors()
        assert loaded.keys() == tensors.keys()
        assert all(torch.equal(loaded[name], tensors[name]) for name in tensors)


def test_signs_and_lengths(tiny_scene: Scene, busy_recipe: Recipe) -> None:
    tensors = stepped(tiny_scene, busy_recipe).tensors()
    for name in ("statistics.seen", "adam.means.exp_avg_sq", "adam.means.step"):
        with pytest.raises(ValueError, match="negative"):
            refuse_foreign({**tensors, name: tensors[name] - 1e6}, busy_recipe)
    none = {name: values[:0] if name.startswith("gaussians.") else values for name, values in tensors.items()}
    with pytest.raises(ValueError, match="of no Gaussian"):
        refuse_foreign(none, busy_recipe)
    still = {**tensors, "gaussians.quaternions": torch.zeros_like(tensors["gaussians.quaternions"])}
    with pytest.raises(ValueError, match="length zero"):
        refuse_foreign(still, busy_recipe)


@pytest.fixture(scope="module")
def with_moments(demo_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run that has kept the optimizer's state."""
    out = tmp_path_factory.mktemp("moments") / "run"
    session = SessionOptions(threads=1, keep_optimizer=True)
    polarguide.train(
        demo_scene, out, settings=TrainSettings(40), reading=SceneOptions(downscale=4), session=session
    )
    return out


@pytest.mark.parametrize("way", ["open", "resume"])
def test_opening_and_going_on_check_alike(
    with_moments: Path, demo_scene: Path, tmp_path: Path, way: str
) -> None:
    """Moments that do not fit used to crash the optimizer, and only where a run was gone on with."""
    run = tmp_path / "run"
    shutil.copytree(with_moments, run)
    tensors = load_file(run / CHECKPOINT)
    tensors["adam.means.exp_avg"] = tensors["adam.means.exp_avg"][:-1].clone()
    save_file(tensors, run / CHECKPOINT)
    reading, settings = SceneOptions(downscale=4), TrainSettings(40)
    attempt = {
        "open": lambda: polarguide.open_run(run),
        "resume": lambda: polarguide.train(demo_scene, run, settings=settings, reading=reading, resume=True),
    }[way]
    with pytest.raises(PolarguideError, match=r"adam\.means\.exp_avg"):
        attempt()


def test_sums_for_other_views_a_step_are_refused(trained: Path, demo_scene: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    tensors = load_file(run / CHECKPOINT)
    for name in ("statistics.gradient", "statistics.seen"):
        tensors[name] = tensors[name].expand(3, -1).clone()
    save_file(tensors, run / CHECKPOINT)
    with pytest.raises(PolarguideError, match="views a step"):
        polarguide.train(
            demo_scene,
            run,
            settings=TrainSettings(40),
            reading=SceneOptions(downscale=4),
            resume=True,
        )


def test_a_checkpoint_that_is_no_file_is_refused(tmp_path: Path, busy_recipe: Recipe) -> None:
    os.mkfifo(tmp_path / CHECKPOINT)
    with pytest.raises(PolarguideError, match="pipe"):
        load_checkpoint(tmp_path, busy_recipe)
