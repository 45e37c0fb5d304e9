"""Analyze shots of a polarizer in front of a uniform light: validate them, and estimate their angles and brightness.

The means of all positions of the pattern form a matrix ``M = X A^T``. X [T, 3] contains the Stokes vectors of the
shots, ``L (1, e cos 2t, e sin 2t)``, with level L and angle t of each shot. A [K, 3] contains the analyzer vectors of
the positions. Both are estimated jointly by least squares. A is linear for given X and is eliminated (variable
projection, Golub and Pereyra 1973).

M does not determine:

- the scale of A relative to L
- for unknown angles, their common zero and their direction, which follow from the nominal angles of the positions
- the diattenuation e of the polarizer, which scales S1 and S2
- for unknown angles and levels, two more numbers. They correspond to a Lorentz boost of X, as a second polarizer in
  front or a polarized lamp would cause.

Levels are therefore free if the angles or an unpolarized flat field are given. Otherwise the light must be steady and
unpolarized, and all levels are equal.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from polarguide.capture.layout import describe_contents, index_files
from polarguide.capture.sensor.mosaics import RAW_SUFFIXES, RawFormat, read_mosaic, sample_blocks
from polarguide.capture.sensor.pattern import (
    SIDE,
    Levels,
    Pattern,
    agreed_full_scale,
    estimate_levels,
    require_kind,
    sensor_pattern,
)
from polarguide.core.errors import require
from polarguide.core.files import require_folder
from polarguide.core.progress import Reporter
from polarguide.geometry.polarizer import malus
from polarguide_shots.calibration.settings import CalibrateSettings

FEWEST = 5
"""Smallest number of angles in the shots. Five points determine an ellipse."""
SATURATED = 0.001
"""Largest share of saturated samples in a shot. It allows for a few defects of the sensor."""
TOO_DARK = 0.02
"""Smallest mean of a shot that is bright enough, as a share of full scale."""
UNEVEN = 0.2
"""Smallest ratio of the dimmest to the brightest part of a uniform light."""
TEXTURED = 0.05
"""Largest relative deviation of a uniform light within 32 pixels."""
_CELLS = 16
_SMALLEST = 64

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ShotMeans:
    """Mean intensities of all shots.

    Attributes:
        levels: black level and full scale of the stored values.
        means: [T, P * P] means of each shot over the sensor, for each position in the pattern of the region, row by
            row. Full scale is 1.
        flat: [P * P] means of the flat field, or None.
    """

    levels: Levels
    means: Array
    flat: Array | None


class Shots:
    """Files of a calibration, and their mean intensities.

    Args:
        root: folder of the shots.
        settings: settings of the calibration.

    Attributes:
        files: shots of the polarizer, sorted by name.
        pattern: pattern of the region. It starts at its top-left pixel.

    Raises:
        PolarguideError: there are too few shots.
    """

    def __init__(self, root: Path, settings: CalibrateSettings) -> None:
        require_folder(
            root,
            expected="a folder of raw mosaics",
            remedy="Give the folder of the shots of the polarizer, one mosaic each.",
        )
        self._settings = settings
        self._raw = RawFormat(settings.width, settings.height, settings.packing)
        self._flat = _files("--flat", settings.flat)
        self._dark = _files("--dark-frame", settings.dark_frame)
        others = {os.path.realpath(path) for path in (*self._flat, *self._dark)}
        paths = index_files(root, RAW_SUFFIXES)
        self.files = [paths[name] for name in sorted(paths) if os.path.realpath(paths[name]) not in others]
        require(
            len(self.files) >= FEWEST,
            root,
            expected=f"at least {FEWEST} shots of the polarizer, at different angles",
            found=f"{len(self.files)} ({describe_contents(root)})",
            remedy="Take more shots; twelve at steps of 15 degrees are a good number.",
        )
        self.pattern: Pattern = sensor_pattern(settings.sensor).shifted(*settings.offset)
        self._first: tuple[Path, tuple[int, ...], Any] | None = None
        self._floor: Any = settings.black_level

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the mosaics. It is known after the first file was read."""
        assert self._first is not None
        return self._first[1][1], self._first[1][0]

    def measure(self, reporter: Reporter) -> ShotMeans:
        """Read all files, and compute their mean intensities.

        Raises:
            PolarguideError: a file is damaged, has a different size, is saturated or dark, or does not show a uniform
                light.
        """
        files = [*self.files, *self._flat]
        period = self.pattern.period
        sums: list[Array] = []
        counts: list[NDArray[np.int64]] = []
        blocks: list[NDArray[Any]] = []
        stated: dict[Path, int | None] = {}
        light: Any = 0
        with reporter.track("reading shots", len(files) + len(self._dark)) as advance:
            if self._dark:
                total = sum(self._read(path).astype(np.float64) for path in self._dark)
                self._floor = np.asarray(total / len(self._dark), np.float32)
            dark = "dark frame" if self._dark else "black level"
            left, top = self.pattern.cell_corner()
            for number, path in enumerate(files, 1):
                values = self._read(path)
                counts.append(np.bincount(values.ravel(), minlength=256))
                if self._settings.bits is None:
                    stated[path] = self._raw.full_scale(path, values)
                if number <= len(self.files):
                    blocks.append(sample_blocks(values[top:, left:], SIDE))
                above = values.astype(np.float32) - np.float32(self._floor)
                planes = (above[row::period, column::period] for row, column in np.ndindex(period, period))
                sums.append(np.array([plane.mean(dtype=np.float64) for plane in planes]))
                mean = float(above.mean())
                require(
                    mean > 0,
                    path,
                    expected=f"a shot that is brighter than the {dark}",
                    found=f"a mean of {values.mean():.1f}, and {np.mean(self._floor):.1f} of the {dark}",
                    remedy="Take the dark frame with the lens covered, at the same exposure and gain.",
                )
                light = light + above / mean
                advance(number + len(self._dark))
        levels = self._levels(counts, agreed_full_scale(stated) if stated else None)
        for path, count in zip(files, counts, strict=True):
            share = float(count[levels.saturation :].sum() / count.sum())
            require(
                share <= SATURATED,
                path,
                expected=f"at most {SATURATED:.1%} saturated samples",
                found=f"{share:.1%}",
                remedy="Expose shorter: the brightest shot should stay below 90 % of full scale.",
            )
        require_kind(self._settings.sensor, np.concatenate(blocks), levels)
        self._require_uniform(light)
        means = np.stack(sums) / (levels.white - levels.black)
        dim = int(means.mean(axis=1).argmin())
        require(
            means[dim].mean() >= TOO_DARK,
            files[dim],
            expected=f"a mean intensity of at least {TOO_DARK:.0%} of full scale",
            found=f"{means[dim].mean():.1%}",
            remedy="Expose longer: half of full scale is good.",
        )
        shots = len(self.files)
        return ShotMeans(levels, means[:shots], means[shots:].mean(axis=0) if self._flat else None)

    def linear(
        self, levels: Levels, reporter: Reporter
    ) -> Iterator[tuple[NDArray[np.float32], NDArray[np.bool_]]]:
        """Read the shots again, one after the other.

        Yields:
            Linear intensities [H, W] with full scale 1; and a mask [H, W] of saturated samples.
        """
        with reporter.track("fitting pixels", len(self.files)) as advance:
            for number, path in enumerate(self.files, 1):
                values = self._read(path)
                above = values.astype(np.float32) - np.float32(self._floor)
                yield above / np.float32(levels.white - levels.black), np.asarray(values >= levels.saturation)
                advance(number)

    def _read(self, path: Path) -> NDArray[Any]:
        values = read_mosaic(path, self._raw, least=_SMALLEST)
        if self._first is None:
            self._first = (path, values.shape, values.dtype)
        first, shape, kind = self._first
        require(
            (values.shape, values.dtype) == (shape, kind),
            path,
            expected=f"{shape[1]}x{shape[0]} pixels of {kind} like {first.name}",
            found=f"{values.shape[1]}x{values.shape[0]} of {values.dtype}",
            remedy="Take all shots, the dark frame and the flat field with the same region and depth.",
        )
        return values

    def _levels(self, counts: list[NDArray[np.int64]], stated: int | None) -> Levels:
        """Estimate black level and full scale of the stored values.

        Args:
            counts: for each shot, the number of samples with each stored value.
            stated: full scale that the files state, or None.
        """
        used = np.concatenate([np.flatnonzero(count) for count in counts])
        assert self._first is not None
        path, _, kind = self._first
        return estimate_levels(
            int(used.max()),
            int(np.bitwise_or.reduce(used)),
            self._raw.container(path, np.dtype(kind)),
            bits=self._settings.bits,
            black=0.0 if self._dark else self._settings.black_level,
            saturation=self._settings.saturation,
            stated=stated,
        )

    def _require_uniform(self, light: NDArray[np.float32]) -> None:
        """Check that the light is uniform. It must have no texture and no dark parts.

        Raises:
            PolarguideError: the light is not uniform.
        """
        left, top = self.pattern.cell_corner()
        step = self.pattern.period
        cut = light[top:, left:]
        cut = cut[: cut.shape[0] // step * step, : cut.shape[1] // step * step]
        # Each position of the pattern has its own throughput and color.
        cells = np.zeros((cut.shape[0] // step, cut.shape[1] // step))
        for row, column in np.ndindex(step, step):
            plane = cut[row::step, column::step]
            cells += plane / plane.mean(dtype=np.float64) / step**2
        side = _CELLS * 2 // step
        rows = cells.shape[0] // side
        columns = cells.shape[1] // side
        grid = cells[: rows * side, : columns * side].reshape(rows, side, columns, side).swapaxes(1, 2)
        blocks = grid.reshape(rows * columns, side * side)
        means = blocks.mean(axis=1)
        low, high = np.percentile(means, [1, 99])
        # A gradient is not texture: the plane through a block is subtracted.
        slope = (np.arange(side) + 0.5) / side - 0.5
        rest = blocks / means[:, None] - 1
        for tilt in (np.tile(slope, side), np.repeat(slope, side)):
            rest = rest - np.outer(rest @ tilt / (tilt @ tilt), tilt)
        texture = float(np.sqrt(np.mean(rest**2)))
        require(
            low >= UNEVEN * high and texture <= TEXTURED,
            self.files[0].parent,
            expected=f"a uniform light: its dimmest part above {UNEVEN:.0%}, texture below {TEXTURED:.0%}",
            found=f"{low / high:.0%} of the brightest part in the dimmest, {texture:.0%} of texture",
            remedy="Fill the field with the polarizer in front of a diffuser or an integrating sphere, out of focus.",
        )


def _files(option: str, path: Path | None) -> list[Path]:
    """Return the files that an option specifies: a single file, or all mosaics of a folder.

    Raises:
        PolarguideError: the folder has no mosaic.
    """
    if path is None or not path.is_dir():
        return [] if path is None else [path]
    paths = list(index_files(path, RAW_SUFFIXES).values())
    require(
        paths,
        f"{option} {path}",
        expected="a mosaic, or a folder of mosaics",
        found=describe_contents(path),
        remedy="Remove the option, or specify the files.",
    )
    return paths


MISFIT = 0.02
"""Largest relative deviation of the means from the fit. Above it, the shots contradict each other."""
SAME_ANGLE = np.radians(2.0)
"""Largest difference of two angles that count as equal, radians."""
NARROW = 0.15
"""Smallest spread of the angles, as a singular value of the directions of the shots.

Angles that are spread over half a turn have 0.7.
"""
POLARIZED = 0.5
"""Smallest DoLP of a shot that was taken through a polarizer."""
FLAT_POLARIZED = 0.1
"""Smallest DoLP of a flat field that is certainly polarized. Unequal gains of a sensor cause less."""
UNSTEADY = 0.15
"""Largest change of the brightness that sensor errors can cause (3 % of gain, extinction ratios of 20)."""
LARGEST_ZERO = np.radians(10.0)
"""Largest error of the zero direction of angles that the user specified, radians."""
ALIKE = 0.9
"""Smallest agreement between specified and estimated angles. It is 1 if they differ by a constant."""


@dataclass(frozen=True, eq=False)
class ShotFit:
    """Estimated angles and brightness of the shots.

    Attributes:
        angles: angles of the polarizer, radians, [T].
        levels: brightness of the light behind the polarizer, [T], with mean 1.
        vectors: analyzer vectors of the positions, [K, 3], in the unit of the means.
        misfit: root mean square deviation of the means from the fit, as a share of their mean.
        zero: mean deviation of the positions from their nominal angles in radians, before the zero direction is chosen.
        flat_dolp: DoLP of the flat field according to the calibration, or None.
    """

    angles: Array
    levels: Array
    vectors: Array
    misfit: float
    zero: float
    flat_dolp: float | None

    def stokes(self, diattenuation: float) -> Array:
        """Return the Stokes vectors [T, 3] of the light in the shots, behind a polarizer with this diattenuation."""
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
    """Estimate the angles and the brightness of the shots.

    Args:
        means: means of each shot by position, [T, K].
        nominal: nominal angles of the positions, radians, [K].
        known: angles of the polarizer, radians, [T]. If None, they are estimated.
        flat: means of the flat field, [K], or None.
        diattenuation: diattenuation of the polarizer, (E - 1) / (E + 1) for the extinction ratio E.
        to_mean: True to choose the zero direction so that the positions have no mean deviation from their nominal
            angles.
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
            remedy="Take the shot through the polarizer, and --flat without the polarizer. Check --sensor and offsets.",
        )
    if flat is not None:
        dolp = _dolp(_pixel_stokes(flat[None], nominal)[0])
        require(
            dolp <= FLAT_POLARIZED,
            "--flat",
            expected="unpolarized light",
            found=f"a DoLP of {dolp:.0%}",
            remedy="Take --flat without the polarizer, with a thick diffuser. Avoid screens and reflections.",
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
        expected=f"one steady, unpolarized light: shots that differ in brightness by at most {UNSTEADY:.0%}",
        found=f"{change:.0%}: the lamp is polarized, or lamp or exposure changed",
        remedy="Specify --angles, or --flat (a picture without the polarizer), to measure the light of each shot.",
    )


def _stokes(angles: Array, levels: Array, diattenuation: float) -> Array:
    """Return the Stokes vectors [T, 3] of light behind a polarizer, given its angles and the levels of the light."""
    polarized = diattenuation * np.cos(2 * angles), diattenuation * np.sin(2 * angles)
    return levels[:, None] * np.stack([np.ones_like(angles), *polarized], axis=1)


def _pixel_stokes(means: Array, nominal: Array) -> Array:
    """Return the Stokes vectors [T, 3] that ideal analyzers would measure. All colors are scaled to the same level."""
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
    """Fit angles and levels by variable projection.

    The first level is fixed. Known angles are fixed; otherwise, only the first angle is fixed.

    Args:
        means: means of each shot by position, [T, K].
        apparent: initial angles, [T].
        brightness: initial levels, [T].
        known: known angles, as for ``solve_shots``.
        flat: means of the flat field, as for ``solve_shots``.
        diattenuation: diattenuation of the polarizer, as for ``solve_shots``.

    Returns:
        Angles and levels, each [T].
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
    """Check that there are enough angles, and that they are spread widely enough.

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
    """Check that specified angles match the estimated angles.

    Raises:
        PolarguideError: the specified angles increase in the opposite direction, start at a different zero, or belong
            to different shots.
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
    """Return the circular mean of the positions' deviations from their nominal angles, in radians."""
    angles = np.arctan2(vectors[:, 2], vectors[:, 1]) / 2
    return float(np.angle(np.mean(np.exp(2j * (angles - nominal))))) / 2


def _turned(vectors: Array, angle: float) -> Array:
    """Rotate analyzer vectors [K, 3] about the optical axis, by an angle in radians."""
    cosine = np.cos(2 * angle)
    sine = np.sin(2 * angle)
    s0, s1, s2 = vectors.T
    return np.stack([s0, s1 * cosine - s2 * sine, s1 * sine + s2 * cosine], axis=1)
