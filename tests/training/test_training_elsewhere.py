"""Training on a device that is not the CPU, with values: every step, what happens between steps, and checkpoints."""

from pathlib import Path

import pytest
import torch
from other_device import BACKEND, THERE, OtherDevice, unfused_adam
from safetensors.torch import load_file
from torch import Tensor
from trainings import CPU, different, make_trainer, run

from polarguide.capture import Scene
from polarguide.gaussians.ply import read_ply
from polarguide.methods import RECIPES
from polarguide.runs.folder import CHECKPOINT, load_checkpoint, save_checkpoint
from polarguide.runs.model import write_run_ply
from polarguide.training.callbacks import NormalOrientation
from polarguide.training.loop import TrainingLoop
from polarguide.training.recipe import Recipe

OF_GAUSSIANS = [name for name, recipe in RECIPES.items() if isinstance(recipe, Recipe)]
STEPS, HALF = 20, 9


@pytest.fixture(autouse=True)
def plain_adam(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("polarguide.gaussians.gaussians.adam", unfused_adam)


def checkpoint(folder: Path, trainer: TrainingLoop) -> dict[str, Tensor]:
    folder.mkdir(exist_ok=True)
    save_checkpoint(folder, trainer.state)
    return load_file(folder / CHECKPOINT)


@pytest.mark.parametrize("name", OF_GAUSSIANS)
def test_a_step_of_every_stage_stays_there_and_waits_for_nothing(tiny_scene: Scene, name: str) -> None:
    """When a view is looked at again: its picture, priors and pose have reached the device."""
    steps = 40
    with OtherDevice() as device:
        trainer = make_trainer(tiny_scene, RECIPES[name], steps, backend=BACKEND)
        plain = [step for step in range(steps) if not trainer.schedule.at(step).actions]
        stages = {trainer.schedule.at(step).stage.name: step for step in plain}
        assert len(stages) == len(RECIPES[name].stages)
        for step in stages.values():
            for again in (False, True):
                trainer.state.step, before = step, device.waits
                trainer.prepare()
                trainer.optimize()
                assert not again or device.waits == before, step


def test_a_training_stays_there_and_goes_on_from_its_checkpoint(
    tiny_scene: Scene, busy_recipe: Recipe, tmp_path: Path
) -> None:
    """Nothing mixes devices, and a step with nothing due before or after it waits for nothing."""
    densified = busy_recipe.densification.every
    with OtherDevice() as device:
        trainer = make_trainer(tiny_scene, busy_recipe, STEPS, backend=BACKEND)
        counts = [len(trainer.state.gaussians)]
        for step in range(STEPS):
            if step == HALF:
                checkpoint(tmp_path / "half", trainer)
            due = trainer.schedule.at(step).actions or (step + 1) % densified == 0
            before = device.waits
            trainer.step()
            assert due or device.waits == before, step
            counts.append(len(trainer.state.gaussians))
        assert len(set(counts)) > 2
        # Plain Adam counts its steps on the CPU.
        tensors = {n: t for n, t in trainer.state.tensors().items() if not n.endswith((".step", "scalars"))}
        assert {n for n, t in tensors.items() if t.device != THERE} == set()
        whole = checkpoint(tmp_path / "whole", trainer)
        state = load_checkpoint(tmp_path / "half", busy_recipe, THERE)
        resumed = make_trainer(tiny_scene, busy_recipe, STEPS, state, backend=BACKEND)
        run(resumed)
        assert different(whole, checkpoint(tmp_path / "again", resumed)) == []
    state = load_checkpoint(tmp_path / "half", busy_recipe)
    run(make_trainer(tiny_scene, busy_recipe, STEPS, state), until=HALF + 1)


@pytest.mark.parametrize("name", ["3dgs", "polarguide-stokes", "ref-gs"])
def test_what_a_recipe_begins_and_ends_with(tiny_scene: Scene, tmp_path: Path, name: str) -> None:
    """First rows, the side that is outward, and the PLY: as on the CPU."""
    written, outward = [], []
    for backend in (CPU, BACKEND):
        with OtherDevice():
            trainer = make_trainer(tiny_scene, RECIPES[name], STEPS, backend=backend)
            if RECIPES[name].oriented:
                NormalOrientation().act(trainer)
                outward.append(trainer.state.gaussians["outward"].detach().to("cpu"))
            write_run_ply(tmp_path / "run.ply", trainer.state, trainer.current.shading)
        written.append(read_ply(tmp_path / "run.ply"))
    assert bool(outward) == RECIPES[name].oriented
    if outward:
        assert bool(outward[0].any())
        torch.testing.assert_close(*outward, rtol=1e-4, atol=1e-4)
    for field, values in written[0].items():
        torch.testing.assert_close(written[1][field], values, rtol=1e-4, atol=1e-4)


def test_the_other_device_refuses_what_a_gpu_refuses() -> None:
    with OtherDevice() as device:
        there = torch.rand(4, 3).to(THERE)
        for mixture in (
            lambda: there + torch.ones(3),
            lambda: there[torch.tensor([0, 1])],
            lambda: torch.cat((there, torch.ones(1, 3))),
            lambda: torch.rand(3, generator=torch.Generator(), device=THERE),
        ):
            with pytest.raises(RuntimeError, match=r"mixes devices|generator of the CPU"):
                mixture()
        with pytest.raises(RuntimeError, match="numpy"):
            there.numpy()
        assert device.waits == 0
        assert bool((there * torch.tensor(2.0) <= 2).all())
        assert there[there > 2].shape == (0,)
        assert float(there.to("cpu").sum()) > 0
        assert device.waits == 3
