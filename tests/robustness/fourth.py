"""More of the corpus, by a fourth tester: names, places to write, descriptions of scenes, what is torn away."""

from __future__ import annotations

from collections.abc import Iterator

import fourth_names
import fourth_places
import fourth_shots
import fourth_synth
from making import MadeCase

MAKERS = (
    fourth_names.name_cases, fourth_names.environment_cases, fourth_names.limit_cases,
    fourth_places.place_cases, fourth_places.checkpoint_cases,
    fourth_shots.shot_cases, fourth_shots.watch_cases,
    fourth_synth.description_cases, fourth_synth.mesh_cases, fourth_synth.option_cases,
)  # fmt: skip
SHARE_OF_OTHERS = 4
"""One of so many is always run, all cases by ``make fuzz``; those that render or train take seconds each."""
SLOW = ("synth", "eval")


def fourth_cases(*, every: bool) -> Iterator[MadeCase]:
    """All cases, or those that are always run."""
    for number, case in enumerate(case for make in MAKERS for case in make()):
        slow = case.command in SLOW and bool(case.accepted)
        if every or (number % SHARE_OF_OTHERS == 0 and not slow):
            yield case
