"""A run folder: whole checkpoints or none, a configuration that is checked, a log that can be cut."""

import json
import os
import shutil
import signal
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from faults import Fault
from heard import Heard
from safetensors import safe_open
from safetensors.torch import save_file
from trainings import make_trainer

import polarguide
from polarguide.capture import Scene
from polarguide.core.errors import PolarguideError
from polarguide.core.options import SceneOptions, SessionOptions
from polarguide.methods import RECIPES
from polarguide.runs.callbacks import TrainingStopped
from polarguide.runs.folder import (
    CHECKPOINT,
    CONFIGURATION,
    LOG,
    RunConfiguration,
    RunLog,
    load_checkpoint,
    save_checkpoint,
    writing_to,
)
from polarguide.training.context import TrainingState
from polarguide.training.recipe import Recipe
from polarguide.training.settings import ResolvedSettings, TrainSettings


@pytest.fixture
def state(tiny_scene: Scene, busy_recipe: Recipe) -> TrainingState:
    return make_trainer(tiny_scene, busy_recipe, 10).state


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


class Crash(Exception):
    pass


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
    state.step, state.opacity_frozen_until = 2**40, 2**40 + 9
    save_checkpoint(tmp_path, state)
    loaded = load_checkpoint(tmp_path, busy_recipe)
    assert (loaded.step, loaded.opacity_frozen_until) == (2**40, 2**40 + 9)
    assert not any(name.startswith("frozen.") for name in loaded.extra)


@pytest.mark.skipif(sys.platform != "linux", reason="the file system takes names in UTF-8 alone")
def test_a_checkpoint_is_read_under_a_name_that_is_no_utf8(
    tmp_path: Path, state: TrainingState, busy_recipe: Recipe
) -> None:
    folder = tmp_path / os.fsdecode(b"run\xff")
    folder.mkdir()
    save_checkpoint(folder, state)
    assert load_checkpoint(folder, busy_recipe).step == state.step


@pytest.mark.parametrize("damage", ["cut", "empty", "header", "text", "missing tensor", "other rows", "gone"])
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
    elif damage == "gone":
        path.unlink()
    elif damage == "text":
        path.write_text("not a checkpoint")
    elif damage == "missing tensor":
        save_file({k: t for k, t in tensors.items() if k != "scalars"}, path)
    else:
        save_file({**tensors, "gaussians.means": torch.zeros(3, 3)}, path)
    Fault(str(tmp_path)).raised_by(load_checkpoint, tmp_path, busy_recipe)


def configuration() -> RunConfiguration:
    recipe = RECIPES["polarguide"]
    return RunConfiguration(
        scene="/some/scene",
        scene_digest="abc",
        recipe=recipe.name,
        recipe_data=recipe.data(),
        settings=ResolvedSettings(steps=100, seed=5, refractive_index=1.4),
        downscale=2,
        transfer="linear",
        device="cpu",
        test_views=("v000",),
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
    assert replace(recipe, means_decay=recipe.means_decay / 2).data() != data
    first = replace(recipe.stages[0], densify=not recipe.stages[0].densify)
    assert replace(recipe, stages=(first, *recipe.stages[1:])).data() != data


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "3", "{}", '{"settings": 3}', '{"settings": {"steps": 3}}', "\xff\xfe"]
)
def test_a_configuration_that_is_something_else_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / CONFIGURATION).write_bytes(text.encode("latin-1"))
    Fault(CONFIGURATION).raised_by(RunConfiguration.load, tmp_path)


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


@pytest.mark.parametrize(
    "line",
    ['{"step": "9"}', '{"step": 1e400}', '{"step": null}', "[]", "{}", "[" * 5000, "\0", '{"step": -1}', "9", "",
     '{"step": 1, "psnr": NaN}', '{"step": 1, "x": "\xff"}',
     '{"step": 9, "seconds": "x"}', '{"step": 9, "seconds": NaN}', '{"step": 9, "alone": []}', '{"step": true}'],
)  # fmt: skip
def test_lines_that_are_none_of_ours_are_dropped(tmp_path: Path, line: str) -> None:
    good = '{"step": 3, "stage": "x", "seconds": 1.5, "alone": true, "more": 1}'
    (tmp_path / LOG).write_text(f"{good}\n{line}\n", "latin-1")
    log = RunLog(tmp_path)
    assert [row["step"] for row in log.rows()] == [3]
    assert log.elapsed() == (1.5, True)
    log.cut(10)
    assert (tmp_path / LOG).read_text() == good + "\n"


def test_one_training_at_a_time_writes_to_a_run(tmp_path: Path) -> None:
    run = tmp_path / "run"
    with writing_to(run):
        Fault(str(run), "", "another training").raised_by(writing_to(run).__enter__)
        pid = os.fork()
        if not pid:  # another process
            try:
                with writing_to(run):
                    os._exit(0)
            except PolarguideError:
                os._exit(3)
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 3
    pid = os.fork()
    if not pid:  # one that is killed with the lock in its hands
        with writing_to(run):
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(pid, 0)
    with writing_to(run):
        pass


