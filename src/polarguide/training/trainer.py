"""The loop: walks a recipe's stages over a scene. It knows no method and compares no step with a constant.

Everything that a step reads lies on the backend's device before: a step that does nothing but train copies nothing
there and asks nothing back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from polarguide.capture import Scene, View
from polarguide.capture.background import has_black_background
from polarguide.capture.smaller import smaller
from polarguide.gaussians.densify import densify
from polarguide.gaussians.free_space import free_space
from polarguide.gaussians.initialize import orbit, scene_extent
from polarguide.raster import Backend, ScreenStatistic
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.shading.layout import COLOR_CHANNELS
from polarguide.shading.model import PLAIN
from polarguide.shading.visibility import outward_directions, touched_pixels
from polarguide.system import UNBOUNDED, MemoryBound
from polarguide.training.actions import OPACITY_REST, propagate_normals, reset_opacity
from polarguide.training.behind import turned_behind
from polarguide.training.distributed import ALONE, Ranks
from polarguide.training.indices import index_offsets, numbers_in
from polarguide.training.losses import step_loss
from polarguide.training.metals.search import MetalSearch
from polarguide.training.polarizers import SEARCH_SIZE, Polarizers, search_steps
from polarguide.training.priors import ViewPriors
from polarguide.training.recipe import Action, Recipe, Stage
from polarguide.training.schedule import Schedule
from polarguide.training.settings import ResolvedSettings, StepReport, TrainSettings
from polarguide.training.sizes import Sizes
from polarguide.training.state import TrainingState, first_state, seeded
from polarguide.training.view_store import ViewStore

# From so many training views on, what only one of them sees goes where nothing is behind the subject.
ENOUGH_VIEWS = 12


def is_black(scene: Scene, settings: TrainSettings) -> bool:
    """Whether a training takes it that nothing is behind the subject; a scene's pictures are looked at once."""
    if settings.background != "auto":
        return settings.background != "scene"
    if "_black" not in vars(scene):
        vars(scene)["_black"] = has_black_background(scene.train_views)
    return bool(vars(scene)["_black"])


