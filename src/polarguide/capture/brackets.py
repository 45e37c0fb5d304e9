"""Merge exposure brackets to linear radiance.

An exposure of ``t`` times the normal light stores the value ``x = t L`` of a sample with the radiance ``L``. The
variance of a linear sensor is ``x`` times a constant (photon noise), plus a constant (read noise), see EMVA 1288. The
merged radiance is the mean of ``x / t`` with the inverse variances as weights, as in Granados et al. (CVPR 2010).
Clipped samples have no weight. A radiance of 1 is full scale of the normal exposure.

The ratios of the exposures are measured in samples that both exposures of a pair record well, because shutters deviate
from their nominal times. The same samples show if the camera, the object or the light changed between the exposures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.filter.camera_files import missing_tags, read_exposure_data
from polarguide.capture.layout import exposure_files, exposure_name
from polarguide.core.errors import PolarguideError, require

READ_NOISE = 2.4**2 / 10500
"""Variance of the read noise, relative to the photon noise at full scale. The value is that of Sony's IMX250MYR."""
BRIGHT = 0.25
"""Linear intensity above which a block of the longer exposure is compared with the next exposure."""
DARK = 0.004
"""Linear intensity below which noise and 8-bit rounding hide the exposure."""
SIDE = 4
"""Side of the blocks that are compared, in samples: one period of a color sensor with polarizers."""
FEWEST = 10
"""Smallest number of blocks by which two exposures are compared."""
OTHER_EXPOSURE = 1 / 6
"""Smallest difference of two exposures in stops that counts as different.

It is half of a third of a stop, because cameras change exposures by thirds of a stop.
"""
MOVED_VALUE = 0.1
"""Smallest relative difference of two exposures of a block that counts as a change of the scene."""
MOVED_SHARE = 0.02
"""Share of changed blocks from which the exposures show different scenes."""
_SIGMAS = 5.0
_MOST_BLOCKS = 50_000

Values = NDArray[np.float32]
Mask = NDArray[np.bool_]
T = TypeVar("T")


@dataclass(frozen=True)
class Bracket:
    """Files of K shots at E exposures.

    Attributes:
        files: files of the K shots at each exposure, from the longest to the shortest if ``stops`` is known.
        stops: exposures in stops relative to the normal exposure, as names, tables or EXIF state them. None if they are
            not stated.
    """

    files: tuple[tuple[Path, ...], ...]
    stops: tuple[float, ...] | None

    @classmethod
    def of(cls, paths: Sequence[Path]) -> Bracket:
        """Find all exposures of the shots that some files represent.

        Raises:
            PolarguideError: the shots have different exposures, or names or the table state no normal exposure.
        """
        brackets = [exposure_files(path) for path in paths]
        for files in brackets:
            _require_normal(files)
        if all(len(files) == 1 for files in brackets):
            return cls((tuple(paths),), (0.0,))
        stated = [_stated_stops(files) for files in brackets]
        for path, files, stops in zip(paths, brackets, stated, strict=True):
            require(
                len(files) == len(brackets[0]) and _are_alike(stops, stated[0]),
                path,
                expected=f"{len(brackets[0])} exposures like {paths[0].name} ({_stops_text(stated[0])})",
                found=f"{', '.join(file.name for file in files)} ({_stops_text(stops)})",
                remedy="Add the missing files, correct the stops, or remove this exposure of all shots of the view.",
            )
        if stated[0] is None:
            return cls(tuple(zip(*brackets, strict=True)), None)
        ordered = [
            [file for _, file in sorted(zip(stops or (), files, strict=True), key=lambda pair: -pair[0])]
            for stops, files in zip(stated, brackets, strict=True)
        ]
        return cls(tuple(zip(*ordered, strict=True)), tuple(sorted(stated[0], reverse=True)))

    @property
    def single(self) -> bool:
        """True if there is one exposure only."""
        return len(self.files) == 1

    @property
    def normal(self) -> int:
        """Index of the exposure that is nearest to the normal one."""
        stops = self.stops or (0.0,)
        return min(range(len(stops)), key=lambda k: abs(stops[k]))


SINGLE = Bracket(((),), (0.0,))
"""One exposure of shots in memory."""


