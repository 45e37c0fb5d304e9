"""Callbacks that belong to the method of training Gaussians, and functions that change Gaussians for them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from polarguide.capture import View
from polarguide.core.errors import require
from polarguide.gaussians.densify import DensityStatistics, densify, free_space
from polarguide.geometry.camera import Camera, seen_at
from polarguide.geometry.vectors import unit
from polarguide.raster import Rasterize
from polarguide.raster.magnification import footprints
from polarguide.shading.gbuffer import RenderRequest, render, splats
from polarguide.shading.model import Parameters, ShadingModel
from polarguide.training.callback import AnyCallback, Callback
from polarguide.training.context import TrainingState, seeded
from polarguide.training.loop import TrainingLoop
from polarguide.training.metals.observations import index_offsets
from polarguide.training.metals.search import MetalSearch
from polarguide.training.recipe import Position, Propagation
from polarguide.training.settings import StepReport
from polarguide.training.targets import Step


def _logit(value: float) -> float:
    return float(torch.logit(torch.tensor(value, dtype=torch.float64)))


@torch.no_grad()
def reset_opacity(state: TrainingState, shading: ShadingModel, most: float) -> None:
    """Lower opacities to at most ``most`` (Kerbl et al. 2023).

    Useful Gaussians become opaque again, and unneeded Gaussians stay transparent. Parameters of the shading model with
    a ``reset_minimum`` are raised to it.
    """
    gaussians = state.gaussians
    gaussians.overwrite("opacity_logits", gaussians["opacity_logits"].clamp(max=_logit(most)))
    for name, parameter in shading.parameters.items():
        if parameter.reset_minimum is not None:
            gaussians.overwrite(name, gaussians[name].clamp(min=parameter.reset_minimum))


@torch.no_grad()
def propagate_normals(
    state: TrainingState,
    shading: ShadingModel,
    settings: Propagation,
    generator: torch.Generator,
    steps: int,
) -> None:
    """Spread Gaussians with a correct normal over their neighborhood (Ye et al. 2024, Sec. 3.3).

    All opacities are raised. Matte Gaussians get noise on their color, which hides reflections that they reproduce by
    their color alone. Glossy Gaussians grow along their surface.
    """
    gaussians = state.gaussians
    strengths = [row for row in shading.surface if row.name == "strength"]
    require(
        strengths,
        "recipe",
        expected="a shading model with a reflection strength",
        found=type(shading).__name__,
        remedy='Remove the action "propagate_normals" from the recipe, or add a surface property "strength".',
    )
    strength = strengths[0].values(gaussians)
    gaussians.overwrite("opacity_logits", gaussians["opacity_logits"].clamp(min=_logit(settings.opacity)))
    # The noise is drawn on the CPU, so that it is the same on every device.
    noise = (torch.rand(gaussians["sh_dc"].shape, generator=generator) * 2 - 1) * settings.color_noise
    noise = noise.to(gaussians["sh_dc"].device)
    matte = (strength <= settings.matte)[:, None]
    # As in the release, the noise is added to the SH coefficient itself.
    gaussians.overwrite("sh_dc", gaussians["sh_dc"] + torch.where(matte, noise, torch.zeros_like(noise)))
    scales = gaussians["log_scales"]
    longer = torch.ones_like(scales).scatter(1, scales.argmin(dim=1, keepdim=True), 0.0)
    grow = (strength >= settings.glossy)[:, None] * longer * torch.log(torch.tensor(settings.widen))
    gaussians.overwrite("log_scales", scales + grow)
    state.opacity_frozen_until = state.step + min(settings.rest, steps // settings.rest_part)


DEPTH_SLACK = 0.02
"""Largest distance by which a visible Gaussian may lie behind the rendered depth, as a share of this depth."""
LEAST_PIXELS = 0.05
"""Least sum of the blending weights with which a Gaussian counts as contributing to a picture."""
DEPTH_ALONE = RenderRequest(sh_degree=0, normals=False, depth=True)


@torch.no_grad()
def outward_directions(gaussians: Parameters, views: Iterable[View], rasterize: Rasterize) -> Tensor:
    """Sum, for each Gaussian, the unit directions to all cameras that see it.

    A camera sees a Gaussian if its center is inside the picture and not behind the rendered depth.

    Args:
        gaussians: the Gaussians.
        views: views with the cameras.
        rasterize: rasterizer of the backend.

    Returns:
        Sums [N, 3], zero for Gaussians that no camera sees.
    """
    means = gaussians["means"]
    total = torch.zeros_like(means)
    for view in views:
        camera = view.camera
        depth = render(gaussians, camera, rasterize, DEPTH_ALONE).depth
        center = camera.pose(means.dtype, means.device).center
        pixel, z, inside = seen_at(means - center, camera)
        visible = inside & (z < depth[pixel] * (1 + DEPTH_SLACK))
        total += visible[:, None] * unit(center - means)
    return total


class PixelCounts(NamedTuple):
    """Number of pixels to which each Gaussian contributes in training pictures.

    Attributes:
        views: [N] float32, number of pictures in which the sum of its blending weights is at least ``LEAST_PIXELS``.
        most: [N] largest sum of its blending weights in any picture. An opaque Gaussian that covers one pixel has 1.
    """

    views: Tensor
    most: Tensor


def touched_pixels(gaussians: Parameters, cameras: Iterable[Camera], rasterize: Rasterize) -> PixelCounts:
    """Count the pixels to which each Gaussian contributes.

    Args:
        gaussians: the Gaussians.
        cameras: cameras of the pictures.
        rasterize: rasterizer of the backend.
    """
    splatted = splats(gaussians)
    views = torch.zeros(len(splatted.means), device=splatted.means.device)
    most = torch.zeros_like(views)
    for camera in cameras:
        # The gradient of the summed weights with respect to a feature is the sum of its Gaussian's weights.
        with torch.enable_grad():
            features = torch.ones_like(splatted.features).requires_grad_()
            fixed = type(splatted)(*(tensor.detach() for tensor in splatted))
            total = rasterize(fixed._replace(features=features), camera).features.sum()
            pixels = torch.autograd.grad(total, features)[0][:, 0]
        views += (pixels >= LEAST_PIXELS).float()
        most = torch.maximum(most, pixels)
    return PixelCounts(views, most)


class OpacityReset(Callback[TrainingLoop]):
    """Callback that resets the opacities to a small value."""

    action = "reset_opacity"

    def act(self, loop: TrainingLoop) -> None:
        context = loop.current
        reset_opacity(loop.state, context.shading, context.recipe.densification.reset_opacity)


class NormalPropagation(Callback[TrainingLoop]):
    """Callback that spreads Gaussians with a correct normal over their neighborhood."""

    action = "propagate_normals"

    def before_step(self, loop: TrainingLoop, position: Position) -> None:
        self._hold_opacities(loop)

    def act(self, loop: TrainingLoop) -> None:
        context = loop.current
        generator = seeded(context.settings.seed, 3, loop.state.step)
        steps = context.settings.steps
        propagate_normals(loop.state, context.shading, context.recipe.propagation, generator, steps)
        self._hold_opacities(loop)

    def _hold_opacities(self, loop: TrainingLoop) -> None:
        if loop.state.step < loop.state.opacity_frozen_until:
            loop.rates["opacity_logits"] = 0.0


class NormalOrientation(Callback[TrainingLoop]):
    """Callback that determines the side from which training views see each Gaussian."""

    action = "orient_normals"

    def act(self, loop: TrainingLoop) -> None:
        context = loop.current
        gaussians = loop.state.gaussians
        views = context.memory.between(context.views)
        outward = outward_directions(gaussians, views, context.backend.rasterize)
        gaussians.overwrite("outward", outward)


class Metals(Callback[TrainingLoop]):
    """Callback that searches for metals when the priors are refreshed."""

    action = "refresh_priors"

    def begin(self, loop: TrainingLoop) -> None:
        self._search = MetalSearch(loop.current)

    def act(self, loop: TrainingLoop) -> None:
        if self._search.is_due(loop.state.step):
            loop.feed.refresh_priors()  # the search needs their memory
            self._search.look(loop.state)


class IndexOffsets(Callback[TrainingLoop]):
    """Callback that assigns to Gaussians the refractive indices that the user specified for materials."""

    action = "refresh_priors"

    def act(self, loop: TrainingLoop) -> None:
        context = loop.current
        indices = context.scene.indices
        if not indices or "index_offset" not in context.shading.parameters:
            return
        loop.feed.refresh_priors()
        gaussians = loop.state.gaussians
        offsets = index_offsets(
            gaussians,
            context.views,
            indices,
            context.settings.refractive_index,
            context.backend.rasterize,
            context.memory,
        )
        gaussians.overwrite("index_offset", offsets)


class PriorRefresh(Callback[TrainingLoop]):
    """Callback that has the priors of all views recomputed.

    The normals of a copy of the Gaussians, the guide, resolve the ambiguities of polarization in these priors.
    """

    action = "refresh_priors"
    name = "prior_refresh"
    prefix = "frozen."

    def begin(self, loop: TrainingLoop) -> None:
        self._guide = dict[str, Tensor]()

    def before_step(self, loop: TrainingLoop, position: Position) -> None:
        """Request a refresh if the step needs priors and there was no refresh before."""
        loop.feed.guide = self._guide
        if self._guide or not position.stage.weights.priors or self.action in position.actions:
            return
        if loop.feed.view_at(loop.state.step).is_determined:
            loop.position = replace(position, actions=(*position.actions, self.action))

    def act(self, loop: TrainingLoop) -> None:
        self._guide = loop.state.gaussians.snapshot()
        loop.feed.refresh_priors()
        loop.feed.guide = self._guide

    def state_dict(self) -> dict[str, Tensor]:
        return self._guide

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        self._guide = dict(tensors)


class DensityControl(Callback[TrainingLoop]):
    """Callback that adds and removes Gaussians in stages with density control."""

    prefix = "statistics."
    name = "density_control"

    def begin(self, loop: TrainingLoop) -> None:
        context = loop.current
        device = context.backend.device
        density = context.recipe.densification
        cameras = [view.camera for view in context.views]
        self._middle = context.centers.mean(dim=0).float().to(device)
        empty = free_space(context.scene.points, cameras, density.free_share, density.free_quantile)
        self._empty = empty.to(device)
        means = loop.state.gaussians["means"]
        self._statistics = DensityStatistics(len(means), means.device)

    def after_backward(self, loop: TrainingLoop, step: Step) -> None:
        if step.statistic is None or step.statistic.gradient is None:
            return
        loop.whole = False
        camera = step.targets.camera
        radii = step.result.training["radii"]
        self._statistics.add(step.statistic.gradient, radii, camera.width, camera.height)

    def after_step(self, loop: TrainingLoop, report: StepReport) -> None:
        if not loop.position.stage.densify:
            return
        context = loop.current
        settings = context.settings
        density = context.recipe.densification
        state = loop.state
        if state.step % density.every == 0:
            densify(
                state.gaussians,
                self._statistics,
                density,
                extent=context.extent,
                middle=self._middle,
                prune_large=density.prunes_large(state.step, settings.steps),
                empty=self._empty,
                limit=settings.gaussians,
                generator=seeded(settings.seed, 2, state.step),
            )
        if state.step >= settings.steps or not loop.schedule.at(state.step).stage.densify:
            self._prune_untouched(loop)

    def state_dict(self) -> dict[str, Tensor]:
        return {"gradient": self._statistics.gradient, "seen": self._statistics.seen}

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        self._statistics.gradient = tensors["gradient"]
        self._statistics.seen = tensors["seen"]

    def _prune_untouched(self, loop: TrainingLoop) -> None:
        """Remove Gaussians that contribute too little to the training views.

        If the scene has no background, Gaussians that only few training views show are removed, because they appear as
        fog in new views. Gaussians that are fainter in all training views than the recipe's limit are also removed.
        """
        context = loop.current
        density = context.recipe.densification
        gaussians = loop.state.gaussians
        if not (context.black or density.faint_pixels):
            return
        cameras = context.memory.between(view.camera for view in context.views)
        touched = touched_pixels(gaussians, cameras, context.backend.rasterize)
        keep = touched.most >= density.faint_pixels
        if context.black:
            enough = len(context.views) >= density.enough_views
            keep &= touched.views >= (2 if enough else 1)
        if bool(keep.any()):
            gaussians.keep(keep)
            self._statistics.clear(len(gaussians))


class Footprints(Callback[TrainingLoop]):
    """Callback that computes the size of a training pixel at each Gaussian after the last step."""

    def at_end(self, loop: TrainingLoop) -> None:
        cameras = (view.camera for view in loop.current.views)
        loop.state.footprints = footprints(loop.state.gaussians["means"].detach(), cameras)


def method_callbacks() -> list[AnyCallback]:
    """Return the callbacks of a training of Gaussians, in the order in which they run."""
    return [
        OpacityReset(),
        NormalPropagation(),
        NormalOrientation(),
        Metals(),
        IndexOffsets(),
        PriorRefresh(),
        DensityControl(),
        Footprints(),
    ]
