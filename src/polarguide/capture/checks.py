"""Find faults of a capture in its pictures: exposure, encoding, order of the files, and different gains.

``measure`` reduces each view to a few numbers while its pictures are in memory. ``exposure_warnings`` and
``polarization_warnings`` turn the numbers of all views into warnings.

For any light, I0 + I90 = I45 + I135. With gains g, I0/g0 - I45/g45 + I90/g90 - I135/g135 is zero at every pixel. The
median of the pair sums gives one ratio of the gains. All pixels together give the four gains up to a common factor if
their polarization varies in strength and direction: the vector (1/g) is perpendicular to all samples (I0, I45, I90,
I135), and thus the eigenvector of their second moments with the smallest eigenvalue. An angle error of two degrees
looks like a gain error of some percent. Exposures differ by thirds of a stop.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from polarguide.capture.angle_evidence import AngleLimits, angle_difference, jackknife_error
from polarguide.capture.view import FULL_CODE
from polarguide.core.text import listed
from polarguide.geometry.polarizer import ANGLES


class CheckLimits:
    """Constants of the checks.

    Attributes:
        top_share: share of the value range that the histogram for ``full_scale`` covers. It starts at the top.
        full_share: share of the value range in which the full scale may be. It starts at the top.
        dark: a view is almost black if the 99th percentile of its intensities is smaller.
        blown: a view is heavily saturated if the share of its saturated pixels is larger.
        low_code: quantization hides the polarization of pixels with a smaller code.
        samples: largest number of pixels of a view that are measured.
        residual: residual of the pair sums, as a share of S0, above which the user gets a warning.
        right_angle: largest deviation of two perpendicular pictures from 90 degrees, in degrees. The sum of the two
            pictures is then wrong by two percent of the polarized light.
        other_exposure: smallest difference of the logarithms of two exposures that count as different. It is half of
            a third of a stop, because cameras change exposures by thirds of a stop.
        tiles: number of tiles of a picture in each direction, for jackknife errors.
        hidden: read-out noise hides the polarization of pixels below this share of the largest value.
        fewest: smallest number of pixels for a regression.
        least_spread: smallest standard deviation of the regressor for a regression.
        moment_samples: largest number of pixels of a view from which second moments are computed.
    """

    top_share = 0.02
    full_share = 0.002
    dark = 0.01
    blown = 0.1
    low_code = FULL_CODE // 256
    samples = 20_000
    residual = 0.05
    right_angle = 1.0
    other_exposure = math.log(2.0) / 6
    tiles = 4
    hidden = 0.01
    fewest = 1000
    least_spread = 0.005
    moment_samples = 1 << 18


# Curvature (see ``pair_slopes``) of encoded data taken as linear is about -0.6, of linear data decoded as sRGB about
# +0.3; the gain differences of real sensors leave less than 0.1.
ENCODED = (-0.12, -0.25)
"""Two limits of the curvature of files that are read as linear.

Below the first limit, the files may be encoded. Below the second limit, they are encoded."""
DECODED = (0.1, 0.2)
"""Two limits of the curvature of files that are decoded as sRGB.