def _require_normal(files: Sequence[Path]) -> None:
    """Check that one exposure of a shot is the normal one, if names or the table state the stops of all of them.

    Raises:
        PolarguideError: all stated stops differ from 0.
    """
    named = [exposure_name(file).stops for file in files]
    stops = [value for value in named if value is not None]
    require(
        len(stops) < len(files) or min(map(abs, stops)) < OTHER_EXPOSURE,
        files[0],
        expected="a normal exposure of the shot, which has 0 stops",
        found=_stops_text(stops),
        remedy="Add the normal exposure, or correct the stops in the names or in exposures.csv.",
    )


def _are_alike(stops: Sequence[float] | None, others: Sequence[float] | None) -> bool:
    """Return True if two shots have the same exposures in any order, or state none."""
    if stops is None or others is None:
        return stops is others
    pairs = zip(sorted(stops), sorted(others), strict=True)
    return all(abs(stop - other) < OTHER_EXPOSURE for stop, other in pairs)


def _stops_text(stops: Sequence[float] | None) -> str:
    """Format the exposures of a shot for an error message, the longest first."""
    if stops is None:
        return "stops not stated"
    return f"{', '.join(f'{stop:+.2f}' for stop in sorted(stops, reverse=True))} stops"


def _stated_stops(files: Sequence[Path]) -> list[float] | None:
    """Return the exposures in stops that names or the table state, else those of EXIF tags, else None.

    Raises:
        PolarguideError: two files state the same exposure.
    """
    named = [exposure_name(file).stops for file in files]
    stops = [value for value in named if value is not None]
    if len(stops) < len(files):
        data = {file: read_exposure_data(file) for file in files}
        light = [each.light for each in data.values()]
        logs = [math.log2(value) for value in light if value is not None]
        if missing_tags(data) or len(logs) < len(files):
            return None
        stops = [log - max(logs) for log in logs]
    first: dict[float, Path] = {}
    for file, value in zip(files, stops, strict=True):
        twin = next((first[other] for other in first if abs(other - value) < OTHER_EXPOSURE), None)
        require(
            twin is None,
            file,
            expected="different exposures of a shot",
            found=f"{value:+.2f} stops, like {twin.name if twin else ''}",
            remedy="Correct the exposure in the name or in exposures.csv, or remove the file.",
        )
        first[value] = file
    return stops


@dataclass(frozen=True)
class MergedExposures:
    """Exposures that were merged.

    Attributes:
        stops: measured exposures in stops relative to the normal exposure, in the order of ``Bracket.files``.
        fitted: True if the exposures were not stated.
    """

    stops: tuple[float, ...] = (0.0,)
    fitted: bool = False


NORMAL = MergedExposures()
"""The normal exposure alone."""


@dataclass(frozen=True, eq=False)
class Radiance:
    """Linear radiance from one exposure or several merged ones.

    Attributes:
        values: linear radiance, in the shape of one exposure; 1 is full scale of the normal exposure. Samples that clip
            in all exposures have the value of the shortest exposure, which is a lower bound.
        clipped: mask of the samples that clip in all exposures.
        exposures: the merged exposures.
    """

    values: Values
    clipped: Mask
    exposures: MergedExposures = NORMAL


def bracket_notes(merged: Sequence[MergedExposures]) -> list[str]:
    """Return a note for the user about the exposures of the views of a capture that have several ones."""
    kinds: dict[int, list[MergedExposures]] = {}
    for exposures in merged:
        kinds.setdefault(len(exposures.stops), []).append(exposures)
    notes = []
    for count, group in sorted(kinds.items()):
        middle = np.median([sorted(exposures.stops, reverse=True) for exposures in group], axis=0)
        stops = ", ".join(f"{stop:+.2f}" for stop in middle)
        fitted = sum(exposures.fitted for exposures in group)
        source = (
            f" They are not stated for {fitted} views, and fitted where the exposures overlap."
            if fitted
            else ""
        )
        notes.append(f"{len(group)} views have {count} exposures, which are merged: {stops} stops.{source}")
    return notes


