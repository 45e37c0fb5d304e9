"""Training a run: the loop with its log, its checkpoints and a clean stop, and going on with a run."""

from __future__ import annotations

import json
import math
import os
import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext
from dataclasses import replace
from pathlib import Path

import torch

from polarguide.capture import Scene
from polarguide.capture.layout import refuse_scene
from polarguide.capture.variants import mask_background, select_exposures
from polarguide.core.errors import PolarguideError, PolarguideWarning
from polarguide.core.files import check_out, make_folder
from polarguide.core.options import PathLike, SceneOptions, SessionOptions
from polarguide.core.progress import SILENT, Advance, Reporter
from polarguide.core.records import first_difference
from polarguide.core.system import MEBIBYTE, MemoryBound, peak_memory_mib, return_freed_memory
from polarguide.raster import Backend, use_threads
from polarguide.recipes import recipe_named
from polarguide.runs.families import AnyTrainer, Family, family_of
from polarguide.runs.folder import (
    CHECKPOINT,
    CONFIGURATION,
    RunConfiguration,
    RunLog,
    load_checkpoint,
    most_gaussians,
    resolve,
    save_checkpoint,
    writing_to,
)
from polarguide.runs.health import examine
from polarguide.runs.memory_plan import MemoryPlan, in_gigabytes, pixels_of
from polarguide.runs.opened import OpenedRun, read_scene
from polarguide.runs.painted import read_painted
from polarguide.runs.stopwatch import Stopwatch, in_words
from polarguide.training.distributed import Ranks, backend_of, process_group
from polarguide.training.feed import ViewStore
from polarguide.training.losses import refuse_diverged
from polarguide.training.recipe import Method
from polarguide.training.settings import ResolvedSettings, StepReport, TrainSettings

LOG_EVERY = 10
Ends = Callable[[], bool]
"""Whether training should end."""
Look = Callable[[Ends], None]
"""Lets others look between two steps; asks what it is given whether training should end."""


class TrainingStopped(KeyboardInterrupt):
    """Training was asked to stop; its state is saved.

    Attributes:
        step: how many steps were done.
    """

    def __init__(self, step: int) -> None:
        super().__init__(f"stopped after step {step}")
        self.step = step


