"""Training into a run folder, with a log, checkpoints and a clean stop, and resuming of a run."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext
from dataclasses import replace
from pathlib import Path

import torch

from polarguide.capture import Scene
from polarguide.capture.layout import refuse_scene
from polarguide.core.errors import PolarguideError, PolarguideWarning
from polarguide.core.files import check_out, make_folder
from polarguide.core.options import PathLike, SceneOptions, SessionOptions
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.records import first_differing_value
from polarguide.core.system import MemoryBound, return_freed_memory
from polarguide.methods import recipe_named
from polarguide.raster import Backend, choose_backend, use_threads
from polarguide.runs.callbacks import Ends, Look, run_to_the_end
from polarguide.runs.folder import (
    CHECKPOINT,
    CONFIGURATION,
    RunConfiguration,
    load_checkpoint,
    most_gaussians,
    resolve,
    writing_to,
)
from polarguide.runs.health import (
    HealthCheck,
    MetalReport,
    PlyFile,
    PolarizerReport,
    RecordedWarnings,
    held_out_score,
)
from polarguide.runs.memory_plan import MemoryPlan, pixels_of, plan_memory
from polarguide.runs.model import GaussianModel
from polarguide.runs.opened import OpenedRun, read_scene, trained_scene
from polarguide.training.angles.polarizers import gaussian_training
from polarguide.training.callback import AnyCallback
from polarguide.training.context import TrainingContext, TrainingState
from polarguide.training.loop import TrainingLoop
from polarguide.training.metals.search import warn_of_unused_materials
from polarguide.training.recipe import Recipe
from polarguide.training.settings import ResolvedSettings, TrainSettings
from polarguide.training.storage import ViewStore


def train_gaussians(
    scene: Scene | PathLike,
    out: PathLike,
    *,
    recipe: Recipe | str = "polarguide-stokes",
    settings: TrainSettings = TrainSettings(),
    session: SessionOptions = SessionOptions(),
    reading: SceneOptions = SceneOptions(),
    resume: bool = False,
    reporter: Reporter = SILENT,
    should_stop: Ends = lambda: False,
    watch: Callable[[TrainingLoop], AbstractContextManager[Look]] | None = None,
    callbacks: Sequence[AnyCallback] = (),
) -> OpenedRun:
    """Train a recipe on a scene, and write the result to a run folder.

    KeyboardInterrupt (Ctrl-C, or the stop button of a notebook) is raised again after the state has been saved. If it
    interrupts a change of the state, the previous checkpoint remains.

    Args:
        scene: a scene, or its folder, which is read with the options ``reading``.
        out: folder for the configuration, checkpoints, the log, reports, and a PLY at the end.
        recipe: the method, or its name.
        settings: steps, seed and other settings of the training; ``resolve`` completes them.
        session: device, threads, and number of steps between two checkpoints.
        resume: True to continue the run in ``out``. The result is the same as without the interruption.
        reporter: receives progress.
        should_stop: function that is called between steps and returns True to end the training.
        watch: function that returns a context manager for the loop. The context yields a function that is called
            between steps.
        callbacks: additional callbacks, see ``training.callback.Callback``. They run after the callbacks of the method.

    Raises:
        PolarguideError: the input is invalid, the folder is unsuitable, or a loss is not finite.
        TrainingStopped: ``should_stop`` returned True. The state has been saved.
    """
    out = Path(out)
    use_threads(session.threads)
    method = recipe_named(recipe) if isinstance(recipe, str) else recipe
    with ExitStack() as stack:
        check_run_folder(out, resume)
        backend = choose_backend(session.device, say=reporter.say)
        earlier = RunConfiguration.load(out).settings if resume else None
        plan = _planned(scene, method, settings, earlier, reading)
        original = scene if isinstance(scene, Scene) else read_scene(scene, reading, reporter, hold=plan.hold)
        loaded = trained_scene(original, settings)
        check_trainable(loaded)
        resolved = resolve(settings, loaded, method, earlier)
        _report_settings(settings, resolved, loaded, reporter, resume=resume)
        configuration = RunConfiguration.of(loaded, method.name, method.data(), resolved, backend.device)
        state = None
        if resume:
            stack.enter_context(writing_to(out))
            state = _resumed_state(out, method, configuration, reporter)
        return_freed_memory()  # of decoding
        store = stack.enter_context(closing(view_store(plan, backend, out, reporter)))
        bound = MemoryBound(plan.peak)
        context = TrainingContext(loaded, method, resolved, backend, store, bound, reporter)
        warn_of_unused_materials(context)
        loop, fits = gaussian_training(context, state, callbacks)
        if fits.polarizers.ignored:
            reporter.warn(ignored_filters(method.name))
        with watch(loop) if watch is not None else nullcontext() as look:
            if not resume:
                stack.enter_context(writing_to(out))
                check_run_folder(out, resume)  # another training may have begun in the meantime
            configuration.save(out)
            recorded = RecordedWarnings(reporter)
            loop.observers += [
                PolarizerReport(out, fits, recorded),
                MetalReport(out, recorded),
                PlyFile(out),
                HealthCheck(out, fits, recorded),
            ]
            run_to_the_end(loop, out, session, reporter, should_stop, look, plan.peak, held_out_score(loop))
        model = GaussianModel(loop.state, context.shading, backend)
    return OpenedRun(out, configuration, method, model, scene=original, reporter=reporter)


def _report_settings(
    settings: TrainSettings,
    resolved: ResolvedSettings,
    scene: Scene,
    reporter: Reporter,
    *,
    resume: bool,
) -> None:
    """Report settings that depend on the scene."""
    if settings.refractive_index is None and not resume and scene.refractive_index is not None:
        reporter.say(f"refractive index {scene.refractive_index:g} from scene.json")
    if settings.background == "auto" and resolved.background == "black":
        reporter.say("the edges of the pictures are black: the training has no background behind the subject")


def _resumed_state(
    out: Path, recipe: Recipe, configuration: RunConfiguration, reporter: Reporter
) -> TrainingState | None:
    """Read the state to resume from. Return None if the run has no checkpoint."""
    check_same_run(RunConfiguration.load(out), configuration, out)
    state = None
    if os.path.lexists(out / CHECKPOINT):  # a broken link is an error, not a missing file
        state = load_checkpoint(out, recipe, torch.device(configuration.device))
        check_step(state.step, configuration.settings, out)
    else:
        reporter.say(f"{out} has no checkpoint: the training begins at step 0")
    return state


def _planned(
    scene: Scene | PathLike,
    recipe: Recipe,
    settings: TrainSettings,
    resumed: ResolvedSettings | None,
    reading: SceneOptions,
) -> MemoryPlan:
    """Plan the memory of the training from the headers of its files."""
    if isinstance(scene, Scene):
        pixels = [view.camera.width * view.camera.height for view in scene.train_views]
    else:
        pixels = pixels_of(Path(scene), reading.downscale)
    gaussians = most_gaussians(sum(pixels), recipe, settings, resumed)
    return plan_memory(pixels, recipe, gaussians, limit=reading.memory, in_memory=isinstance(scene, Scene))


def view_store(plan: MemoryPlan, backend: Backend, out: Path, reporter: Reporter) -> ViewStore:
    """Create the cache of per-view data. On a GPU, all data stay on the device."""
    if plan.view_bytes is None or backend.device.type != "cpu":
        return ViewStore()
    make_folder(out)
    return ViewStore(plan.view_bytes, out, reporter.warn)


def check_run_folder(out: Path, resume: bool) -> None:
    """Check a run folder. A new training needs a new folder, and resuming needs a folder with a run.

    Raises:
        PolarguideError: the folder is unsuitable.
    """
    check_out(out)
    refuse_scene(out)
    if os.path.lexists(out / CONFIGURATION) == resume:
        return
    expected, actual, remedy = (
        ("a run to resume", "no run.json", "Train without --resume, or name the folder of a run.")
        if resume
        else ("a new folder", "a run", "Add --resume (resume=True) to continue it, or name another folder.")
    )
    raise PolarguideError(out, expected=expected, found=actual, remedy=remedy)


def check_trainable(scene: Scene) -> None:
    """Check that the training views were taken from at least two places, and warn if no camera faces a point.

    Raises:
        PolarguideError: all training views were taken from one place.
    """
    centers = torch.stack([view.camera.center for view in scene.train_views])
    if float((centers - centers[0]).norm(dim=1).max()) <= 1e-9 * max(1.0, float(centers.abs().max())):
        raise PolarguideError(
            scene.root,
            expected="training views from at least two places",
            found=f"{len(centers)} from one place",
            remedy="Add views, or correct the poses.",
        )
    cameras = [view.camera for view in scene.train_views]
    ahead = (scene.points.double() @ c.rotation[2] + c.translation[2] > 0 for c in cameras)
    if len(scene.points) and not any(bool(each.any()) for each in ahead):
        fault = f"{scene.root}: all points are behind all cameras: poses and points do not match."
        warnings.warn(fault, PolarguideWarning, stacklevel=2)


def check_same_run(old: RunConfiguration, new: RunConfiguration, out: Path) -> None:
    """Check that a run is resumed with the scene, recipe and settings with which it was started.

    Raises:
        PolarguideError: a value differs.
    """
    if old.settings != new.settings and replace(old.settings, steps=new.settings.steps) == new.settings:
        raise PolarguideError(
            f"{out}/{CONFIGURATION} (steps)",
            expected=f"{old.settings.steps}, the number with which this training began",
            found=str(new.settings.steps),
            remedy=f"Use --steps {old.settings.steps}, or train with --steps {new.settings.steps} into a new folder: "
            "stages are shares of all steps, so that their number is fixed.",
        )
    # The place of the scene and the device do not change the result.
    for field in sorted(old.__annotations__.keys() - {"scene", "device"}):
        a = getattr(old, field)
        b = getattr(new, field)
        if a != b and a is not None:
            name, a, b = first_differing_value(field, a, b)
            raise PolarguideError(
                f"{out}/{CONFIGURATION} ({name})",
                expected="none recorded" if a is None else json.dumps(a, default=str)[:120],
                found="none" if b is None else json.dumps(b, default=str)[:120],
                remedy="Resume with the same scene, options and program version, or train into a new folder.",
            )


def check_step(step: int, settings: ResolvedSettings, out: Path) -> None:
    """Check that the step of a checkpoint is not beyond the last step of the training.

    Raises:
        PolarguideError: the step is beyond the last one.
    """
    if step > settings.steps:
        raise PolarguideError(
            out / CHECKPOINT,
            expected=f"the state of a training of {settings.steps} steps",
            found=f"the state after step {step}",
            remedy="Train again into a new folder.",
        )


def ignored_filters(recipe: str) -> str:
    """Return the warning for a recipe that treats pictures through a filter as photographs without a filter."""
    return (
        f"the recipe {recipe} has no term for single pictures through a filter and treats them as photographs "
        "without a filter."
    )
