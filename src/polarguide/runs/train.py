"""Training a run: the loop with its log, its checkpoints and a clean stop, and going on with a run."""

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
from polarguide.core.system import MEBIBYTE, MemoryBound, peak_memory_mib, return_freed_memory
from polarguide.raster import Backend, use_threads
from polarguide.recipes import recipe_named
from polarguide.runs.callbacks import Ends, Look, run_to_the_end
from polarguide.runs.folder import (
    CHECKPOINT,
    CONFIGURATION,
    PLY,
    RunConfiguration,
    load_checkpoint,
    most_gaussians,
    resolve,
    save_checkpoint,
    writing_to,
)
from polarguide.runs.health import PolarizationSupport, TrainingEvidence, examine
from polarguide.runs.memory_plan import MemoryPlan, in_gigabytes, pixels_of, plan_memory
from polarguide.runs.model import GaussianModel, write_run_ply
from polarguide.runs.opened import OpenedRun, read_scene, trained_scene
from polarguide.runs.painted import FOLDER, read_painted
from polarguide.runs.reports import report_metals, report_polarizers
from polarguide.runs.stopwatch import in_words
from polarguide.training.angles.fits import gaussian_training
from polarguide.training.angles.polarizers import Polarizers, predicts_filters
from polarguide.training.callback import AnyCallback
from polarguide.training.context import TrainingContext
from polarguide.training.distributed import Ranks, backend_of, process_group
from polarguide.training.loop import TrainingLoop
from polarguide.training.metals.search import MetalSearch, looks, warn_of_unused_materials
from polarguide.training.recipe import Recipe
from polarguide.training.settings import ResolvedSettings, TrainSettings
from polarguide.training.state import TrainingState
from polarguide.training.storage import ViewStore


