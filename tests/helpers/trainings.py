"""Trainings of small scenes on the CPU, and comparisons of what they leave, bit by bit."""

from pathlib import Path
from typing import Any

from safetensors.torch import load_file
from torch import Tensor

from polarguide.capture import Scene
from polarguide.raster import Backend, choose_backend
from polarguide.runs.folder import resolve
from polarguide.training.feed import ViewStore
from polarguide.training.recipe import Recipe
from polarguide.training.settings import StepReport, TrainSettings
from polarguide.training.state import TrainingState
from polarguide.training.trainer import Trainer

CPU = choose_backend("cpu")


def make_trainer(
    scene: Scene,
    recipe: Recipe,
    steps: int,
    state: TrainingState | None = None,
    *,
    backend: Backend = CPU,
    store: ViewStore | None = None,
    seed: int = 3,
    **settings: Any,
) -> Trainer:
    """A trainer that has not begun, or goes on from a state. ``settings``: further fields of ``TrainSettings``."""
    resolved = resolve(TrainSettings(steps, seed, **settings), scene, recipe)
    return Trainer(scene, recipe, resolved, backend, state, store=store)


def run(trainer: Trainer, until: int | None = None) -> list[StepReport]:
    """Train on; the reports of the steps."""
    reports: list[StepReport] = []
    trainer.run(reports.append, until=until)
    return reports


def trained(
    scene: Scene, recipe: Recipe, steps: int, *, until: int | None = None, **given: Any
) -> dict[str, Tensor]:
    """The state that a training leaves."""
    trainer = make_trainer(scene, recipe, steps, **given)
    run(trainer, until)
    return trainer.state.tensors()


def different(a: dict[str, Tensor] | Path, b: dict[str, Tensor] | Path) -> list[str]:
    """Names of the tensors of two states, or checkpoints, that are not the same bits, or that one of them lacks."""
    a, b = (load_file(side) if isinstance(side, Path) else side for side in (a, b))
    return sorted(name for name in a.keys() | b.keys() if _bits(a, name) != _bits(b, name))


def _bits(tensors: dict[str, Tensor], name: str) -> object:
    if name not in tensors:
        return None
    values = tensors[name].detach()
    return values.dtype, values.shape, values.contiguous().numpy().tobytes()
