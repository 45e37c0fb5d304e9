"""The training loop: schedule, targets, render, loss, step. Everything else is a callback.

The loop contains no constant of a method. All data that a step reads are copied to the device in advance. A step
without actions therefore copies nothing to the device and does not wait for it.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from polarguide.gaussians.initialize import stretch_steps
from polarguide.raster import ScreenStatistic
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.shading.model import PLAIN
from polarguide.shading.result import COLOR_CHANNELS
from polarguide.training.behind import fade_behind
from polarguide.training.callback import AnyCallback, Loop, check_known, stateful
from polarguide.training.context import TrainingContext, TrainingState, first_state
from polarguide.training.feed import Feed
from polarguide.training.losses import step_loss
from polarguide.training.recipe import Schedule, Stage
from polarguide.training.targets import Step


class TrainingLoop(Loop):
    """Loop that trains the Gaussians of one recipe on one scene.

    Args:
        context: context of the training.
        callbacks: callbacks that run between steps; see ``training.callbacks.method_callbacks``.
        state: state to resume from, on the device of the backend. None starts from the beginning.
        first: context of the first schedule, such as a search for angles. With None, this is ``context``.

    Attributes:
        current: context of the current schedule: a search for angles, or ``context``.
        schedule: stages of the current schedule.
        feed: targets of the current schedule.
        position: stage and actions of this step.
        rates: learning rates of this step by name.
    """

    state: TrainingState

    def __init__(
        self,
        context: TrainingContext,
        callbacks: Sequence[AnyCallback],
        state: TrainingState | None = None,
        first: TrainingContext | None = None,
    ) -> None:
        super().__init__(context.settings, callbacks)
        self.context = context
        self.begin(first or context, state)

    def begin(self, context: TrainingContext, state: TrainingState | None) -> None:
        """Begin a schedule, or resume it from a state.

        Raises:
            PolarguideError: no callback performs an action of the recipe, no callback holds a tensor of the state, or a
                callback with a state has no unique name.
        """
        holders = stateful(self.callbacks)
        check_known("action", context.recipe.actions, {each.action for each in self.callbacks})
        self.current = context
        self.schedule = Schedule(context.recipe, context.settings.steps)
        self.feed = Feed(context)
        self.state = state or first_state(context)
        stored = self.state.further_callbacks()
        check_known("callback of the checkpoint", stored, {each.name for each in self.callbacks})
        self._enter_step()
        for callback in self.callbacks:
            callback.begin(self)
            if callback in holders:
                self.state.attach(callback)

    def prepare(self) -> None:
        """Run the callbacks and actions that are due before a step."""
        self._enter_step()
        for callback in self.callbacks:
            callback.before_step(self, self.position)  # may begin another schedule, or add an action
        self.whole = not self.position.actions
        for action in self.position.actions:
            for callback in self.callbacks:
                if callback.action == action:
                    callback.act(self)

    def optimize(self) -> tuple[Tensor, str, int]:
        """Render the view of a step, and change the parameters by its gradient."""
        measured = self.backpropagate()
        self.whole = False
        self.update_parameters()
        return measured, self.position.stage.name, len(self.state.gaussians)

    def backpropagate(self) -> Tensor:
        """Render the view of a step and add its gradients.

        Returns:
            ``StepReport.measured``.
        """
        context = self.current
        state = self.state
        stage = self.position.stage
        shading = context.shading if stage.reflection else PLAIN
        view = self.feed.view_at(state.step)
        # Targets come first, since their computation and the rendering both need memory.
        targets = self.feed.targets(state.step, view, stage.weights)
        statistic = ScreenStatistic(COLOR_CHANNELS) if stage.densify else None
        request = requested_layers(stage, self.schedule.sh_degree(state.step), statistic)
        rasterize = context.backend.rasterize
        result = render(
            state.gaussians, targets.camera, rasterize, request, shading=shading, light=state.light
        )
        if stage.behind is not None and request.normal_rotation_only:
            result = fade_behind(result, *(share * context.reach for share in stage.behind))
        ssim_weight = context.recipe.ssim_weight
        step = Step(result, targets, shading, state.gaussians, context.extent, ssim_weight, statistic)
        loss = step_loss(step, stage.weights)
        loss.total.backward()
        for callback in self.callbacks:
            callback.after_backward(self, step)
        return loss.measured()

    def update_parameters(self) -> None:
        """Update all parameters by Adam, with the learning rates of this step."""
        for name, rate in self.rates.items():
            self.state.gaussians.set_rate(name, rate)
        means = self.state.gaussians["means"].detach()
        before = means.clone()
        for optimized in self.state.optimized:
            optimized.step()
        stretch_steps(means, before, self.current.middle, self.current.reach)

    def _enter_step(self) -> None:
        """Look up the position and the learning rates of the next step."""
        step = self.state.step
        self.position = self.schedule.at(step)
        self.rates = self.schedule.rates(step)
        self.rates["means"] *= self.current.extent


def requested_layers(stage: Stage, sh_degree: int, statistic: ScreenStatistic | None) -> RenderRequest:
    """Return the layers that a step of a stage has to render."""
    layers = stage.weights.rendered
    fades = stage.behind is not None and "normal" in layers
    return RenderRequest(
        sh_degree=sh_degree,
        normals="normal" in layers,
        depth="depth" in layers or fades,
        layers_detached=stage.reflection and stage.hold_normals and "layers" in layers,
        normal_rotation_only=fades,
        statistic=statistic,
    )
