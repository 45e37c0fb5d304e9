"""Memory plan of a training, computed from the headers of the picture files before a picture is decoded."""

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
# Estimates from the tensors of a training; one (24 steps, 1224 x 1024 x 60, 4 GB) took 12 % less.
# benchmarks/speed/memory.py measures them.
PROCESS = 250_000_000
"""Bytes that a training adds to the process for libraries and fragmentation of the allocator."""
STEP = 780
"""Bytes per pixel that a step needs for targets, G-buffer, layers, loss terms and gradients."""
PRIORS = 900
"""Bytes per pixel that the computation of a view's priors needs."""
PRIORS_KEPT = 44
"""Bytes per pixel of cached priors."""
SHOWN_KEPT = 8
"""Bytes per pixel of the cached photograph and its masks."""
UNGUIDED_KEPT = 13
"""Bytes per pixel of cached data that do not depend on the guide, see ``training.priors.Unguided``."""
COPIES = 5
"""Number of copies of a Gaussian's parameters in memory: values, gradients, two moments, and frozen values."""
WRITTEN = 4
"""Number of copies of a Gaussian's parameters in memory while a file is written."""
SPLAT = 600
"""Bytes per Gaussian of intermediate results of the rasterizer."""
FILLED = 0.88
"""Share of the memory limit that may be used. The rest is a margin for fragmentation."""


@dataclass(frozen=True)
class MemoryPlan:
    """Distribution of the memory of a training.

    Attributes:
        hold: True if all pictures stay in memory. Otherwise views decode their pictures again at each use.
        view_bytes: largest number of bytes of computed per-view data in memory. Data beyond it are stored in a file.
            None means no limit.
        peak: largest number of bytes that the process uses.
    """

    hold: bool
    view_bytes: int | None
    peak: int


def plan_memory(
    pixels: Sequence[int], recipe: Recipe, gaussians: int, *, limit: float | None, in_memory: bool = False
) -> MemoryPlan:
    """Divide memory among the steps, the Gaussians and the views of a training.

    Args:
        pixels: number of pixels of each view, after downscaling.
        recipe: the method.
        gaussians: largest number of Gaussians.
        limit: memory limit of the process in GiB. None means four fifths of the free memory.
        in_memory: True if the pictures are already in memory.

    Raises:
        PolarguideError: the specified limit is too small. The message contains the smallest sufficient limit.
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
    """Divide memory between a training and its views.

    Args:
        pixels: number of pixels of each view, after downscaling.
        own: bytes that the training needs apart from its views.
        of_view: bytes per pixel of the cached data of a view.
        limit, in_memory: arguments of ``plan_memory``.
        what: other data that need memory, for the message.
        less: additional remedy for the message.

    Raises:
        PolarguideError: the specified limit is too small.
    """
    largest = max(pixels, default=0)
    total = sum(pixels)
    resident = resident_memory()
    work = resident + own
    pictures = 0 if in_memory else (KEPT - MASKS) * total
    masks = 0 if in_memory else (MASKS - 3) * total
    # The decoded photograph of one view, and its targets.
    least = work + masks + (KEPT + of_view) * largest
    least = max(least, resident + PROCESS + MASKS * total + 4 * READ * largest)
    total_need = work + masks + pictures + of_view * total
    if limit is not None:
        allowed = int(limit * GIBIBYTE)
        if allowed < least:
            raise PolarguideError(
                "memory",
                expected=f"at least {in_gigabytes(least)} for pictures of this size{what}",
                found=in_gigabytes(allowed, up=False),
                remedy=f"Use --memory {in_gigabytes(least).replace(' ', '')}, {less}--downscale 2.",
            )
    else:
        allowed = resident + int(SHARE * free_memory())
    if total_need <= allowed:
        return MemoryPlan(True, None, total_need)
    filled = int(FILLED * allowed)
    hold = in_memory or (
        work + masks + pictures + of_view * largest <= filled and of_view * total <= pictures
    )
    room = filled - work - masks - (pictures if hold and not in_memory else KEPT * largest)
    return MemoryPlan(hold, max(0, room), max(least, min(allowed, total_need)))


def pixels_of(folder: Path, downscale: int) -> list[int]:
    """Return the number of pixels of each view of a scene after downscaling, from the headers of its files.

    Raises:
        PolarguideError: the folder is no scene.
    """
    layout = find_layout(folder)
    return [count // downscale**2 for count in stated_pixels(layout, select_views(layout, None))]


def in_gigabytes(count: int, *, up: bool = True) -> str:
    """Format a number of bytes as gigabytes with one decimal place.

    By default it is rounded up, so that a limit of the displayed size suffices.
    """
    tenths = count * 10 / GIGABYTE
    return f"{(math.ceil(tenths) if up else math.floor(tenths)) / 10:.1f} GB"
