"""Compute linear intensities from shots through a filter, and estimate levels, exposures and gains of camera files.

The functions work for whole captures and for single shots. Levels and exposures are estimated from all pictures that
the caller passes together.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.brackets import (
    NORMAL,
    SINGLE,
    Bracket,
    MergedExposures,
    measure_exposures,
    merge,
)
from polarguide.capture.calibration import (
    UNIT_GAINS,
    Gains,
    balancing_gains,
)
from polarguide.capture.checks import measured_gains, pair_moments
from polarguide.capture.filter.camera_files import (
    ExposureData,
    is_camera_raw,
    missing_tags,
    read_exposure_data,
)
from polarguide.capture.filter.shots import Shots, read_stack
from polarguide.capture.formats.pictures import linear_codes
from polarguide.capture.formats.stored import may_use_fewer_bits, require_alike
from polarguide.capture.raw_options import GainOptions, SampledOptions
from polarguide.capture.sensor.analyzers import (
    imbalance_notes,
)
from polarguide.capture.sensor.pattern import (
    FULL_16,
    Levels,
    estimate_levels,
    level_notes,
)
from polarguide.capture.view import FULL_CODE
from polarguide.core.errors import PolarguideError
from polarguide.core.progress import Advance
from polarguide.geometry.polarizer import ANGLES

SMALLEST = 0.2
"""Smallest shift in pixels that is corrected. The estimate has errors of this size, and a correction blurs a shot."""
LARGEST_SHARE = 0.05
"""Largest shift that is corrected, as a share of the picture's width."""

_BETTER = 0.95
_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-5)


@dataclass(frozen=True)
class Shift:
    """Displacement of a shot relative to the first.

    Attributes:
        x: shift to the right in pixels. If there is a ``warp``, it is the shift of the picture's center.
        y: shift down in pixels, as ``x``.
        trusted: True if the estimate is reliable.
        warp: affine matrix [2, 3] from pixels of the first shot to pixels of this shot, row by row. It is ``None`` if
            the shot is not rotated. The center of the first pixel is at (0, 0).
    """

    x: float
    y: float
    trusted: bool
    warp: tuple[float, ...] | None = None

    @property
    def corrected(self) -> bool:
        """True if the shift is reliable and large enough for a correction."""
        return self.trusted and (self.warp is not None or max(abs(self.x), abs(self.y)) >= SMALLEST)


AGREEING = 0.05
"""Largest mean of |I0 + I90 - I45 - I135| / S0 at which four shots count as aligned."""


def estimate_shifts(linear: NDArray[np.float32]) -> list[Shift]:
    """Estimate the shifts of the four shots relative to the first.

    Phase correlation of fine detail in the logarithms gives initial values: brightness and polarization vary slowly
    across a surface, and edges stay. Maximization of the enhanced correlation coefficient refines them to a fraction of
    a pixel. Edges of polarization can mislead both. Shifts are therefore trusted only if they improve I0 + I90 = I45 +
    I135. A rotation is added if it improves the pair sums further. A homography would improve them more, but deviates
    more from the truth.

    Args:
        linear: linear intensities [4, H, W, 3].
    """
    detail = [_detail(shot) for shot in linear]
    shifts = [Shift(0.0, 0.0, True), *(_shift(detail[0], other) for other in detail[1:])]
    least = _disagreement(linear, np.zeros(linear.shape[1:3], bool))
    if any(shift.corrected for shift in shifts):
        after = _aligned_disagreement(linear, shifts)
        if after < _BETTER * least:
            least = after
        else:
            shifts = [shifts[0], *(replace(shift, trusted=False) for shift in shifts[1:])]
    turned = [shifts[0], *(_turn(detail[0], detail[k], shifts[k]) for k in (1, 2, 3))]
    if turned != shifts and _aligned_disagreement(linear, turned) < _BETTER * least:
        return turned
    if least < AGREEING:  # pair sums agree, so shots did not move
        return [shift if shift.trusted else Shift(0.0, 0.0, True) for shift in shifts]
    return shifts


def _aligned_disagreement(linear: NDArray[np.float32], shifts: Sequence[Shift]) -> float:
    moved, _, outside = align_shots(linear, (), shifts)
    return _disagreement(moved, outside)


