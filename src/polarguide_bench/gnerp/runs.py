"""Runs of a field: training, resuming and opening.

Such runs cannot be viewed, exported or shared. The memory of a training is planned from the headers of the scene's
files.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from polarguide.capture import Scene
from polarguide.core.errors import require
from polarguide.core.options import DeviceName, PathLike, SceneOptions, SessionOptions, index_of
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.system import return_freed_memory
from polarguide.geometry.camera import Camera
from polarguide.raster import choose_backend, use_threads
from polarguide.results.rendering.mesh import RESOLUTION, Surface
from polarguide.runs.callbacks import Ends, run_to_the_end
from polarguide.runs.folder import CHECKPOINT, RunConfiguration, checkpoint_tensors, writing_to
from polarguide.runs.memory_plan import PROCESS, MemoryPlan, pixels_of, share_memory
from polarguide.runs.opened import read_scene, trained_scene
from polarguide.runs.train import (
    check_run_folder,
    check_same_run,
    check_step,
    check_trainable,
    ignored_filters,
    view_store,
)
from polarguide.training.settings import ResolvedSettings, TrainSettings
from polarguide_bench.gnerp.loop import FieldLoop
from polarguide_bench.gnerp.model import FieldModel, implicit_surface
from polarguide_bench.gnerp.recipe import NeuralRecipe
from polarguide_bench.gnerp.state import FieldState

FIELD_COPIES = 5
"""Number of copies of a field's parameters in memory: values, gradients, two moments, and the checkpoint."""
SAMPLE = 14_000
"""Memory of one sample in a training step, in bytes."""
READ_VIEW = 60
"""Memory of one pixel of the view that a step reads, in bytes."""
TARGET_BYTES = 10
"""Memory of one pixel in the cache of targets, in bytes."""


def plan_field_memory(
    pixels: Sequence[int], recipe: NeuralRecipe, *, limit: float | None, in_memory: bool = False
) -> MemoryPlan:
    """Divide memory between the training steps of a field and the cache of its views.

    Args:
        pixels: number of training pixels of each view.
        recipe: the recipe.
        limit: memory limit of the process in GiB. None uses four fifths of the free memory.
        in_memory: True if the pictures are already in memory.

    Raises:
        PolarguideError: the limit is too small.
    """
    largest = max(pixels, default=0)
    own = PROCESS + 4 * recipe.numbers * FIELD_COPIES + SAMPLE * recipe.sampling.samples + READ_VIEW * largest
    return share_memory(pixels, own, TARGET_BYTES, limit, in_memory, "", "")


@dataclass(frozen=True, eq=False)
class FieldRun:
    """Trained run of a field, with the interface that scores and reports need.

    Attributes:
        folder: run folder.
        configuration: recorded configuration of the run.
        recipe: recipe of the training.
        model: the trained field.
    """

    folder: Path
    configuration: RunConfiguration
    recipe: NeuralRecipe
    model: FieldModel

    @property
    def steps(self) -> int:
        """Number of trained steps."""
        return self.model.steps

    @cached_property
    def scene(self) -> Scene:
        """Scene of the training, read on first use.

        Raises:
            PolarguideError: the scene cannot be read.
        """
        configuration = self.configuration
        reading = SceneOptions(configuration.downscale, configuration.transfer, split="every-8th")
        whole = read_scene(configuration.scene, reading, SILENT, configuration.test_views)
        return trained_scene(whole, configuration.settings)

    @property
    def cameras(self) -> dict[str, Camera]:
        """Cameras of the scene's views by name."""
        return {view.name: view.camera for view in self.scene.views}

    def undecided(self, camera: Camera) -> Tensor | None:
        """Return None, because a field has no metals."""

    def surface(self) -> Surface:
        """Extract the surface, which is the zero set of the signed distance, for scores of the mesh.

        Raises:
            PolarguideError: there is no surface.
        """
        return implicit_surface(self.cameras, self.model, resolution=RESOLUTION)