def train(
    scene: Scene | PathLike,
    out: PathLike,
    *,
    recipe: Method | str = "polarguide-stokes",
    settings: TrainSettings = TrainSettings(),
    session: SessionOptions = SessionOptions(),
    reading: SceneOptions = SceneOptions(),
    resume: bool = False,
    reporter: Reporter = SILENT,
    should_stop: Ends = lambda: False,
    watch: Callable[[AnyTrainer], AbstractContextManager[Look]] | None = None,
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
        watch: gives, for the trainer, a context with what is to be called between steps.

    Raises:
        PolarguideError: wrong input, a folder that does not suit, or a loss that is not finite.
        TrainingStopped: ``should_stop`` returned true; the state is saved.
    """
    out = Path(out)
    use_threads(session.threads)
    chosen = recipe_named(recipe) if isinstance(recipe, str) else recipe
    family = family_of(chosen)
    with process_group(session.device, out) as ranks, ExitStack() as locked:
        leads = ranks.rank == 0
        reporter = reporter if leads else SILENT
        _check_out(out, resume, ranks)
        backend = backend_of(ranks, session.device, reporter)
        earlier = RunConfiguration.load(out).settings if resume else None
        plan = _planned(family, scene, chosen, settings, earlier, reading)
        whole = scene if isinstance(scene, Scene) else read_scene(scene, reading, reporter, hold=plan.hold)
        loaded = select_exposures(whole, settings.exposures)
        if settings.background == "masked":
            loaded = mask_background(loaded)
        _check_scene(loaded)
        if settings.refractive_index is None and not resume and loaded.refractive_index is not None:
            reporter.say(f"refractive index {loaded.refractive_index:g}, as scene.json says")
        resolved = resolve(settings, loaded, chosen, earlier, processes=ranks.world)
        if resolved.views_per_step < ranks.world:
            idle = ranks.world - resolved.views_per_step
            reporter.warn(f"{idle} of {ranks.world} processes have no view to look at")
        if settings.background == "auto" and resolved.background == "black" and leads:
            reporter.say("the edges of the pictures are black: nothing is taken to be behind the subject")
        painted = read_painted(out, loaded) if resume else None
        if painted is not None:
            loaded = painted.over(loaded)
        digest = None if painted is None else painted.digest
        configuration = RunConfiguration.of(loaded, chosen, resolved, backend.device, digest)
        state = None
        if resume:
            if leads:
                locked.enter_context(writing_to(out))
            recorded = RunConfiguration.load(out)
            _check_same(recorded, configuration, out)
            if os.path.lexists(out / CHECKPOINT):  # a link to nowhere is no absence
                state = load_checkpoint(out, chosen, backend.device)
                family.check(state, resolved, out)
            else:
                reporter.say(f"{out} has no checkpoint: the training begins at step 0")
            if recorded.painted != digest:
                family.go_back(state, chosen, resolved, out, reporter)
                if state is not None and leads:
                    save_checkpoint(out, state)  # before run.json says that what was painted is in it
        return_freed_memory()  # of decoded files
        store = locked.enter_context(closing(_store(plan, backend, out, reporter)))
        bound = MemoryBound(plan.peak)
        trainer = family.trainer(loaded, chosen, resolved, backend, state, ranks, store, reporter, bound)
        with watch(trainer) if watch is not None else nullcontext() as look:
            ranks.barrier()
            if leads:
                if not resume:
                    locked.enter_context(writing_to(out))
                    if problem := _unsuitable(out, resume):  # another training has begun meanwhile
                        raise problem
                configuration.save(out)
            seconds = _Loop(trainer, out, session, reporter, should_stop, look, bound).run()
        model = family.model(trainer.state, chosen, resolved, backend)
        reporter.say(_taken(seconds, plan.peak))
        if leads:
            finished = _Warned(reporter)
            family.finish(out, trainer, model, finished)
            evidence = family.evidence(trainer, chosen)
            health = examine(model, evidence, loaded.points, resolved.steps, reporter)
            for warning in health.warnings:
                reporter.warn(warning)
            health = replace(health, warnings=(*health.warnings, *finished.warnings))
            health.save(out)
            reporter.say(f"{health.summary}; polarization: {health.polarization.text}")
    return OpenedRun(out, configuration, chosen, model, scene=whole, reporter=reporter)


def _taken(seconds: float, planned: int) -> str:
    """Time and memory that a training took, and the bytes of memory that were planned."""
    peak = peak_memory_mib()
    memory = "" if peak is None else f" and {in_gigabytes(int(peak * MEBIBYTE))} of memory"
    return f"took {in_words(seconds)}{memory} (planned: up to {in_gigabytes(planned)})"


class _Warned(Reporter):
    """Hands messages on to another reporter, and keeps the warnings."""

    def __init__(self, to: Reporter) -> None:
        self.say, self.track = to.say, to.track  # type: ignore[method-assign]
        self._to, self.warnings = to, list[str]()

    def warn(self, text: str) -> None:
        """See ``Reporter``."""
        self.warnings.append(text)
        self._to.warn(text)


class _Loop:
    """Trains to the end with progress, checkpoints and a log. Rank 0 alone writes."""

    def __init__(
        self,
        trainer: AnyTrainer,
        out: Path,
        session: SessionOptions,
        reporter: Reporter,
        should_stop: Ends,
        look: Look | None,
        memory: MemoryBound,
    ) -> None:
        self._trainer, self._out, self._session, self._memory = trainer, out, session, memory
        self._reporter, self._should_stop, self._look = reporter, should_stop, look
        self._log = RunLog(out) if trainer.ranks.rank == 0 else None
        if self._log is not None:
            self._log.cut(trainer.state.step)
        seconds, alone = self._log.elapsed() if self._log else (0.0, True)
        self._stopwatch = Stopwatch(seconds, alone)

    def run(self) -> float:
        """Train; see ``train``. Returns the seconds that it took."""
        trainer = self._trainer
        with self._reporter.track("training", trainer.total) as advance:
            meter = _Meter(advance, self._log, self._stopwatch)
            advance(trainer.done, seconds=self._stopwatch.read()[0])
            try:
                stopped = self._steps(meter)
            except KeyboardInterrupt:
                if trainer.ranks.world == 1 and trainer.whole:
                    self._save()
                raise
            meter.read()
        self._save()
        if stopped:
            raise TrainingStopped(trainer.state.step)
        return self._stopwatch.read()[0]

    def _steps(self, meter: _Meter) -> bool:
        """Steps up to the last one; True where training is to stop before."""
        trainer, ranks = self._trainer, self._trainer.ranks
        while trainer.state.step < trainer.settings.steps:
            # Several ranks stop after the same step, so they have to ask each other, which takes time.
            if (ranks.world == 1 or trainer.state.step % LOG_EVERY == 0) and ranks.any(self._should_stop()):
                return True
            meter.take(trainer.step())
            self._memory.keep()
            if trainer.state.step % self._session.checkpoint_every == 0:
                with self._stopwatch.paused():
                    meter.read()
                    self._save()
            if self._look is not None:
                with self._stopwatch.paused():
                    self._look(self._should_stop)
        return False

    def _save(self) -> None:
        """A checkpoint of what all ranks have seen, by rank 0."""
        self._trainer.exchange_statistics()
        if self._trainer.ranks.rank == 0:
            state = self._trainer.state
            goes_on = state.step < self._trainer.settings.steps
            save_checkpoint(self._out, state, optimizer=goes_on or self._session.keep_optimizer)


class _Meter:
    """Smooths what the steps report, hands it on, and writes every tenth into the log.

    Reports are looked at ten at a time: on a GPU, looking waits for it.
    """

    def __init__(self, advance: Advance, log: RunLog | None, stopwatch: Stopwatch) -> None:
        self._advance, self._log, self._stopwatch = advance, log, stopwatch
        self._loss = self._psnr = math.nan
        self._began, self._first = stopwatch.read()[0], -1
        self._waiting: list[StepReport] = []

    def take(self, report: StepReport) -> None:
        """Take one step's report."""
        if self._first < 0:
            self._first = report.done - 1
        elif report.step == 0 and self._log is not None:
            self._log.cut(0)  # it has begun again
        self._waiting.append(report)
        if (report.step + 1) % LOG_EVERY == 0:
            loss, psnr = self.read()
            if self._log is None:
                return
            seconds, alone = self._stopwatch.read()
            self._log.append(
                step=report.step,
                stage=report.stage,
                loss=round(loss, 6),
                psnr=round(psnr, 3),
                gaussians=report.gaussians,
                seconds=round(seconds, 3),
                alone=alone,
            )

    def read(self) -> tuple[float, float]:
        """Look at the reports that wait; loss and PSNR of the last.

        Raises:
            PolarguideError: a loss that is not finite.
        """
        if not self._waiting:
            return math.nan, math.nan
        last = self._waiting[-1]
        measured = torch.stack([report.measured for report in self._waiting]).cpu()
        self._waiting.clear()
        refuse_diverged(measured[:, 2])
        for loss, psnr, _ in measured.tolist():
            keep = 0.0 if math.isnan(self._loss) else 0.98
            self._loss = loss if keep == 0 else keep * self._loss + (1 - keep) * loss
            self._psnr = psnr if keep == 0 else keep * self._psnr + (1 - keep) * psnr
        seconds, _ = self._stopwatch.read()
        rate = (last.done - self._first) / max(1e-9, seconds - self._began)
        count = "" if last.gaussians is None else f"{last.gaussians:,} Gaussians  "
        note = f"{last.stage}  loss {self._loss:.4f}  PSNR {self._psnr:.2f} dB  {count}{rate:.1f} it/s"
        self._advance(last.done, note=note, seconds=seconds)
        return loss, psnr


def _planned(
    family: Family,
    scene: Scene | PathLike,
    recipe: Method,
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
    return family.plan(pixels, recipe, gaussians, reading.memory, in_memory=isinstance(scene, Scene))


def expected_memory(
    pixels: Sequence[int], recipe: Method, settings: TrainSettings, reading: SceneOptions
) -> int:
    """Bytes that the process of a training takes at most, as far as headers tell.

    Args:
        pixels: of each view, as ``memory_plan.pixels_of`` reads them. recipe, settings, reading: of the training.

    Raises:
        PolarguideError: the limit in ``reading`` is too small.
    """
    gaussians = most_gaussians(sum(pixels), recipe, settings, None)
    return family_of(recipe).plan(pixels, recipe, gaussians, reading.memory, in_memory=False).peak


def _store(plan: MemoryPlan, backend: Backend, out: Path, reporter: Reporter) -> ViewStore:
    """Where what is computed of the views is kept. What a GPU reads stays on it."""
    if plan.view_bytes is None or backend.device.type != "cpu":
        return ViewStore()
    make_folder(out)
    return ViewStore(plan.view_bytes, out, reporter.warn)


def _check_out(out: Path, resume: bool, ranks: Ranks) -> None:
    """Refuse a folder that does not suit, once for all ranks: rank 0 looks, before it writes there itself."""
    problem = _unsuitable(out, resume) if ranks.rank == 0 else None
    if ranks.any(problem is not None):
        raise problem or SystemExit(2)


def _unsuitable(out: Path, resume: bool) -> PolarguideError | None:
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


def _check_scene(scene: Scene) -> None:
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


def _check_same(old: RunConfiguration, new: RunConfiguration, out: Path) -> None:
    if old.settings.background == "auto":  # as the first versions recorded it
        old = replace(old, settings=replace(old.settings, background=new.settings.background))
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
        a, b = getattr(old, field), getattr(new, field)
        if a != b and a is not None:
            name, a, b = first_difference(field, a, b)
            raise PolarguideError(
                f"{out}/{CONFIGURATION} ({name})",
                expected="none recorded" if a is None else json.dumps(a, default=str)[:120],
                found="none" if b is None else json.dumps(b, default=str)[:120],
                remedy="Resume with the same scene, options and program version, or train into a new folder.",
            )
