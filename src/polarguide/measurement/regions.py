"""Regions of interest: rectangles of a picture, by name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from polarguide.errors import PolarguideError
from polarguide.records import shortened

WHOLE = "all"
"""The region that is measured where none is given."""
_FORM = re.compile(r"(?:(?P<name>[^=]*)=)?(?P<numbers>-?[0-9]{1,9}(?:,-?[0-9]{1,9}){3})")
_LONGEST_NAME = 64
_MOST = 1_000_000


@dataclass(frozen=True)
class Region:
    """A rectangle of pixels, its top-left corner included, ``x + width`` and ``y + height`` not."""

    name: str
    x: int
    y: int
    width: int
    height: int

    @property
    def rows(self) -> slice:
        """Its rows."""
        return slice(self.y, self.y + self.height)

    @property
    def columns(self) -> slice:
        """Its columns."""
        return slice(self.x, self.x + self.width)


def parse_regions(texts: Sequence[str]) -> tuple[Region, ...]:
    """Regions as the command line states them: ``x,y,width,height`` or ``name=x,y,width,height``.

    Those without a name are called roi1, roi2, ... by their place among all.

    Raises:
        PolarguideError: one has another form or no pixel, or two have one name.
    """
    found: dict[str, Region] = {}
    for number, text in enumerate(texts, 1):
        region = _parse(text, number)
        if region.name in found:
            raise PolarguideError(
                "--roi",
                expected="one region of each name",
                found=f"{region.name} twice",
                remedy="Rename one of them.",
            )
        found[region.name] = region
    return tuple(found.values())


def _parse(text: str, number: int) -> Region:
    match = _FORM.fullmatch(text.strip())
    if match is None:
        raise _wrong("x,y,width,height or name=x,y,width,height in whole pixels", shortened(text))
    name = f"roi{number}" if match["name"] is None else match["name"].strip()
    if not name or len(name) > _LONGEST_NAME or not name.isprintable():
        raise _wrong(f"a name of 1 to {_LONGEST_NAME} printable characters", repr(name))
    x, y, width, height = (int(part) for part in match["numbers"].split(","))
    if min(x, y) < 0 or min(width, height) < 1 or max(x, y, width, height) > _MOST:
        raise _wrong("x and y of 0 or more, width and height of 1 or more", repr(text))
    return Region(name, x, y, width, height)


def _wrong(expected: str, found: str) -> PolarguideError:
    return PolarguideError(
        "--roi",
        expected=expected,
        found=found if len(found) <= 100 else f"{found[:100]}...",
        remedy="Correct the region.",
    )


def placed(regions: Sequence[Region], size: tuple[int, int], where: Path) -> tuple[Region, ...]:
    """The regions of a picture of this width and height; the whole picture where there are none.

    Raises:
        PolarguideError: one reaches beyond the picture.
    """
    width, height = size
    for region in regions:
        if region.x + region.width > width or region.y + region.height > height:
            raise PolarguideError(
                where,
                expected=f"the region {region.name} within {width}x{height} pixels",
                found=f"{region.x},{region.y},{region.width},{region.height}",
                remedy="Correct --roi; it counts pixels of the developed picture.",
            )
    return tuple(regions) or (Region(WHOLE, 0, 0, width, height),)
