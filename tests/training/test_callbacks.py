"""Callbacks of a user: the example, its state in a checkpoint, and names that nobody knows."""

import importlib.util
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from faults import Fault
from torch import Tensor
from trainings import different

import polarguide
from polarguide.capture import Scene
from polarguide.core.options import SessionOptions
from polarguide.methods import RECIPES
from polarguide.runs.callbacks import TrainingStopped
from polarguide.runs.folder import CHECKPOINT
from polarguide.runs.train import train_gaussians
from polarguide.training.callback import Callback
from polarguide.training.recipe import Repeat

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "05_train_with_a_callback.py"
SETTINGS = polarguide.TrainSettings(30, 3)
SESSION = SessionOptions(device="cpu", threads=1, keep_optimizer=True)


@pytest.fixture(scope="module")
def example() -> ModuleType:
    specification = importlib.util.spec_from_file_location("example", EXAMPLE)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def trained(scene: Scene, out: Path, *callbacks: Any, **more: Any) -> Path:
    given = {"recipe": "3dgs", "settings": SETTINGS, "session": SESSION, "callbacks": callbacks}
    train_gaussians(scene, out, **{**given, **more})
    return out / CHECKPOINT


def test_the_example_caps_opacities_and_resumes_to_the_same_bits(
    tiny_scene: Scene, tmp_path: Path, example: ModuleType
) -> None:
    whole = example.OpacityCap(0.05, 7)
    checkpoint = trained(tiny_scene, tmp_path / "whole", whole)
    assert whole.capped > 0

    answers = iter([*[False] * 17, True])
    with pytest.raises(TrainingStopped):
        trained(
            tiny_scene, tmp_path / "parts", example.OpacityCap(0.05, 7), should_stop=lambda: next(answers)
        )
    Fault("training", expected="callback", found="opacity_cap").raised_by(
        trained, tiny_scene, tmp_path / "parts", resume=True
    )
    resumed = example.OpacityCap(0.05, 7)
    again = trained(tiny_scene, tmp_path / "parts", resumed, resume=True)
    assert resumed.capped == whole.capped
    assert different(checkpoint, again) == []
    assert "callback.opacity_cap.capped" in polarguide.open_run(tmp_path / "whole").model.state.extra


class Recorder(Callback[Any]):
    """Notes what it is called for."""

    action = "note"

    def __init__(self) -> None:
        self.calls: list[tuple[str, int]] = []

    def begin(self, loop: Any) -> None:
        self.calls.append(("begin", loop.state.step))

    def before_step(self, loop: Any, position: Any) -> None:
        self.calls.append(("before", loop.state.step))

    def act(self, loop: Any) -> None:
        self.calls.append(("act", loop.state.step))

    def after_step(self, loop: Any, report: Any) -> None:
        self.calls.append(("after", loop.state.step))

    def at_end(self, loop: Any) -> None:
        self.calls.append(("end", loop.state.step))


def test_a_recipe_names_the_action_of_a_callback(tiny_scene: Scene, tmp_path: Path) -> None:
    plain = RECIPES["3dgs"]
    note = Repeat("note", fraction=0.25)
    stages = tuple(replace(stage, repeats=(note,), on_enter=()) for stage in plain.stages)
    noting = replace(plain, stages=stages)
    recorder = Recorder()
    short = polarguide.TrainSettings(4)
    trained(tiny_scene, tmp_path / "run", recorder, recipe=noting, settings=short)
    acts = [step for name, step in recorder.calls if name == "act"]
    assert acts == [1, 3]
    assert [call for call in recorder.calls if call[0] != "act"] == [
        ("begin", 0),
        *(call for step in range(4) for call in (("before", step), ("after", step + 1))),
        ("end", 4),
    ]
    for step in acts:
        at = recorder.calls.index(("act", step))
        assert recorder.calls[at - 1] == ("before", step)

    Fault("training", expected="reset_opacity", found="note").raised_by(
        trained, tiny_scene, tmp_path / "other", recipe=noting, settings=short
    )


class Nameless(Callback[Any]):
    """Has a state, but no name for it."""

    def state_dict(self) -> dict[str, Tensor]:
        return {"count": torch.zeros(())}


class Named(Nameless):
    """Has a name, which a second one would share."""

    name = "named"


@pytest.mark.parametrize(("callbacks", "found"), [([Nameless()], "''"), ([Named(), Named()], "'named'")])
def test_a_state_needs_a_name_of_its_own(
    tiny_scene: Scene, tmp_path: Path, callbacks: list[Callback[Any]], found: str
) -> None:
    Fault("training", expected="a name of its own", found=found).raised_by(
        trained, tiny_scene, tmp_path / "run", *callbacks
    )