Above the first limit, the files may already be linear. Above the second limit, they are linear."""
BENT = 0.05
"""Largest significant curvature of a linear response. A gamma of 0.9 has a curvature of -0.056, and a similar error of
DoLP."""


@dataclass(frozen=True)
class Measures:
    """Statistics of the pictures of one view, from which warnings are derived.

    Attributes:
        bright: 99th percentile of the linear intensities, in [0, 1].
        residuals: difference of the two pair sums relative to S0, as the median of its absolute value. There is a value
            for each of the three ways to form two pairs: (0, 90 | 45, 135), (0, 45 | 90, 135), (0, 135 | 45, 90). The
            first value is zero for an ideal capture.
        slopes: result of ``pair_slopes`` for the pairs of the view; empty if the view has too few usable pixels.
    """

    bright: float
    residuals: tuple[float, float, float]
    slopes: list[NDArray[np.float64]]


def sampled(codes: NDArray[Any]) -> NDArray[Any]:
    """Return a sample of a view's codes [K, H, W, ...].

    It is sufficient for ``measure``, so the caller can free the memory of the codes.
    """
    step = _step(codes.shape[1] * codes.shape[2])
    return codes[:, ::step, ::step].copy()


def _step(pixels: int) -> int:
    """Return the distance between sampled pixels in each direction."""
    return max(1, math.ceil(math.sqrt(pixels / CheckLimits.samples)))


def measure(codes: NDArray[np.uint16], usable: NDArray[np.bool_], *, four: bool = True) -> Measures:
    """Compute the statistics of one view.

    Args:
        codes: linear codes [K, H, W, 3], or a sample of them by ``sampled``.
        usable: mask of the pixels that are neither saturated nor invalid, [H, W].
        four: True if the pictures are at 0, 45, 90 and 135 degrees. Otherwise, only the brightness is measured.
    """
    step = _step(usable.size)
    sample = (codes if codes.shape[1:3] != usable.shape else codes[:, ::step, ::step]).astype(np.float64)
    bright = float(np.percentile(sample, 99.0)) / FULL_CODE
    gray = sample.mean(axis=3)
    usable = usable[::step, ::step]
    angles = gray[:, usable & (gray.min(axis=0) > CheckLimits.low_code)]
    if not four or angles.shape[1] < 16:
        return Measures(bright, (0.0, 0.0, 0.0), [])
    i0, i45, i90, i135 = angles
    s0 = (i0 + i45 + i90 + i135) / 2.0
    differences = (i0 + i90 - i45 - i135, i0 + i45 - i90 - i135, i0 + i135 - i45 - i90)
    first, second, third = (float(np.median(np.abs(difference) / s0)) for difference in differences)
    return Measures(bright, (first, second, third), pair_slopes(sample, usable, FOUR_PAIRS))


def top_histogram(raw: NDArray[Any]) -> NDArray[np.int64]:
    """Count how often each stored value in the top 2 % of the range occurs. The last count is the largest value's.

    Radiance has no largest value. Its counts are 0, in the range of 16-bit files.
    """
    full = FULL_CODE if raw.dtype.kind == "f" else int(np.iinfo(raw.dtype).max)
    low = full - int(full * CheckLimits.top_share)
    if raw.dtype.kind == "f":
        return np.zeros(full - low + 1, np.int64)
    return np.bincount(raw[raw >= low].astype(np.int64) - low, minlength=full - low + 1)


def full_scale(histogram: NDArray[np.int64], full: int) -> int | None:
    """Return the stored value at which the pixels of a capture are saturated. Return None if no pixel is saturated.

    It is the largest possible value of the files if this value occurs. The largest value of a sensor with fewer bits,
    such as 10 bits stored in 16, is slightly smaller. The largest value that occurs is therefore also accepted if it is
    in the top 0.2 % of the range and much more frequent than the values near it.

    Args:
        histogram: sum of ``top_histogram`` over the capture.
        full: the largest possible value, 255 or 65535.
    """
    occupied = np.flatnonzero(histogram)
    if len(occupied) == 0:
        return None
    top = int(occupied[-1])
    value = full - (len(histogram) - 1) + top
    if value == full:
        return value
    near = int(histogram[:top].max(initial=0))
    piled_up = histogram[top] >= 3 and histogram[top] > 3 * near
    return value if value >= full * (1.0 - CheckLimits.full_share) and piled_up else None


def exposure_warnings(
    names: Sequence[str], measures: Sequence[Measures], blown: Sequence[float], largest: int, full: int
) -> list[str]:
    """Return warnings about dark and saturated pictures.

    Args:
        names: view names.
        measures: statistics of each view.
        blown: share of the saturated pixels of each view.
        largest: largest stored value in all pictures.
        full: largest value that the files can store.
    """
    warnings = []
    if full == FULL_CODE and 0 < largest < 4096:
        bits = 10 if largest < 1024 else 12
        return [
            f"No value of the 16-bit pictures exceeds {largest}. They look like unscaled {bits}-bit data. "
            f"Multiply the values by {2 ** (16 - bits)}."
        ]
    dark = [name for name, measure in zip(names, measures, strict=True) if measure.bright < CheckLimits.dark]
    if dark:
        warnings.append(
            f"{len(dark)} of {len(names)} views are almost black: 99% of their values are under {CheckLimits.dark:.0%} "
            f"of full scale ({listed(dark)}). Increase the exposure, or remove these views."
        )
    over = [name for name, share in zip(names, blown, strict=True) if share > CheckLimits.blown]
    if over:
        warnings.append(
            f"{len(over)} of {len(names)} views are heavily saturated: up to {max(blown):.0%} of the pixels "
            f"are at full scale and have no polarization ({listed(over)}). Decrease the exposure."
        )
    return warnings


def polarization_warnings(names: Sequence[str], measures: Sequence[Measures], transfer: str) -> list[str]:
    """Return warnings about the order of the files and their encoding."""
    off = {name: m.residuals for name, m in zip(names, measures, strict=True) if _is_off(m.residuals)}
    warnings = []
    swapped = False
    if off:
        pairs = np.median(list(off.values()), axis=0)
        best = int(pairs.argmin())
        swapped = best > 0 and len(off) * 2 > len(names)
        hint = (
            "Probably files are swapped, or the transfer is wrong",
            "The pictures at 45 and 90 (or 0 and 135) degrees are probably swapped",
            "The pictures at 90 and 135 (or 0 and 45) degrees are probably swapped",
        )[best]
        warnings.append(
            f"I0 + I90 differs from I45 + I135 by {pairs[0]:.1%} of S0 (median) in {len(off)} of "
            f"{len(names)} views ({listed(list(off))}). The limit is {CheckLimits.residual:.0%}. {hint}."
        )
    curvature = curvature_of([tile for measure in measures for tile in measure.slopes])
    if swapped or curvature is None:  # wrong pairs have a meaningless curvature
        return warnings
    if transfer == "linear" and encoding(curvature) == "srgb":
        warnings.append(
            f"The pictures look sRGB-encoded (curvature {curvature.value:.2f}; linear pictures have 0). "
            "If so, read them with transfer srgb."
        )
    if transfer == "srgb" and curvature.value > DECODED[1]:
        warnings.append(
            f"The pictures look linear already (curvature {curvature.value:.2f} after decoding; 0 is expected). "
            "If so, read them with transfer linear."
        )
    return warnings


FOUR_PAIRS = ((0, 2), (1, 3))
"""Indices of the perpendicular pictures among four at 0, 45, 90 and 135 degrees."""


def right_pairs(angles: Sequence[object]) -> list[tuple[int, int]]:
    """Return pairs of indices of perpendicular pictures. Each picture is in at most one pair.

    Args:
        angles: angle of each picture in degrees, or a word if it has no known angle.
    """
    free = [(place, angle) for place, angle in enumerate(angles) if isinstance(angle, int | float)]
    pairs = []
    while free:
        place, angle = free.pop(0)
        limit = CheckLimits.right_angle
        match = next((other for other in free if abs(angle_difference(other[1], angle + 90)) <= limit), None)
        if match is not None:
            free.remove(match)
            pairs.append((place, match[0]))
    return pairs


@dataclass(frozen=True)
class Curvature:
    """Curvature of the camera's response, which is 0 for linear files, and its standard error."""

    value: float
    error: float

    def surely_below(self, limit: float) -> bool:
        """Return True if the curvature is significantly below a limit."""
        return self.value + AngleLimits.sure * self.error < limit

    def surely_above(self, limit: float) -> bool:
        """Return True if the curvature is significantly above a limit."""
        return self.value - AngleLimits.sure * self.error > limit