def train_field(
    scene: PathLike,
    out: PathLike,
    *,
    recipe: NeuralRecipe,
    settings: TrainSettings,
    session: SessionOptions = SessionOptions(),
    reading: SceneOptions = SceneOptions(),
    resume: bool = False,
    reporter: Reporter = SILENT,
    should_stop: Ends = lambda: False,
) -> FieldRun:
    """Train a field on a scene, and write a run folder.

    Args:
        scene: scene folder.
        out: run folder.
        recipe: the recipe.
        settings: steps, seed and other settings of the training.
        session: device, threads and interval of checkpoints.
        reading: options for reading the scene.
        resume: resume the run in ``out``. The result is the same as without the interruption.
        reporter: receives progress.
        should_stop: function that is called between steps and returns True to stop.

    Raises:
        PolarguideError: the input is invalid, the folder is not suitable, or a loss is not finite.
        TrainingStopped: ``should_stop`` returned True. The state is saved.
    """
    out = Path(out)
    use_threads(session.threads)
    check_run_folder(out, resume)
    backend = choose_backend(session.device, say=reporter.say)
    plan = plan_field_memory(pixels_of(Path(scene), reading.downscale), recipe, limit=reading.memory)
    earlier = RunConfiguration.load(out) if resume else None
    whole = read_scene(scene, reading, reporter, hold=plan.hold)
    resolved = resolve_field(settings, whole, recipe, None if earlier is None else earlier.settings)
    loaded = trained_scene(whole, resolved)
    check_trainable(loaded)
    configuration = RunConfiguration.of(loaded, recipe.name, recipe.data(), resolved, backend.device)
    if not all(view.is_determined for view in loaded.train_views):
        reporter.warn(ignored_filters(recipe.name))
    return_freed_memory()
    with writing_to(out), closing(view_store(plan, backend, out, reporter)) as store:
        state = None
        if earlier is not None:
            check_same_run(earlier, configuration, out)
            if os.path.lexists(out / CHECKPOINT):
                state = load_field(out, recipe, backend.device)
                check_step(state.step, resolved, out)
            else:
                reporter.say(f"{out} has no checkpoint: the training begins at step 0")
        loop = FieldLoop(loaded, recipe, resolved, backend.device, state, store)
        configuration.save(out)
        run_to_the_end(loop, out, session, reporter, should_stop, None, plan.peak)
    return FieldRun(out, configuration, recipe, FieldModel(loop.state, recipe, backend.device))


def open_field(folder: PathLike, recipe: NeuralRecipe, *, device: DeviceName = "auto") -> FieldRun:
    """Open the run of a field.

    Raises:
        PolarguideError: the folder is not a run, is damaged, or belongs to another recipe.
    """
    folder = Path(folder)
    configuration = RunConfiguration.load(folder)
    backend = choose_backend(device)
    model = FieldModel(load_field(folder, recipe, backend.device), recipe, backend.device)
    return FieldRun(folder, configuration, recipe, model)


def load_field(folder: Path, recipe: NeuralRecipe, device: torch.device | str = "cpu") -> FieldState:
    """Read the state of a field's training from its checkpoint.

    Raises:
        PolarguideError: the checkpoint is missing or damaged.
    """
    with checkpoint_tensors(folder) as tensors:
        return FieldState.from_tensors(tensors, recipe, device)


def resolve_field(
    settings: TrainSettings,
    scene: Scene,
    recipe: NeuralRecipe,
    resumed: ResolvedSettings | None = None,
) -> ResolvedSettings:
    """Choose all settings of a field's training that are not specified.

    Args:
        settings: specified settings.
        scene: the scene.
        recipe: the recipe.
        resumed: settings of the run that is resumed, if any. They have priority over the settings of the scene.

    Raises:
        PolarguideError: a field does not support a setting.
    """
    recorded: dict[str, Any] = {} if resumed is None else vars(resumed)
    values: dict[str, Any] = {
        **vars(settings),
        "steps": recipe.steps,
        "refractive_index": index_of(None, scene.refractive_index),
        "gaussians": 0,
        **{name: recorded[name] for name in ("steps", "refractive_index") if name in recorded},
        **settings.specified(),
    }
    if values["background"] == "auto":
        values["background"] = "scene"
    require(
        values["gaussians"] == 0,
        "gaussians",
        expected=f"0 with the recipe {recipe.name}, a field",
        found=str(values["gaussians"]),
        remedy="Omit this option.",
    )
    return ResolvedSettings(**values)
