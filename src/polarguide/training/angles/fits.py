"""Fits of polarizer angles between the steps of a training.

Unknown angles are estimated. Known angles are fitted as well, to check the specified values.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import torch
from torch import Tensor

from polarguide.capture import View
from polarguide.capture.variants import smaller
from polarguide.core.progress import SILENT
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.training.angles.polarizers import Polarizers, search_steps
from polarguide.training.callback import AnyCallback, Callback
from polarguide.training.callbacks import method_callbacks
from polarguide.training.context import TrainingContext
from polarguide.training.loop import TrainingLoop
from polarguide.training.recipe import Position
from polarguide.training.state import TrainingState
from polarguide.training.storage import ViewStore


class AngleFits(Callback[TrainingLoop]):
    """Callback that fits polarizer angles during a training.

    Short trainings on small pictures search for unknown angles. Then the training begins again with the angles
    that were found. If ``TrainSettings.begin_again`` is False, there is no search, and unknown angles are fitted
    between the steps of the training. Known angles are compared with the pictures between these steps.

    Args:
        context: context of the training.
        table: table of all earlier fits. None means that there was no fit.

    Attributes:
        polarizers: fitted angles.
        begins_again: True if a search precedes the training.
        current: context of the next schedule, which is a search or the training itself.
    """

    def __init__(self, context: TrainingContext, table: Tensor | None) -> None:
        self._context = context
        self._schedule_next(table)

    def _schedule_next(self, table: Tensor | None) -> None:
        """Choose the next schedule: another search, or the training if all angles have been found."""
        context = self._context
        scene = context.scene
        steps = context.settings.steps
        search = search_steps(context.recipe, context.settings)
        self.polarizers = Polarizers(scene, context.recipe, steps, table, search)
        self.begins_again = context.settings.begin_again and self.polarizers.search > 0
        self._searches = self.begins_again and not self.polarizers.settled
        self.current = context
        if self._searches:
            small = smaller(scene, context.recipe.angle_rules.search_size)
            settings = replace(context.settings, steps=search)
            self.current = replace(
                context, scene=small, settings=settings, store=ViewStore(), reporter=SILENT
            )
            self.polarizers = Polarizers(small, context.recipe, search, table, search)
        elif self.begins_again:
            self.current = replace(context, scene=self.polarizers.resolved(scene))

    def begin(self, loop: TrainingLoop) -> None:
        """Apply the earlier fits."""
        loop.state.angles = self.polarizers.table
        if self.begins_again:
            loop.offset = self.polarizers.searched
            loop.total = self._context.settings.steps + self.polarizers.search
        if self._searches or not self.begins_again:
            loop.feed.set_exposures(self.polarizers.beliefs)

    def before_step(self, loop: TrainingLoop, position: Position) -> None:
        """Fit angles if a fit is due before this step."""
        if not self.polarizers.due(loop.state.step):
            return
        loop.whole = False
        ended = self.polarizers.ended
        self._fit(loop)
        if self._searches and self.polarizers.ended > ended:
            self._schedule_next(loop.state.angles)
            loop.begin(self.current, None)
        loop.whole = True

    @torch.no_grad()
    def _fit(self, loop: TrainingLoop) -> None:
        """Fit all angles to the Stokes vectors that the current state predicts."""
        state = loop.state
        context = loop.current
        request = RenderRequest(sh_degree=loop.schedule.sh_degree(state.step))

        def predicted(view: View) -> Tensor:
            context.memory.clear()
            result = render(
                state.gaussians,
                view.camera,
                context.backend.rasterize,
                request,
                shading=context.shading,
                light=state.light,
            )
            return context.shading.predicted_stokes(result, view.camera)

        table = self.polarizers.fit(predicted).to(context.backend.device)
        earlier = [] if state.angles is None else [*state.angles]
        state.angles = torch.stack([*earlier, table.cpu()])
        changed = self.polarizers.take(state.angles)
        loop.feed.set_exposures({name: self.polarizers.beliefs[name] for name in changed})


def gaussian_training(
    context: TrainingContext, state: TrainingState | None = None, callbacks: Iterable[AnyCallback] = ()
) -> tuple[TrainingLoop, AngleFits]:
    """Create the loop of a training of Gaussians, with a callback that fits polarizer angles.

    Args:
        context: context of the training.
        state: state to resume from, which may be in the middle of a search. None starts from the beginning.
        callbacks: additional callbacks, which run after the callbacks of the method.

    Returns:
        A tuple of the loop and its callback that fits the angles.
    """
    fits = AngleFits(context, None if state is None else state.angles)
    return TrainingLoop(context, [fits, *method_callbacks(), *callbacks], state, fits.current), fits
