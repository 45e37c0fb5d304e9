"""Exposures of the four pictures of a view from their pair sums, pixel by pixel.

Whatever the light, I0 + I90 = I45 + I135. With pictures exposed by gains g, I0/g0 - I45/g45 + I90/g90 - I135/g135 is
zero at every pixel. The median of the pair sums tells one ratio of the gains; all pixels together tell the four of them
up to a common factor, as soon as their polarization differs in strength and direction: the vector (1/g) is the one that
all samples (I0, I45, I90, I135) are perpendicular to, the eigenvector of their second moments with the least
eigenvalue. Angles that are off by two degrees look like gains that differ by some percent; exposures differ by thirds
of a stop.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.geometry.polarizer import ANGLES

OTHER_EXPOSURE = math.log(2.0) / 6
"""Difference of logarithms from which on exposures differ: half of a third of a stop, the step of cameras."""
_SURE = 3.0
_TILES = 4
# Of the largest value; read-out noise hides the polarization of darker pixels.
_DARK = 0.01
_FEWEST = 1000
_SAMPLES = 1 << 18


@dataclass(frozen=True)
class MeasuredGains:
    """Gains of the four pictures by their pair sums.

    Attributes:
        logs: natural logarithms in the order of the angles, mean 0.
        errors: their standard errors (jackknife over tiles of the pictures).
        pairing: index of the pictures' pairing in the order of ``checks.Measures.residuals``: 0 where 0 and 90 are a
            pair, 1 where 0 and 45 are, 2 where 0 and 135 are; None where the samples contradict any.
    """

    logs: tuple[float, float, float, float]
    errors: tuple[float, float, float, float]
    pairing: int | None

    def deviating(self, stated: Sequence[float] = (0.0, 0.0, 0.0, 0.0)) -> dict[int, float]:
        """Angle -> by which factor its picture is exposed otherwise than stated, of those that surely are.

        Args:
            stated: logarithms of the exposures, as files state them.
        """
        if self.pairing != 0:
            return {}
        off = [mine - said for mine, said in zip(self.logs, stated, strict=True)]
        found = {}
        for place, angle in enumerate(ANGLES):
            apart = off[place] - float(np.median(off[:place] + off[place + 1 :]))
            if abs(apart) > max(OTHER_EXPOSURE, _SURE * max(self.errors)):
                found[angle] = math.exp(apart)
        return found


def pair_moments(gray: NDArray[np.floating[Any]], usable: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Second moments of the samples of a view by tiles, [T, 5, 4]: four rows of moments, and the count in the last.

    Args:
        gray: linear intensities [4, H, W]. usable: [H, W].
    """
    step = max(1, math.ceil(math.sqrt(usable.size / _SAMPLES)))
    gray, usable = gray[:, ::step, ::step].astype(np.float64), usable[::step, ::step]
    total = gray.sum(axis=0)
    usable = usable & (total > 4 * _DARK * float(gray.max(initial=0)))
    rows = np.where(usable, gray / np.where(usable, total, 1.0), 0.0)
    tiles = []
    for band, kept in zip(
        np.array_split(rows, _TILES, axis=1), np.array_split(usable, _TILES, axis=0), strict=True
    ):
        for part, mine in zip(
            np.array_split(band, _TILES, axis=2), np.array_split(kept, _TILES, axis=1), strict=True
        ):
            flat = part.reshape(4, -1)
            tiles.append(np.vstack([flat @ flat.T, [mine.sum()] * 4]))
    return np.stack(tiles)


def measured_gains(moments: NDArray[np.float64]) -> MeasuredGains | None:
    """The gains of the pictures of one or several views.

    Args:
        moments: ``pair_moments`` of the views, [T, 5, 4].

    Returns:
        None where too few pixels are bright enough.
    """
    moments = moments[moments[:, 4, 0] > 0]
    if len(moments) < 2 or moments[:, 4, 0].sum() < _FEWEST:
        return None
    total = moments.sum(axis=0)
    vector = _least(total)
    without = np.stack([_least(total - tile) for tile in moments])
    pairs = [(0, 2), (0, 1), (0, 3)]
    signs = np.sign(vector)
    alike = [k for k, (a, b) in enumerate(pairs) if signs[a] == signs[b] and signs.sum() == 0]
    logs = _logs(vector)
    spread = _logs(without) - logs
    count = len(moments)
    errors = np.sqrt((spread**2).sum(axis=0) * (count - 1) / count)
    return MeasuredGains(_four(logs), _four(errors), alike[0] if len(alike) == 1 else None)


def _least(moments: NDArray[np.float64]) -> NDArray[np.float64]:
    """The unit vector that the samples are most nearly perpendicular to."""
    return np.asarray(np.linalg.eigh(moments[:4])[1][:, 0])


def _logs(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Logarithms of gains, mean 0, of vectors of their inverses [..., 4]."""
    logs = -np.log(np.maximum(np.abs(vectors), 1e-9))
    return np.asarray(logs - logs.mean(axis=-1, keepdims=True))


def _four(values: NDArray[np.float64]) -> tuple[float, float, float, float]:
    first, second, third, fourth = (float(value) for value in values)
    return first, second, third, fourth
