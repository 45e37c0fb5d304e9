"""Calibration of a polarization camera or filter, and rotation of its pictures for display.

A calibration contains the gains of the four pictures, and their true polarizer angles.
"""

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
"""Largest relative difference of the pair sums I0 + I90 and I45 + I135 that gains can explain.

A larger difference means swapped or nonlinear files.
"""
LARGEST_ZERO = 3600.0
"""Largest direction of angle zero in degrees that is accepted."""
ROTATED_PEAK = (1.0 + math.sqrt(2.0)) / 2.0
"""Largest intensity behind a polarizer at any angle if the intensities at the four angles are at most 1."""
UNIDENTIFIED = (
    "Gains within a pair (0 and 90, or 45 and 135 degrees) look like polarization and remain: polarguide calibrate "
    "measures them."
)
_FEWEST = 32


@dataclass(frozen=True)
class Calibration:
    """Gains and true polarizer angles of the pictures named 0, 45, 90 and 135.

    Attributes:
        gains: factors by which the intensities of the pictures are divided, in the order of the names. If None, gains
            are estimated from the pictures.
        order: angle of the instrument at which each of the pictures named 0, 45, 90 and 135 was taken.
        sense: direction in which the angles increase as displayed, "ccw" or "cw". None means the default of the source:
            "ccw", except for some published datasets.
        zero: direction of angle zero, in degrees counter-clockwise from the picture's horizontal.
    """

    gains: Gains | None = None
    order: tuple[int, int, int, int] = ANGLES
    sense: Sense | None = None
    zero: Annotated[float, msgspec.Meta(ge=-LARGEST_ZERO, le=LARGEST_ZERO)] = 0.0

    @property
    def permutes(self) -> bool:
        """True if the four pictures only need to be exchanged, because the zero is a multiple of 45 degrees."""
        return (self.zero / 45.0).is_integer()

    @property
    def peak(self) -> float:
        """Largest intensity that ``oriented`` can return if all of its input is at most 1."""
        return 1.0 if self.permutes else ROTATED_PEAK

    def record(self) -> dict[str, Any]:
        """Return order, sense and zero as an entry of ``scene.json``."""
        return {"order": list(self.order), "sense": self.sense or "ccw", "zero_degrees": self.zero}

    def true_angles(self) -> tuple[tuple[int, ...], float]:
        """Return the true angles of the pictures named 0, 45, 90 and 135 in two parts.

        Returns:
            The angle of each picture, rounded to a multiple of 45 degrees; and the remaining rotation in degrees,
            which is equal for all four.
        """
        sign = -1 if self.sense == "cw" else 1
        steps = 45 * round(self.zero / 45.0)
        return tuple((sign * angle + steps) % 180 for angle in self.order), self.zero - steps

    def options(self) -> str:
        """Return order, sense and zero as text with the options of ``prepare``."""
        order = ",".join(map(str, self.order))
        return f"--order {order} --sense {self.sense or 'ccw'} --zero {self.zero:g}"


def checked(calibration: Calibration, where: object) -> Calibration:
    """Validate a calibration and return it.

    Raises:
        PolarguideError: a value is invalid: gains are not positive, the order is not a permutation, the zero is not
            finite, ...
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
    """Combine two calibrations into one that has the effect of ``first`` followed by ``second``.

    Returns:
        The calibration, without gains. It is ``None`` if no single calibration has this effect. This happens if
        ``first`` rotates by a fraction of 45 degrees and ``second`` changes which pictures are perpendicular.
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
    """Return the true angles of the pictures named 0, 45, 90 and 135 for a sense (1 or -1) and a zero."""
    return tuple((sign * angle + zero) % 180 for angle in ANGLES)


class _Gains(msgspec.Struct, forbid_unknown_fields=True):
    i0: Gain = msgspec.field(name="0")
    i45: Gain = msgspec.field(name="45")
    i90: Gain = msgspec.field(name="90")
    i135: Gain = msgspec.field(name="135")


class _File(msgspec.Struct, forbid_unknown_fields=True):
    """Fields of a calibration file."""

    gains: _Gains | None = None
    order: tuple[int, int, int, int] = ANGLES
    sense: Sense | None = None
    zero: float = 0.0


def read_calibration(path: Path) -> Calibration:
    """Read a calibration from a JSON file.

    Its content has the form ``{"gains": {"0": 1.01, ...}, "order": [...], "sense": "ccw", "zero": 0.0}``. All keys are
    optional.

    Raises:
        PolarguideError: the file cannot be read, or has unknown keys or invalid values.
    """
    file = read_record(path, _File, remedy="See docs/reference/formats.md for the calibration file.")
    return checked(
        Calibration(
            None if file.gains is None else msgspec.structs.astuple(file.gains),
            file.order,
            file.sense,
            file.zero,
        ),
        path,
    )


