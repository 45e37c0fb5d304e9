"""A recipe's stages laid over a number of steps: which stage a step belongs to, and what is due before it."""

from __future__ import annotations

from dataclasses import dataclass

from polarguide.training.recipe import Action, Recipe, Repeat, Stage


@dataclass(frozen=True)
class Position:
    """Where a step lies: its stage, and which actions are due before it.

    Attributes:
        stage: the stage.
        actions: due now, in order.
    """

    stage: Stage
    actions: tuple[Action, ...]


class Schedule:
    """The stages of a recipe laid over a number of steps.

    In a training so short that a stage has no step, its ``on_enter`` happens with that of the next one; the last stage
    always has a step.
    """

    def __init__(self, recipe: Recipe, steps: int) -> None:
        self.recipe = recipe
        self.steps = steps
        self._starts: list[int] = []
        share = 0.0
        for stage in recipe.stages:
            self._starts.append(min(round(share * steps), steps - 1))
            share += stage.fraction
        ends = (*self._starts[1:], steps)
        self._turns = [
            stage.rounds.turns(end - start, steps) if stage.rounds else {}
            for stage, start, end in zip(recipe.stages, self._starts, ends, strict=True)
        ]

    def at(self, step: int) -> Position:
        """The stage of a step (0-based) and the actions due before it."""
        index = max(i for i, start in enumerate(self._starts) if start <= step)
        stage, since = self.recipe.stages[index], step - self._starts[index]
        if since == 0:
            begun = zip(self.recipe.stages, self._starts, strict=True)
            entered = (action for each, start in begun if start == step for action in each.on_enter)
            return Position(stage, tuple(dict.fromkeys(entered)))
        due = [r.action for r in stage.repeats if since % self.period(r) == 0]
        turn = self._turns[index].get(since)
        return Position(stage, (turn, *due) if turn else tuple(due))

    def period(self, repeat: Repeat) -> int:
        """Steps between two occurrences."""
        return max(repeat.minimum, round(repeat.fraction * self.steps))

    def sh_degree(self, step: int) -> int:
        """SH degree in use at a step."""
        return sum(step >= f * self.steps for f in self.recipe.sh_fractions)

    def rates(self, step: int) -> dict[str, float]:
        """Learning rates at a step by name; that of the means is before the scene's extent."""
        factors = self.at(step).stage.rate_factors
        rates = {name: rate * factors.get(name, 1.0) for name, rate in self.recipe.learning_rates.items()}
        rates["means"] *= self.recipe.means_decay ** (step / max(1, self.steps - 1))
        return rates
