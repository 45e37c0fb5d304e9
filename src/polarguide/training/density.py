"""The density control of a training: Gaussians are added and removed between its steps."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from polarguide.capture import Scene, View
from polarguide.gaussians.densify import densify
from polarguide.gaussians.free_space import free_space
from polarguide.gaussians.initialize import scene_extent
from polarguide.raster import Backend
from polarguide.shading.visibility import touched_pixels
from polarguide.system import MemoryBound
from polarguide.training.distributed import Ranks
from polarguide.training.recipe import Recipe
from polarguide.training.settings import ResolvedSettings
from polarguide.training.state import TrainingState, seeded


class DensityControl:
    """Adds and removes Gaussians, by what all ranks have seen.

    Args:
        scene: the capture. recipe: the method. settings: the user's choices.
        backend: device and rasterizer. ranks: the processes that share the views of each step.
        memory: gives back what was freed between two views. black: whether nothing is behind the subject.

    Attributes:
        extent: of the scene, to which distances are relative.
    """

    def __init__(
        self,
        scene: Scene,
        recipe: Recipe,
        settings: ResolvedSettings,
        backend: Backend,
        ranks: Ranks,
        memory: MemoryBound,
        *,
        black: bool,
    ) -> None:
        self._settings, self._backend, self._ranks, self._memory = settings, backend, ranks, memory
        self._densification, self._black = recipe.densification, black
        self._views: Sequence[View] = scene.train_views
        centers = torch.stack([view.camera.center for view in self._views])
        self.extent = scene_extent(centers)
        self._middle = centers.mean(dim=0).float().to(backend.device)
        cameras, density = [view.camera for view in self._views], self._densification
        empty = free_space(scene.points, cameras, density.free_share, density.free_quantile)
        self._empty = empty.to(backend.device)

    def exchange_statistics(self, state: TrainingState) -> None:
        """Let every rank know what all have seen since the last densification. All ranks have to call it."""
        for sums in (state.statistics.gradient, state.statistics.seen):
            self._ranks.exchange_slots(sums if sums.ndim == 2 else sums[None])

    def after_step(self, state: TrainingState, *, last: bool) -> None:
        """What is due after a step of a stage with density control.

        Args:
            last: whether the next step has no density control; Gaussians that show too little are then removed.
        """
        settings, densification = self._settings, self._densification
        if state.step % densification.every == 0:
            self.exchange_statistics(state)
            densify(
                state.gaussians,
                state.statistics,
                densification,
                extent=self.extent,
                middle=self._middle,
                prune_large=densification.prunes_large(state.step, settings.steps),
                empty=self._empty,
                limit=settings.gaussians,
                generator=seeded(settings.seed, 2, state.step),
            )
        if last:
            self._prune_untouched(state)

    def _prune_untouched(self, state: TrainingState) -> None:
        """Remove Gaussians that show too little.

        Before nothing, those that too few training views can tell anything about: in new views they are fog. And those
        that are faint in all training views, where the recipe says how faint.
        """
        faint = self._densification.faint_pixels
        if not (self._black or faint):
            return
        cameras = self._memory.between(view.camera for view in self._views)
        touched = touched_pixels(state.gaussians, cameras, self._backend.rasterize)
        for values in touched:
            self._ranks.broadcast(values)
        kept = touched.most >= faint
        if self._black:
            enough = len(self._views) >= self._densification.enough_views
            kept &= touched.views >= (2 if enough else 1)
        if bool(kept.any()):
            state.gaussians.keep(kept)
            state.statistics.clear(len(state.gaussians))
