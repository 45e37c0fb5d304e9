"""Training of pictures whose polarizer angles are fitted: unknown ones before it begins, known ones to check them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from polarguide.capture import Scene, View
from polarguide.capture.variants import smaller
from polarguide.core.progress import SILENT
from polarguide.core.system import UNBOUNDED, MemoryBound
from polarguide.raster import Backend
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.shading.model import ShadingModel
from polarguide.training.angles.polarizers import Polarizers, search_steps
from polarguide.training.distributed import ALONE, Ranks
from polarguide.training.feed import ViewStore
from polarguide.training.recipe import Recipe, Schedule
from polarguide.training.settings import ResolvedSettings, StepReport
from polarguide.training.state import TrainingState
from polarguide.training.trainer import Trainer


class AngleTrainer:
    """Searches for unknown angles in short trainings on small pictures, then trains with those that were found.

    Each search and the training have a ``Trainer`` of their own, which knows nothing of the others. With
    ``TrainSettings.begin_again`` off there is no search, and unknown angles are fitted between steps of the training.
    Known angles are compared with the pictures there.

    Args:
        state: where to go on from, also in the middle of a search; None: from the beginning.
        scene, recipe, settings, backend, ranks, store, warn, memory: as of ``Trainer``.

    Attributes:
        polarizers: what has been found.
        whole: as of ``Trainer``.
    """

    def __init__(
        self,
        scene: Scene,
        recipe: Recipe,
        settings: ResolvedSettings,
        backend: Backend,
        state: TrainingState | None = None,
        ranks: Ranks = ALONE,
        store: ViewStore | None = None,
        warn: Callable[[str], None] = lambda _: None,
        memory: MemoryBound = UNBOUNDED,
    ) -> None:
        self.scene = scene
        self.recipe = recipe
        self.settings = settings
        self.backend = backend
        self.ranks = ranks
        self._store = store
        self._warn = warn
        self._memory = memory
        self._fits = False
        self._set_up(state, None if state is None else state.angles)

    def _set_up(self, state: TrainingState | None, table: Tensor | None) -> None:
        """Make the trainer of the search that is next, or of the training once all angles are found.

        Args:
            state: that it goes on from; None: from the beginning. table: table of all fits so far.
        """
        settings = self.settings
        search = search_steps(self.recipe, self.settings)
        self.polarizers = Polarizers(self.scene, self.recipe, settings.steps, table, search)
        self._searches = self.begins_again and not self.polarizers.settled
        scene = self.scene
        store = self._store
        warn = self._warn
        if self._searches:
            scene = smaller(scene, self.recipe.angle_rules.search_size)
            settings = replace(settings, steps=search)
            self.polarizers = Polarizers(scene, self.recipe, search, table, search)
            store = None
            warn = SILENT.warn
        elif self.begins_again:
            scene = self.polarizers.resolved(scene)
        self._trainer = Trainer(
            scene, self.recipe, settings, self.backend, state, self.ranks, store, warn, self._memory
        )
        self._trainer.state.angles = table
        if not (self.begins_again and self.polarizers.settled):
            self._trainer.set_exposures(self.polarizers.beliefs)

    @property
    def begins_again(self) -> bool:
        """Whether the training begins, or has begun, after a search."""
        return self.settings.begin_again and self.polarizers.search > 0

    @property
    def total(self) -> int:
        """Steps in all, with those of searches."""
        return self.settings.steps + (self.polarizers.search if self.begins_again else 0)

    @property
    def done(self) -> int:
        """Number of finished steps."""
        return (self.polarizers.searched if self.begins_again else 0) + self.state.step

    @property
    def state(self) -> TrainingState:
        """The state of the current search, or of the training."""
        return self._trainer.state

    def undecided(self) -> Tensor | None:
        """As of ``Trainer``."""
        return self._trainer.undecided()

    @property
    def shading(self) -> ShadingModel:
        """The recipe's, for the run's refractive index."""
        return self._trainer.shading

    @property
    def schedule(self) -> Schedule:
        """Of the present search, or of the training."""
        return self._trainer.schedule

    @property
    def whole(self) -> bool:
        """Whether the state is one between two steps."""
        return self._trainer.whole and not self._fits

    def run(self, on_step: Callable[[StepReport], None], *, until: int | None = None) -> None:
        """Train until the last step (or ``until``, also of a search), reporting each step."""
        while self.state.step < (self.settings.steps if until is None else until):
            on_step(self.step())

    def step(self) -> StepReport:
        """Fit angles if that is due, then one optimizer step."""
        if self.polarizers.due(self.state.step):
            self._fits = True
            ended = self.polarizers.ended
            self._fit()
            if self._searches and self.polarizers.ended > ended:
                self._set_up(None, self.state.angles)
            self._fits = False
        report = self._trainer.step()
        return replace(report, done=self.done)

    def exchange_statistics(self) -> None:
        """As of ``Trainer``."""
        self._trainer.exchange_statistics()

    @torch.no_grad()
    def _fit(self) -> None:
        """Fit all angles to what the present state predicts."""
        state = self.state
        table = self.polarizers.fit(self._predicted).to(self.backend.device)
        self.ranks.broadcast(table)
        earlier = [] if state.angles is None else [*state.angles]
        state.angles = torch.stack([*earlier, table.cpu()])
        changed = self.polarizers.take(state.angles)
        self._trainer.set_exposures({name: self.polarizers.beliefs[name] for name in changed})

    def _predicted(self, view: View) -> Tensor:
        """Stokes vectors [3, H, W, 3] of the present state in a view."""
        state = self.state
        rasterize = self.backend.rasterize
        shading = self.shading
        self._memory.clear()
        request = RenderRequest(sh_degree=self.schedule.sh_degree(state.step))
        result = render(state.gaussians, view.camera, rasterize, request, shading=shading, light=state.light)
        return shading.predicted_stokes(result, view.camera)
