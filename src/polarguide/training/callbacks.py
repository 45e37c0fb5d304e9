"""The callbacks of the training of Gaussians that belong to a method."""

from __future__ import annotations

from polarguide.gaussians.densify import densify, free_space
from polarguide.raster.magnification import footprints
from polarguide.training.actions import (
    exchange_statistics,
    outward_directions,
    propagate_normals,
    reset_opacity,
    touched_pixels,
)
from polarguide.training.callback import AnyCallback, Callback
from polarguide.training.loop import TrainingLoop
from polarguide.training.metals.observations import index_offsets
from polarguide.training.metals.search import MetalSearch
from polarguide.training.settings import StepReport
from polarguide.training.state import seeded


class OpacityReset(Callback[TrainingLoop]):
    """Lowers opacities."""

    action = "reset_opacity"

    def act(self, loop: TrainingLoop) -> None:
        context = loop.current
        reset_opacity(loop.state, context.shading, context.recipe.densification.reset_opacity)


class NormalPropagation(Callback[TrainingLoop]):
    """Lets Gaussians with a right normal take over their neighborhood."""

    action = "propagate_normals"

    def act(self, loop: TrainingLoop) -> None:
        context = loop.current
        generator = seeded(context.settings.seed, 3, loop.state.step)
        steps = context.settings.steps
        propagate_normals(loop.state, context.shading, context.recipe.propagation, generator, steps)


class NormalOrientation(Callback[TrainingLoop]):
    """Finds the side from which the training views see each Gaussian."""

    action = "orient_normals"

    def act(self, loop: TrainingLoop) -> None:
        context = loop.current
        gaussians = loop.state.gaussians
        outward = outward_directions(
            gaussians, context.memory.between(context.views), context.backend.rasterize
        )
        loop.ranks.broadcast(outward)
        gaussians.overwrite("outward", outward)


class Metals(Callback[TrainingLoop]):
    """Finds metals at the refreshes of the priors."""

    action = "refresh_priors"

    def begin(self, loop: TrainingLoop) -> None:
        self._search = MetalSearch(loop.current)

    def act(self, loop: TrainingLoop) -> None:
        if self._search.is_due(loop.state.step):
            loop.feed.refresh_priors()  # their memory is needed for looks at all views
            self._search.look(loop.state)


class IndexOffsets(Callback[TrainingLoop]):
    """Gives Gaussians the refractive indices that the user specified for materials."""

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
        loop.ranks.broadcast(offsets)
        gaussians.overwrite("index_offset", offsets)


class PriorRefresh(Callback[TrainingLoop]):
    """Drops the priors of all views, and lets the present Gaussians guide the next ones."""

    action = "refresh_priors"

    def act(self, loop: TrainingLoop) -> None:
        loop.feed.refresh_priors()
        loop.state.frozen = loop.state.gaussians.snapshot()


class DensityControl(Callback[TrainingLoop]):
    """Adds and removes Gaussians by what all ranks have seen, in stages with density control."""

    def begin(self, loop: TrainingLoop) -> None:
        context = loop.current
        device = context.backend.device
        density = context.recipe.densification
        cameras = [view.camera for view in context.views]
        self._middle = context.centers.mean(dim=0).float().to(device)
        empty = free_space(context.scene.points, cameras, density.free_share, density.free_quantile)
        self._empty = empty.to(device)

    def after_step(self, loop: TrainingLoop, report: StepReport) -> None:
        if not loop.position.stage.densify:
            return
        context = loop.current
        settings = context.settings
        density = context.recipe.densification
        state = loop.state
        if state.step % density.every == 0:
            exchange_statistics(state, loop.ranks)
            densify(
                state.gaussians,
                state.statistics,
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

    def _prune_untouched(self, loop: TrainingLoop) -> None:
        """Remove Gaussians that show too little.

        Where nothing is behind the subject: those in too few training views, which are fog in new views. Also those
        that are faint in all training views, as faint as the recipe specifies.
        """
        context = loop.current
        density = context.recipe.densification
        state = loop.state
        if not (context.black or density.faint_pixels):
            return
        cameras = context.memory.between(view.camera for view in context.views)
        touched = touched_pixels(state.gaussians, cameras, context.backend.rasterize)
        for values in touched:
            loop.ranks.broadcast(values)
        keep = touched.most >= density.faint_pixels
        if context.black:
            enough = len(context.views) >= density.enough_views
            keep &= touched.views >= (2 if enough else 1)
        if bool(keep.any()):
            state.gaussians.keep(keep)
            state.statistics.clear(len(state.gaussians))


class Footprints(Callback[TrainingLoop]):
    """Measures the size of a training pixel at each Gaussian after the last step."""

    def at_end(self, loop: TrainingLoop) -> None:
        cameras = (view.camera for view in loop.current.views)
        loop.state.footprints = footprints(loop.state.gaussians["means"].detach(), cameras)


def method_callbacks() -> list[AnyCallback]:
    """Return the callbacks of a training of Gaussians, in their order."""
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
