"""The possible orders of the four pictures, and their effect on the angle of polarization.

The pair sums decide which pictures are perpendicular to each other (three pairings). Within a pairing eight orders
remain, the symmetries of a square: a picture named L degrees was taken at ``sense * L + zero``, with a sense of +1 or
-1 and a zero of 0, 45, 90 or 135 degrees. The measured AoLP transforms the same way.
"""

from __future__ import annotations

from dataclasses import dataclass

from polarguide.capture.view import ANGLES

FileOrder = tuple[int, int, int, int]

PAIRINGS: tuple[FileOrder, ...] = ((0, 45, 90, 135), (0, 90, 45, 135), (0, 45, 135, 90))
"""One order for each way to pair the pictures, in the order of ``capture.checks.Measures.residuals``."""
SENSES = (1, -1)
ZEROS = (0, 45, 90, 135)


@dataclass(frozen=True)
class Order:
    """One of the eight orders within a pairing.

    Attributes:
        sense: +1 if the angles increase counter-clockwise as displayed, -1 if clockwise.
        zero: direction of their zero, degrees counter-clockwise from the image's horizontal.
    """

    sense: int
    zero: int

    def files(self, pairing: FileOrder = ANGLES) -> FileOrder:
        """The true angles of the pictures named 0, 45, 90 and 135."""
        first, second, third, fourth = ((self.sense * angle + self.zero) % 180 for angle in pairing)
        return first, second, third, fourth

    @property
    def label(self) -> str:
        """Sense and zero in words."""
        return f"{'counter-clockwise' if self.sense > 0 else 'clockwise'}, zero at {self.zero}°"


ORDERS: tuple[Order, ...] = tuple(Order(sense, zero) for sense in SENSES for zero in ZEROS)
"""All eight orders; the first is the identity."""
IDENTITY = ORDERS[0]


def swaps(files: FileOrder) -> str:
    """A description of wrong file names: "the picture named 45° was taken at 135°, ..."."""
    moved = [(name, true) for name, true in zip(ANGLES, files, strict=True) if name != true]
    if not moved:
        return "nothing"
    return ", ".join(f"the picture named {name}° was taken at {true}°" for name, true in moved)