def pair_slopes(
    codes: NDArray[Any], usable: NDArray[np.bool_], pairs: Sequence[tuple[int, int]]
) -> list[NDArray[np.float64]]:
    """Compute sums for a regression that measures the curvature of the response from the pair sums of a view.

    The dependent variable r is the difference of two pair sums, (I0 + I90 - I45 - I135) / S0. The regressor q is the
    difference of the squared polarizations, ((I0 - I90) / S0)^2 - ((I45 - I135) / S0)^2. The slope of r over q is 0 for
    linear data, negative for a concave encoding, and positive for a convex encoding. If the exposures of the pictures
    differ, r also contains shares of I0 - I90 and I45 - I135. A fit of these two differences is subtracted.

    Args:
        codes: linear codes [K, H, W, C] of a view, or of a sample of it.
        usable: mask of usable pixels, [H, W].
        pairs: indices of perpendicular pictures, see ``right_pairs``.

    Returns:
        An array for each combination of two pairs, with the number of pixels, the sum of q q, and the sum of q r in
        each tile of the picture.
    """
    if len(pairs) < 2:
        return []
    gray = codes.mean(axis=3, dtype=np.float64)
    usable = usable & (gray.min(axis=0) > CheckLimits.low_code)
    rows, columns = (np.arange(size) * CheckLimits.tiles // size for size in usable.shape)
    tile = (rows[:, None] * CheckLimits.tiles + columns)[usable]
    first, second = (gray[:, usable][[pair[side] for pair in pairs]] for side in (0, 1))
    s0 = (first + second).mean(axis=0)
    sums = (first + second) / s0
    polarized = (first - second) / s0
    tiles = np.zeros((CheckLimits.tiles**2, 3))
    for one, other in itertools.combinations(range(len(pairs)), 2):
        nuisance = np.stack([np.ones_like(s0), polarized[one], polarized[other]], axis=1)
        both = np.stack([polarized[one] ** 2 - polarized[other] ** 2, sums[one] - sums[other]], axis=1)
        q, r = (both - nuisance @ np.linalg.lstsq(nuisance, both, rcond=None)[0]).T
        for place, values in enumerate((np.ones_like(q), q * q, q * r)):
            tiles[:, place] += np.bincount(tile, values, len(tiles))
    return [tile for tile in tiles if tile[0] > 0]


def curvature_of(tiles: Sequence[NDArray[np.float64]]) -> Curvature | None:
    """Compute the curvature of the response from the ``pair_slopes`` of all views.

    Return None if the polarization is too weak.
    """
    total = np.sum(tiles, axis=0)
    if len(tiles) < 2 or total[0] < CheckLimits.fewest or total[1] < total[0] * CheckLimits.least_spread**2:
        return None
    value = total[2] / total[1]
    without = total - np.stack(tiles)
    return Curvature(float(value), float(jackknife_error(value, without[:, 2] / without[:, 1])))


def encoding(curvature: Curvature | None) -> Literal["linear", "srgb"] | None:
    """Decide the encoding of files from the curvature that they have if they are read as linear.

    Return None if the curvature does not decide.
    """
    doubtful, certain = ENCODED
    if curvature is not None and curvature.value < certain and curvature.surely_below(doubtful):
        return "srgb"
    if curvature is not None and curvature.value >= doubtful and curvature.surely_above(certain):
        return "linear"
    return None


def _is_off(residuals: tuple[float, float, float]) -> bool:
    """Return True if the residual of the first pairing is large, or much larger than the residual of another."""
    right, *others = residuals
    return right > CheckLimits.residual or (right > 0.4 * CheckLimits.residual and min(others) < 0.25 * right)


@dataclass(frozen=True)
class MeasuredGains:
    """Gains of the four pictures of a view, measured from the pair sums.

    Attributes:
        logs: natural logarithms of the gains in the order of the angles, with mean 0.
        errors: standard errors of ``logs``, by a jackknife over tiles of the pictures.
        pairing: index of the pictures that are perpendicular: 0 for 0 and 90, 1 for 0 and 45, 2 for 0 and 135, as in
            ``Measures.residuals``. It is ``None`` if the samples contradict all three.
    """

    logs: tuple[float, ...]
    errors: tuple[float, ...]
    pairing: int | None

    def deviating(self, stated: Sequence[float] = (0.0, 0.0, 0.0, 0.0)) -> dict[int, float]:
        """Return the pictures whose exposure differs significantly from the stated exposure, as factors by angle.

        Args:
            stated: logarithms of the exposures that the files state.
        """
        if self.pairing != 0:
            return {}
        off = [log - shift for log, shift in zip(self.logs, stated, strict=True)]
        deviations = {}
        for place, angle in enumerate(ANGLES):
            apart = off[place] - float(np.median(off[:place] + off[place + 1 :]))
            if abs(apart) > max(CheckLimits.other_exposure, AngleLimits.sure * max(self.errors)):
                deviations[angle] = math.exp(apart)
        return deviations


def pair_moments(gray: NDArray[np.floating[Any]], usable: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Compute the second moments of the intensities of a view in each tile of the picture.

    Args:
        gray: linear intensities at 0, 45, 90 and 135 degrees, [4, H, W].
        usable: mask of usable pixels, [H, W].

    Returns:
        [T, 5, 4] for T tiles. The first four rows are the moments, the last row is the number of pixels.
    """
    step = max(1, math.ceil(math.sqrt(usable.size / CheckLimits.moment_samples)))
    gray = gray[:, ::step, ::step].astype(np.float64)
    usable = usable[::step, ::step]
    total = gray.sum(axis=0)
    usable = usable & (total > 4 * CheckLimits.hidden * float(gray.max(initial=0)))
    rows = np.where(usable, gray / np.where(usable, total, 1.0), 0.0)
    tiles = []
    for band in np.array_split(np.concatenate([rows, usable[None]]), CheckLimits.tiles, axis=1):
        for part in np.array_split(band, CheckLimits.tiles, axis=2):
            flat = part[:4].reshape(4, -1)
            tiles.append(np.vstack([flat @ flat.T, [part[4].sum()] * 4]))
    return np.stack(tiles)


def measured_gains(moments: NDArray[np.float64]) -> MeasuredGains | None:
    """Compute the gains of the four pictures of views. Return None if too few pixels are bright enough.

    Args:
        moments: result of ``pair_moments`` for one view or several views, [T, 5, 4].
    """
    moments = moments[moments[:, 4, 0] > 0]
    if len(moments) < 2 or moments[:, 4, 0].sum() < CheckLimits.fewest:
        return None
    total = moments.sum(axis=0)
    vector = _least(total)
    signs = np.sign(vector)
    alike = [k for k, other in enumerate((2, 1, 3)) if signs[0] == signs[other] and signs.sum() == 0]
    logs = _logs(vector)
    errors = jackknife_error(logs, _logs(np.stack([_least(total - tile) for tile in moments])))
    return MeasuredGains(tuple(logs.tolist()), tuple(errors.tolist()), alike[0] if len(alike) == 1 else None)


def _least(moments: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the eigenvector of the moments with the smallest eigenvalue."""
    return np.asarray(np.linalg.eigh(moments[:4])[1][:, 0])


def _logs(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return logarithms of gains, with mean 0, from vectors of inverse gains [..., 4]."""
    logs = -np.log(np.maximum(np.abs(vectors), 1e-9))
    return np.asarray(logs - logs.mean(axis=-1, keepdims=True))
