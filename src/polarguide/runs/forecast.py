"""Memory and time of a training: planned from headers, estimated from a few steps of each stage, and measured."""

from __future__ import annotations

import contextlib
import math
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median_low

import numpy as np
import torch
from numpy.typing import NDArray

from polarguide.capture import Scene
from polarguide.capture.layout import (
    GIBIBYTE,
    KEPT,
    MASKS,
    READ,
    SHARE,
    find_layout,
    select_views,
    stated_pixels,
)
from polarguide.core.errors import PolarguideError
from polarguide.core.system import (
    MEBIBYTE,
    MemoryBound,
    free_memory,
    machine_busy_seconds,
    peak_memory_mib,
    resident_memory,
)
from polarguide.fields.recipe import NeuralRecipe
from polarguide.raster import Backend
from polarguide.training.angles.polarizers import Polarizers, search_steps
from polarguide.training.feed import coarse_steps
from polarguide.training.flat import Flat
from polarguide.training.recipe import Recipe, Schedule
from polarguide.training.settings import ResolvedSettings
from polarguide.training.trainer import Trainer

GIGABYTE = 10**9
# Estimates by the tensors that there are: one training (24 steps, 1224 x 1024 x 60, 4 GB) took 12 % less than they say.
# benchmarks/speed/memory.py measures.
PROCESS = 250_000_000
"""Bytes that a process takes beside what it holds before training: of libraries, and what the allocator splits."""
STEP = 780
"""Bytes a pixel of a step: targets, G-buffer, layers, terms, and their gradients."""
PRIORS = 900
"""Bytes a pixel while the priors of a view are computed."""
PRIORS_KEPT, SHOWN_KEPT, UNGUIDED_KEPT = 44, 8, 13
"""Bytes a pixel of what is kept of a view: targets, photograph with masks, and what of the targets needs no guide."""
COPIES, WRITTEN = 5, 4
"""Of a Gaussian's parameters: values, gradients, two moments, frozen; and those in the file that is written."""
SPLAT = 600
"""Bytes a Gaussian of what a rasterizer makes of it."""
FILLED = 0.88
"""Of a limit, up to which views are kept in memory; the rest is for gaps between what is used."""
FIELD_COPIES = 5
"""Of what a field learns: values, gradients, two moments, and those in the file that is written."""
SAMPLE, READ_VIEW, TARGET_KEPT = 14_000, 60, 10
"""Bytes a sample of a field's step, a pixel of the view it looks at, and a pixel of what is kept of each view."""


@dataclass(frozen=True)
class MemoryPlan:
    """How a training stays within its memory.

    Attributes:
        hold: whether the pictures stay in memory; otherwise views decode theirs again.
        view_bytes: of what is computed of the views and stays in memory, the rest lies in a file; None: all stays.
        peak: bytes that the process takes at most.
    """

    hold: bool
    view_bytes: int | None
    peak: int


def plan_memory(
    pixels: Sequence[int], recipe: Recipe, gaussians: int, *, limit: float | None, in_memory: bool = False
) -> MemoryPlan:
    """Share out memory among a training's step, its Gaussians and its views.

    Args:
        pixels: pixels of each view as it is trained on. recipe: the method. gaussians: most that there may be.
        limit: GiB that the process may take; None: what is free, but a fifth.
        in_memory: whether the pictures are in memory already.

    Raises:
        PolarguideError: a limit that was given is too small; the message has the least that suffices.
    """
    largest = max(pixels, default=0)
    floats = sum(math.prod(shape) for shape in recipe.shapes.values())
    guided = any(stage.weights.priors for stage in recipe.stages)
    of_view = SHOWN_KEPT + (PRIORS_KEPT + UNGUIDED_KEPT if guided else 0)
    step = (max(STEP, PRIORS) if guided else STEP) * largest + SPLAT * gaussians
    own = PROCESS + 4 * floats * COPIES * gaussians + max(step, 4 * floats * WRITTEN * gaussians)
    what = f" and up to {gaussians:,} Gaussians"
    return _shared(pixels, own, of_view, limit, in_memory, what, "fewer --gaussians, or ")


