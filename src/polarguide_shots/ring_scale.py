"""A printable scale of polarizer angles, to be put around a filter's ring and read from the front."""

from __future__ import annotations

import math

from jinja2 import Environment, PackageLoader

BAND = 16.0
"""Width of the paper ring in mm."""
MARGIN = 6.0
LABELED = 15
"""Degrees between numbers."""
SHORT = 5
"""Degrees between lines."""
RULER = 50.0
_FOOT = 22.0
_SLIT = 277.5


def ring_scale(diameter: float) -> str:
    """An SVG picture, sized in millimeters: a paper ring with the angles of a filter inside it.

    Angles count counter-clockwise as seen from behind the camera, from its horizontal. Seen from the front, where one
    reads the scale, they count clockwise, from the left; 0 and 180 are the same angle, so that the ring has each twice.

    Args:
        diameter: diameter of the hole, the outer diameter of the filter's turning ring, in mm.
    """
    inner = diameter / 2
    outer = inner + BAND
    width = 2 * (outer + MARGIN)
    middle = width / 2
    marks = []
    for angle in range(0, 360, SHORT):
        label = None
        if angle % LABELED == 0:
            x, y = place(angle, middle, inner + 7.6)
            # Digits stand on the ring, so that they are upright where one looks at them from outside it.
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
    """Where an angle stands on the print: 0 at the left, 90 at the top, clockwise; x right, y down."""
    turn = math.radians(degrees)
    return middle - radius * math.cos(turn), middle - radius * math.sin(turn)
