"""Angles and levels of the shots, from the means of all positions of the pattern.

The means form a matrix ``M = X A^T``. X [T, 3] contains the Stokes vectors of the shots,
``L (1, e cos 2t, e sin 2t)``, and A [K, 3] the analyzer vectors of the positions. Both are estimated jointly by least
squares. A is linear for given X and is eliminated (variable projection, Golub and Pereyra 1973).

M does not determine:

- the scale of A against L
- for unknown angles, their common zero and their sense, which follow from the names of the positions
- the diattenuation e of the polarizer, which scales S1 and S2
- for unknown angles and levels, two more numbers. X may undergo a Lorentz boost, as by another polarizer in front or by
  a polarized lamp.

Levels are therefore free if the angles or an unpolarized flat field are given. Otherwise the light must be steady and
unpolarized, and all levels are equal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from polarguide.core.errors import require
from polarguide.geometry.polarizer import malus
from polarguide_shots.calibration.shots import FEWEST

MISFIT = 0.02
"""Relative deviation of the means from the fit above which the shots contradict each other."""
SAME_ANGLE = np.radians(2.0)
"""Largest difference of equal angles, radians."""
NARROW = 0.15
"""Smallest singular value of the directions of the shots; angles all around have 0.7."""
POLARIZED = 0.5
"""Smallest DoLP of a shot through a polarizer."""
FLAT_POLARIZED = 0.1
"""DoLP from which a flat field is certainly polarized. Gains of a sensor are smaller."""
UNSTEADY = 0.15
"""Largest change of the brightness by errors of a sensor (3 % of gain, extinction ratios of 20)."""
LARGEST_ZERO = np.radians(10.0)
"""Largest error of the zero of given angles, radians."""
ALIKE = 0.9
"""Smallest agreement of matching lists of angles; lists with a constant difference have 1."""

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ShotFit:
    """Estimated angles and levels of the shots.

    Attributes:
        angles: angles of the polarizer, radians, [T].
        levels: levels of the light behind the polarizer, [T], with mean 1.
        vectors: analyzer vectors of the positions, [K, 3], in the unit of the means.
        misfit: root mean square deviation of the means from the fit, as a share of their mean.
        zero: mean deviation of the positions from their nominal angles before the choice of the zero, radians.
        flat_dolp: DoLP of the flat field with the calibration, or None.
    """

    angles: Array
    levels: Array
    vectors: Array
    misfit: float
    zero: float
    flat_dolp: float | None

    def stokes(self, diattenuation: float) -> Array:
        """Return the Stokes vectors of the light in the shots, [T, 3]."""
        return _stokes(self.angles, self.levels, diattenuation)


def solve_shots(
    means: Array,
    nominal: Array,
    *,
    known: Sequence[float] | None,
    flat: Array | None,
    diattenuation: float,
    to_mean: bool,
    files: Sequence[Path],
) -> ShotFit:
    """Estimate the angles and levels of the shots.

    Args:
        means: means of each shot by position, [T, K].
        nominal: angles of the positions by their names, radians, [K].
        known: angles of the polarizer, radians, [T]; None to estimate them.
        flat: means of the flat field, [K], or None.
        diattenuation: diattenuation of the polarizer, (E - 1) / (E + 1) for the extinction ratio E.
        to_mean: choose the zero of the angles at which the positions have no mean deviation from their names.
        files: files of the shots, for messages.

    Raises:
        PolarguideError: the shots are not polarized, have too few angles, or contradict the angles or each other, or
            the flat field is polarized.
    """
    start = _pixel_stokes(means, nominal)
    folder = files[0].parent
    for path, stokes in zip(files, start, strict=True):
        require(
            _dolp(stokes) >= POLARIZED,
            path,
            expected=f"light through a polarizer, with a DoLP above {POLARIZED:.0%}",
            found=f"{_dolp(stokes):.0%}",
            remedy="Take it through the polarizer, and the --flat without it. Check --sensor and offsets.",
        )
    if flat is not None:
        dolp = _dolp(_pixel_stokes(flat[None], nominal)[0])
        require(
            dolp <= FLAT_POLARIZED,
            "--flat",
            expected="unpolarized light",
            found=f"a DoLP of {dolp:.0%}",
            remedy="Take it without the polarizer, of a light behind a thick diffuser; no screen, no reflection.",
        )
    apparent = np.arctan2(start[:, 2], start[:, 1]) / 2
    if known is not None:
        _require_match(np.asarray(known), apparent, folder, to_mean)
    elif flat is None:
        _require_steady(start[:, 0], folder)
    _require_different(apparent if known is None else np.asarray(known), folder, known is not None)
    angles, levels = _refined(means, apparent, start[:, 0], known, flat, diattenuation)
    levels = levels / levels.mean()
    light = _stokes(angles, levels, diattenuation)
    vectors = np.asarray(np.linalg.lstsq(light, means, rcond=None)[0].T, np.float64)
    misfit = float(np.sqrt(np.mean((means - light @ vectors.T) ** 2)) / means.mean())
    model = "the given angles"
    remedy = (
        "Check their order and zero; shots must be linear (no gamma, no automatic exposure within the list)."
    )
    if known is None:
        model = "one steady, unpolarized light behind a turned polarizer"
        remedy = "Give --flat (a picture without the polarizer) or --angles; do not change lamp and exposure."
    require(
        misfit <= MISFIT,
        folder,
        expected=f"shots that agree with {model} within {MISFIT:.0%}",
        found=f"{misfit:.1%}",
        remedy=remedy,
    )
    zero = _mean_deviation(vectors, nominal)
    if to_mean:
        angles = angles - zero
        vectors = _turned(vectors, -zero)
    flat_dolp = None if flat is None else _dolp(np.linalg.lstsq(vectors, flat, rcond=None)[0])
    return ShotFit(np.mod(angles, np.pi), levels, vectors, misfit, zero, flat_dolp)


def _dolp(stokes: NDArray[Any]) -> float:
    return float(np.hypot(stokes[1], stokes[2]) / stokes[0])


def _require_steady(brightness: Array, folder: Path) -> None:
    """Check that the light is steady. Without angles and a flat field, its changes look like errors of the sensor.

    Raises:
        PolarguideError: the brightness of the shots differs too much.
    """
    change = float(brightness.max() / brightness.min()) - 1
    require(
        change <= UNSTEADY,
        folder,
        expected=f"one steady, unpolarized light, whose shots differ by at most {UNSTEADY:.0%} in brightness",
        found=f"{change:.0%}: the lamp is polarized, or lamp or exposure changed",
        remedy="Give --angles, or --flat (a picture without the polarizer), which measure the light of each shot.",
    )


def _stokes(angles: Array, levels: Array, diattenuation: float) -> Array:
    """Return Stokes vectors behind a polarizer, [T, 3]."""
    polarized = diattenuation * np.cos(2 * angles), diattenuation * np.sin(2 * angles)
    return levels[:, None] * np.stack([np.ones_like(angles), *polarized], axis=1)


def _pixel_stokes(means: Array, nominal: Array) -> Array:
    """Return the Stokes vectors that ideal analyzers would measure, [T, 3], with equal levels of all colors."""
    ideal = np.stack([malus(unit, nominal) for unit in np.eye(3)], axis=1)
    balanced = means
    if len(nominal) > 4:  # cells behind color filters
        side = round(len(nominal) ** 0.5)
        grid = means.reshape(len(means), side // 2, 2, side // 2, 2)
        level = grid.mean(axis=(2, 4), keepdims=True)
        balanced = (grid / level * level.mean(axis=(1, 3), keepdims=True)).reshape(means.shape)
    return np.asarray(balanced @ np.linalg.pinv(ideal).T)


def _refined(
    means: Array,
    apparent: Array,
    brightness: Array,
    known: Sequence[float] | None,
    flat: Array | None,
    diattenuation: float,
) -> tuple[Array, Array]:
    """Fit angles and levels by variable projection. The first level and the known angles, or the first, are fixed.

    Args:
        means: means of each shot by position, [T, K].
        apparent, brightness: initial angles and levels, [T].
        known, flat, diattenuation: as for ``solve_shots``.

    Returns:
        Angles and levels, [T].
    """
    count = len(means)
    initial = apparent if known is None else np.asarray(known)
    # Known angles determine the levels. A flat field is then a test, not a measurement.
    with_flat = flat if known is None else None
    data = means / means.mean()
    initial_levels = brightness
    if with_flat is not None:
        data = np.concatenate([data, with_flat[None] / means.mean()])
        initial_levels = np.append(brightness, with_flat.sum() / means.sum() * count * brightness.mean())
    free_levels = known is not None or with_flat is not None
    turns = count - 1 if known is None else 0

    def unpacked(free: Array) -> tuple[Array, Array]:
        angles = initial.copy()
        levels = np.ones(len(data))
        angles[count - turns :] = free[:turns]
        if free_levels:
            levels[1:] = np.exp(free[turns:])
        return angles, levels

    def deviations(free: Array) -> Array:
        angles, levels = unpacked(free)
        light = _stokes(angles, levels[:count], diattenuation)
        if with_flat is not None:
            light = np.concatenate([light, [[levels[count], 0.0, 0.0]]])
        basis, _ = np.linalg.qr(light)
        return np.asarray((data - basis @ (basis.T @ data)).ravel())

    begin = initial[count - turns :]
    if free_levels:
        begin = np.append(begin, np.log(initial_levels[1:] / initial_levels[0]))
    if len(begin):
        solution: Any = least_squares(deviations, begin, xtol=1e-12, ftol=1e-14, gtol=1e-14, max_nfev=500)
        begin = solution.x
    angles, levels = unpacked(begin)
    return angles, levels[:count]


def _require_different(angles: Array, folder: Path, known: bool) -> None:
    """Check the number and the spread of the angles.

    Raises:
        PolarguideError: the angles are too few or too similar.
    """
    ordered = np.sort(np.mod(angles, np.pi))
    gaps = np.diff(np.append(ordered, ordered[0] + np.pi))
    different = max(1, int((gaps > SAME_ANGLE).sum()))
    directions = np.stack([np.ones_like(angles), np.cos(2 * angles), np.sin(2 * angles)], axis=1)
    least = float(np.linalg.svd(directions / np.sqrt(len(angles)), compute_uv=False)[-1])
    span = np.degrees(np.pi - gaps.max())
    require(
        different >= FEWEST and least >= NARROW,
        "--angles" if known else folder,
        expected=f"at least {FEWEST} different angles of the polarizer, spread over 180 degrees",
        found=f"{different} different angles over {span:.0f} degrees"
        if different > 1
        else f"{len(angles)} shots at one angle",
        remedy="Turn the polarizer between the shots; twelve shots at steps of 15 degrees are a good number.",
    )


def _require_match(known: Array, apparent: Array, folder: Path, to_mean: bool) -> None:
    """Check that given angles match the apparent angles.

    Raises:
        PolarguideError: the given angles have the other sense or another zero, or belong to other shots.
    """
    along, against = (np.mean(np.exp(2j * (apparent - sign * known))) for sign in (1, -1))
    other_sense = abs(against) >= ALIKE
    require(
        abs(along) >= ALIKE,
        "--angles",
        expected="angles that match the sensor",
        found=f"angles that look like {', '.join(f'{np.degrees(a) % 180:.0f}' for a in apparent[:8])}, ...",
        remedy="Give the other --sense: the angles count in the opposite direction."
        if other_sense
        else "List the angles in the order of the files' names.",
    )
    zero = float(np.angle(along)) / 2
    require(
        abs(zero) <= LARGEST_ZERO or to_mean,
        "--angles",
        expected="angles from the image's horizontal, counter-clockwise as displayed",
        found=f"a zero that differs by {-np.degrees(zero):+.1f} degrees from the sensor in {folder}",
        remedy="Give angles from the horizontal, or --reference mean for the zero of the sensor's mean.",
    )


def _mean_deviation(vectors: Array, nominal: Array) -> float:
    """Return the circular mean of the deviations of the positions' angles from their names, in radians."""
    angles = np.arctan2(vectors[:, 2], vectors[:, 1]) / 2
    return float(np.angle(np.mean(np.exp(2j * (angles - nominal))))) / 2


def _turned(vectors: Array, angle: float) -> Array:
    """Rotate analyzer vectors [K, 3] by an angle in radians."""
    cosine = np.cos(2 * angle)
    sine = np.sin(2 * angle)
    s0, s1, s2 = vectors.T
    return np.stack([s0, s1 * cosine - s2 * sine, s1 * sine + s2 * cosine], axis=1)