def measure_exposures(
    bracket: Bracket, exposures: Sequence[T], linear: Callable[[T], tuple[Values, Mask]]
) -> MergedExposures:
    """Measure the exposures of a view in samples that two exposures record well, and check them.

    If the normal exposure of a view has no highlights, shorter exposures have no such samples. Their stated values are
    then used.

    Args:
        bracket: files of the exposures.
        exposures: data of each exposure, in the order of ``bracket.files``.
        linear: function that converts an exposure to linear intensities, and to the mask of its clipped samples. The
            mask has the shape of the intensities, or lacks their last axis.

    Raises:
        PolarguideError: two exposures do not overlap, show different scenes, or differ from their stated ratio. The
            message names the file.
    """
    if bracket.single:
        return NORMAL
    blocks = [_blocks(*linear(exposure)) for exposure in exposures]
    order = list(range(len(blocks)))
    if bracket.stops is None:
        order.sort(key=lambda k: -float(blocks[k][0].mean()))
    names = [bracket.files[k][0] for k in order]
    stated = None if bracket.stops is None else np.asarray(bracket.stops)
    steps = [
        _step(names[k : k + 2], blocks[order[k]], blocks[order[k + 1]], stated is not None)
        for k in range(len(order) - 1)
    ]
    differences = np.array([step.stops for step in steps])
    if stated is not None:
        differences = np.where(np.isnan(differences), np.diff(stated), differences)
    _require_still(names, steps)
    if stated is not None:
        _require_stated(names, np.diff(stated), differences)
    fitted = np.concatenate([[0.0], np.cumsum(differences)])
    if stated is not None:
        fitted += stated[bracket.normal] - fitted[bracket.normal]
    stops = dict(zip(order, fitted.tolist(), strict=True))
    return MergedExposures(tuple(stops[k] for k in range(len(order))), stated is None)


def merge(
    exposures: Sequence[T], linear: Callable[[T], tuple[Values, Mask]], measured: MergedExposures
) -> Radiance:
    """Merge the exposures of a view. One exposure is returned unchanged.

    Args:
        exposures: data of each exposure, or of equal parts of them.
        linear: see ``measure_exposures``.
        measured: result of ``measure_exposures``.
    """
    if len(exposures) == 1:
        return Radiance(*linear(exposures[0]))
    stops = np.asarray(measured.stops)
    order = [int(k) for k in np.argsort(-stops)]
    values, clipped = _weighted_mean([exposures[k] for k in order], linear, np.exp2(stops[order]))
    return Radiance(values, clipped, measured)


def _blocks(values: Values, clipped: Mask) -> tuple[Values, Mask]:
    """Return a regular sample of blocks of an exposure.

    Returns:
        The values of N blocks, [N, 16]; and the mask of clipped samples, [N, 16].
    """
    mask = _like(clipped, values)
    planes = (np.moveaxis(each, -1, 0) if values.ndim == 4 else each[None] for each in (values, mask))
    blocks, masks = (_cut_blocks(plane.reshape(-1, *plane.shape[-2:])) for plane in planes)
    return blocks, masks


