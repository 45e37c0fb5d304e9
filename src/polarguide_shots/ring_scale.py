"""Printable scale with the angles of a polarizing filter, to put around its ring."""

from __future__ import annotations

import math

from jinja2 import Environment, PackageLoader

BAND = 16.0
"""Width of the paper ring in mm."""
MARGIN = 6.0
"""Margin around the ring in mm."""
LABELED = 15
"""Degrees between two numbers on the scale."""
SHORT = 5
"""Degrees between two lines on the scale."""
RULER = 50.0
"""Length in mm of the printed ruler, which shows if the print has the right size."""
_FOOT = 22.0
_SLIT = 277.5


def ring_scale(diameter: float) -> str:
    """Return an SVG picture of a paper ring with the angles of a filter, in millimeters.

    Seen from behind the camera, angles count counter-clockwise from the camera's horizontal. The scale is read from the
    front, where the angles count clockwise from the left. The period is 180 degrees, so each angle is on the ring
    twice.

    Args:
        diameter: diameter of the hole in mm, which is the outer diameter of the filter's rotating ring.
    """
    inner = diameter / 2
    outer = inner + BAND
    middle = outer + MARGIN
    width = 2 * middle
    marks = []
    for angle in range(0, 360, SHORT):
        label = None
        if angle % LABELED == 0:
            x, y = place(angle, middle, inner + 7.6)
            # Digits are upright as seen from outside of the ring.
            label = {"x": x, "y": y, "turn": angle - 90, "text": angle % 180}
        length = 3.0 if label is None else 5.0
        marks.append((place(angle, middle, inner), place(angle, middle, inner + length), label))
    pages = Environment(
        loader=PackageLoader("polarguide_shots", "page"),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return pages.get_template("ring.svg").render(
        mm="{:.3f}".format,
        hole=f"{diameter:g}",
        width=width,
        height=width + _FOOT,
        middle=middle,
        radii=(inner, outer),
        marks=marks,
        top=middle - inner - BAND + 1.0,
        slit=(place(_SLIT, middle, inner), place(_SLIT, middle, outer)),
        foot=width + 2.0,
        left=middle - RULER / 2,
        ruler=RULER,
    )


def place(degrees: float, middle: float, radius: float) -> tuple[float, float]:
    """Return the position (x right, y down) of an angle on the print.

    0 degrees is at the left, 90 degrees at the top, and angles increase clockwise.
    """
    turn = math.radians(degrees)
    return middle - radius * math.cos(turn), middle - radius * math.sin(turn)