class Trainer:
    """Trains one recipe on one scene.

    Args:
        scene: the capture.
        recipe: the method.
        settings: the user's choices.
        backend: device and rasterizer.
        state: where to go on from, on the backend's device; None: from the beginning.
        ranks: the processes that share the views of each step.
        store: keeps what is computed of the views; None: in memory.
        warn: told what the user should know.
        memory: gives back what was freed where it would lie between what is kept.

    Attributes:
        shading: the recipe's, for the run's refractive index.
        black: whether nothing is behind the subject.
        polarizers: what is found out about those whose angle is not known.
        whole: whether the state is one between two steps; an exception may leave it in the middle of a change.
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
        self.scene, self.recipe, self.settings, self.backend = scene, recipe, settings, backend
        self.ranks, self._device, self._memory = ranks, backend.device, memory
        self.whole = True
        self.shading = recipe.shading.bind(settings.refractive_index)
        self.black = is_black(scene, settings)
        self.state = state or self._first_state()
        self._rate = math.sqrt(settings.views_per_step)
        centers = torch.stack([view.camera.center for view in scene.train_views])
        self._extent = scene_extent(centers)
        self._reach = orbit(scene.points.double().numpy(), centers.double().numpy())[1]
        self._middle = centers.mean(dim=0).float().to(self._device)
        empty = free_space(scene.points, [view.camera for view in scene.train_views])
        self._empty = empty.to(self._device)
        self._store = store or ViewStore()
        self._set_up()
        self._metals = MetalSearch(scene, recipe, settings, self.shading, backend, ranks, warn, memory)
        self._metals.warn_if_never(self._refreshes())
        self._warn_of_indices(warn)

    def _set_up(self) -> None:
        """What depends on the pictures and the number of steps: those of the search for angles, or of the training."""
        recipe, settings = self.recipe, self.settings
        scene, steps, search = self.scene, settings.steps, search_steps(settings)
        self.polarizers = Polarizers(scene, recipe, steps, self.state.angles, search)
        self._searches = self.begins_again and not self.polarizers.settled
        if self._searches:
            scene, steps = smaller(scene, SEARCH_SIZE), search
            self.polarizers = Polarizers(scene, recipe, steps, self.state.angles, search)
        self._views, self._steps, self.schedule = scene.train_views, steps, Schedule(recipe, steps)
        self._limit = settings.gaussians
        store = ViewStore() if self._searches else self._store
        index = settings.refractive_index
        self._sizes = Sizes(
            self.backend, recipe, index, store, self._views, steps, black=self.black, memory=self._memory
        )
        self._use_batch_rates()

    def _first_state(self) -> TrainingState:
        return first_state(self.scene, self.recipe, self.settings, self._device, surroundings=not self.black)

    @property
    def begins_again(self) -> bool:
        """Whether the training begins, or has begun, again with the angles that it found."""
        return self.settings.begin_again and self.polarizers.search > 0

    @property
    def total(self) -> int:
        """Steps in all, with those in search of angles before it begins again."""
        return self.settings.steps + (self.polarizers.search if self.begins_again else 0)

    @property
    def done(self) -> int:
        """Those of them that are done."""
        before = self.polarizers.searched if self.begins_again else 0
        return before + self.state.step

    def run(self, on_step: Callable[[StepReport], None], *, until: int | None = None) -> None:
        """Train until the last step (or ``until``), reporting each step."""
        while self.state.step < (self.settings.steps if until is None else until):
            on_step(self.step())

    def step(self) -> StepReport:
        """One optimizer step."""
        if self.polarizers.due(self.state.step):
            self.whole = False
            ended = self.polarizers.ended
            self._fit_polarizers()
            if self._searches and self.polarizers.ended > ended:
                self._begin_again()
            self.whole = True
        state, recipe, views = self.state, self.recipe, self.settings.views_per_step
        position = self.schedule.at(state.step)
        self.whole = not position.actions
        if "refresh_priors" in position.actions:
            self._sizes.refresh_priors()  # first: they leave room for looks at all views
        for action in position.actions:
            self._act(action)
        mine = self.ranks.slots(views)
        # A rank without a view renders the first one, so that it knows what has gradients, and adds nothing.
        measured = [self._backpropagate(slot, position.stage, bool(mine)) for slot in mine or range(1)]
        self.whole = False
        self._join_gradients(idle=not mine)
        self._optimize()
        mean = measured[0] if len(measured) == 1 else torch.stack(measured).mean(dim=0)
        report = StepReport(state.step, position.stage.name, len(state.gaussians), mean, self.done + 1)
        state.step += 1
        if position.stage.densify and state.step % recipe.densification.every == 0:
            self.exchange_statistics()
            densify(
                state.gaussians,
                state.statistics,
                recipe.densification,
                extent=self._extent,
                middle=self._middle,
                prune_large=recipe.densification.prunes_large(state.step, self._steps),
                empty=self._empty,
                limit=self._limit,
                generator=seeded(self.settings.seed, 2, state.step),
            )
        if position.stage.densify and not self._densifies_next():
            self._prune_untouched()
        self.whole = True
        return report

    def _densifies_next(self) -> bool:
        """Whether the next step belongs to a stage with density control."""
        step = self.state.step
        return step < self._steps and self.schedule.at(step).stage.densify

    def _prune_untouched(self) -> None:
        """Remove Gaussians that show too little.

        Before nothing, those that too few training views can tell anything about: in new views they are fog. And those
        that are faint in all training views, where the recipe says how faint.
        """
        state, views, faint = self.state, self._views, self.recipe.densification.faint_pixels
        if not (self.black or faint):
            return
        cameras = self._memory.between(view.camera for view in views)
        touched = touched_pixels(state.gaussians, cameras, self.backend.rasterize)
        for values in touched:
            self.ranks.broadcast(values)
        kept = touched.most >= faint
        if self.black:
            kept &= touched.views >= (2 if len(views) >= ENOUGH_VIEWS else 1)
        if bool(kept.any()):
            state.gaussians.keep(kept)
            state.statistics.clear(len(state.gaussians))

    def exchange_statistics(self) -> None:
        """Let every rank know what all have seen since the last densification. All ranks have to call it."""
        for sums in (self.state.statistics.gradient, self.state.statistics.seen):
            self.ranks.exchange_slots(sums if sums.ndim == 2 else sums[None])

    def _backpropagate(self, slot: int, stage: Stage, counts: bool) -> Tensor:
        """Render the view of a slot and add its gradients; [3] as of ``StepReport.measured``."""
        state, recipe = self.state, self.recipe
        view = self._view_of(state.step * self.settings.views_per_step + slot)
        shading = self.shading if stage.reflection else PLAIN
        statistic = ScreenStatistic(COLOR_CHANNELS) if stage.densify else None
        priors = self._priors_of(view, stage)  # before there is a picture, which takes memory, too
        turning = stage.behind is not None and stage.weights.normals
        result = render(
            state.gaussians,
            view.camera,
            self.backend.rasterize,
            RenderRequest(
                sh_degree=self.schedule.sh_degree(state.step),
                normals=stage.weights.normals,
                depth=stage.weights.depth or turning,
                normal_rotation_only=turning,
                layers_detached=stage.reflection and stage.hold_normals and stage.weights.layers,
                statistic=statistic,
            ),
            shading=shading,
            light=state.light,
        )
        if turning:
            assert stage.behind is not None
            near, far = (share * self._reach for share in stage.behind)
            result = turned_behind(result, near, far)
        shown = self._sizes.feed(state.step).shown(view)
        loss = step_loss(
            result,
            shown.picture,
            shown.valid,
            stage.weights,
            priors,
            ssim_weight=recipe.ssim_weight,
            shading=shading,
            log_scales=state.gaussians["log_scales"],
            extent=self._extent,
            camera=view.camera,
            empty=shown.empty,
            partial=shown.partial,
        )
        loss.total.backward()
        gradient = statistic.gradient if statistic else None
        if counts and gradient is not None and result.radii is not None:
            self.whole = False
            state.statistics.add(gradient, result.radii, view.camera.width, view.camera.height, slot)
        psnr = -10 * torch.log10(loss.error.clamp(min=1e-10))
        return torch.stack((loss.photometric.detach(), psnr, loss.total.detach()))

    def _join_gradients(self, *, idle: bool) -> None:
        """From the gradients of this rank's views to the mean over the views of all."""
        views = self.settings.views_per_step
        if views == 1 and self.ranks.world == 1:
            return
        trained = (*self.state.gaussians.trained(), *self.state.light.values())
        gradients = [t.grad for t in trained if t.grad is not None]
        if idle:
            torch._foreach_zero_(gradients)
        self.ranks.all_reduce(gradients)
        if views > 1:
            torch._foreach_div_(gradients, float(views))

    def _use_batch_rates(self) -> None:
        """What the optimizers need for more than one view a step; see ``TrainSettings``."""
        views = self.settings.views_per_step
        if views == 1:
            return
        betas = (0.9**views, 0.999**views)
        self.state.gaussians.set_betas(betas)
        if self.state.environment is not None:
            self.state.environment.set_betas(betas)
            for name, rate in self.recipe.light_rates.items():
                self.state.environment.set_rate(name, rate * self._rate)

    def _optimize(self) -> None:
        state = self.state
        rates = self.schedule.rates(state.step)
        rates["means"] *= self._extent
        if state.step < state.opacity_frozen_until:
            rates["opacity_logits"] = 0.0
        for name, rate in rates.items():
            state.gaussians.set_rate(name, rate * self._rate)
        state.gaussians.step()
        if state.environment is not None:
            state.environment.step()

    @torch.no_grad()
    def _fit_polarizers(self) -> None:
        """Find the angles of pictures from the present state."""
        state = self.state

        def predicted(view: View) -> Tensor:
            degree = self.schedule.sh_degree(state.step)
            rasterize, shading = self.backend.rasterize, self.shading
            self._memory.clear()
            request = RenderRequest(sh_degree=degree)
            result = render(
                state.gaussians, view.camera, rasterize, request, shading=shading, light=state.light
            )
            return shading.predicted_stokes(result, view.camera)

        table = self.polarizers.fit(predicted).to(self._device)
        self.ranks.broadcast(table)
        earlier = [] if state.angles is None else [*state.angles]
        state.angles = torch.stack([*earlier, table.cpu()])
        self._sizes.forget(self.polarizers.take(state.angles))

    def _begin_again(self) -> None:
        """Back to the first step, with what was found of the polarizers."""
        angles = self.state.angles
        self.state = self._first_state()
        self.state.angles = angles
        self._set_up()

    def _act(self, action: Action) -> None:
        if action == "reset_opacity":
            reset_opacity(self.state, self.shading)
        elif action == "propagate_normals":
            generator = seeded(self.settings.seed, 3, self.state.step)
            rest = min(OPACITY_REST, self._steps // 50)
            propagate_normals(self.state, self.shading, self.recipe.propagation, generator, rest)
        elif action == "orient_normals":
            gaussians, rasterize = self.state.gaussians, self.backend.rasterize
            outward = outward_directions(gaussians, self._memory.between(self._views), rasterize)
            self.ranks.broadcast(outward)
            gaussians.overwrite("outward", outward)
        else:
            if self._metals.is_due(self.state.step / self._steps):
                self._metals.look(self.state, self._views)
            self._heed_indices()
            self.state.frozen = self.state.gaussians.snapshot()

    def _warn_of_indices(self, warn: Callable[[str], None]) -> None:
        """Say where refractive indices of single things, which the scene lists, count for nothing."""
        indices = self.scene.indices
        if not indices:
            return
        if not self.shading.knows_indices or not any(True for _ in self._refreshes()):
            why = f"the recipe {self.recipe.name} takes the run's for everything"
        elif not any(numbers_in(view) & indices.keys() for view in self.scene.train_views):
            why = "no picture in materials/ of a training view has one of their numbers"
        else:
            return
        warn(f"the refractive indices that scene.json lists under materials are not used: {why}.")

    def _heed_indices(self) -> None:
        """Give Gaussians the refractive indices that the user says objects have."""
        indices = self.scene.indices
        if not indices or not self.shading.knows_indices:
            return
        gaussians, rasterize = self.state.gaussians, self.backend.rasterize
        index = self.settings.refractive_index
        offsets = index_offsets(gaussians, self._views, indices, index, rasterize, self._memory)
        self.ranks.broadcast(offsets)
        gaussians.overwrite("index_offset", offsets)

    def _refreshes(self) -> Iterator[float]:
        """Shares of the training's steps, search for angles apart, after which the priors are refreshed."""
        steps, schedule = self.settings.steps, Schedule(self.recipe, self.settings.steps)
        return (step / steps for step in range(steps) if "refresh_priors" in schedule.at(step).actions)

    def _view_of(self, place: int) -> View:
        """The view at a place in the sequence of all views ever trained on.

        Every epoch visits every training view once, in an order of its own.
        """
        views = self._sizes.views(self.state.step)
        epoch, place = divmod(place, len(views))
        order = torch.randperm(len(views), generator=seeded(self.settings.seed, 4, epoch))
        return self.polarizers.believed(views[int(order[place])])

    def _priors_of(self, view: View, stage: Stage) -> ViewPriors | None:
        if not stage.weights.priors or not view.is_determined:
            return None
        if self.state.frozen is None:
            self._act("refresh_priors")
        assert self.state.frozen is not None
        return self._sizes.feed(self.state.step).priors(view, stage, self.state.frozen)
