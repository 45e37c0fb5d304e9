"""A run folder: whole checkpoints or none, a configuration that is checked, a log that can be cut."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from polarguide.capture import Scene
from polarguide.errors import PolarguideError
from polarguide.files import atomic
from polarguide.recipes import RECIPES
from polarguide.runs.folder import (
    CHECKPOINT,
    CONFIGURATION,
    LOG,
    RunConfiguration,
    RunLog,
    load_checkpoint,
    save_checkpoint,
)
from polarguide.training.recipe import Recipe
from polarguide.training.state import TrainingState
from polarguide.training.trainer import TrainSettings, first_state


@pytest.fixture
def state(tiny_scene: Scene, busy_recipe: Recipe) -> TrainingState:
    return first_state(tiny_scene, busy_recipe, TrainSettings(10, 0))


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


class Crash(Exception):
    pass


def test_a_crash_while_writing_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("old")

    def write() -> None:
        with atomic(path) as temporary:
            temporary.write_text("half of the n")
            assert path.read_text() == "old"
            raise Crash

    with pytest.raises(Crash):
        write()
    assert path.read_text() == "old"
    assert files(tmp_path) == ["file"]


def test_a_crash_before_writing_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("old")
    with pytest.raises(Crash), atomic(path):
        raise Crash
    assert path.read_text() == "old"
    assert files(tmp_path) == ["file"]


def test_a_finished_write_takes_the_place_of_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("old")
    with atomic(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new"
    assert files(tmp_path) == ["file"]


def test_a_crash_while_saving_leaves_the_old_checkpoint(
    tmp_path: Path, state: TrainingState, busy_recipe: Recipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_checkpoint(tmp_path, state)
    before = (tmp_path / CHECKPOINT).read_bytes()

    def cut_short(tensors: object, path: Path, metadata: object) -> None:
        path.write_bytes(before[: len(before) // 2])
        raise Crash

    monkeypatch.setattr("polarguide.runs.folder.save_file", cut_short)
    state.step = 7
    with pytest.raises(Crash):
        save_checkpoint(tmp_path, state)
    assert (tmp_path / CHECKPOINT).read_bytes() == before
    assert files(tmp_path) == [CHECKPOINT]
    assert load_checkpoint(tmp_path, busy_recipe).step == 0


def test_scalars_survive_a_checkpoint(tmp_path: Path, state: TrainingState, busy_recipe: Recipe) -> None:
    state.step, state.opacity_frozen_until, state.opacity_was_reset = 2**40, 2**40 + 9, True
    save_checkpoint(tmp_path, state)
    loaded = load_checkpoint(tmp_path, busy_recipe)
    assert (loaded.step, loaded.opacity_frozen_until, loaded.opacity_was_reset) == (2**40, 2**40 + 9, True)
    assert loaded.frozen is None


@pytest.mark.parametrize("damage", ["cut", "empty", "header", "text", "missing tensor", "other rows"])
def test_a_damaged_checkpoint_is_refused(
    tmp_path: Path, state: TrainingState, busy_recipe: Recipe, damage: str
) -> None:
    save_checkpoint(tmp_path, state)
    path = tmp_path / CHECKPOINT
    whole = path.read_bytes()
    tensors = state.tensors()
    if damage == "cut":
        path.write_bytes(whole[: len(whole) // 2])
    elif damage == "empty":
        path.write_bytes(b"")
    elif damage == "header":
        path.write_bytes(b"\xff" * 64 + whole[64:])
    elif damage == "text":
        path.write_text("not a checkpoint")
    elif damage == "missing tensor":
        save_file({k: t for k, t in tensors.items() if k != "scalars"}, path)
    else:
        save_file({**tensors, "gaussians.means": torch.zeros(3, 3)}, path)
    with pytest.raises(PolarguideError) as error:
        load_checkpoint(tmp_path, busy_recipe)
    assert error.value.remedy


def test_a_folder_without_checkpoint_is_named(tmp_path: Path, busy_recipe: Recipe) -> None:
    with pytest.raises(PolarguideError, match=CHECKPOINT):
        load_checkpoint(tmp_path, busy_recipe)


def configuration() -> RunConfiguration:
    recipe = RECIPES["polarguide"]
    return RunConfiguration(
        scene="/some/scene",
        scene_digest="abc",
        recipe=recipe.name,
        recipe_data=recipe.data(),
        settings=TrainSettings(100, 5, 1.4),
        downscale=2,
        transfer="linear",
        device="cpu",
    )


def test_the_configuration_survives_its_file(tmp_path: Path) -> None:
    configuration().save(tmp_path)
    assert RunConfiguration.load(tmp_path) == configuration()
    assert files(tmp_path) == [CONFIGURATION]


@pytest.mark.parametrize("name", RECIPES)
def test_every_value_of_a_recipe_is_on_record(name: str) -> None:
    recipe = RECIPES[name]
    data = recipe.data()
    assert json.loads(json.dumps(data)) == data
    changed = replace(recipe, means_decay=recipe.means_decay / 2)
    assert changed.data() != data
    first = replace(recipe.stages[0], densify=not recipe.stages[0].densify)
    assert replace(recipe, stages=(first, *recipe.stages[1:])).data() != data


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "3", "{}", '{"settings": 3}', '{"settings": {"steps": 3}}', "\xff\xfe"]
)
def test_a_configuration_that_is_something_else_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / CONFIGURATION).write_bytes(text.encode("latin-1"))
    with pytest.raises(PolarguideError, match=CONFIGURATION):
        RunConfiguration.load(tmp_path)


def test_a_folder_that_is_no_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(PolarguideError, match="expected a run folder"):
        RunConfiguration.load(tmp_path / "none")


def test_the_log_is_cut_at_a_step_and_forgives_a_torn_line(tmp_path: Path) -> None:
    log = RunLog(tmp_path)
    assert log.elapsed() == (0.0, True)
    log.cut(3)
    assert not (tmp_path / LOG).exists()
    for step in (9, 19, 29):
        log.append(step=step, seconds=step / 10, alone=step < 15)
    with open(tmp_path / LOG, "a") as file:
        file.write('{"step": 39, "seco')
    log.cut(25)
    lines = [json.loads(line) for line in (tmp_path / LOG).read_text().splitlines()]
    assert [line["step"] for line in lines] == [9, 19]
    assert log.elapsed() == (1.9, False)
    log.cut(0)
    assert log.elapsed() == (0.0, True)
