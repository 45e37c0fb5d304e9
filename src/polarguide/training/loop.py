"""The training loop: schedule, targets, render, loss, step. Everything else is a callback.

The loop contains no constant of a method. All that a step reads is on the device before it: a step without actions
copies nothing there and waits for nothing.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence

import torch
from torch import Tensor

from polarguide.capture import View
from polarguide.capture.exposures import Exposure
from polarguide.core.errors import PolarguideError
from polarguide.gaussians.initialize import camera_reach
from polarguide.raster import ScreenStatistic
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.shading.model import PLAIN
from polarguide.shading.result import COLOR_CHANNELS
from polarguide.training.actions import exchange_statistics
from polarguide.training.behind import turned_behind
from polarguide.training.callback import AnyCallback, Callback
from polarguide.training.context import TrainingContext
from polarguide.training.distributed import Ranks
from polarguide.training.feed import Feed
from polarguide.training.losses import step_loss
from polarguide.training.recipe import Schedule, Stage
from polarguide.training.settings import ResolvedSettings, StepReport
from polarguide.training.state import SavedState, TrainingState, first_state, seeded
from polarguide.training.targets import Step


class Loop(ABC):
    """Steps of a training, with callbacks between them.

    Attributes:
        settings: settings of the training.
        ranks: processes that share the training.
        callbacks: called in this order. observers: called after them, when the step is complete; they change nothing.
        state: state between two steps.
        whole: False while an exception would leave the state in the middle of a change.
        total: number of steps in all. offset: number of steps before the current schedule began.
    """

    state: SavedState

    def __init__(self, settings: ResolvedSettings, ranks: Ranks, callbacks: Sequence[AnyCallback]) -> None:
        self.settings = settings
        self.ranks = ranks
        self.callbacks = list(callbacks)
        self.observers: list[AnyCallback] = []
        self.whole = True
        self.total = settings.steps
        self.offset = 0

    @property
    def done(self) -> int:
        """Number of finished steps of ``total``."""
        return self.offset + self.state.step

    def run(self, until: int | None = None) -> None:
        """Train up to the last step, or up to the step ``until``."""
        while self.state.step < (self.settings.steps if until is None else until):
            self.step()

    def step(self) -> StepReport:
        """Do one optimizer step, with the callbacks before and after it."""
        self.prepare()
        measured, stage, gaussians = self.optimize()
        report = StepReport(self.state.step, stage, gaussians, measured, self.done + 1)
        self.state.step += 1
        for callback in self.callbacks:
            callback.after_step(self, report)
        if self.state.step == self.settings.steps:
            for callback in self.callbacks:
                callback.at_end(self)
        self.whole = True
        for observer in self.observers:
            observer.after_step(self, report)
        return report

    def prepare(self) -> None:  # noqa: B027
        """Do what is due before a step."""

    @abstractmethod
    def optimize(self) -> tuple[Tensor, str, int | None]:
        """Change the parameters once.

        Returns:
            ``StepReport.measured``, the name of the stage, and the number of Gaussians.
        """

    def saved_state(self) -> SavedState:
        """Return the state for a checkpoint. Every rank calls it."""
        return self.state


class TrainingLoop(Loop):
    """Trains the Gaussians of one recipe on one scene.

    Args:
        context: context of the training.
        callbacks: everything that happens between steps; see ``training.callbacks.method_callbacks``.
        state: state to resume from, on the backend's device; None: from the beginning.
        first: context of the schedule to begin with; None: ``context``.

    Attributes:
        current: context of the current schedule, which is that of a search for angles or ``context``.
        schedule: stages of the current schedule. feed: its targets. position: the stage and actions of this step.
    """

    state: TrainingState

    def __init__(
        self,
        context: TrainingContext,
        callbacks: Sequence[AnyCallback],
        state: TrainingState | None = None,
        first: TrainingContext | None = None,
    ) -> None:
        super().__init__(context.settings, context.ranks, callbacks)
        self.context = context
        self.begin(first or context, state)

    def begin(self, context: TrainingContext, state: TrainingState | None) -> None:
        """Begin with a schedule, or resume it from a state.

        Raises:
            PolarguideError: the recipe has an action, or the state has tensors, of a callback that is not there; or
                callbacks with a state have no name of their own.
        """
        _check_names(self.callbacks)
        self.current = context
        self.schedule = Schedule(context.recipe, context.settings.steps)
        self.feed = Feed(context)
        self.state = state or first_state(context)
        self.position = self.schedule.at(self.state.step)
        self._exposures = dict[str, tuple[Exposure, ...]]()
        self._reach = camera_reach(context.scene.points.double().numpy(), context.centers.double().numpy())[1]
        self._set_batch_betas()
        _check_known("action", context.recipe.actions, {each.action for each in self.callbacks})
        stored = {name.split(".")[1] for name in self.state.extra}
        _check_known("callback of the checkpoint", stored, {each.name for each in self.callbacks})
        for callback in self.callbacks:
            callback.begin(self)
            prefix = f"callback.{callback.name}."
            own = {k.removeprefix(prefix): t for k, t in self.state.extra.items() if k.startswith(prefix)}
            if own:
                callback.load_state_dict(own)

    def prepare(self) -> None:
        """Run the callbacks and actions before a step."""
        self.position = self.schedule.at(self.state.step)
        for callback in self.callbacks:
            callback.before_step(self, self.position)  # one may begin another schedule
        actions = self.position.actions
        if self._lacks_priors():
            actions = (*actions, "refresh_priors")
        self.whole = not actions
        for action in actions:
            for callback in self.callbacks:
                if callback.action == action:
                    callback.act(self)

    def optimize(self) -> tuple[Tensor, str, int]:
        """Render the views of this rank, and change the parameters by the mean gradient of all views."""
        slots = self.ranks.slots(self.settings.views_per_step)
        # A rank without a view renders the first one to learn what has gradients, and adds nothing.
        measured = [self.backpropagate(slot, counts=bool(slots)) for slot in slots or range(1)]
        self.whole = False
        self._join_gradients(idle=not slots)
        self.update_parameters()
        mean = measured[0] if len(measured) == 1 else torch.stack(measured).mean(dim=0)
        return mean, self.position.stage.name, len(self.state.gaussians)

    def backpropagate(self, slot: int, *, counts: bool = True) -> Tensor:
        """Render the view of a slot and add its gradients, and its statistics if it counts.

        Returns:
            ``StepReport.measured``.
        """
        state = self.state
        stage = self.position.stage
        shading = self.current.shading if stage.reflection else PLAIN
        view = self.view_at(state.step * self.settings.views_per_step + slot)
        # Targets come first: the picture takes memory, too.
        targets = self.feed.targets(state.step, view, stage.weights, state.frozen)
        camera = targets.camera
        statistic = ScreenStatistic(COLOR_CHANNELS) if stage.densify else None
        request = requested_layers(stage, self.schedule.sh_degree(state.step), statistic)
        rasterize = self.current.backend.rasterize
        result = render(state.gaussians, camera, rasterize, request, shading=shading, light=state.light)
        if stage.behind is not None and request.normal_rotation_only:
            result = turned_behind(result, *(share * self._reach for share in stage.behind))
        scales = state.gaussians["log_scales"]
        step = Step(result, targets, shading, scales, self.current.extent, self.current.recipe.ssim_weight)
        loss = step_loss(step, stage.weights)
        loss.total.backward()
        gradient = statistic.gradient if statistic else None
        if counts and gradient is not None:
            self.whole = False
            state.statistics.add(gradient, result.training["radii"], camera.width, camera.height, slot)
        psnr = -10 * torch.log10(loss.error.clamp(min=1e-10))
        return torch.stack((loss.photometric.detach(), psnr, loss.total.detach()))

    def update_parameters(self) -> None:
        """Make a step of Adam with the learning rates of this step."""
        state = self.state
        rates = self.schedule.rates(state.step)
        rates["means"] *= self.current.extent
        if state.step < state.opacity_frozen_until:
            rates["opacity_logits"] = 0.0
        for name, rate in rates.items():
            state.gaussians.set_rate(name, rate * math.sqrt(self.settings.views_per_step))
        state.gaussians.step()
        if state.environment is not None:
            state.environment.step()

    def view_at(self, place: int) -> View:
        """Return the view at a place in the sequence of all views of the training.

        Every epoch visits every training view once, in a new order.
        """
        views = self.feed.views(self.state.step)
        epoch, place = divmod(place, len(views))
        order = torch.randperm(len(views), generator=seeded(self.settings.seed, 4, epoch))
        view = views[int(order[place])]
        exposures = self._exposures.get(view.name, view.exposures)
        return view if exposures == view.exposures else view.with_exposures(exposures)

    def set_exposures(self, exposures: Mapping[str, tuple[Exposure, ...]]) -> None:
        """Use other exposures of views, by name, from now on; their targets are computed again."""
        self._exposures.update(exposures)
        self.feed.forget(exposures)

    def saved_state(self) -> TrainingState:
        """Return the state for a checkpoint, with what all ranks have seen. Every rank calls it."""
        exchange_statistics(self.state, self.ranks)
        self.state.extra = {
            f"callback.{callback.name}.{key}": values
            for callback in self.callbacks
            for key, values in callback.state_dict().items()
        }
        return self.state

    def _lacks_priors(self) -> bool:
        """Return True if the views of this step need priors that no action has computed so far."""
        actions = self.position.actions
        if (
            not self.position.stage.weights.priors
            or self.state.frozen is not None
            or "refresh_priors" in actions
        ):
            return False
        views = self.settings.views_per_step
        first = self.state.step * views
        return any(self.view_at(first + slot).is_determined for slot in range(views))

    def _join_gradients(self, *, idle: bool) -> None:
        """Replace the gradients of this rank's views by the mean over the views of all ranks."""
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

    def _set_batch_betas(self) -> None:
        """Set the optimizers up for more than one view a step; see ``TrainSettings``."""
        views = self.settings.views_per_step
        if views == 1:
            return
        betas = (0.9**views, 0.999**views)
        self.state.gaussians.set_betas(betas)
        if self.state.environment is not None:
            self.state.environment.set_betas(betas)
            for name, rate in self.current.recipe.light_rates.items():
                self.state.environment.set_rate(name, rate * math.sqrt(views))


def requested_layers(stage: Stage, sh_degree: int, statistic: ScreenStatistic | None) -> RenderRequest:
    """Return the layers that a step of a stage needs."""
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


def _check_names(callbacks: Sequence[AnyCallback]) -> None:
    """Check that callbacks with a state have names by which a checkpoint can hold it."""
    names = [each.name for each in callbacks if type(each).state_dict is not Callback.state_dict]
    for name in names:
        if not name.isidentifier() or names.count(name) > 1:
            raise PolarguideError(
                "training",
                expected="a name of its own for each callback that has state_dict, made of letters, digits and _",
                found=repr(name),
                remedy="Set the attribute name of the callback.",
            )


def _check_known(what: str, names: Iterable[str], known: set[str]) -> None:
    """Check that the callbacks of a loop know all names."""
    strangers = sorted(set(names) - known)
    if strangers:
        raise PolarguideError(
            "training",
            expected=f"a {what} among {', '.join(sorted(known - {''}))}",
            found=strangers[0],
            remedy="Correct the name, or pass the callback that has it.",
        )
