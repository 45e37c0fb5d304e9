"""The loop: walks a recipe's stages over a scene. It knows no method and compares no step with a constant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.capture import Scene, View
from polarguide.gaussians.densify import DensityStatistics, densify
from polarguide.gaussians.free_space import free_space
from polarguide.gaussians.initialise import SH_C0, initial_rows, scene_extent
from polarguide.gaussians.rows import GaussianRows
from polarguide.raster import Backend, ScreenStatistic
from polarguide.shading.display import srgb_decode, srgb_encode
from polarguide.shading.render import COLOUR_CHANNELS, render
from polarguide.training.actions import OPACITY_REST, propagate_normals, reset_opacity
from polarguide.training.losses import step_loss
from polarguide.training.orientation import outward_directions
from polarguide.training.priors import ViewPriors, view_priors
from polarguide.training.stages import Action, Recipe, Schedule, Stage
from polarguide.training.state import Environment, TrainingState


@dataclass(frozen=True)
class TrainSettings:
    """What the user chooses about a training.

    Attributes:
        steps: total number of optimiser steps.
        seed: of every random draw.
        refractive_index: of all surfaces.
    """

    steps: int
    seed: int
    refractive_index: float = 1.5


@dataclass(frozen=True)
class StepReport:
    """What a step tells the progress display."""

    step: int
    stage: str
    loss: float
    psnr: float
    gaussians: int


def _seeded(*numbers: int) -> torch.Generator:
    """A generator that depends on all the numbers: draws do not depend on what was drawn before."""
    value = 0
    for number in numbers:
        value = (value * 1_000_003 + number + 1) % (2**63 - 1)
    return torch.Generator().manual_seed(value)


def first_state(scene: Scene, recipe: Recipe, settings: TrainSettings) -> TrainingState:
    """The state before the first step."""
    colours = srgb_decode(scene.point_colours.float() / 255)
    centres = torch.stack([view.camera.centre for view in scene.train_views])
    tensors = initial_rows(scene.points, colours, centres, recipe.initialisation, seed=settings.seed)
    count = tensors["means"].shape[0]
    environment = None
    if recipe.oriented:
        tensors["outward"] = torch.zeros(count, 3)
    if recipe.directional is not None:
        generator = _seeded(settings.seed, 5)
        tensors.update(recipe.directional.first_rows(tensors["sh_dc"] * SH_C0 + 0.5, generator))
        light = recipe.directional.first_light_values(
            recipe.environment_resolution, recipe.environment_spread, generator
        )
        environment = Environment(light, recipe.environment_rates)
    elif recipe.reflects:
        logit = torch.logit(torch.tensor(recipe.first_strength))
        tensors["strength_logits"] = logit.expand(count).clone()
        if recipe.local:
            tensors["local_dc"] = torch.zeros(count, 3)
            tensors["local_rest"] = torch.zeros(count, 15, 3)
        size = (6, recipe.environment_resolution, recipe.environment_resolution, 3)
        uniform = torch.rand(size, generator=_seeded(settings.seed, 1)) * 2 - 1
        environment = Environment({"texels": uniform * recipe.environment_spread}, recipe.environment_rates)
    rows = GaussianRows(tensors, recipe.rates)
    return TrainingState(0, rows, environment, DensityStatistics(count))


class Trainer:
    """Trains one recipe on one scene, one view a step.

    Args:
        scene: the capture.
        recipe: the method.
        settings: the user's choices.
        backend: device and rasteriser.
        state: where to go on from; None: from the beginning.
    """

    def __init__(
        self,
        scene: Scene,
        recipe: Recipe,
        settings: TrainSettings,
        backend: Backend,
        state: TrainingState | None = None,
    ) -> None:
        self.scene, self.recipe, self.settings, self.backend = scene, recipe, settings, backend
        self.schedule = Schedule(recipe, settings.steps)
        self.state = state or first_state(scene, recipe, settings)
        centres = torch.stack([view.camera.centre for view in scene.train_views])
        self._extent = scene_extent(centres)
        self._middle = centres.mean(dim=0).float()
        pixels = sum(view.camera.width * view.camera.height for view in scene.train_views)
        self._limit = int(pixels / recipe.densification.pixels_each)
        self._empty = free_space(scene.points, [view.camera for view in scene.train_views])
        self._shown: dict[str, Tensor] = {}
        self._priors: dict[str, ViewPriors] = {}

    def run(self, on_step: Callable[[StepReport], None], *, until: int | None = None) -> None:
        """Train until the last step (or ``until``), reporting each step."""
        while self.state.step < (self.settings.steps if until is None else until):
            on_step(self.step())

    def step(self) -> StepReport:
        """One optimiser step on one view."""
        state, recipe = self.state, self.recipe
        position = self.schedule.at(state.step)
        for action in position.actions:
            self._act(action)
        stage = position.stage
        view = self._view_of(state.step)
        statistic = ScreenStatistic(COLOUR_CHANNELS) if stage.densify else None
        result = render(
            state.rows,
            view.camera,
            self.backend.rasterise,
            sh_degree=self.schedule.sh_degree(state.step),
            environment=state.environment.parameters if state.environment and stage.reflection else None,
            shading=recipe.shading(self.settings.refractive_index),
            normals=stage.weights.normals,
            depth=stage.weights.consistency > 0,
            statistic=statistic,
        )
        shown = self._shown_photograph(view)
        valid = None if not bool(view.invalid.any()) else (~view.invalid).float()
        loss, photometric = step_loss(
            result,
            shown,
            valid,
            stage.weights,
            self._priors_of(view, stage),
            ssim_weight=recipe.ssim_weight,
            index=self.settings.refractive_index,
            log_scales=state.rows["log_scales"],
            extent=self._extent,
            camera=view.camera,
        )
        loss.backward()
        if statistic is not None and statistic.gradient is not None:
            state.statistics.add(statistic.gradient, result.radii, view.camera.width, view.camera.height)
        self._optimise()
        psnr = _psnr(result.final, shown)
        report = StepReport(state.step, stage.name, float(photometric.detach()), psnr, len(state.rows))
        state.step += 1
        if stage.densify and state.step % recipe.densification.every == 0:
            densify(
                state.rows,
                state.statistics,
                recipe.densification,
                extent=self._extent,
                middle=self._middle,
                prune_large=state.opacity_was_reset,
                empty=self._empty,
                limit=self._limit,
                generator=_seeded(self.settings.seed, 2, state.step),
            )
        return report

    def _optimise(self) -> None:
        state, rates = self.state, self.recipe.rates
        state.rows.set_rate("means", self.schedule.means_rate(state.step) * self._extent)
        resting = state.step < state.opacity_frozen_until
        state.rows.set_rate("opacity_logits", 0.0 if resting else rates["opacity_logits"])
        state.rows.step()
        if state.environment is not None:
            state.environment.step()

    def _act(self, action: Action) -> None:
        if action == "reset_opacity":
            reset_opacity(self.state)
        elif action == "propagate_normals":
            generator = _seeded(self.settings.seed, 3, self.state.step)
            rest = min(OPACITY_REST, self.settings.steps // 50)
            propagate_normals(self.state, self.recipe.propagation, generator, rest)
        elif action == "orient_normals":
            rows, rasterise = self.state.rows, self.backend.rasterise
            rows.overwrite("outward", outward_directions(rows, self.scene.train_views, rasterise))
        else:
            self.state.frozen = self.state.rows.snapshot()
            self._priors.clear()

    def _view_of(self, step: int) -> View:
        """Every epoch visits every training view once, in an order of its own."""
        views = self.scene.train_views
        epoch, place = divmod(step, len(views))
        order = torch.randperm(len(views), generator=_seeded(self.settings.seed, 4, epoch))
        return views[int(order[place])]

    def _shown_photograph(self, view: View) -> Tensor:
        if view.name not in self._shown:
            self._shown[view.name] = srgb_encode(view.photograph().clamp(0, 1))
        return self._shown[view.name]

    def _priors_of(self, view: View, stage: Stage) -> ViewPriors | None:
        if not stage.weights.priors:
            return None
        if view.name not in self._priors:
            if self.state.frozen is None:
                self._act("refresh_priors")
            assert self.state.frozen is not None
            with torch.no_grad():
                guide = render(self.state.frozen, view.camera, self.backend.rasterise, sh_degree=0).normal
            assert guide is not None
            self._priors[view.name] = view_priors(
                view, guide, self.recipe.priors, self.settings.refractive_index
            )
        return self._priors[view.name]


@torch.no_grad()
def _psnr(final: Tensor, shown: Tensor) -> float:
    error = (srgb_encode(final.clamp(0, 1)) - shown).square().mean()
    return float(-10 * torch.log10(error.clamp(min=1e-10)))