def test_a_second_training_into_a_run_is_refused(demo_scene: Path, tmp_path: Path, trained: Path) -> None:
    run = tmp_path / "run"
    reading, settings = SceneOptions(downscale=4), TrainSettings(40)
    old = Path(shutil.copytree(trained, tmp_path / "old"))
    before = (old / CHECKPOINT).read_bytes()
    for folder in (run, old):
        given = {"settings": settings, "reading": reading, "resume": folder == old}
        with writing_to(folder):
            Fault(found="another training").raised_by(polarguide.train, demo_scene, folder, **given)
    assert (old / CHECKPOINT).read_bytes() == before


def test_a_finished_run_keeps_no_state_of_the_optimizer(
    demo_scene: Path, tmp_path: Path, state: TrainingState
) -> None:
    given = {"recipe": "3dgs", "reading": SceneOptions(downscale=8), "settings": TrainSettings(3)}

    def names(run: Path) -> set[str]:
        with safe_open(run / CHECKPOINT, framework="pt") as file:
            keys = list(file.keys())
        return {part for key in keys for part in key.split(".")}

    for keep in (False, True):
        out = tmp_path / str(keep)
        session = SessionOptions(keep_optimizer=keep, checkpoint_every=2)
        stop = iter((False, False, True)).__next__
        with pytest.raises(TrainingStopped):
            polarguide.train(demo_scene, out, **given, session=session, should_stop=stop)
        assert "adam" in names(out)
        polarguide.train(demo_scene, out, **given, session=session, resume=True)
        assert ("adam" in names(out)) == keep
    # It is as good as before for all that is done with it, and a further resume of what is finished does nothing.
    pictures = [polarguide.open_run(tmp_path / str(keep)).render("v000")["final"] for keep in (False, True)]
    assert bool((pictures[0] == pictures[1]).all())
    before = (tmp_path / "False" / CHECKPOINT).read_bytes()
    polarguide.train(demo_scene, tmp_path / "False", **given, resume=True)
    assert (tmp_path / "False" / CHECKPOINT).read_bytes() == before
    frozen = {f"frozen.{name}": values for name, values in state.gaussians.snapshot().items()}
    save_checkpoint(tmp_path, replace(state, extra=frozen), optimizer=False)
    assert not {"adam", "frozen"} & names(tmp_path)


@pytest.mark.parametrize("name", [CHECKPOINT, CONFIGURATION])
def test_a_link_to_nowhere_is_no_new_training(
    demo_scene: Path, trained: Path, tmp_path: Path, name: str
) -> None:
    run = Path(shutil.copytree(trained, tmp_path / "run"))
    (run / name).unlink()
    (run / name).symlink_to(tmp_path / "unmounted" / name)
    given = {"settings": TrainSettings(40), "reading": SceneOptions(downscale=4)}
    fault = Fault(found="a link to nowhere") if name == CHECKPOINT else Fault(name, "a readable file")
    fault.raised_by(polarguide.train, demo_scene, run, **given, resume=True)
    Fault(expected="a new folder", found="a run").raised_by(polarguide.train, demo_scene, run, **given)
    assert (run / name).is_symlink()


def test_a_run_without_a_checkpoint_says_that_it_begins_again(demo_scene: Path, tmp_path: Path) -> None:
    run, heard = tmp_path / "run", Heard()
    given = {"settings": TrainSettings(2), "reading": SceneOptions(downscale=8), "recipe": "3dgs"}
    polarguide.train(demo_scene, run, **given)
    (run / CHECKPOINT).unlink()
    polarguide.train(demo_scene, run, **given, resume=True, reporter=heard)
    assert any("has no checkpoint: the training begins at step 0" in text for text in heard.said)


def test_more_steps_than_a_training_was_begun_with(demo_scene: Path, trained: Path, tmp_path: Path) -> None:
    shutil.copytree(trained, tmp_path / "run")
    given = {"settings": TrainSettings(50), "reading": SceneOptions(downscale=4), "resume": True}
    Fault("(steps)", "40", "50", "new folder").raised_by(
        polarguide.train, demo_scene, tmp_path / "run", **given
    )
    Fault(expected="a folder", found="a null byte").raised_by(
        polarguide.train, demo_scene, "runs/\0", settings=TrainSettings(3)
    )


def test_a_checkpoint_has_the_rights_of_other_files(tmp_path: Path, state: TrainingState) -> None:
    save_checkpoint(tmp_path, state)
    (tmp_path / "other").write_text("x")
    assert (tmp_path / CHECKPOINT).stat().st_mode == (tmp_path / "other").stat().st_mode


def test_the_same_state_is_the_same_bytes(tmp_path: Path, state: TrainingState) -> None:
    found = set()
    for _ in range(12):
        save_checkpoint(tmp_path, state)
        found.add((tmp_path / CHECKPOINT).read_bytes())
    assert len(found) == 1
