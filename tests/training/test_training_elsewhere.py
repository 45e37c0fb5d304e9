"""Training on a device that is not the CPU, with values: the density control, resets, refreshes and checkpoints."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from other_device import BACKEND, THERE, OtherDevice
from safetensors.torch import load_file
from torch import Tensor

from polarguide.capture import Scene
from polarguide.gaussians.ply import read_ply
from polarguide.raster import choose_backend
from polarguide.recipes import RECIPES
from polarguide.runs.defaults import resolve
from polarguide.runs.folder import CHECKPOINT, load_checkpoint, save_checkpoint
from polarguide.runs.model import write_run_ply
from polarguide.training.recipe import Recipe
from polarguide.training.settings import TrainSettings
from polarguide.training.trainer import Trainer

STEPS = TrainSettings(30, 3)
HALF = 13


@pytest.fixture(autouse=True)
def plain_adam(monkeypatch: pytest.MonkeyPatch) -> None:
    """torch's fused Adam knows its devices by name; where the moments lie is the same without it."""
    adam = torch.optim.Adam
    monkeypatch.setattr(torch.optim, "Adam", lambda groups, eps, fused: adam(groups, eps=eps, foreach=True))


def checkpoint(folder: Path, trainer: Trainer) -> dict[str, Tensor]:
    folder.mkdir(exist_ok=True)
    save_checkpoint(folder, trainer.state)
    return load_file(folder / CHECKPOINT)


def test_a_training_stays_there_and_goes_on_from_its_checkpoint(
    tiny_scene: Scene, busy_recipe: Recipe, tmp_path: Path
) -> None:
    """Nothing mixes devices, and a step with nothing due before or after it waits for nothing."""
    densified = busy_recipe.densification.every
    with OtherDevice() as device:
        trainer = Trainer(tiny_scene, busy_recipe, resolve(STEPS, tiny_scene, busy_recipe), BACKEND)
        counts = [len(trainer.state.gaussians)]
        for step in range(STEPS.steps):
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
        again = Trainer(tiny_scene, busy_recipe, resolve(STEPS, tiny_scene, busy_recipe), BACKEND, state)
        again.run(lambda _: None)
        resumed = checkpoint(tmp_path / "again", again)
    assert {name for name in whole if not torch.equal(whole[name], resumed[name])} == set()
    state = load_checkpoint(tmp_path / "half", busy_recipe)
    Trainer(
        tiny_scene, busy_recipe, resolve(STEPS, tiny_scene, busy_recipe), choose_backend("cpu"), state
    ).run(lambda _: None, until=HALF + 1)


@pytest.mark.parametrize("name", ["3dgs", "polarguide-stokes", "ref-gs"])
def test_what_a_recipe_begins_and_ends_with(tiny_scene: Scene, tmp_path: Path, name: str) -> None:
    """First rows, the side that is outward, and the PLY: as on the CPU."""
    written, outward = {}, {}
    for backend in (choose_backend("cpu"), BACKEND):
        here = backend.device.type == "cpu"
        with OtherDevice():
            trainer = Trainer(tiny_scene, RECIPES[name], resolve(STEPS, tiny_scene, RECIPES[name]), backend)
            if RECIPES[name].oriented:
                trainer._act("orient_normals")
                outward[here] = trainer.state.gaussians["outward"].detach().to("cpu")
            path = tmp_path / f"{here}.ply"
            write_run_ply(path, trainer.state, trainer.shading)
            written[here] = read_ply(path)
    assert bool(outward) == RECIPES[name].oriented
    if outward:
        assert bool(outward[True].any())
        torch.testing.assert_close(outward[False], outward[True], rtol=1e-4, atol=1e-4)
    for field, values in written[True].items():
        torch.testing.assert_close(written[False][field], values, rtol=1e-4, atol=1e-4)


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