def _cut_blocks(planes: NDArray[Any]) -> NDArray[Any]:
    """Cut planes [P, H, W] into blocks, and return a regular sample of them, [N, 16]."""
    count, height, width = planes.shape
    rows = height // SIDE
    columns = width // SIDE
    cut = planes[:, : rows * SIDE, : columns * SIDE].reshape(count, rows, SIDE, columns, SIDE)
    total = count * rows * columns
    plane, row, column = np.unravel_index(
        np.arange(0, total, max(1, total // _MOST_BLOCKS)), (count, rows, columns)
    )
    return cut[plane, row, :, column].reshape(-1, SIDE * SIDE)


def _like(clipped: Mask, values: Values) -> Mask:
    return np.broadcast_to(clipped if clipped.ndim == values.ndim else clipped[..., None], values.shape)


@dataclass(frozen=True)
class _Step:
    """Comparison of two successive exposures.

    Attributes:
        stops: their difference in stops; NaN if no sample is bright enough in the longer exposure.
        changed: share of samples that changed between the exposures.
    """

    stops: float
    changed: float = 0.0


def _step(
    names: Sequence[Path], longer: tuple[Values, Mask], shorter: tuple[Values, Mask], stated: bool
) -> _Step:
    """Compare two exposures in the samples that both record well.

    Raises:
        PolarguideError: there are too few such samples, and the longer exposure clips or the ratio is not stated.
    """
    x = longer[0].astype(np.float64)
    y = shorter[0].astype(np.float64)
    usable = ~(longer[1] | shorter[1]).any(axis=1) & (x.mean(axis=1) > BRIGHT)
    x = x[usable]
    y = y[usable]
    middle = float(np.median(y)) if len(y) else 0.0
    if len(x) < FEWEST or middle <= DARK:
        require(
            longer[1].all(axis=1).sum() < FEWEST and stated,
            names[1],
            expected=f"an exposure that overlaps with {names[0].name}: both record bright areas without clipping",
            found=f"{len(x)} blocks of pixels in the brightest two stops of the longer exposure"
            + (f", which have {middle:.4f} of full scale in the shorter one" if len(x) else ""),
            remedy="Add an exposure between the two, or remove the file.",
        )
        return _Step(math.nan)
    sums = x.sum(axis=1)
    ratio = float(np.median(y.sum(axis=1) / sums))
    residual = (y - ratio * x) / np.sqrt(ratio * x.mean(axis=1, keepdims=True))
    # Noise differs from sample to sample. A change of the scene is common to the samples of a block.
    noise = float(np.median(residual.std(axis=1))) / SIDE
    mean = np.abs(residual.mean(axis=1))
    relative = np.abs(y.sum(axis=1) / (ratio * sums) - 1)
    changed = (mean > _SIGMAS * noise) & (relative > MOVED_VALUE)
    still = ~changed
    # The median of few photons is smaller than their mean.
    ratio = float(y[still].sum() / x[still].sum()) if still.any() else ratio
    return _Step(math.log2(ratio), float(changed.mean()))


def _require_stated(names: Sequence[Path], stated: NDArray[np.float64], fitted: NDArray[np.float64]) -> None:
    """Check that the measured differences of successive exposures are the stated ones.

    Raises:
        PolarguideError: a difference deviates. The message names the file.
    """
    wrong = np.abs(stated - fitted) > OTHER_EXPOSURE
    if wrong.any():
        k = _odd(wrong)
        pair = max(k - 1, 0)
        other = k - 1 if k else 1
        sign = 1 if k else -1
        raise PolarguideError(
            names[k],
            expected=f"{sign * stated[pair]:+.2f} stops from {names[other].name}, as stated",
            found=f"{sign * fitted[pair]:+.2f} stops in the pictures",
            remedy="Correct the exposure in the name, in exposures.csv or in EXIF, or remove the file.",
        )


def _odd(wrong: Mask) -> int:
    """Return the index of the exposure that causes wrong pairs. The mask has an entry for each pair of neighbors."""
    pair = int(np.argmax(wrong))
    alone = len(wrong) > 1 and not wrong[1:].any()
    return pair if pair == 0 and alone else pair + 1


def _require_still(names: Sequence[Path], steps: Sequence[_Step]) -> None:
    moved = np.array([step.changed > MOVED_SHARE for step in steps])
    if moved.any():
        k = _odd(moved)
        share = max(steps[pair].changed for pair in (k - 1, k) if 0 <= pair < len(steps))
        raise PolarguideError(
            names[k],
            expected=f"the same scene as in {names[k - 1 if k else 1].name} at another exposure",
            found=f"differences beyond noise in {share:.0%} of the bright areas",
            remedy="The camera, the object or the light moved, or a tone curve was applied. Remove the file.",
        )


def _weighted_mean(
    exposures: Sequence[T], linear: Callable[[T], tuple[Values, Mask]], light: NDArray[np.float64]
) -> tuple[Values, Mask]:
    """Return the mean radiance with the inverse variances as weights, and the mask of samples without weight.

    The variance is computed from the longest exposure that does not clip, so that it is the same for all exposures.

    Args:
        exposures: data of each exposure, the longest first.
        linear: see ``merge``.
        light: relative exposures.
    """
    total: Any = None
    for exposure, t in zip(exposures, light.astype(np.float32), strict=True):
        values, clipped = linear(exposure)
        if total is None:
            total = np.zeros_like(values)
            weights = np.zeros_like(values)
            first = np.zeros_like(values)
        usable = ~_like(clipped, values)
        radiance = values / t
        first = np.where(weights == 0, radiance, first)
        weight = usable * t * t / (t * np.maximum(first, 0) + np.float32(READ_NOISE))
        total += weight * radiance
        weights += weight
    lost = weights == 0
    mean = np.where(lost, first, total / np.where(lost, 1, weights)).astype(np.float32)
    return mean, lost if clipped.ndim == values.ndim else lost.any(axis=-1)
