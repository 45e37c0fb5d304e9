"""The loop: walks a recipe's stages over a scene. It knows no method and compares no step with a constant.

Everything that a step reads lies on the backend's device before: a step that does nothing but train copies nothing
there and asks nothing back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from polarguide.capture import Scene, View
from polarguide.capture.exposures import Exposure
from polarguide.core.system import UNBOUNDED, MemoryBound
from polarguide.gaussians.initialize import camera_reach
from polarguide.raster import Backend, ScreenStatistic
from polarguide.raster.magnification import footprints
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.shading.model import PLAIN
from polarguide.shading.result import COLOR_CHANNELS, RenderResult
from polarguide.training.actions import DensityControl, outward_directions, propagate_normals, reset_opacity
from polarguide.training.distributed import ALONE, Ranks
from polarguide.training.feed import Feed, ViewStore
from polarguide.training.losses import step_loss
from polarguide.training.metals.observations import index_offsets, numbers_in
from polarguide.training.metals.search import MetalSearch, refreshes
from polarguide.training.recipe import Action, Recipe, Schedule, Stage
from polarguide.training.settings import ResolvedSettings, StepReport
from polarguide.training.state import TrainingState, first_state, seeded
from polarguide.training.targets import Step, StepTargets


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
        warn: receives messages for the user.
        memory: gives back what was freed where it would lie between what is kept.

    Attributes:
        shading: the recipe's, for the run's refractive index.
        black: whether nothing is behind the subject.
        schedule: schedule of the stages.
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
        self.scene = scene
        self.recipe = recipe
        self.settings = settings
        self.backend = backend
        self.ranks = ranks
        self._memory = memory
        self._views = scene.train_views
        self.whole = True
        self.black = settings.background != "scene"
        self.shading = recipe.shading.bind(settings.refractive_index)
        index = settings.refractive_index
        self.schedule = Schedule(recipe, settings.steps)
        self._exposures = dict[str, tuple[Exposure, ...]]()
        self.state = state or first_state(
            scene, recipe, settings, backend.device, surroundings=not self.black
        )
        self._feed = Feed(
            backend,
            recipe,
            index,
            store or ViewStore(),
            self._views,
            settings.steps,
            black=self.black,
            memory=memory,
        )
        self._density = DensityControl(scene, recipe, settings, backend, ranks, memory, black=self.black)
        self._metals = MetalSearch(scene, recipe, settings, self.shading, backend, ranks, warn, memory)
        centers = torch.stack([view.camera.center for view in self._views])
        self._reach = camera_reach(scene.points.double().numpy(), centers.double().numpy())[1]
        self._rate = math.sqrt(settings.views_per_step)
        self._actions: Mapping[Action, Callable[[], None]] = {
            "reset_opacity": self._reset_opacity,
            "propagate_normals": self._propagate_normals,
            "orient_normals": self._orient_normals,
            "refresh_priors": self._refresh_priors,
        }
        self._use_batch_rates()

    def undecided(self) -> Tensor | None:
        """Gaussians [N] bool of which polarization cannot tell whether they are metals; see ``MetalSearch``."""
        return self._metals.undecided(self.state, self._views)

    def set_exposures(self, exposures: Mapping[str, tuple[Exposure, ...]]) -> None:
        """Take views, by name, for captured with these exposures from now on; their targets are made anew."""
        self._exposures.update(exposures)
        self._feed.forget(exposures)

    def run(self, on_step: Callable[[StepReport], None], *, until: int | None = None) -> None:
        """Train until the last step (or ``until``), reporting each step."""
        while self.state.step < (self.settings.steps if until is None else until):
            on_step(self.step())

    def step(self) -> StepReport:
        """One optimizer step."""
        state = self.state
        views = self.settings.views_per_step
        position = self.schedule.at(state.step)
        stage = position.stage
        self.whole = not position.actions
        self._act(position.actions, stage)
        mine = self.ranks.slots(views)
        # A rank without a view renders the first one, so that it knows what has gradients, and adds nothing.
        measured = [self._backpropagate(slot, stage, bool(mine)) for slot in mine or range(1)]
        self.whole = False
        self._join_gradients(idle=not mine)
        self._optimize()
        mean = measured[0] if len(measured) == 1 else torch.stack(measured).mean(dim=0)
        report = StepReport(state.step, stage.name, len(state.gaussians), mean, state.step + 1)
        state.step += 1
        if stage.densify:
            self._density.after_step(state, last=not self._densifies(state.step))
        if state.step == self.settings.steps:
            cameras = (view.camera for view in self._views)
            state.footprints = footprints(state.gaussians["means"].detach(), cameras)
        self.whole = True
        return report

    def _densifies(self, step: int) -> bool:
        """Whether a step belongs to a stage with density control."""
        return step < self.settings.steps and self.schedule.at(step).stage.densify

    def exchange_statistics(self) -> None:
        """Let every rank know what all have seen since the last densification. All ranks have to call it."""
        self._density.exchange_statistics(self.state)

    def _backpropagate(self, slot: int, stage: Stage, counts: bool) -> Tensor:
        """Render the view of a slot and add its gradients; [3] as of ``StepReport.measured``."""
        state = self.state
        shading = self.shading if stage.reflection else PLAIN
        targets = self._targets(slot, stage)  # before there is a picture, which takes memory, too
        camera = targets.camera
        statistic = ScreenStatistic(COLOR_CHANNELS) if stage.densify else None
        request = requested(stage, self.schedule.sh_degree(state.step), statistic)
        rasterize = self.backend.rasterize
        light = state.light
        result = render(state.gaussians, camera, rasterize, request, shading=shading, light=light)
        if request.normal_rotation_only:
            assert stage.behind is not None
            result = turned_behind(result, *(share * self._reach for share in stage.behind))
        scales = state.gaussians["log_scales"]
        extent = self._density.extent
        step = Step(result, targets, shading, scales, extent, self.recipe.ssim_weight)
        loss = step_loss(step, stage.weights)
        loss.total.backward()
        gradient = statistic.gradient if statistic else None
        if counts and gradient is not None:
            self.whole = False
            state.statistics.add(gradient, result.training["radii"], camera.width, camera.height, slot)
        psnr = -10 * torch.log10(loss.error.clamp(min=1e-10))
        return torch.stack((loss.photometric.detach(), psnr, loss.total.detach()))

    def _targets(self, slot: int, stage: Stage) -> StepTargets:
        """Targets of the rendering of a slot's view."""
        state = self.state
        view = self._view_of(state.step * self.settings.views_per_step + slot)
        return self._feed.targets(state.step, view, stage.weights, state.frozen)

    def _act(self, actions: Sequence[Action], stage: Stage) -> None:
        """Do the actions that are due before a step, and compute priors that the step needs."""
        for action in actions:
            self._actions[action]()
        if self._needs_first_priors(stage):
            self._refresh_priors()

    def _needs_first_priors(self, stage: Stage) -> bool:
        """True where the views of a step need priors that no action has computed so far."""
        if not stage.weights.priors or self.state.frozen is not None:
            return False
        views = self.settings.views_per_step
        first = self.state.step * views
        return any(self._view_of(first + slot).is_determined for slot in range(views))

    def _view_of(self, place: int) -> View:
        """The view at a place in the sequence of all views ever trained on.

        Every epoch visits every training view once, in a new order.
        """
        views = self._feed.views(self.state.step)
        epoch, place = divmod(place, len(views))
        order = torch.randperm(len(views), generator=seeded(self.settings.seed, 4, epoch))
        view = views[int(order[place])]
        exposures = self._exposures.get(view.name, view.exposures)
        return view if exposures == view.exposures else view.with_exposures(exposures)

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
        """Settings of the optimizers for more than one view a step; see ``TrainSettings``."""
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
        rates["means"] *= self._density.extent
        if state.step < state.opacity_frozen_until:
            rates["opacity_logits"] = 0.0
        for name, rate in rates.items():
            state.gaussians.set_rate(name, rate * self._rate)
        state.gaussians.step()
        if state.environment is not None:
            state.environment.step()

    def _reset_opacity(self) -> None:
        reset_opacity(self.state, self.shading, self.recipe.densification.reset_opacity)

    def _propagate_normals(self) -> None:
        generator = seeded(self.settings.seed, 3, self.state.step)
        steps = self.settings.steps
        propagate_normals(self.state, self.shading, self.recipe.propagation, generator, steps)

    def _orient_normals(self) -> None:
        gaussians = self.state.gaussians
        views = self._memory.between(self._views)
        outward = outward_directions(gaussians, views, self.backend.rasterize)
        self.ranks.broadcast(outward)
        gaussians.overwrite("outward", outward)

    def _refresh_priors(self) -> None:
        """Drop the priors of all views, look for metals where that is due, and let the present Gaussians guide."""
        self._feed.refresh_priors()  # this leaves room for looks at all views
        if self._metals.is_due(self.state.step):
            self._metals.look(self.state, self._views)
        self._set_indices()
        self.state.frozen = self.state.gaussians.snapshot()

    def _set_indices(self) -> None:
        """Give Gaussians the refractive indices that the user specified for materials."""
        indices = self.scene.indices
        if not indices or "index_offset" not in self.shading.parameters:
            return
        gaussians = self.state.gaussians
        rasterize = self.backend.rasterize
        index = self.settings.refractive_index
        offsets = index_offsets(gaussians, self._views, indices, index, rasterize, self._memory)
        self.ranks.broadcast(offsets)
        gaussians.overwrite("index_offset", offsets)