def _disagreement(linear: NDArray[np.float32], bad: NDArray[np.bool_]) -> float:
    """Return the mean of |I0 + I90 - I45 - I135| / S0, after the two pair sums were scaled to the same brightness."""
    i0, i45, i90, i135 = linear.mean(axis=3)[:, ~bad]
    first = i0 + i90
    second = i45 + i135
    if not second.sum() > 0:
        return 0.0
    return float(np.abs(first - second * (first.sum() / second.sum())).sum() / first.sum())


def align_shots(
    linear: NDArray[np.float32], masks: Sequence[NDArray[np.bool_]], shifts: Sequence[Shift]
) -> tuple[NDArray[np.float32], list[NDArray[np.bool_]], NDArray[np.bool_]]:
    """Resample shots so that all of them are aligned with the first shot.

    Args:
        linear: linear intensities [K, H, W, 3].
        masks: masks for each shot, [K, H, W], or for all shots, [H, W].
        shifts: shift of each shot.

    Returns:
        The aligned intensities; for each of ``masks`` a mask [H, W] of the pixels that depend on a marked pixel of some
        shot; and a mask [H, W] of the pixels that depend on a place outside a shot. If no shot moved, the intensities
        are ``linear`` itself.
    """
    height, width = linear.shape[1:3]
    moved = linear.copy() if any(shift.corrected for shift in shifts) else linear
    each = [np.broadcast_to(mask, linear.shape[:3]).copy() for mask in masks]
    outside = np.zeros((height, width), bool)
    for index, shift in enumerate(shifts):
        if not shift.corrected:
            continue
        y, x = np.mgrid[:height, :width].astype(np.float32)
        if shift.warp is None:
            x = x + np.float32(shift.x)
            y = y + np.float32(shift.y)
        else:
            places = np.stack([x.ravel(), y.ravel()], axis=-1)[:, None]
            matrix = np.array(shift.warp, np.float64).reshape(2, 3)
            x, y = cv2.transform(places, matrix)[:, 0].T.reshape(2, height, width)
        moved[index] = cv2.remap(linear[index], x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        beyond = remapped_mask(np.zeros((height, width), bool), x, y)
        for mask in each:
            mask[index] = remapped_mask(mask[index], x, y) & ~beyond
        outside |= beyond
    return moved, [np.asarray(mask.any(axis=0)) for mask in each], outside


def remapped_mask(mask: NDArray[np.bool_], x: Any, y: Any) -> NDArray[np.bool_]:
    """Resample a mask [H, W] at the coordinates ``x`` and ``y`` by bilinear interpolation.

    A pixel of the result is True if its interpolation uses a marked pixel or a place outside the mask.
    """
    weight = cv2.remap(
        mask.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1.0
    )
    return np.asarray(weight > 0)


def moved_shots(shifts: Sequence[Shift]) -> list[str]:
    """Describe each shot whose shift was corrected, as text."""
    return [
        f"{angle} by ({-shift.x:+.2f}, {-shift.y:+.2f}){'' if shift.warp is None else ' and turned'}"
        for angle, shift in zip(ANGLES, shifts, strict=True)
        if shift.corrected
    ]


def shift_notes(view: str, shifts: Sequence[Shift]) -> list[str]:
    """Return notes for the user about shots with a corrected shift, and about shots with an unreliable shift."""
    moved = moved_shots(shifts)
    doubtful = [str(angle) for angle, shift in zip(ANGLES, shifts, strict=True) if not shift.trusted]
    notes = [f"{view}: shots were shifted back, in pixels: {', '.join(moved)}."] if moved else []
    if doubtful:
        notes.append(
            f"{view}: I0 + I90 and I45 + I135 differ, and no shift of the shots at {', '.join(doubtful)} explains it. "
            "These shots are not shifted."
        )
    return notes


def _detail(shot: NDArray[np.float32]) -> NDArray[np.float32]:
    gray = np.log(shot.mean(axis=2) + np.float32(0.01))
    return np.asarray(cv2.GaussianBlur(gray, (0, 0), 0.8) - cv2.GaussianBlur(gray, (0, 0), 5.0), np.float32)


def _shift(reference: NDArray[np.float32], other: NDArray[np.float32]) -> Shift:
    height, width = reference.shape
    if min(height, width) < 2:  # the window needs two pixels
        return Shift(0.0, 0.0, False)
    window = cv2.createHanningWindow((width, height), cv2.CV_32F)
    # The window reduces the weight of borders, where new content has no match. phaseCorrelate would apply it in place,
    # and only for some sizes.
    reference = reference * window
    other = other * window
    (x, y), _ = cv2.phaseCorrelate(reference, other)
    limit = LARGEST_SHARE * width
    if max(abs(x), abs(y)) > limit:
        x = y = 0.0
    warp = np.array([[1, 0, x], [0, 1, y]], np.float32)
    try:
        score, moved = cv2.findTransformECC(
            reference, other, warp, cv2.MOTION_TRANSLATION, _CRITERIA, np.ones(reference.shape, np.uint8), 5
        )
    except cv2.error:  # no convergence without detail
        return Shift(0.0, 0.0, False)
    x, y = (float(value) for value in np.asarray(moved)[:, 2])
    return Shift(
        round(x, 3),
        round(y, 3),
        score > 0.3 and max(abs(x), abs(y)) <= limit and bool(np.isfinite([x, y]).all()),
    )


_TURN_SIDE = 1024
"""Longer side in pixels at which rotations are estimated."""


def _turn(reference: NDArray[np.float32], other: NDArray[np.float32], shift: Shift) -> Shift:
    """Estimate the rotation of a shot in addition to its shift.

    The shift is returned unchanged if the estimate does not converge, or if the rotation is negligible.
    """
    height, width = reference.shape
    if min(height, width) < 2:
        return shift
    factor = max(1, -(-max(height, width) // _TURN_SIDE))
    small = [
        cv2.resize(d, (width // factor, height // factor), interpolation=cv2.INTER_AREA)
        for d in (reference, other)
    ]
    half = (
        factor - 1
    ) / 2  # distance between the centers of the first pixels of the small and the large picture
    large = np.array([[factor, 0, half], [0, factor, half], [0, 0, 1]], np.float64)
    start = np.eye(3)
    start[:2, 2] = (shift.x, shift.y) if shift.trusted else (0.0, 0.0)
    start = (np.linalg.inv(large) @ start @ large).astype(np.float32)
    everywhere = np.ones(small[0].shape, np.uint8)
    try:
        score, start[:2] = cv2.findTransformECC(
            small[0], small[1], start[:2].copy(), cv2.MOTION_EUCLIDEAN, _CRITERIA, everywhere, 5
        )
    except cv2.error:  # no convergence without detail
        return shift
    warp = large @ start.astype(np.float64) @ np.linalg.inv(large)
    corners = np.array([[x, y] for x in (0, width - 1) for y in (0, height - 1)], np.float64)
    moved = cv2.transform(corners[:, None], warp[:2])[:, 0] - corners
    middle = moved.mean(axis=0)
    limit = LARGEST_SHARE * width
    if not (np.isfinite(moved).all() and score > 0.3 and np.abs(moved).max() <= limit):
        return shift
    if np.abs(moved - middle).max() < SMALLEST:
        return shift
    x, y = (round(float(value), 3) for value in middle)
    return Shift(x, y, True, tuple(float(f"{value:.9g}") for value in warp[:2].ravel()))


LARGE_IMBALANCE = 0.01
"""Relative difference of the pair sums above which the user gets a note if it is not corrected."""


def pair_gains(
    ratio: float | None, options: GainOptions, notes: Mapping[str, str], *, calibrated: bool = False
) -> tuple[Gains, list[str]]:
    """Choose the gains of the four angles, and describe the choice for the user.

    Args:
        ratio: ratio (I0 + I90) / (I45 + I135) of the pair sums; None if the pictures are too dark.
        options: options of the user. The gains in ``calibration`` take precedence over the option ``gains``.
        notes: text of the note for each outcome, with a placeholder for the ratio minus 1. The outcomes are "dark",
            "off" if the ratio is too large for gains, "corrected", and "left" if a large ratio is not corrected.
        calibrated: True if the intensities were corrected with analyzer vectors, which include the gains.

    Returns:
        The gains, and notes for the user.
    """
    if calibrated:
        return UNIT_GAINS, imbalance_notes(ratio)
    if options.calibration.gains is not None:
        return options.calibration.gains, []
    gains = balancing_gains(ratio)
    deviation = 0.0 if ratio is None else ratio - 1
    if gains is None:
        outcome = "dark" if ratio is None else "off"
    elif options.gains == "auto":
        outcome = "corrected"
    else:
        outcome = "left" if abs(deviation) > LARGE_IMBALANCE else ""
    used = gains if gains is not None and outcome == "corrected" else UNIT_GAINS
    return used, [notes[outcome].format(deviation)] if outcome in notes else []


# Largest difference of the logarithms of two equal exposures. Files state exposures with three digits.
_EQUAL = 1e-3


def light_of_files(
    views: Mapping[str, Sequence[Path]], advance: Advance | None = None
) -> tuple[dict[Path, float], str]:
    """Read the exposure of each shot from EXIF tags.

    The exposures of a bracket become one value: the exposure at which the merged radiance 1 is full scale.

    Args:
        views: files of each view, which represent its shots.
        advance: callback for the number of views that were read.

    Returns:
        The exposures of the shots whose files state an exposure; and a warning, or "". If some files lack a tag that
        others have, exposures cannot be compared. The result is then empty, and the warning names the missing tags.

    Raises:
        PolarguideError: a file cannot be read, or the shots of a view have different exposures.
    """
    taken: dict[Path, ExposureData] = {}
    scales: dict[Path, tuple[Path, float]] = {}
    for number, paths in enumerate(views.values(), 1):
        bracket = Bracket.of(paths)
        taken |= {file: read_exposure_data(file) for files in bracket.files for file in files}
        scale = 2.0 ** -(bracket.stops or (0.0,))[bracket.normal]
        scales |= {
            path: (file, scale) for path, file in zip(paths, bracket.files[bracket.normal], strict=True)
        }
        if advance is not None:
            advance(number)
    missing = missing_tags(taken)
    if missing:
        return {}, missing
    stated = {path: (taken[file].light, scale) for path, (file, scale) in scales.items()}
    return {path: light * scale for path, (light, scale) in stated.items() if light is not None}, ""


def stated_exposures(
    views: Mapping[str, Sequence[Path]], advance: Advance | None = None
) -> tuple[dict[str, list[float]], str]:
    """Read the relative exposures of the pictures of each view from EXIF tags. Their geometric mean is 1.

    Returns:
        The exposures of all views; and the warning of ``light_of_files``. The exposures are empty if all of them are
        equal, or if the files cannot be compared.
    """
    stated, missing = light_of_files(views, advance)
    logs = {path: math.log(light) for path, light in stated.items()}
    if not logs or max(logs.values()) - min(logs.values()) < _EQUAL:
        return {}, missing
    mean = sum(logs.values()) / len(logs)
    return {view: [math.exp(logs[path] - mean) for path in paths] for view, paths in views.items()}, ""


def exposure_notes(stated: Mapping[str, Sequence[float]]) -> list[str]:
    """Return a note for the user about the exposures that the files state."""
    if not stated:
        return []
    every = [value for exposures in stated.values() for value in exposures]
    stops = math.log2(max(every) / min(every))
    within = sum(math.log(max(exposures) / min(exposures)) >= _EQUAL for exposures in stated.values())
    return [
        f"Exposures differ by up to {stops:.2f} stops by EXIF, in {within} views from shot to shot. They are divided "
        "out (--gains none keeps them)."
    ]


def exposures_of_view(
    names: Sequence[str], gray: NDArray[np.floating[Any]], usable: NDArray[np.bool_], stated: Sequence[float]
) -> tuple[Gains, str]:
    """Choose the exposures of the four shots of a view.

    The exposures that the files state are used, unless the pair sums of the shots contradict them significantly.

    Args:
        names: names of the shots for messages.
        gray: linear intensities [4, H, W].
        usable: mask of usable pixels, [H, W].
        stated: exposures that the files state; 1 if they state no exposure.

    Returns:
        The gains by which the shots are divided; and a warning if the pair sums contradict the files, otherwise "".
    """
    logs = np.log(np.asarray(stated, np.float64))
    mean = float(logs.mean())
    measured = measured_gains(pair_moments(gray, usable))
    off = {} if measured is None else measured.deviating(list(logs - mean))
    if measured is None or not off:
        return _as_gains(np.exp(logs)), ""
    differ = float(np.ptp(logs)) >= _EQUAL
    named = ", ".join(
        f"{names[ANGLES.index(angle)]} ({angle} degrees) by {factor - 1:+.0%}"
        for angle, factor in off.items()
    )
    reference = "than their EXIF exposures say" if differ else "than the other shots of the view"
    warning = (
        f"exposed differently {reference}, by the pair sums: {named}. The pair sums are used. Automatic exposure, "
        "edited pictures, or a filter that was not rotated?"
    )
    return _as_gains(np.exp(np.asarray(measured.logs) + mean)), warning


def _as_gains(values: Iterable[float]) -> Gains:
    first, second, third, fourth = map(float, values)
    return first, second, third, fourth


COMPARABLE = "Keep one kind: their brightness cannot be compared."
"""Remedy in the error for different kinds of files in one capture or view."""


def require_one(where: Path, kinds: Iterable[tuple[str, Path]], expected: str, remedy: str) -> None:
    """Refuse pictures that differ in a property that must be equal, such as their size.

    Args:
        where: folder of the pictures.
        kinds: value of the property and path of each file.
        expected: text of the error.
        remedy: text of the error.

    Raises:
        PolarguideError: two files differ. The message names the first file of each value.
    """
    first: dict[str, Path] = {}
    for name, path in kinds:
        first.setdefault(name, path)
    if len(first) > 1:
        named = " and ".join(f"{name} ({path.name})" for name, path in list(first.items())[:4])
        raise PolarguideError(where, expected=expected, found=named, remedy=remedy)


def levels_of_capture(
    counts: NDArray[np.int64],
    container: int,
    options: SampledOptions,
    *,
    black: float = 0.0,
    stated: int | None = None,
) -> tuple[Levels, list[str]]:
    """Estimate the levels (such as full scale) of the stored values of a capture.

    Args:
        counts: number of occurrences of each stored value, starting at the value 0.
        container: number of bits of a value in the files.
        options: options ``bits`` and ``saturation`` of the user.
        black: stored value without light.
        stated: full scale that all files state, or None.

    Returns:
        The levels, and notes for the user.

    Raises:
        PolarguideError: a value exceeds ``--bits``, or ``--saturation`` is out of range.
    """
    occurring = np.flatnonzero(counts)
    levels = estimate_levels(
        int(occurring[-1]), int(np.bitwise_or.reduce(occurring)), container,
        bits=options.bits, black=black, saturation=options.saturation, counts=counts, stated=stated,
    )  # fmt: skip
    return levels, level_notes(levels, counts, container, options.bits, stated)


def levels_of_pictures(paths: Sequence[Path], options: SampledOptions) -> tuple[Levels | None, list[str]]:
    """Estimate the levels (such as full scale) of the stored values of all pictures of a capture.

    Args:
        paths: files of the capture.
        options: options ``bits`` and ``saturation`` of the user.

    Returns:
        The levels, and notes for the user. The levels are ``None`` if the full scale of each file is known.

    Raises:
        PolarguideError: a value exceeds ``--bits``, or ``--saturation`` is out of range.
    """
    wide = [path for path in paths if not is_camera_raw(path) and may_use_fewer_bits(path)]
    if not wide and options.bits is None and options.saturation is None:
        return None, []
    counts = np.zeros(FULL_16 + 1, np.int64)
    container = 8
    for path in wide or paths:
        values = read_stack([path]).pictures
        container = 8 * values.dtype.itemsize
        counts += np.bincount(values.ravel(), minlength=len(counts))
    levels, notes = levels_of_capture(counts, container, options)
    return levels, [] if levels.is_full(container) else notes


@dataclass(frozen=True, eq=False)
class BracketedShots:
    """Stored pixels of the K shots of a view at E exposures.

    Attributes:
        bracket: files of the exposures.
        shots: stored pixels at each exposure.
    """

    bracket: Bracket
    shots: Sequence[Shots]

    @classmethod
    def single(cls, shots: Shots) -> BracketedShots:
        """Use shots with one exposure."""
        return cls(SINGLE, [shots])

    @classmethod
    def read(cls, paths: Sequence[Path], levels: Levels | None = None) -> BracketedShots:
        """Read all exposures of the shots that some files represent. ``read_stack`` describes the arguments.

        Raises:
            PolarguideError: a file cannot be read, or files differ in size, depth, orientation or exposures.
        """
        bracket = Bracket.of(paths)
        shots = [read_stack(files, levels) for files in bracket.files]
        for files, others in zip(bracket.files, shots, strict=True):
            require_alike(files[0], others.pictures[0], bracket.files[0][0], shots[0].pictures[0])
        return cls(bracket, shots)


@dataclass(frozen=True, eq=False)
class LinearShots:
    """Linear intensities of the K shots of a view. If there are four shots, they may be aligned.

    Attributes:
        values: linear intensities, [K, H, W, 3]; full scale of the normal exposure is 1.
        saturated: mask of the pixels that are saturated in some shot, [H, W].
        dark: mask of the pixels that are 0 in all shots, [H, W].
        outside: mask of the pixels that are outside the picture of some shot after the alignment, [H, W].
        shifts: estimated shifts of the shots.
        orientation: EXIF orientation of the shots.
        clipped_share: share of the saturated pixels before the alignment.
        dark_share: share of the dark pixels before the alignment.
        exposures: exposures that were merged.
    """

    values: NDArray[np.float32]
    saturated: NDArray[np.bool_]
    dark: NDArray[np.bool_]
    outside: NDArray[np.bool_]
    shifts: list[Shift]
    orientation: int
    clipped_share: float
    dark_share: float
    exposures: MergedExposures = NORMAL

    @property
    def invalid(self) -> NDArray[np.bool_]:
        """Mask of the pixels that are saturated, dark or outside the picture of a shot, [H, W]."""
        return self.saturated | self.dark | self.outside

    @classmethod
    def of(cls, exposures: BracketedShots, transfer: str, *, align: bool) -> LinearShots:
        """Convert the stored values of shots to linear intensities, and merge their exposures.

        Shifts of the shots are corrected if ``align``.

        Raises:
            PolarguideError: the exposures contradict each other, see ``measure_exposures``.
        """

        def linear(shots: Shots) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
            codes = linear_codes(shots.pictures, transfer)
            return codes.astype(np.float32) / np.float32(FULL_CODE), shots.clipped

        measured = measure_exposures(exposures.bracket, exposures.shots, linear)
        radiance = merge(exposures.shots, linear, measured)
        values = radiance.values
        clipped = radiance.clipped
        no_light = np.logical_and.reduce([shots.dark for shots in exposures.shots])
        # Highlights must not dominate the correlation of the shots.
        shifts = estimate_shifts(np.minimum(values, 1.0)) if align else [Shift(0.0, 0.0, True)] * len(values)
        values, (saturated, dark), outside = align_shots(values, (clipped, no_light), shifts)
        return cls(
            values,
            saturated,
            dark,
            outside,
            shifts,
            exposures.shots[0].orientation,
            float(clipped.any(axis=0).mean()),
            float(no_light.mean()),
            radiance.exposures,
        )

    def evenly_exposed(
        self, names: Sequence[str], stated: Sequence[float], options: GainOptions
    ) -> tuple[NDArray[np.float32], Gains, str]:
        """Divide four shots by their exposures.

        Args:
            names: names of the shots for messages.
            stated: exposures that the files state; 1 if they state no exposure.
            options: options of the user. If ``gains`` is auto and no calibration specifies gains, the exposures are
                also measured from the pair sums.

        Returns:
            The divided intensities, the exposures, and the warning of ``exposures_of_view``.
        """
        exposures = _as_gains(stated)
        warning = ""
        if options.gains == "auto" and options.calibration.gains is None:
            exposures, warning = exposures_of_view(names, self.values.mean(axis=3), ~self.invalid, stated)
        return self.values / np.asarray(exposures, np.float32)[:, None, None, None], exposures, warning
