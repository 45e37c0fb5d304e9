"""Base class of everything that happens between the steps of a training."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Generic, TypeVar

from torch import Tensor

from polarguide.training.recipe import Position
from polarguide.training.settings import StepReport

LoopKind = TypeVar("LoopKind", contravariant=True)
"""Kind of the loop whose steps a callback accompanies."""


class Callback(Generic[LoopKind]):
    """Does something between the steps of a training; every method of this class does nothing.

    Attributes:
        name: prefix of its tensors in a checkpoint, an identifier; unique among the callbacks that have a state.
        action: name in ``Stage.on_enter``, ``Repeat`` and ``Rounds`` of a recipe that makes ``act`` due.
    """

    name = ""
    action = ""

    def begin(self, loop: LoopKind) -> None:
        """Set up for the loop, before its first step and whenever it begins again."""

    def before_step(self, loop: LoopKind, position: Position) -> None:
        """Run before a step, and before the actions that are due."""

    def act(self, loop: LoopKind) -> None:
        """Run where the recipe names ``action``. Callbacks of one action follow each other in their order."""

    def after_step(self, loop: LoopKind, report: StepReport) -> None:
        """Run after a step; ``loop.state.step`` is the number of finished steps."""

    def at_end(self, loop: LoopKind) -> None:
        """Run after the last step."""

    def state_dict(self) -> dict[str, Tensor]:
        """Return the tensors that a resumed training needs."""
        return {}

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore what ``state_dict`` returned."""


AnyCallback = Callback[Any]
