"""Callbacks, which run between the steps of a training, and the loop that calls them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Generic, TypeVar

from torch import Tensor

from polarguide.core.errors import PolarguideError
from polarguide.training.context import SavedState
from polarguide.training.recipe import Position
from polarguide.training.settings import ResolvedSettings, StepReport
from polarguide.training.targets import Step

LoopKind = TypeVar("LoopKind", contravariant=True)
"""Type of the loop for which a callback runs."""


class Callback(Generic[LoopKind]):
    """Base class of callbacks, which run between the steps of a training. The methods of this class do nothing.

    Attributes:
        name: identifier that names the tensors of the callback in a checkpoint. It must be unique among the callbacks
            with a state.
        action: name of an action. ``act`` runs where ``Stage.on_enter``, ``Repeat`` or ``Rounds`` of a recipe contain
            this name.
    """

    name = ""
    action = ""

    @property
    def prefix(self) -> str:
        """Prefix of the names of the callback's tensors in a checkpoint."""
        return f"callback.{self.name}."

    def begin(self, loop: LoopKind) -> None:
        """Set up for the loop, before its first step and whenever it begins again."""

    def before_step(self, loop: LoopKind, position: Position) -> None:
        """Run before a step, and before the actions that are due."""

    def act(self, loop: LoopKind) -> None:
        """Perform the action. Several callbacks with the same action run in the order of the callbacks."""

    def after_backward(self, loop: LoopKind, step: Step) -> None:
        """Run after the gradients of a step have been computed."""

    def after_step(self, loop: LoopKind, report: StepReport) -> None:
        """Run after a step; ``loop.state.step`` is the number of finished steps."""

    def at_end(self, loop: LoopKind) -> None:
        """Run after the last step."""

    def state_dict(self) -> dict[str, Tensor]:
        """Return the tensors that a resumed training needs."""
        return {}

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore the tensors that ``state_dict`` returned."""


AnyCallback = Callback[Any]


class Loop(ABC):
    """Base class of training loops: it runs steps, and callbacks between them.

    Attributes:
        settings: settings of the training.
        callbacks: callbacks in the order of their calls.
        observers: callbacks that run after all other callbacks, when the step is complete. They do not change the
            state.
        state: state between two steps.
        whole: False during a change of the state that an exception would leave incomplete.
        total: number of steps of all schedules.
        offset: number of steps before the current schedule began.
    """

    state: SavedState

    def __init__(self, settings: ResolvedSettings, callbacks: Sequence[AnyCallback]) -> None:
        self.settings = settings
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
        """Run the work that is due before a step."""

    @abstractmethod
    def optimize(self) -> tuple[Tensor, str, int | None]:
        """Update the parameters once.

        Returns:
            A tuple of ``StepReport.measured``, the name of the stage, and the number of Gaussians.
        """


def stateful(callbacks: Iterable[AnyCallback]) -> list[AnyCallback]:
    """Return the callbacks that have a state.

    Raises:
        PolarguideError: a callback has no unique name for its tensors in a checkpoint.
    """
    holders = [each for each in callbacks if type(each).state_dict is not Callback.state_dict]
    names = [each.name for each in holders]
    for name in names:
        if not name.isidentifier() or names.count(name) > 1:
            raise PolarguideError(
                "training",
                expected="a name of its own for each callback that has state_dict, made of letters, digits and _",
                found=repr(name),
                remedy="Set the attribute name of the callback.",
            )
    return holders


def check_known(kind: str, names: Iterable[str], known: set[str]) -> None:
    """Check that the callbacks of a loop define all given names, such as the actions of a recipe.

    Raises:
        PolarguideError: one name is unknown.
    """
    unknown = sorted(set(names) - known)
    if unknown:
        raise PolarguideError(
            "training",
            expected=f"a {kind} among {', '.join(sorted(known - {''}))}",
            found=unknown[0],
            remedy="Correct the name, or pass the callback that has it.",
        )