def requested(stage: Stage, sh_degree: int, statistic: ScreenStatistic | None) -> RenderRequest:
    """The layers that a step of a stage needs."""
    weights = stage.weights
    fades = stage.behind is not None and weights.normals
    return RenderRequest(
        sh_degree=sh_degree,
        normals=weights.normals,
        depth=weights.depth or fades,
        layers_detached=stage.reflection and stage.hold_normals and weights.layers,
        normal_rotation_only=fades,
        statistic=statistic,
    )


def warn_of_unused_materials(
    scene: Scene, recipe: Recipe, settings: ResolvedSettings, backend: Backend, warn: Callable[[str], None]
) -> None:
    """Warn if ``materials/``, or refractive indices of single materials, have no effect on a training."""
    shading = recipe.shading.bind(settings.refractive_index)
    MetalSearch(scene, recipe, settings, shading, backend, ALONE, warn, UNBOUNDED).warn_if_never()
    if not scene.indices:
        return
    if not ("index_offset" in shading.parameters and refreshes(recipe, settings.steps)):
        why = f"the recipe {recipe.name} takes the run's for everything"
    elif not any(numbers_in(view) & scene.indices.keys() for view in scene.train_views):
        why = "no picture in materials/ of a training view has one of their numbers"
    else:
        return
    warn(f"the refractive indices that scene.json lists under materials are not used: {why}.")


