"""What a training will take, measured in a few steps of each of its stages, and what it took in the end."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import torch

from polarguide.angles.polarizers import Polarizers, search_steps
from polarguide.capture import Scene
from polarguide.raster import Backend
from polarguide.runs.memory import in_gigabytes
from polarguide.system import MEBIBYTE, peak_memory_mib
from polarguide.training.feed import coarse_steps
from polarguide.training.recipe import Recipe
from polarguide.training.schedule import Schedule
from polarguide.training.settings import ResolvedSettings
from polarguide.training.trainer import Trainer

LEAST_STEPS = 500
"""A shorter training is over before it has been measured."""
GROWTH = 16
"""Of the Gaussians, up to which the time is estimated: the density control decides it on the way."""


@dataclass(frozen=True)
class Forecast:
    """What a training is expected to take.

    Attributes:
        seconds: as long as there are as many Gaussians as at the beginning. most_seconds: with ``most`` of them.
        gaussians: at the beginning. most: see above.
        peak: bytes of memory, at most.
    """

    seconds: float
    most_seconds: float
    gaussians: int
    most: int
    peak: int

    def sentence(self) -> str:
        """For whoever waits."""
        return (
            f"estimate: {in_words(self.seconds)} with the {self.gaussians:,} Gaussians of the beginning, "
            f"{in_words(self.most_seconds)} with {self.most:,}; up to {in_gigabytes(self.peak)} of memory"
        )

    def truth(self, seconds: float) -> str:
        """What it took, beside what was expected."""
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
        scene, recipe, settings, backend: of the training. peak: bytes that it will take.
    """
    if settings.steps < LEAST_STEPS:
        return None
    trainer = Trainer(scene, recipe, replace(settings, begin_again=False), backend)
    first = len(trainer.state.gaussians)
    most = max(first, min(GROWTH * first, settings.gaussians))
    coarse = coarse_steps(recipe, scene.train_views, settings.steps)
    seconds, of_view = _measured(trainer, coarse)
    made = _priors_made(recipe, settings, len(scene.train_views), coarse)
    priors = sum(count * of_view.get(size, 0.0) for size, count in made.items())
    again = 1 + _search_share(scene, recipe, settings)
    least = greatest = again * (seconds + priors)
    if most != first:
        _multiply(trainer, most)
        greatest = again * (_measured(trainer, coarse)[0] + priors)
    return Forecast(least, greatest, first, most, peak)


def _search_share(scene: Scene, recipe: Recipe, settings: ResolvedSettings) -> float:
    """What the search for unknown angles adds, over the time of all steps: as many as there are pixels."""
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


def _measured(trainer: Trainer, coarse: int) -> tuple[float, dict[bool, float]]:
    """Seconds of all steps with as many Gaussians as now, without priors, and seconds of the priors of one view, by
    whether its picture is one of the smaller ones of the first steps.
    """
    schedule, steps = trainer.schedule, trainer.settings.steps
    stages = [schedule.at(step).stage for step in range(steps)]
    found: dict[tuple[bool, bool, object], float] = {}
    priors: dict[bool, float] = {}
    for step in range(1, steps - 1):
        position = schedule.at(step)
        small = step < coarse
        kind = small, position.stage.reflection, position.stage.weights
        if kind in found or position.actions or stages[step + 1] is not position.stage or step + 1 == coarse:
            continue
        if (step + 1) % trainer.recipe.densification.every == 0:
            continue
        if not found or (position.stage.weights.priors and small not in priors):
            # What is loaded and made once, on another view: this one shall have no priors yet.
            _timed(trainer, step + 1)
        fresh, found[kind] = _timed(trainer, step), _timed(trainer, step)
        if position.stage.weights.priors:
            priors[small] = max(priors.get(small, 0.0), fresh - found[kind])
    kinds = ((step < coarse, stage.reflection, stage.weights) for step, stage in enumerate(stages))
    return sum(found.get(kind, max(found.values())) for kind in kinds), priors


def _timed(trainer: Trainer, step: int) -> float:
    """Seconds of one step."""
    trainer.state.step = step
    begin = time.perf_counter()
    trainer.step().measured.tolist()  # which waits for the device
    return time.perf_counter() - begin


def _priors_made(recipe: Recipe, settings: ResolvedSettings, views: int, coarse: int) -> dict[bool, int]:
    """How many times priors of a view are computed, by whether its picture is one of the smaller ones."""
    schedule, due = Schedule(recipe, settings.steps), views
    made = {True: 0, False: 0}
    for step in range(settings.steps):
        position = schedule.at(step)
        if "refresh_priors" in position.actions or step == coarse:
            due = views
        if position.stage.weights.priors:
            made[step < coarse] += min(due, settings.views_per_step)
            due -= min(due, settings.views_per_step)
    return made


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
