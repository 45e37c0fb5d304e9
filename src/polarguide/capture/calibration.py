"""Deviations of a polarization camera or filter from an ideal one: gains, and order, sense and zero of its angles."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from polarguide.core.errors import require
from polarguide.core.records import check_options, read_record
from polarguide.geometry.polarizer import ANGLES, four_intensities, stokes_of_four

Gain = Annotated[float, msgspec.Meta(ge=0.5, le=2.0)]
Gains = tuple[Gain, Gain, Gain, Gain]
Sense = Literal["ccw", "cw"]
UNIT_GAINS: Gains = (1.0, 1.0, 1.0, 1.0)
LARGEST_IMBALANCE = 0.1
"""Pair sums that differ by more than this share are no gain differences: files are swapped, or not linear."""
LARGEST_ZERO = 3600.0
"""Degrees; farther, a number says less and less about an angle."""
ROTATED_PEAK = (1.0 + math.sqrt(2.0)) / 2.0
"""The most a turned analyzer can measure where four angles stay under 1."""
UNIDENTIFIED = (
    "Gains inside a pair (0 against 90, 45 against 135 degrees) look like polarization and stay: polarguide calibrate "
    "measures them."
)
_FEWEST = 32


@dataclass(frozen=True)
class Calibration:
    """How the pictures called 0, 45, 90 and 135 relate to polarizer angles as displayed.

    Attributes:
        gains: response of the pictures, in the order of their names; intensities are divided by them. None
            to estimate the ratio of the pair sums.
        order: the angle that each of the pictures called 0, 45, 90 and 135 was really taken at.
        sense: "ccw" or "cw", how these angles count as the picture is displayed; None for what is usual for the
            source: "ccw", but for published datasets that say otherwise.
        zero: where their zero lies, in degrees counter-clockwise from the image's horizontal.
    """

    gains: Gains | None = None
    order: tuple[int, int, int, int] = ANGLES
    sense: Sense | None = None
    zero: Annotated[float, msgspec.Meta(ge=-LARGEST_ZERO, le=LARGEST_ZERO)] = 0.0

    @property
    def permutes(self) -> bool:
        """Whether the pictures only change places."""
        return (self.zero / 45.0).is_integer()

    @property
    def peak(self) -> float:
        """The largest intensity that comes out where none exceeds 1."""
        return 1.0 if self.permutes else ROTATED_PEAK

    def record(self) -> dict[str, Any]:
        """Order, sense and zero for ``scene.json``."""
        return {"order": list(self.order), "sense": self.sense or "ccw", "zero_degrees": self.zero}

    def true_angles(self) -> tuple[tuple[int, ...], float]:
        """The true angles of the pictures called 0, 45, 90 and 135: multiples of 45, and what is left for all four."""
        sign = -1 if self.sense == "cw" else 1
        steps = 45 * round(self.zero / 45.0)
        return tuple((sign * angle + steps) % 180 for angle in self.order), self.zero - steps

    def options(self) -> str:
        """Order, sense and zero as options of ``prepare``."""
        order = ",".join(map(str, self.order))
        return f"--order {order} --sense {self.sense or 'ccw'} --zero {self.zero:g}"


def checked(calibration: Calibration, where: object) -> Calibration:
    """The calibration, if it makes sense.

    Raises:
        PolarguideError: gains are not positive, the order is no permutation, the zero is not finite, ...
    """
    check_options(calibration, lambda field: f"{where} ({field})")
    require(
        sorted(calibration.order) == sorted(ANGLES),
        f"{where} (order)",
        expected="0, 45, 90 and 135, each once",
        found=str(calibration.order),
        remedy="List the four angles in the order of the pictures.",
    )
    return calibration


def combined(first: Calibration, second: Calibration) -> Calibration | None:
    """One calibration in place of two: ``second`` was found on pictures to which ``first`` was applied.

    Returns:
        Order, sense and zero, without gains; None where no calibration says the same (pictures that ``first`` turned
        by a part of 45 degrees, and ``second`` pairs otherwise).
    """
    named, turn = first.true_angles()
    renamed, more = second.true_angles()
    angles = tuple(renamed[ANGLES.index(angle)] for angle in named)
    senses: tuple[tuple[Sense, int], ...] = (("ccw", 1), ("cw", -1))
    sign = next((sign for _, sign in senses if renamed == _count(sign, renamed[0])), None)
    if sign is None and turn:
        return None
    rest = round((sign or 1) * turn + more, 2)
    for sense, way in senses:
        if angles == _count(way, angles[0]):
            zero = round((angles[0] + rest) % 180, 2)
            return Calibration(sense=sense, zero=zero - 180 if zero > 90 else zero)
    first_angle, second_angle, third, fourth = angles
    return Calibration(order=(first_angle, second_angle, third, fourth), sense="ccw", zero=rest)


def _count(sign: int, zero: int) -> tuple[int, ...]:
    """The angles named 0, 45, 90 and 135 where angles count one way from a zero."""
    return tuple((sign * angle + zero) % 180 for angle in ANGLES)


class _Gains(msgspec.Struct, forbid_unknown_fields=True):
    i0: Gain = msgspec.field(name="0")
    i45: Gain = msgspec.field(name="45")
    i90: Gain = msgspec.field(name="90")
    i135: Gain = msgspec.field(name="135")


class _File(msgspec.Struct, forbid_unknown_fields=True):
    """A calibration file."""

    gains: _Gains | None = None
    order: tuple[int, int, int, int] = ANGLES
    sense: Sense | None = None
    zero: float = 0.0


def read_calibration(path: Path) -> Calibration:
    """Read a calibration file: ``{"gains": {"0": 1.01, ...}, "order": [...], "sense": "ccw", "zero": 0.0}``.

    Every key may be left out.

    Raises:
        PolarguideError: the file cannot be read, has unknown keys or values that make no sense.
    """
    file = read_record(path, _File, remedy="See docs/reference/formats.md for the calibration file.")
    gains = None if file.gains is None else msgspec.structs.astuple(file.gains)
    return checked(Calibration(gains, file.order, file.sense, file.zero), path)


def pair_ratio(angles: NDArray[np.floating[Any]], usable: NDArray[np.bool_]) -> float | None:
    """Median of (I0 + I90) / (I45 + I135), which is 1 for ideal analyzers whatever the light.

    Args:
        angles: linear intensities [4, ...], without channels.
        usable: [...], what may be looked at.

    Returns:
        The ratio, or None where fewer than 32 samples are bright enough to tell.
    """
    i0, i45, i90, i135 = angles[:, usable].astype(np.float64)
    first = i0 + i90
    second = i45 + i135
    bright = np.minimum(first, second) > 0.02
    if bright.sum() < _FEWEST:
        return None
    return float(np.median(first[bright] / second[bright]))


def balancing_gains(ratio: float | None) -> Gains | None:
    """Gains of the four pictures that explain a ratio of pair sums, with product 1; None if none do."""
    if ratio is None or abs(ratio - 1.0) > LARGEST_IMBALANCE:
        return None
    root = math.sqrt(ratio)
    return (root, 1.0 / root, root, 1.0 / root)


def oriented(intensities: NDArray[np.float32], calibration: Calibration) -> NDArray[np.float32]:
    """Intensities at 0, 45, 90 and 135 degrees, counter-clockwise as displayed.

    A picture taken at angle L of the instrument lies at ``sense * L + zero``. Multiples of 45 degrees exchange
    pictures; any other zero turns (S1, S2) by twice the angle and forms the four intensities anew.

    Args:
        intensities: [4, ...], by the names of the pictures.
        calibration: order, sense and zero; its gains are not looked at.

    Returns:
        [4, ...], at least 0 and at most ``calibration.peak`` times the largest given.
    """
    sign = -1 if calibration.sense == "cw" else 1
    turn = calibration.zero if calibration.permutes else 0.0
    targets = [int(sign * angle + turn) % 180 for angle in calibration.order]
    places = [targets.index(angle) for angle in ANGLES]
    placed = intensities if places == [0, 1, 2, 3] else intensities[places]
    if calibration.permutes:
        return placed
    s0, s1, s2 = stokes_of_four(placed)
    cosine, sine = (f(2.0 * math.radians(calibration.zero)) for f in (math.cos, math.sin))
    turned = four_intensities((s0, s1 * cosine - s2 * sine, s1 * sine + s2 * cosine))
    return np.maximum(np.stack(turned), 0.0).astype(np.float32)
