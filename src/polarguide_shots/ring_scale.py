"""A printable scale of polarizer angles, to be put around a filter's ring and read from the front."""

from __future__ import annotations

import math

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
_INK = 'stroke="black" stroke-width="0.25" fill="none"'


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
    height = width + _FOOT
    middle = width / 2
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.3f}mm" height="{height:.3f}mm" '
        f'viewBox="0 0 {width:.3f} {height:.3f}" font-family="Helvetica, Arial, sans-serif">',
        f"<title>Polarizer angles, read from the front; hole of {diameter:g} mm</title>",
        f'<rect width="{width:.3f}" height="{height:.3f}" fill="white"/>',
        *(f'<circle cx="{middle:.3f}" cy="{middle:.3f}" r="{r:.3f}" {_INK}/>' for r in (inner, outer)),
    ]
    for step in range(0, 360, SHORT):
        parts += _mark(step, middle, inner)
    parts += [*_top(middle, inner), *_foot(middle, width, diameter), "</svg>"]
    return "\n".join(parts) + "\n"


def place(degrees: float, middle: float, radius: float) -> tuple[float, float]:
    """Where an angle stands on the print: 0 at the left, 90 at the top, clockwise; x right, y down."""
    turn = math.radians(degrees)
    return middle - radius * math.cos(turn), middle - radius * math.sin(turn)


def _mark(step: int, middle: float, inner: float) -> list[str]:
    """A line from the hole outward, and its number where it has one."""
    long = step % LABELED == 0
    x1, y1 = place(step, middle, inner)
    x2, y2 = place(step, middle, inner + (5.0 if long else 3.0))
    line = f'<line x1="{x1:.3f}" y1="{y1:.3f}" x2="{x2:.3f}" y2="{y2:.3f}" {_INK}/>'
    if not long:
        return [line]
    x, y = place(step, middle, inner + 7.6)
    # Digits stand on the ring, so that they are upright where one looks at them from outside it.
    turn = step - 90
    return [
        line,
        f'<text x="{x:.3f}" y="{y:.3f}" font-size="3.4" text-anchor="middle" dominant-baseline="central" '
        f'transform="rotate({turn} {x:.3f} {y:.3f})">{step % 180}</text>',
    ]


def _top(middle: float, inner: float) -> list[str]:
    """Marks at the top, an arrow, and at the bottom, a slit to open the ring."""
    y = middle - inner - BAND + 1.0
    (x1, y1), (x2, y2) = (place(_SLIT, middle, radius) for radius in (inner, inner + BAND))
    return [
        f'<path d="M {middle:.3f} {y:.3f} l 1.6 2.6 h -3.2 z" fill="black"/>',
        f'<text x="{middle + 3:.3f}" y="{y + 2.4:.3f}" font-size="2.8">up</text>',
        f'<line x1="{x1:.3f}" y1="{y1:.3f}" x2="{x2:.3f}" y2="{y2:.3f}" {_INK} stroke-dasharray="1.2 0.8"/>',
    ]


def _foot(middle: float, width: float, diameter: float) -> list[str]:
    """A ruler that shows whether the print has the right size, and what to do."""
    y = width + 2.0
    left = middle - RULER / 2
    ticks = [
        f'<line x1="{left + x:.3f}" y1="{y - 1.5:.3f}" x2="{left + x:.3f}" y2="{y + 1.5:.3f}" {_INK}/>'
        for x in (0.0, RULER)
    ]
    text_lines = (
        f"{RULER:g} mm: print at 100 %. Hole {diameter:g} mm.",
        "Fix it to the lens behind the filter's ring, arrow up. Read it",
        "from the front, at a mark on the ring where its axis ends.",
    )
    lines = [
        f'<text x="{middle:.3f}" y="{y + 5 + 4 * k:.3f}" font-size="2.8" text-anchor="middle">{text}</text>'
        for k, text in enumerate(text_lines)
    ]
    return [
        f'<line x1="{left:.3f}" y1="{y:.3f}" x2="{left + RULER:.3f}" y2="{y:.3f}" {_INK}/>',
        *ticks,
        *lines,
    ]
