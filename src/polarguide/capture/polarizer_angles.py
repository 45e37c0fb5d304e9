"""The polarizer angle of one photograph: a number of degrees, unknown, or none where there was no filter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

from polarguide.capture.calibration import Calibration
from polarguide.text import decimal

Angle = float | Literal["unknown", "none"]
"""Degrees counter-clockwise from the picture's horizontal, modulo 180; or a word."""
LARGEST = 3600.0
"""Degrees; farther, a number says less and less about an angle."""


def parse_angle(text: str) -> Angle | None:
    """The angle that a text states; None where it states none."""
    word = text.strip().lower()
    if word == "unknown":
        return "unknown"
    if word == "none":
        return "none"
    try:
        number = decimal(word)
    except ValueError:
        return None
    return number if math.isfinite(number) and abs(number) <= LARGEST else None


def turned(angle: Angle, calibration: Calibration) -> Angle:
    """The angle after sense and zero of a calibration: ``sense * angle + zero``, from 0 to below 180 degrees."""
    if isinstance(angle, str):
        return angle
    sign = -1 if calibration.sense == "cw" else 1
    return round(sign * angle + calibration.zero, 6) % 180.0


def angle_text(angle: Angle) -> str:
    """An angle as tables state it."""
    return angle if isinstance(angle, str) else f"{angle:.10g}"


def angle_labels(angles: Sequence[Angle]) -> list[str]:
    """What tells the pictures of a view apart in their names: 045, 012.5, unknown, none, unknown-2, ..."""
    found: list[str] = []
    for angle in angles:
        label = angle if isinstance(angle, str) else _number(angle)
        same = sum(other == label or other.startswith(f"{label}-") for other in found)
        found.append(label if not same else f"{label}-{same + 1}")
    return found


def _number(angle: float) -> str:
    whole, _, rest = f"{angle % 180:.2f}".rstrip("0").rstrip(".").partition(".")
    return whole.zfill(3) + (f".{rest}" if rest else "")
