"""The memory of a training, planned from the headers of its files before a picture is decoded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from polarguide.capture.layout import (
    GIBIBYTE,
    KEPT,
    MASKS,
    READ,
    SHARE,
    find_layout,
    select_views,
    stated_pixels,
)
from polarguide.core.errors import PolarguideError
from polarguide.core.system import free_memory, resident_memory
from polarguide.training.recipe import Recipe

GIGABYTE = 10**9
# Estimates by the tensors that there are: one training (24 steps, 1224 x 1024 x 60, 4 GB) took 12 % less than they say.
# benchmarks/speed/memory.py measures.
PROCESS = 250_000_000
"""Bytes that a process takes beside what it holds before training: of libraries, and what the allocator splits."""
STEP = 780
"""Bytes a pixel of a step: targets, G-buffer, layers, terms, and their gradients."""
PRIORS = 900
"""Bytes a pixel while the priors of a view are computed."""
PRIORS_KEPT = 44
"""Bytes that are kept of a pixel for targets from priors."""
SHOWN_KEPT = 8
"""Bytes that are kept of a pixel for the photograph and its masks."""
UNGUIDED_KEPT = 13
"""Bytes that are kept of a pixel for targets that need no guide."""
COPIES = 5
"""Copies of a Gaussian's parameters in memory: values, gradients, two moments, frozen values."""
WRITTEN = 4
"""Copies of a Gaussian's parameters in the written file."""
SPLAT = 600
"""Bytes a Gaussian of what a rasterizer makes of it."""
FILLED = 0.88
"""Share of a limit up to which views are kept in memory; the rest is for gaps between what is used."""


@dataclass(frozen=True)
class MemoryPlan:
    """How a training stays within its memory.

    Attributes:
        hold: whether the pictures stay in memory; otherwise views decode theirs again.
        view_bytes: of what is computed of the views and stays in memory, the rest lies in a file; None: all stays.
        peak: bytes that the process takes at most.
    """

    hold: bool
    view_bytes: int | None
    peak: int


def plan_memory(
    pixels: Sequence[int], recipe: Recipe, gaussians: int, *, limit: float | None, in_memory: bool = False
) -> MemoryPlan:
    """Share out memory among a training's step, its Gaussians and its views.

    Args:
        pixels: pixels of each view as it is trained on. recipe: the method. gaussians: most that there may be.
        limit: GiB that the process may take; None: what is free, but a fifth.
        in_memory: whether the pictures are in memory already.

    Raises:
        PolarguideError: a limit that was given is too small; the message has the least that suffices.
    """
    largest = max(pixels, default=0)
    floats = sum(math.prod(shape) for shape in recipe.shapes.values())
    guided = any(stage.weights.priors for stage in recipe.stages)
    of_view = SHOWN_KEPT + (PRIORS_KEPT + UNGUIDED_KEPT if guided else 0)
    step = (max(STEP, PRIORS) if guided else STEP) * largest + SPLAT * gaussians
    own = PROCESS + 4 * floats * COPIES * gaussians + max(step, 4 * floats * WRITTEN * gaussians)
    what = f" and up to {gaussians:,} Gaussians"
    return share_memory(pixels, own, of_view, limit, in_memory, what, "fewer --gaussians, or ")


def share_memory(
    pixels: Sequence[int], own: int, of_view: int, limit: float | None, in_memory: bool, what: str, less: str
) -> MemoryPlan:
    """Share out memory between a training and its views.

    Args:
        pixels: pixels of each view as it is trained on.
        own: bytes that the training takes beside its views. of_view: bytes that it keeps of a pixel of a view.
        limit, in_memory: as for ``plan_memory``.
        what: for the message: needs beside the pictures. less: another remedy.

    Raises:
        PolarguideError: a limit that was given is too small.
    """
    largest = max(pixels, default=0)
    total = sum(pixels)
    now = resident_memory()
    work = now + own
    pictures = 0 if in_memory else (KEPT - MASKS) * total
    masks = 0 if in_memory else (MASKS - 3) * total
    # The photograph of one view, decoded again, and its targets.
    least = work + masks + (KEPT + of_view) * largest
    least = max(least, now + PROCESS + MASKS * total + 4 * READ * largest)
    whole = work + masks + pictures + of_view * total
    if limit is not None:
        allowed = int(limit * GIBIBYTE)
        if allowed < least:
            raise too_little(least, allowed, what, less)
    else:
        allowed = now + int(SHARE * free_memory())
    if whole <= allowed:
        return MemoryPlan(True, None, whole)
    filled = int(FILLED * allowed)
    hold = in_memory or (
        work + masks + pictures + of_view * largest <= filled and of_view * total <= pictures
    )
    room = filled - work - masks - (pictures if hold and not in_memory else KEPT * largest)
    return MemoryPlan(hold, max(0, room), max(least, min(allowed, whole)))


def pixels_of(folder: Path, downscale: int) -> list[int]:
    """Pixels of each view of a scene at the size that is trained on, as the headers of its files state.

    Raises:
        PolarguideError: the folder is no scene.
    """
    layout = find_layout(folder)
    return [count // downscale**2 for count in stated_pixels(layout, select_views(layout, None))]


def too_little(least: int, allowed: int, what: str, less: str) -> PolarguideError:
    """The error that a limit is too small for pictures and ``what``; ``less`` helps, too."""
    return PolarguideError(
        "memory",
        expected=f"at least {in_gigabytes(least)} for pictures of this size{what}",
        found=in_gigabytes(allowed, up=False),
        remedy=f"Give --memory {in_gigabytes(least).replace(' ', '')}, {less}--downscale 2.",
    )


def in_gigabytes(count: int, *, up: bool = True) -> str:
    """Bytes as gigabytes with one digit, rounded up, so that the stated number suffices."""
    tenths = count * 10 / GIGABYTE
    return f"{(math.ceil(tenths) if up else math.floor(tenths)) / 10:.1f} GB"
