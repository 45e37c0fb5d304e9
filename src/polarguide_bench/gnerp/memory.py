"""The memory of a field's training, planned from the headers of the scene's files."""

from __future__ import annotations

from collections.abc import Sequence

from polarguide.runs.memory_plan import PROCESS, MemoryPlan, share_memory
from polarguide_bench.gnerp.recipe import NeuralRecipe

FIELD_COPIES = 5
"""Copies of the parameters of a field: values, gradients, two moments, and those in the file that is written."""
SAMPLE = 14_000
"""Bytes of a sample of a step."""
READ_VIEW = 60
"""Bytes of a pixel of the view of a step."""
TARGET_KEPT = 10
"""Bytes of a pixel of what is kept of each view."""


def plan_field_memory(
    pixels: Sequence[int], recipe: NeuralRecipe, *, limit: float | None, in_memory: bool = False
) -> MemoryPlan:
    """Share out memory between the step of a field's training and its views.

    Args:
        pixels: pixels of each view as it is trained on. recipe: the method.
        limit: GiB that the process may take; None: four fifths of what is free.
        in_memory: whether the pictures are in memory already.

    Raises:
        PolarguideError: a limit that was given is too small.
    """
    largest = max(pixels, default=0)
    own = PROCESS + 4 * recipe.numbers * FIELD_COPIES + SAMPLE * recipe.sampling.samples + READ_VIEW * largest
    return share_memory(pixels, own, TARGET_KEPT, limit, in_memory, "", "")