def plan_field_memory(
    pixels: Sequence[int], recipe: NeuralRecipe, *, limit: float | None, in_memory: bool = False
) -> MemoryPlan:
    """The same for a field: ``plan_memory``."""
    largest = max(pixels, default=0)
    own = PROCESS + 4 * recipe.numbers * FIELD_COPIES + SAMPLE * recipe.sampling.samples + READ_VIEW * largest
    return _shared(pixels, own, TARGET_KEPT, limit, in_memory, "", "")


def _shared(
    pixels: Sequence[int], own: int, of_view: int, limit: float | None, in_memory: bool, what: str, less: str
) -> MemoryPlan:
    """Share out memory: ``own`` is what a training takes beside its views, ``of_view`` a pixel of what it keeps of
    them.

    Raises:
        PolarguideError: a limit that was given is too small; ``what`` it is for beside pictures, ``less`` helps, too.
    """
    largest, total = max(pixels, default=0), sum(pixels)
    now = resident_memory() or 0
    work = now + own
    pictures = 0 if in_memory else (KEPT - MASKS) * total
    masks = 0 if in_memory else (MASKS - 3) * total
    # The photograph of one view, decoded again, and its targets.
    least = work + masks + (KEPT + of_view) * largest
    least = max(least, now + PROCESS + MASKS * total + 4 * READ * largest)
    whole = work + masks + pictures + of_view * total
    if limit is not None:
        allowed = int(limit * GIBIBYTE)
        if allowed < least:
            raise too_little(least, allowed, what, less)
    else:
        free = free_memory()
        if free is None:
            return MemoryPlan(True, None, whole)
        allowed = now + int(SHARE * free)
    if whole <= allowed:
        return MemoryPlan(True, None, whole)
    filled = int(FILLED * allowed)
    hold = in_memory or (
        work + masks + pictures + of_view * largest <= filled and of_view * total <= pictures
    )
    room = filled - work - masks - (pictures if hold and not in_memory else KEPT * largest)
    return MemoryPlan(hold, max(0, room), max(least, min(allowed, whole)))


