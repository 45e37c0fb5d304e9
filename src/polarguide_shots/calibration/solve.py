"""Angles and levels of the shots, from the means of all positions of the pattern.

The means form a matrix ``M = X A^T``: X [T, 3] are the Stokes vectors of the shots, ``L (1, e cos 2t, e sin 2t)``,
and A [K, 3] the analyzer vectors of the positions. Both are estimated at once, by least squares in which A, linear for
given X, is eliminated (variable projection, Golub and Pereyra 1973: the minimum of alternating least squares).

What M does not tell: the scale of A against L; where angles are unknown, their common zero and the sense in which they
count (the pattern's names say it); e, the polarizer's own diattenuation, which scales S1 and S2; and where angles *and*
levels are unknown, two more numbers (X may undergo a Lorentz boost, as by another polarizer before all: the same that
lamps do whose light is polarized). So levels are free where the angles are given, or a flat field without polarization;
else the light has to be steady and unpolarized, and all levels are taken as equal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from polarguide.core.errors import PolarguideError
from polarguide.geometry.polarizer import malus
from polarguide_shots.calibration.shots import FEWEST

MISFIT = 0.02
"""Deviation of the means from the fit, as a share of them, above which the shots contradict each other."""
SAME_ANGLE = np.radians(2.0)
NARROW = 0.15
"""Smallest singular value of the directions of the shots (0.7 for angles all around) below which they are too alike."""
POLARIZED = 0.5
"""Least DoLP of a shot through a polarizer."""
FLAT_POLARIZED = 0.1
"""DoLP from which a flat field is certainly polarized: no gains of a sensor look like this."""
UNSTEADY = 0.15
"""Change of the brightness over the shots that errors of a sensor (3 % of gain, extinction ratios of 20) may cause."""
LARGEST_ZERO = np.radians(10.0)
ALIKE = 0.9
"""Agreement of two lists of angles, 1 where they differ by a constant."""

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ShotFit:
    """The shots as they were.

    Attributes:
        angles: angles of the polarizer, radians, [T]. levels: levels of the light behind it, [T], their mean is 1.
        vectors: analyzer vectors of the positions, [K, 3], in the unit of the means.
        misfit: root mean square deviation of the means from the fit, as a share of their mean.
        zero: mean deviation of the positions from their nominal angles before the reference was chosen, radians.
        flat_dolp: DoLP of the flat field as the calibration sees it; None without one.
    """

    angles: Array
    levels: Array
    vectors: Array
    misfit: float
    zero: float
    flat_dolp: float | None

    def stokes(self, diattenuation: float) -> Array:
        """Stokes vectors of the light in the shots, [T, 3]."""
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
    """Estimate the shots.

    Args:
        means: means of each shot by position, [T, K]. nominal: angles of the positions by their names, radians, [K].
        known: angles of the polarizer, radians, [T]; None to estimate them.
        flat: means of the flat field, [K], or None.
        diattenuation: diattenuation of the polarizer, (E - 1) / (E + 1) for the extinction ratio E.
        to_mean: whether the mean deviation of the positions from their nominal angles is the zero of all angles.
        files: files of the shots, for messages.

    Raises:
        PolarguideError: the shots are not of a polarizer, not at different angles, contradict the angles given, ...
    """
    start = _pixel_stokes(means, nominal)
    folder = files[0].parent
    for path, stokes in zip(files, start, strict=True):
        dolp = float(np.hypot(stokes[1], stokes[2]) / stokes[0])
        if dolp < POLARIZED:
            raise PolarguideError(
                path,
                expected=f"light through a polarizer, of a DoLP above {POLARIZED:.0%}",
                found=f"{dolp:.0%}",
                remedy="Take it through the polarizer, and the --flat without it. Check --sensor and offsets.",
            )
    if flat is not None:
        s0, s1, s2 = _pixel_stokes(flat[None], nominal)[0]
        if np.hypot(s1, s2) > FLAT_POLARIZED * s0:
            raise PolarguideError(
                "--flat",
                expected="unpolarized light",
                found=f"a DoLP of {np.hypot(s1, s2) / s0:.0%}",
                remedy="Take it without the polarizer, of a light behind a thick diffuser; no screen, no reflection.",
            )
    apparent = np.arctan2(start[:, 2], start[:, 1]) / 2
    if known is None and flat is None:
        _require_steady(start[:, 0], folder)
    if known is not None:
        _require_match(np.asarray(known), apparent, folder, to_mean)
    _require_different(apparent if known is None else np.asarray(known), folder, known is not None)
    angles, levels = _refined(means, apparent, start[:, 0], known, flat, diattenuation)
    levels = levels / levels.mean()
    light = _stokes(angles, levels, diattenuation)
    vectors = np.asarray(np.linalg.lstsq(light, means, rcond=None)[0].T, np.float64)
    misfit = float(np.sqrt(np.mean((means - light @ vectors.T) ** 2)) / means.mean())
    if misfit > MISFIT:
        why = (
            "the angles given"
            if known is not None
            else "one steady, unpolarized light behind a turned polarizer"
        )
        remedy = (
            "Check their order and zero; shots must be linear (no gamma, no automatic exposure within the list)."
            if known is not None
            else "Give --flat (a picture without the polarizer) or --angles; keep lamp and exposure as they are."
        )
        raise PolarguideError(
            folder,
            expected=f"shots that agree with {why} within {MISFIT:.0%}",
            found=f"{misfit:.1%}",
            remedy=remedy,
        )
    zero = _mean_deviation(vectors, nominal)
    if to_mean:
        angles = angles - zero
        vectors = _turned(vectors, -zero)
    flat_dolp = None
    if flat is not None:
        s0, s1, s2 = np.linalg.lstsq(vectors, flat, rcond=None)[0]
        flat_dolp = float(np.hypot(s1, s2) / s0)
    return ShotFit(np.mod(angles, np.pi), levels, vectors, misfit, zero, flat_dolp)


def _require_steady(brightness: Array, folder: Path) -> None:
    """Refuse light that changes from shot to shot where nothing else tells it from the sensor's own polarization."""
    change = float(brightness.max() / brightness.min()) - 1
    if change > UNSTEADY:
        raise PolarguideError(
            folder,
            expected=f"one steady, unpolarized light, whose shots differ by at most {UNSTEADY:.0%} in brightness",
            found=f"{change:.0%}: the lamp is polarized, or it or the exposure changed",
            remedy="Give --angles, or --flat (a picture without the polarizer), which measure the light of each shot.",
        )


