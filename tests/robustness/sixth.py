"""More of the corpus, by a sixth tester, who knew the documentation alone: what some thousand mutations showed."""

from __future__ import annotations

from collections.abc import Iterator

import sixth_places
import sixth_scenes
from making import MadeCase

MAKERS = (
    sixth_scenes.record_cases, sixth_scenes.table_cases, sixth_scenes.model_cases, sixth_scenes.picture_cases,
    sixth_scenes.truth_cases, sixth_scenes.checkpoint_cases,
    sixth_places.link_cases, sixth_places.pipe_cases, sixth_places.option_cases, sixth_places.variable_cases,
)  # fmt: skip


def sixth_cases() -> Iterator[MadeCase]:
    """All cases: most of them ended otherwise than they should before what they showed was mended."""
    for make in MAKERS:
        yield from make()