def pair_ratio(angles: NDArray[np.floating[Any]], usable: NDArray[np.bool_]) -> float | None:
    """Return the median of the ratio (I0 + I90) / (I45 + I135) of the two pair sums.

    For ideal polarizers the ratio is 1 in any light.

    Args:
        angles: linear intensities at 0, 45, 90 and 135 degrees without channels, [4, ...].
        usable: mask of usable samples, [...].

    Returns:
        The ratio, or None if fewer than 32 samples are bright enough.
    """
    i0, i45, i90, i135 = angles[:, usable].astype(np.float64)
    first = i0 + i90
    second = i45 + i135
    bright = np.minimum(first, second) > 0.02
    if bright.sum() < _FEWEST:
        return None
    return float(np.median(first[bright] / second[bright]))


def balancing_gains(ratio: float | None) -> Gains | None:
    """Return gains of the four pictures that make the two pair sums equal. The product of the gains is 1.

    Return None if the ratio deviates too much from 1, see ``LARGEST_IMBALANCE``.
    """
    if ratio is None or abs(ratio - 1.0) > LARGEST_IMBALANCE:
        return None
    root = math.sqrt(ratio)
    return (root, 1.0 / root, root, 1.0 / root)


def oriented(intensities: NDArray[np.float32], calibration: Calibration) -> NDArray[np.float32]:
    """Convert the intensities of the four pictures to displayed angles of 0, 45, 90 and 135 degrees, counter-clockwise.

    The angle L of the instrument is displayed at ``sense * L + zero``. If the zero is a multiple of 45 degrees, the
    pictures are only exchanged. Otherwise the Stokes components S1 and S2 are rotated by twice the remaining angle, and
    the four intensities are computed from the rotated Stokes vectors.

    Args:
        intensities: intensities of the pictures named 0, 45, 90 and 135, [4, ...].
        calibration: order, sense and zero. Its gains are not applied.

    Returns:
        [4, ...], at least 0 and at most ``calibration.peak`` times the largest input.
    """
    sign = -1 if calibration.sense == "cw" else 1
    turn = calibration.zero if calibration.permutes else 0.0
    targets = [int(sign * angle + turn) % 180 for angle in calibration.order]
    places = [targets.index(angle) for angle in ANGLES]
    permuted = intensities if places == [0, 1, 2, 3] else intensities[places]
    if calibration.permutes:
        return permuted
    s0, s1, s2 = stokes_of_four(permuted)
    cosine, sine = (f(2.0 * math.radians(calibration.zero)) for f in (math.cos, math.sin))
    return np.maximum(
        np.stack(four_intensities((s0, s1 * cosine - s2 * sine, s1 * sine + s2 * cosine))), 0.0
    ).astype(np.float32)


_MIRRORED = (2, 4, 5, 7)
QUARTER_TURNS = (5, 6, 7, 8)
"""EXIF orientations that exchange width and height."""
INVERSE = {code: {6: 8, 8: 6}.get(code, code) for code in range(1, 9)}
"""EXIF orientation that undoes each orientation."""
TURNS = {
    2: "mirrored left to right",
    3: "turned by 180 degrees",
    4: "mirrored top to bottom",
    5: "mirrored along the falling diagonal",
    6: "turned by 90 degrees clockwise",
    7: "mirrored along the rising diagonal",
    8: "turned by 90 degrees counter-clockwise",
}
"""Description of the change from the stored to the displayed picture, for each EXIF orientation except 1."""


def apply_orientation(pixels: NDArray[Any], code: int) -> NDArray[Any]:
    """Rotate or mirror pixels [H, W, ...] for display according to an EXIF orientation."""
    if code in (5, 7):
        pixels = pixels.swapaxes(0, 1)
        return np.rot90(pixels, 2) if code == 7 else pixels
    if code in (2, 4):
        return np.flip(pixels, axis=1 if code == 2 else 0)
    return np.rot90(pixels, {1: 0, 3: 2, 6: -1, 8: 1}[code])


def orientation_calibration(code: int) -> Calibration:
    """Return the sense and zero of polarizer angles that result from rotating or mirroring a picture for display."""
    return Calibration(
        sense="cw" if code in _MIRRORED else "ccw", zero=90.0 if code in QUARTER_TURNS else 0.0
    )


def as_displayed(
    linear: NDArray[np.float32], calibration: Calibration, orientation: int
) -> NDArray[np.float32]:
    """Convert four shots to displayed angles of 0, 45, 90 and 135 degrees, and rotate them for display.

    Args:
        linear: linear intensities of the shots, [4, H, W, C].
        calibration: order, sense and zero of the angles.
        orientation: EXIF orientation of the shots.
    """
    turned = np.stack([apply_orientation(picture, orientation) for picture in oriented(linear, calibration)])
    return oriented(turned, orientation_calibration(orientation))