def _stokes(angles: Array, levels: Array, diattenuation: float) -> Array:
    one = np.ones_like(angles)
    polarized = diattenuation * np.cos(2 * angles), diattenuation * np.sin(2 * angles)
    return levels[:, None] * np.stack([one, *polarized], axis=1)


def _pixel_stokes(means: Array, nominal: Array) -> Array:
    """Stokes vectors as a sensor with ideal analyzers would see them, [T, 3]; colors are brought to one level."""
    unit = np.eye(3)
    ideal = np.stack([malus(unit[:, k], nominal) for k in range(3)], axis=1)
    balanced = means
    if len(nominal) > 4:  # cells lie behind color filters
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
    """Angles and levels that fit best; the first angle, or all that are known, and the first level are held."""
    count = len(means)
    initial = apparent if known is None else np.asarray(known)
    # Known angles determine the levels by themselves: a flat field then is a test, not a measurement.
    with_flat = flat if known is None else None
    data = means / means.mean()
    levels_at_first = brightness
    if with_flat is not None:
        data = np.concatenate([data, with_flat[None] / means.mean()])
        levels_at_first = np.append(brightness, with_flat.sum() / means.sum() * count * brightness.mean())
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
        begin = np.append(begin, np.log(levels_at_first[1:] / levels_at_first[0]))
    if len(begin):
        solution: Any = least_squares(deviations, begin, xtol=1e-12, ftol=1e-14, gtol=1e-14, max_nfev=500)
        begin = solution.x
    angles, levels = unpacked(begin)
    return angles, levels[:count]


def _require_different(angles: Array, folder: Path, known: bool) -> None:
    """Refuse shots at one angle, at fewer than five, or at such that lie close together."""
    ordered = np.sort(np.mod(angles, np.pi))
    gaps = np.diff(np.append(ordered, ordered[0] + np.pi))
    different = max(1, int((gaps > SAME_ANGLE).sum()))
    directions = np.stack([np.ones_like(angles), np.cos(2 * angles), np.sin(2 * angles)], axis=1)
    least = float(np.linalg.svd(directions / np.sqrt(len(angles)), compute_uv=False)[-1])
    if different >= FEWEST and least >= NARROW:
        return
    span = np.degrees(np.pi - gaps.max())
    found = (
        f"{len(angles)} shots at one angle"
        if different == 1
        else f"{different} different ones over {span:.0f} degrees"
    )
    raise PolarguideError(
        "--angles" if known else folder,
        expected=f"at least {FEWEST} different angles of the polarizer, spread over 180 degrees",
        found=found,
        remedy="Turn the polarizer between the shots; twelve, 15 degrees apart, are a good number.",
    )


def _require_match(known: Array, apparent: Array, folder: Path, to_mean: bool) -> None:
    """Refuse given angles that count the other way, have another zero, or belong to other shots."""
    along, against = (np.mean(np.exp(2j * (apparent - sign * known))) for sign in (1, -1))
    if abs(along) < ALIKE:
        remedy = "List the angles in the order of the files' names."
        if abs(against) >= ALIKE:
            remedy = "They count the other way: give the other --sense."
        raise PolarguideError(
            "--angles",
            expected="angles like those that the sensor sees",
            found=f"angles that look like {', '.join(f'{np.degrees(a) % 180:.0f}' for a in apparent[:8])}, ...",
            remedy=remedy,
        )
    zero = float(np.angle(along)) / 2
    if abs(zero) > LARGEST_ZERO and not to_mean:
        raise PolarguideError(
            "--angles",
            expected="angles from the image's horizontal, counter-clockwise as displayed",
            found=f"a zero that lies {-np.degrees(zero):+.1f} degrees off what the sensor in {folder} sees",
            remedy="Give angles from the horizontal, or --reference mean: the sensor's own mean is then the zero.",
        )


def _mean_deviation(vectors: Array, nominal: Array) -> float:
    """Circular mean of what the positions' angles deviate from their names, in radians."""
    angles = np.arctan2(vectors[:, 2], vectors[:, 1]) / 2
    return float(np.angle(np.mean(np.exp(2j * (angles - nominal))))) / 2


def _turned(vectors: Array, angle: float) -> Array:
    cosine = np.cos(2 * angle)
    sine = np.sin(2 * angle)
    s0, s1, s2 = vectors.T
    return np.stack([s0, s1 * cosine - s2 * sine, s1 * sine + s2 * cosine], axis=1)