def turned_behind(result: RenderResult, near: float, far: float) -> RenderResult:
    """The same pictures, whose normal and depth move no Gaussian far away.

    Gradients of the normal and the depth reach everything up to ``near``; from there they fade, linearly in inverse
    depth, and from ``far`` on the depth has none, and the normal one that turns Gaussians alone. A pixel is as far away
    as the farthest of its 3 x 3 neighbors, since the normals of the depth look at these.

    Args:
        result: with ``normal``, ``rotation_only_normal`` and ``depth``.
        near, far: camera depths, 0 < near < far.
    """
    depth = result.depth.detach()
    share = shares_before(depth, near, far)
    rotation_only = result.training["rotation_only_normal"]
    return result.with_layers(
        normal=rotation_only.lerp(result.normal, share[..., None]), depth=depth.lerp(result.depth, share)
    )


def shares_before(depth: Tensor, near: float, far: float) -> Tensor:
    """From 1 up to ``near`` to 0 from ``far`` on, of the farthest of the 3 x 3 neighbors; [H, W] like the depth."""
    farthest = _largest_of_three(_largest_of_three(depth).T).T.clamp(min=near)
    return ((1 / farthest - 1 / far) / (1 / near - 1 / far)).clamp(min=0)


def _largest_of_three(values: Tensor) -> Tensor:
    """Of each row and its two neighbors, [H, W]; many times as fast as pooling."""
    largest = values.clone()
    torch.maximum(values[1:], values[:-1], out=largest[1:])
    torch.maximum(largest[:-1], values[1:], out=largest[:-1])
    return largest