def pixels_of(folder: Path, downscale: int) -> list[int]:
    """Pixels of each view of a scene at the size that is trained on, as the headers of its files state.

    Raises:
        PolarguideError: the folder is no scene.
    """
    layout = find_layout(folder)
    return [count // downscale**2 for count in stated_pixels(layout, select_views(layout, None))]


def too_little(least: int, allowed: int, what: str, less: str) -> PolarguideError:
    """The error that a limit is too small for pictures and ``what``; ``less`` helps, too."""
    return PolarguideError(
        "memory",
        expected=f"at least {in_gigabytes(least)} for pictures of this size{what}",
        found=in_gigabytes(allowed, up=False),
        remedy=f"Give --memory {in_gigabytes(least).replace(' ', '')}, {less}--downscale 2.",
    )


def in_gigabytes(count: int, *, up: bool = True) -> str:
    """Bytes as gigabytes with one digit, rounded up, so that the stated number suffices."""
    tenths = count * 10 / GIGABYTE
    return f"{(math.ceil(tenths) if up else math.floor(tenths)) / 10:.1f} GB"


# Share of one core that others may use before a time is no longer worth quoting.
FOREIGN_SHARE = 0.10


class Stopwatch:
    """Adds up wall time, and compares the machine's busy time with this process's own.

    Args:
        seconds: time already spent (before a resume). alone: whether that was spent alone.
    """

    def __init__(self, seconds: float = 0.0, alone: bool = True) -> None:
        self._before, self._alone = seconds, alone
        self._pause = 0.0
        self._start = time.perf_counter()
        self._own, self._machine = time.process_time(), machine_busy_seconds()

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Time inside does not count."""
        begin = time.perf_counter()
        yield
        self._pause += time.perf_counter() - begin

    def read(self) -> tuple[float, bool]:
        """Seconds so far, and whether nothing else of weight ran beside."""
        wall = time.perf_counter() - self._start
        machine = machine_busy_seconds()
        alone = self._alone and machine is not None and self._machine is not None
        if alone and machine is not None and self._machine is not None:
            foreign = (machine - self._machine) - (time.process_time() - self._own)
            alone = foreign <= FOREIGN_SHARE * wall + 0.5
        return self._before + wall - self._pause, alone


LEAST_STEPS = 500
"""A shorter training is over before it has been measured."""
GROWTH = 16
"""Of the Gaussians, up to which the time is estimated: the density control decides it on the way."""
# Of 15 trainings of six scenes, 1,000 to 5,000 steps.
SPROUTING, FIRST_ROUND = 5, 0.15
"""Rounds of the density control that add in proportion to their number, later ones add about as many each; and what the
first adds, as a share of the Gaussians: 0.07 to 0.25."""
NOT_FAINT = 0.65
"""Of the Gaussians, those that stay when the density control ends and the faint ones go: 0.43 to 0.81."""


@dataclass(frozen=True)
class Forecast:
    """The expected time of a training.

    Attributes:
        seconds: as long as there are as many Gaussians as at the beginning. most_seconds: with ``most`` of them.
        gaussians: at the beginning. most: see above. limit: most that the density control allows.
        peak: bytes of memory, at most.
        costs: [2, steps] seconds of every step with either number of Gaussians, with priors of views, looks for
            metals, and what ends the density control.
        priors: [steps] bool, which steps compute the priors of a view.
        flat: flat surfaces of the views, which the training need not find again. spent: seconds that they took.
    """

    seconds: float
    most_seconds: float
    gaussians: int
    most: int
    limit: int
    peak: int
    costs: NDArray[np.float64]
    priors: NDArray[np.bool_]
    flat: dict[str, dict[str, Flat]] = field(default_factory=dict)
    spent: float = 0.0

    def sentence(self) -> str:
        """For whoever waits."""
        return (
            f"estimate: {in_words(self.seconds)} with the {self.gaussians:,} Gaussians of the beginning, "
            f"{in_words(self.most_seconds)} with {self.most:,}; up to {in_gigabytes(self.peak)} of memory"
        )

    def truth(self, seconds: float) -> str:
        """The measured time, beside the expected one."""
        peak = peak_memory_mib()
        memory = "" if peak is None else f" and {in_gigabytes(int(peak * MEBIBYTE))} of memory"
        least, most = in_words(self.seconds), in_words(self.most_seconds)
        estimate = least if least == most else f"{least} to {most}"
        return f"took {in_words(seconds)}{memory} (estimate: {estimate}, up to {in_gigabytes(self.peak)})"


def forecast(
    scene: Scene, recipe: Recipe, settings: ResolvedSettings, backend: Backend, peak: int
) -> Forecast | None:
    """Take a few steps of each stage on a state of their own; None for a training that is too short for it.

    Args:
        scene, recipe, settings, backend: those of the training. peak: bytes that it will take.
    """
    if settings.steps < LEAST_STEPS:
        return None
    trainer = Trainer(scene, recipe, replace(settings, begin_again=False), backend, memory=MemoryBound(peak))
    first = len(trainer.state.gaussians)
    most = max(first, min(GROWTH * first, settings.gaussians))
    coarse = coarse_steps(recipe, scene.train_views, settings.steps)
    computed = np.array(_priors_made(recipe, settings, len(scene.train_views), coarse))
    plain, of_view, spent = _measured(trainer, coarse)
    events, costs = _events(trainer, plain), []
    for count in (first, most):
        if count != first:
            _multiply(trainer, count)
            plain, of_view, _ = _measured(trainer, coarse)
        small = np.arange(settings.steps) < coarse
        priors = computed * np.where(small, of_view.get(True, 0.0), of_view.get(False, 0.0))
        costs.append(plain + priors + events * (count / first))
    again = 1 + _search_share(scene, recipe, settings)
    least, greatest = (spent + again * float(each.sum()) for each in costs)
    of_all = np.stack(costs), computed > 0, trainer.flat, spent
    return Forecast(least, greatest, first, most, max(first, settings.gaussians), peak, *of_all)


class TimeLeft:
    """The time that a training still takes: what its steps were expected to cost with as many Gaussians as there will
    be, times how much longer than expected the last ones of their kind took: with priors to compute, or without.

    Args:
        expected: forecast of the training. recipe: its method.
    """

    def __init__(self, expected: Forecast, recipe: Recipe) -> None:
        self.expected, steps = expected, expected.costs.shape[1]
        schedule, every = Schedule(recipe, steps), recipe.densification.every
        grown = [step + 1 for step in range(steps) if schedule.at(step).stage.densify]
        self._rounds = np.array([done for done in grown if done % every == 0], int)
        self._ends = grown[-1] if grown and recipe.densification.faint_pixels else 0
        self._counts: list[tuple[int, int]] = [(0, expected.gaussians)]
        # Single events, such as the search for metals, are no speed: the median of a tenth of the training is, of
        # which every tenth step calls.
        tenth = max(1, steps // 100)
        self._ratios: dict[bool, deque[float]] = {kind: deque(maxlen=tenth) for kind in (False, True)}

    def take(self, done: int, gaussians: int, seconds: float) -> float:
        """The seconds left after so many steps, the last with so many Gaussians; ``seconds``: since the last call."""
        before = self._counts[-1][0]
        self._counts.append((done, gaussians))
        wanted = float(self._costs(np.arange(before, done), np.full(done - before, gaussians)).sum())
        kind = bool(self.expected.priors[before:done].any())
        mine, others = self._ratios[kind], self._ratios[not kind]
        if not mine:  # until more is known, a step of another kind tells how fast the machine is
            mine.append(median_low(others or [1.0]))
        mine.append(seconds / max(wanted, 1e-9))
        steps = np.arange(done, self.expected.costs.shape[1])
        costs = self._costs(steps, self._growing(steps, gaussians))
        same = self.expected.priors[steps] == kind
        alike, unlike = (float(costs[chosen].sum()) for chosen in (same, ~same))
        return median_low(mine) * alike + median_low(others or mine) * unlike

    def _growing(self, steps: NDArray[np.int64], gaussians: int) -> NDArray[np.float64]:
        """How many Gaussians the steps to come will have, by what the last round of the density control added."""
        done = self._counts[-1][0]
        past = int((self._rounds < done).sum())
        counts = np.full(len(steps), float(gaussians))
        if past < len(self._rounds):
            sizes = np.minimum(np.arange(1, len(self._rounds) + 1), SPROUTING)
            added = FIRST_ROUND * gaussians
            if past:
                before = max(count for count in self._counts if count[0] <= self._rounds[past - 1])[1]
                added = max(0, gaussians - before) / sizes[past - 1]
            total = np.append(0.0, np.cumsum(added * sizes[past:]))
            counts += total[np.searchsorted(self._rounds[past:], steps, "right")]
        counts = counts.clip(max=max(gaussians, self.expected.limit))
        return np.where((steps >= self._ends) & (done <= self._ends), NOT_FAINT, 1.0) * counts

    def _costs(self, steps: NDArray[np.int64], gaussians: NDArray[np.float64]) -> NDArray[np.float64]:
        first, most = self.expected.gaussians, self.expected.most
        least, greatest = self.expected.costs[:, steps]
        return np.asarray(least + (greatest - least) * (gaussians - first) / max(1, most - first))


def _search_share(scene: Scene, recipe: Recipe, settings: ResolvedSettings) -> float:
    """The time that the search for unknown angles adds, as a share of the time of all steps."""
    if not settings.begin_again:
        return 0.0
    steps = Polarizers(scene, recipe, settings.steps, search=search_steps(recipe, settings)).search
    camera = scene.train_views[0].camera
    shrunk = math.ceil(max(camera.width, camera.height) / recipe.angle_rules.search_size)
    return steps / settings.steps / shrunk**2


def in_words(seconds: float) -> str:
    """A time as 40 s, 12 min or 1 h 05 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"


def _measured(trainer: Trainer, coarse: int) -> tuple[NDArray[np.float64], dict[bool, float], float]:
    """Seconds of every step with as many Gaussians as now, without priors; seconds of the priors of one view, by
    whether its picture is one of the smaller ones of the first steps; and those of what is found once of all views.
    """
    once = 0.0
    schedule, steps = trainer.schedule, trainer.settings.steps
    stages = [schedule.at(step).stage for step in range(steps)]
    seconds: dict[tuple[bool, bool, object], float] = {}
    priors: dict[bool, float] = {}
    for step in range(1, steps - 1):
        position = schedule.at(step)
        small = step < coarse
        kind = small, position.stage.reflection, position.stage.weights
        if (
            kind in seconds
            or position.actions
            or stages[step + 1] is not position.stage
            or step + 1 == coarse
        ):
            continue
        if (step + 1) % trainer.recipe.densification.every == 0:
            continue
        if not seconds or (position.stage.weights.priors and small not in priors):
            # What is loaded and made once, on another view: this one shall have no priors yet.
            first = _timed(trainer, step + 1)
            once += first if position.stage.weights.priors else 0.0
        fresh, seconds[kind] = _timed(trainer, step), _timed(trainer, step)
        if position.stage.weights.priors:
            priors[small] = max(priors.get(small, 0.0), fresh - seconds[kind])
    kinds = ((step < coarse, stage.reflection, stage.weights) for step, stage in enumerate(stages))
    return np.array([seconds.get(kind, max(seconds.values())) for kind in kinds]), priors, once


def _events(trainer: Trainer, plain: NDArray[np.float64]) -> NDArray[np.float64]:
    """Seconds of looks at all views (``Trainer.looks``), in proportion to the Gaussians; spoils the state."""
    seconds, measured = np.zeros(len(plain)), dict[tuple[bool, ...], float]()
    for step in range(len(plain)):
        kind = trainer.looks(step)
        if any(kind):
            if kind not in measured:
                measured[kind] = max(0.0, _timed(trainer, step) - float(plain[step]))
            seconds[step] = measured[kind]
    return seconds


def _timed(trainer: Trainer, step: int) -> float:
    """Seconds of one step."""
    trainer.state.step = step
    begin = time.perf_counter()
    trainer.step().measured.tolist()  # which waits for the device
    return time.perf_counter() - begin


def _priors_made(recipe: Recipe, settings: ResolvedSettings, views: int, coarse: int) -> list[int]:
    """Of how many views each step computes the priors."""
    schedule, due = Schedule(recipe, settings.steps), views
    counts = [0] * settings.steps
    for step in range(settings.steps):
        position = schedule.at(step)
        if "refresh_priors" in position.actions or step == coarse:
            due = views
        if position.stage.weights.priors:
            counts[step] = min(due, settings.views_per_step)
            due -= counts[step]
    return counts


@torch.no_grad()
def _multiply(trainer: Trainer, count: int) -> None:
    """Put several smaller Gaussians in the place of each, as the density control does, up to ``count``."""
    gaussians = trainer.state.gaussians
    before = len(gaussians)
    gaussians.keep(torch.arange(count, device=gaussians["means"].device) % before)
    gaussians.overwrite("log_scales", gaussians["log_scales"] - 0.5 * math.log(count / before))
    away = torch.randn(count, 3, generator=torch.Generator().manual_seed(0)).to(gaussians["means"].device)
    gaussians.overwrite("means", gaussians["means"] + away * gaussians["log_scales"].exp())
    trainer.state.statistics.clear(count)