def train(
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
    """Train a recipe on a scene, into a run folder.

    KeyboardInterrupt (Ctrl-C, or a notebook's stop button) is passed on after the state has been saved; where it comes
    in the middle of a change of the state, the last checkpoint stays.

    Args:
        scene: a scene, or the folder of one, which is read as ``reading`` says.
        out: folder to write: configuration, checkpoints, log, and a PLY at the end.
        recipe: the method, or the name of one.
        settings: steps, seed and what else decides the result; ``resolve`` says what is taken for None.
        session: device, threads, and how often the state is saved.
        resume: go on with the run in ``out``, to the same result.
        reporter: receives progress.
        should_stop: asked between steps.
        watch: gives, for the loop, a context with what is to be called between steps.
        callbacks: further callbacks, see ``training.callback.Callback``; they come after those of the method.

    Raises:
        PolarguideError: wrong input, a folder that does not suit, or a loss that is not finite.
        TrainingStopped: ``should_stop`` returned true; the state is saved.
    """
    out = Path(out)
    use_threads(session.threads)
    chosen = recipe_named(recipe) if isinstance(recipe, str) else recipe
    with process_group(session.device, out) as ranks, ExitStack() as locked:
        leads = ranks.rank == 0
        reporter = reporter if leads else SILENT
        _check_out(out, resume, ranks)
        backend = backend_of(ranks, session.device, reporter)
        earlier = RunConfiguration.load(out).settings if resume else None
        plan = _planned(scene, chosen, settings, earlier, reading)
        whole = scene if isinstance(scene, Scene) else read_scene(scene, reading, reporter, hold=plan.hold)
        loaded = trained_scene(whole, settings)
        check_trainable(loaded)
        if settings.refractive_index is None and not resume and loaded.refractive_index is not None:
            reporter.say(f"refractive index {loaded.refractive_index:g}, as scene.json says")
        resolved = resolve(settings, loaded, chosen, earlier, processes=ranks.world)
        if resolved.views_per_step < ranks.world:
            idle = ranks.world - resolved.views_per_step
            reporter.warn(f"{idle} of {ranks.world} processes have no view to look at")
        if settings.background == "auto" and resolved.background == "black":
            reporter.say("the edges of the pictures are black: nothing is taken to be behind the subject")
        painted = read_painted(out, loaded) if resume else None
        if painted is not None:
            loaded = painted.over(loaded)
        digest = None if painted is None else painted.digest
        configuration = RunConfiguration.of(
            loaded, chosen.name, chosen.data(), resolved, backend.device, digest
        )
        state = None
        if resume:
            if leads:
                locked.enter_context(writing_to(out))
            state = _resumed_state(out, chosen, configuration, reporter, leads=leads)
        return_freed_memory()  # of decoded files
        store = locked.enter_context(closing(view_store(plan, backend, out, reporter)))
        bound = MemoryBound(plan.peak)
        context = TrainingContext(loaded, chosen, resolved, backend, ranks, store, bound, reporter)
        warn_of_unused_materials(context)
        loop, fits = gaussian_training(context, state, callbacks)
        if fits.polarizers.ignored:
            reporter.warn(ignored_filters(chosen.name))
        with watch(loop) if watch is not None else nullcontext() as look:
            ranks.barrier()
            if leads:
                if not resume:
                    locked.enter_context(writing_to(out))
                    if problem := unsuitable_folder(out, resume):  # another training has begun meanwhile
                        raise problem
                configuration.save(out)
            seconds = run_to_the_end(loop, out, session, reporter, should_stop, look, bound)
        model = GaussianModel.of(loop.state, chosen, resolved, backend)
        reporter.say(resources_used(seconds, plan.peak))
        if leads:
            _finish(out, loop, model, fits.polarizers)
    return OpenedRun(out, configuration, chosen, model, scene=whole, reporter=reporter)


def _resumed_state(
    out: Path, recipe: Recipe, configuration: RunConfiguration, reporter: Reporter, *, leads: bool
) -> TrainingState | None:
    """Read the state to resume from; None if the run has no checkpoint.

    Where other materials are painted over the run than it was trained with, the state goes back to the last step that
    decides on metals.
    """
    settings = configuration.settings
    recorded = RunConfiguration.load(out)
    check_same_run(recorded, configuration, out)
    state = None
    if os.path.lexists(out / CHECKPOINT):  # a link to nowhere is no absence
        state = load_checkpoint(out, recipe, torch.device(configuration.device))
        _check_state(state, settings, out)
    else:
        reporter.say(f"{out} has no checkpoint: the training begins at step 0")
    if recorded.painted != configuration.painted:
        _go_back(state, recipe, settings, out, reporter)
        if state is not None and leads:
            save_checkpoint(out, state)  # before run.json records the painted materials
    return state


def _finish(out: Path, loop: TrainingLoop, model: GaussianModel, polarizers: Polarizers) -> None:
    """Write the files of a finished training beside its checkpoint: reports, PLY, and health."""
    context = loop.context
    scene = context.scene
    recipe = context.recipe
    reporter = context.reporter
    noted = NotedWarnings(reporter)
    report_polarizers(out, scene, polarizers, noted)
    report_metals(out, scene, MetalSearch(loop.current).undecided(loop.state), model, noted)
    centers = torch.stack([view.camera.center for view in scene.views])
    write_run_ply(out / PLY, model.state, model.shading, centers)
    views = [polarizers.believed(view) for view in context.views]
    filters = predicts_filters(recipe)
    priors = any(stage.weights.priors for stage in recipe.stages)
    support = PolarizationSupport.of(views, polarizers.judgments(), measured=priors, fitted=filters)
    evidence = TrainingEvidence(views, support, filters=filters)
    health = examine(model, evidence, scene.points, context.settings.steps, reporter)
    for warning in health.warnings:
        reporter.warn(warning)
    health = replace(health, warnings=(*health.warnings, *noted.warnings))
    health.save(out)
    reporter.say(f"{health.summary}; polarization: {health.polarization.text}")


def resources_used(seconds: float, planned: int) -> str:
    """Time and memory that a training took, and the bytes of memory that were planned."""
    peak = peak_memory_mib()
    memory = "" if peak is None else f" and {in_gigabytes(int(peak * MEBIBYTE))} of memory"
    return f"took {in_words(seconds)}{memory} (planned: up to {in_gigabytes(planned)})"


class NotedWarnings(Reporter):
    """Hands messages on to another reporter, and keeps the warnings."""

    def __init__(self, to: Reporter) -> None:
        self._to = to
        self.warnings = list[str]()

    def say(self, text: str) -> None:
        """See ``Reporter``."""
        self._to.say(text)

    def warn(self, text: str) -> None:
        """See ``Reporter``."""
        self.warnings.append(text)
        self._to.warn(text)


def _planned(
    scene: Scene | PathLike,
    recipe: Recipe,
    settings: TrainSettings,
    resumed: ResolvedSettings | None,
    reading: SceneOptions,
) -> MemoryPlan:
    """How the training stays within its memory, as far as headers tell."""
    if isinstance(scene, Scene):
        pixels = [view.camera.width * view.camera.height for view in scene.train_views]
    else:
        pixels = pixels_of(Path(scene), reading.downscale)
    gaussians = most_gaussians(sum(pixels), recipe, settings, resumed)
    return plan_memory(pixels, recipe, gaussians, limit=reading.memory, in_memory=isinstance(scene, Scene))


def view_store(plan: MemoryPlan, backend: Backend, out: Path, reporter: Reporter) -> ViewStore:
    """Where what is computed of the views is kept. What a GPU reads stays on it."""
    if plan.view_bytes is None or backend.device.type != "cpu":
        return ViewStore()
    make_folder(out)
    return ViewStore(plan.view_bytes, out, reporter.warn)


def _check_out(out: Path, resume: bool, ranks: Ranks) -> None:
    """Refuse a folder that does not suit, once for all ranks: rank 0 looks, before it writes there itself."""
    problem = unsuitable_folder(out, resume) if ranks.rank == 0 else None
    if ranks.any(problem is not None):
        raise problem or SystemExit(2)


def unsuitable_folder(out: Path, resume: bool) -> PolarguideError | None:
    try:
        check_out(out)
        refuse_scene(out)
    except PolarguideError as error:
        return error
    if os.path.lexists(out / CONFIGURATION) == resume:
        return None
    expected, found, remedy = (
        ("a run to resume", "no run.json", "Train without --resume, or name the folder of a run.")
        if resume
        else ("a new folder", "a run", "Add --resume (resume=True) to go on with it, or name another folder.")
    )
    return PolarguideError(out, expected=expected, found=found, remedy=remedy)


def check_trainable(scene: Scene) -> None:
    """Refuse a scene that says nothing about space: views from one place alone."""
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
        fault = f"{scene.root}: all points lie behind all cameras: poses and points do not belong together."
        warnings.warn(fault, PolarguideWarning, stacklevel=2)


def check_same_run(old: RunConfiguration, new: RunConfiguration, out: Path) -> None:
    if old.settings != new.settings and replace(old.settings, steps=new.settings.steps) == new.settings:
        raise PolarguideError(
            f"{out}/{CONFIGURATION} (steps)",
            expected=f"{old.settings.steps}, as this training was begun",
            found=str(new.settings.steps),
            remedy="The stages of a training are shares of its steps, so that it cannot be made longer or shorter: "
            f"give --steps {old.settings.steps}, or train with --steps {new.settings.steps} into a new folder.",
        )
    # All but where the scene lies and the device decide the result; what is painted may change.
    for field in sorted(old.__annotations__.keys() - {"scene", "device", "painted"}):
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


def _check_state(state: TrainingState, settings: ResolvedSettings, out: Path) -> None:
    """Refuse a checkpoint that does not belong to the settings of its run."""
    check_step(state.step, settings, out)
    sums = state.statistics.gradient
    views = sums.shape[0] if sums.ndim == 2 else 1
    if views != settings.views_per_step:
        raise PolarguideError(
            out / CHECKPOINT,
            expected=f"the state of a training with {settings.views_per_step} views a step",
            found=f"a training with {views}",
            remedy="Train again into a new folder.",
        )


def check_step(step: int, settings: ResolvedSettings, out: Path) -> None:
    """Check that a checkpoint's step belongs to the training.

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


def _go_back(
    state: TrainingState | None, recipe: Recipe, settings: ResolvedSettings, out: Path, reporter: Reporter
) -> None:
    """Take a run back to the last step that looks for metals, where painted materials still count.

    Args:
        state: state of the training; changed. None: it has not begun.

    Raises:
        PolarguideError: materials mean nothing to the recipe, or to a training this short.
    """
    last = max(looks(recipe, settings), default=None)
    if last is None:
        raise PolarguideError(
            out / FOLDER,
            expected="a training that asks at some step what is metal",
            found=f"one of {recipe.name} in {settings.steps} steps, with --materials {settings.materials}",
            remedy="Remove the folder, or train polarguide-stokes in 1,500 steps or more.",
        )
    if state is not None and state.step > last:
        reporter.say(
            f"{out / FOLDER} has changed: training goes on from step {last}, which decides on metals"
        )
        state.step = last
        state.frozen = None
        state.footprints = None


def ignored_filters(recipe: str) -> str:
    """The warning that a recipe takes single pictures through a filter for photographs."""
    return (
        f"the recipe {recipe} has no term for single pictures through a filter: it takes them for "
        "photographs without one."
    )
