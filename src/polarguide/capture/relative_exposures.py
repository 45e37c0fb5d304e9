"""How differently pictures are exposed: from what they show of the same points, and from what their files say."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

Array = NDArray[np.floating[Any]]
FEWEST = 20
"""Points of which fewer say nothing about a picture."""
FILE_ERROR = 0.03
"""Relative error of exposures that files state: shutters and apertures have nominal values."""
POINTS_ERROR = 0.05
"""Relative error of exposures from points, at least: reflections move, and polarization is taken for exposure."""
LARGEST_DOUBT = 0.5
"""Logarithm of 0.7 stops: points that contradict a file by more, and by more than others do, are believed."""
_LEAST_TRACK = 3
_MOST_POINTS = 20_000
_ROUNDS = 40
_SMALLEST = 0.03


def exposures_of_points(values: Array) -> tuple[Array, NDArray[np.int64]]:
    """Logarithms of the exposures of pictures from intensities of points.

    Solves ``log(value) = exposure of the picture + brightness of the point`` with the least sum of absolute residuals
    (iteratively reweighted least squares), where a point counts less the more its own residuals scatter: reflections
    and polarization make points look different from picture to picture, and matte ones tell exposures best.

    Args:
        values: [points, pictures] positive linear intensities; NaN where a point is not seen or not measured.

    Returns:
        [pictures] logarithms, mean 0; NaN for pictures with fewer than ``FEWEST`` points that they share with those of
        the largest connected set. And the number of points of each picture.
    """
    count = values.shape[1]
    logs = np.full(count, np.nan)
    seen = np.isfinite(values)
    long = np.argsort(-seen.sum(axis=1), kind="stable")[:_MOST_POINTS]
    values, seen = values[long], seen[long]
    shared = seen.sum(axis=1) >= min(_LEAST_TRACK, count)
    values, seen = values[shared], seen[shared]
    numbers = seen.sum(axis=0)
    chosen = _connected(seen, numbers)
    if len(chosen) < 2:
        return logs, numbers
    seen = seen[:, chosen]
    kept = seen.sum(axis=1) >= 2
    seen, log = seen[kept], np.log(np.where(seen, values[:, chosen], 1.0))[kept]
    weights = seen.astype(np.float64)
    for _ in range(_ROUNDS):
        total = weights.sum(axis=1)
        # The points' brightnesses are eliminated; adding 1 fixes the mean of the exposures at 0.
        matrix = np.diag(weights.sum(axis=0)) - (weights.T / total) @ weights
        right = (weights * log).sum(axis=0) - weights.T @ ((weights * log).sum(axis=1) / total)
        scale = max(float(np.trace(matrix)) / len(matrix), 1e-12)
        found = np.linalg.solve(matrix + scale / len(matrix), right)
        found -= found.mean()
        bright = (weights * (log - found)).sum(axis=1) / total
        residual = np.where(seen, log - found - bright[:, None], 0.0)
        scatter = (residual**2).sum(axis=1) / np.maximum(seen.sum(axis=1) - 1, 1)
        weights = seen / np.maximum(np.abs(residual), _SMALLEST) / np.maximum(scatter, _SMALLEST**2)[:, None]
    logs[chosen] = found
    return logs, numbers


def _connected(seen: NDArray[np.bool_], numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """The pictures of the largest set in which any two are linked by points in common."""
    enough = np.flatnonzero(numbers >= FEWEST)
    if len(enough) == 0:
        return enough
    links = seen[:, enough].astype(np.float32)
    _, group = connected_components(links.T @ links >= FEWEST / 4, directed=False)
    return enough[group == np.argmax(np.bincount(group))]


@dataclass(frozen=True, eq=False)
class Exposures:
    """Exposures of pictures, and how well their sources agree.

    Attributes:
        logs: logarithms, [N], on an arbitrary common constant; NaN where nothing is known.
        contradicted: indices of pictures whose points contradict their file.
        scatter: robust standard deviation of the differences between points and files; None without both.
    """

    logs: Array
    contradicted: tuple[int, ...]
    scatter: float | None


def reconciled(points: Array, files: Array, unfiltered: NDArray[np.bool_]) -> Exposures:
    """Exposures from those of points and those of files.

    Where both are known, the file's is corrected towards the points', as far as files usually err (``FILE_ERROR``) and
    points agree with files in this capture; larger differences are laid to the points, whose errors have long tails. A
    picture whose points contradict its file by far (``LARGEST_DOUBT``) is exposed as its points say. A filter takes the
    same share of the light from all pictures behind it: the points say which.

    Args:
        points, files: logarithms, [N]; NaN where one is not known.
        unfiltered: [N] whether a picture was taken without a filter.
    """
    files = files + np.where(unfiltered, np.log(2.0), 0.0)  # an ideal filter leaves half of unpolarized light
    both = np.isfinite(points) & np.isfinite(files)
    if both.sum() < 3:
        aligned = points + (np.median((files - points)[both]) if both.any() else 0.0)
        return Exposures(np.where(np.isfinite(files), files, aligned), (), None)
    shifted = files + np.median((points - files)[both])
    for group in (unfiltered, ~unfiltered):
        if (group & both).sum() >= 3:
            shifted = np.where(group, files + np.median((points - files)[group & both]), shifted)
    difference = np.where(both, points - shifted, 0.0)
    scatter = 1.4826 * float(np.median(np.abs(difference[both])))
    weight = FILE_ERROR**2 / (FILE_ERROR**2 + max(scatter, POINTS_ERROR) ** 2)
    odd = both & (np.abs(difference) > max(LARGEST_DOUBT, 4 * scatter))
    correction = weight * difference / (1 + (difference / (3 * FILE_ERROR)) ** 2)
    known = np.where(odd, points, shifted + correction)
    logs = np.where(both, known, np.where(np.isfinite(points), points, shifted))
    return Exposures(logs, tuple(int(k) for k in np.flatnonzero(odd)), scatter)
