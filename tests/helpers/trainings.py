"""Trainings of small scenes on the CPU, and comparisons of what they leave, bit by bit."""

from pathlib import Path
from typing import Any

from safetensors.torch import load_file
from torch import Tensor

from polarguide.capture import Scene
from polarguide.raster import Backend, choose_backend
from polarguide.runs.folder import resolve
from polarguide.training.angles.polarizers import AngleFits, gaussian_training
from polarguide.training.callback import Callback, Loop
from polarguide.training.context import TrainingContext, TrainingState
from polarguide.training.loop import TrainingLoop
from polarguide.training.recipe import Recipe
from polarguide.training.settings import StepReport, TrainSettings
from polarguide.training.storage import ViewStore

CPU = choose_backend("cpu")


def context_of(
    scene: Scene, recipe: Recipe, settings: TrainSettings, backend: Backend = CPU, **services: Any
) -> TrainingContext:
    """The context of a training. ``services``: further fields of it."""
    return TrainingContext(scene, recipe, resolve(settings, scene, recipe), backend, **services)


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
) -> TrainingLoop:
    """A training that has not begun, or resumes from a state. ``settings``: further fields of ``TrainSettings``."""
    specified = TrainSettings(steps, seed, **settings)
    context = context_of(scene, recipe, specified, backend, store=store or ViewStore())
    return gaussian_training(context, state)[0]


class Reports(Callback[Loop]):
    """Keeps the reports of all steps."""

    def __init__(self) -> None:
        self.reports: list[StepReport] = []

    def after_step(self, loop: Loop, report: StepReport) -> None:
        self.reports.append(report)


def run(trainer: Loop, until: int | None = None) -> list[StepReport]:
    """Train on; the reports of the steps."""
    kept = Reports()
    trainer.observers.append(kept)
    trainer.run(until)
    trainer.observers.remove(kept)
    return kept.reports


def fits_of(trainer: TrainingLoop) -> AngleFits:
    """The fits of polarizer angles of a training."""
    return next(callback for callback in trainer.callbacks if isinstance(callback, AngleFits))


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
