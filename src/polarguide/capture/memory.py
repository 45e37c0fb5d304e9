"""How much memory the pictures of a scene take, from their headers alone, before any of them is decoded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from polarguide.capture.formats.pictures import stated_size
from polarguide.capture.layout import Layout
from polarguide.core.errors import PolarguideError
from polarguide.core.system import free_memory

GIBIBYTE = 1 << 30
SHARE = 0.8
"""Of the free memory, that the pictures may take where nothing else was asked for."""
# Bytes for each pixel of a view: peak, black, invalid, saturated, mask; with codes of four pictures in three channels.
MASKS = 2 + 4
KEPT = 4 * 3 * 2 + MASKS
# While one view is read: what is decoded of it, its copy in linear codes, and channels apart.
READ = 4 * 3 * 2 * 3


def check_memory(
    layout: Layout, names: Sequence[str], *, factor: int, at_once: int, limit: float | None, hold: bool = True
) -> None:
    """Refuse pictures that do not fit into memory.

    Args:
        layout: the files. names: views to be read, with all their angles.
        factor: side of the boxes over which they are averaged. at_once: views that are read at a time.
        limit: GiB that may be taken; None: 80 % of what is free. hold: whether the pictures stay in memory.

    Raises:
        PolarguideError: the least that suffices is more.
    """
    pixels = stated_pixels(layout, names)
    kept = sum((KEPT if hold else MASKS) * count // factor**2 for count in pixels)
    needed = kept + sum(READ * count for count in sorted(pixels, reverse=True)[:at_once])
    remedy = "Give --downscale 2 or more, fewer views, or more --memory."
    require_memory(layout.root, needed, f"{len(names)} views", limit=limit, remedy=remedy)


def require_memory_of_each(paths: Sequence[Path], pixel: int, what: str, *, remedy: str) -> None:
    """Refuse files that are worked on one after the other, where the largest does not fit into memory.

    Args:
        paths: of pictures and arrays whose headers state a size; others are passed over.
        pixel: bytes that one of their pixels takes, at least. what, remedy: for messages.

    Raises:
        PolarguideError: it does not.
    """
    sizes = {path: stated_size(path) or (0, 0) for path in paths}
    if sizes:
        path = max(sizes, key=lambda path: math.prod(sizes[path]))
        width, height = sizes[path]
        require_memory(path, pixel * width * height, f"{what} of {width}x{height}", remedy=remedy)


def require_memory(where: Path, needed: int, what: str, *, remedy: str, limit: float | None = None) -> None:
    """Refuse what takes more memory than there is.

    Args:
        where, what, remedy: for messages. needed: bytes, at least.
        limit: GiB that may be taken; None: 80 % of what is free.

    Raises:
        PolarguideError: that is less.
    """
    if limit is not None:
        allowed, whose = int(limit * GIBIBYTE), "as --memory allows"
    elif (free := free_memory()) is not None:
        allowed, whose = int(SHARE * free), f"{SHARE:.0%} of what is free"
    else:
        return
    if needed > allowed:
        raise PolarguideError(
            where,
            expected=f"pictures that take up to {allowed / GIBIBYTE:.1f} GiB, {whose}",
            found=f"{what} that take {needed / GIBIBYTE:.1f} GiB",
            remedy=remedy,
        )


def stated_pixels(layout: Layout, names: Sequence[str]) -> list[int]:
    """Pixels of the pictures of each view, as their headers state; 0 where they do not."""
    return [_largest(layout, name) for name in names]


def _largest(layout: Layout, name: str) -> int:
    """Pixels of the largest picture of a view, as the files state, with as much more for more than four pictures as
    these take; 0 where the files state nothing.
    """
    paths = layout.files(name)
    sizes = [stated_size(path) for path in paths]
    largest = max((size[0] * size[1] for size in sizes if size is not None), default=0)
    return max(largest, largest * len(paths) // 4)
