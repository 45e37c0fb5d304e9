"""Estimate the relative exposures of views from the brightness of 3D points that several views observe."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from polarguide.capture.colmap.model import ColmapModel, fit_camera
from polarguide.capture.formats.pictures import linear_codes

Array = NDArray[np.floating[Any]]
FEWEST = 20
"""Smallest number of points from which the exposure of a picture is estimated."""
MOST_POINTS = 20_000
"""Largest number of points that are compared. Points that many views observe are preferred."""
_LEAST_TRACK = 3
_ROUNDS = 40
_SETTLED = 1e-4
# Smallest residual of a logarithm, from noise and rounding.
_SMALLEST = 0.03
# Number of bisections of space. Pictures need FEWEST points in most parts.
_LEAST_DIVISIONS = 2
_MOST_DIVISIONS = 4
# Probability of a false alarm if all exposures are equal.
_FALSE_ALARM = 0.01
_ERRORS = 2.0
# Linear intensity below which noise and 8-bit rounding hide the exposure.
_DARK = 0.004
_FULL = 65535.0


@dataclass(frozen=True, eq=False)
class PointExposures:
    """Estimated relative exposures of V pictures with C color channels.

    Attributes:
        logs: natural logarithms of the exposures, [V, C], with mean 0. They are NaN for a picture with fewer than
            ``FEWEST`` points, and for a picture that shares too few points with the other pictures.
        errors: standard error of the brightness of each picture, which is the mean of ``logs`` over the channels, [V].
            It is infinite if it is unknown.
        color_errors: standard error of the color of each picture, which is the deviation of ``logs`` from the
            brightness, [V].
        points: number of points in each picture, [V].
    """

    logs: Array
    errors: Array
    color_errors: Array
    points: NDArray[np.int64]

    @property
    def significant(self) -> Array:
        """Significant part of ``logs``, [V, C]. It is NaN for unknown exposures.

        Brightness and color are tested separately. If no picture differs significantly from the mean, all values are 0.
        The probability of a false alarm in this test is 1 % for all pictures together. If a picture differs, only the
        pictures within two standard errors of the mean have the value 0.
        """
        bright = self.logs.mean(axis=1)
        color = self.logs - bright[:, None]
        strongest = np.abs(color).max(axis=1)
        common = np.where(significant(np.abs(bright), self.errors), bright, 0.0)[:, None]
        tint = np.where(significant(strongest, self.color_errors)[:, None], color, 0.0)
        return np.where(np.isfinite(self.logs), common + tint, np.nan)

    def gains(self) -> list[tuple[float, float, float]]:
        """Return the gains of R, G and B for each picture. A gain is 1 if it is unknown or not significant."""
        return [
            (float(r), float(g), float(b)) for r, g, b in np.exp(np.nan_to_num(self.significant)).round(6)
        ]


def significant(sizes: Array, errors: Array) -> NDArray[np.bool_]:
    """Return a mask of the pictures that differ significantly, [V], as ``PointExposures.significant`` describes.

    Args:
        sizes: absolute difference of each picture from the mean, [V].
        errors: standard errors of the differences, [V].
    """
    known = np.isfinite(sizes)
    limit = NormalDist().inv_cdf(1 - _FALSE_ALARM / (2 * max(1, int(known.sum()))))
    with np.errstate(invalid="ignore"):
        differ = bool((sizes[known] > limit * errors[known]).any())
        return np.asarray(differ & (sizes > _ERRORS * errors))


def exposures_of_points(values: Array, places: Array) -> PointExposures:
    """Estimate the exposures of pictures from the intensities of points.

    The model is ``log(value) = exposure of the picture + brightness of the point``. The sum of absolute residuals is
    minimized by iteratively reweighted least squares. Points with scattered residuals get small weights, because
    reflections and polarization change their brightness between pictures.

    For the standard errors, space is divided into parts, and the exposures are estimated from the points of each part
    alone. The error is the standard deviation over the parts. It is not divided by the root of their number, because
    reflections of the same light disturb all parts in the same way.

    Args:
        values: positive linear intensities [points, pictures, channels]; NaN for missing measurements.
        places: positions of the points, [points, 3].
    """
    count, channels = values.shape[1:]
    unknown = np.full((count, channels), np.nan)
    errors = np.full((2, count), np.inf)
    valid = np.all(np.isfinite(values), axis=-1)
    chosen_points = np.argsort(-valid.sum(axis=1), kind="stable")[:MOST_POINTS]
    chosen_points = chosen_points[valid[chosen_points].sum(axis=1) >= min(_LEAST_TRACK, count)]
    values = values[chosen_points]
    valid = valid[chosen_points]
    places = places[chosen_points]
    numbers = valid.sum(axis=0)
    chosen = _connected(valid, FEWEST)
    if len(chosen) < 2:
        return PointExposures(unknown, errors[0], errors[1], numbers)
    logs = unknown.copy()
    logs[chosen] = _solve(values[:, chosen])
    divisions = int(np.log2(max(1.0, float(np.median(numbers[chosen])) / FEWEST)))
    errors[:, chosen] = _errors(
        values[:, chosen],
        _parts(places, int(np.clip(divisions, _LEAST_DIVISIONS, _MOST_DIVISIONS))),
        logs[chosen],
    )
    return PointExposures(logs, errors[0], errors[1], numbers)


def _connected(valid: NDArray[np.bool_], fewest: int) -> NDArray[np.int64]:
    """Return the indices of the largest set of pictures that are connected by at least ``fewest`` shared points."""
    enough = np.flatnonzero(valid.sum(axis=0) >= fewest)
    if len(enough) == 0:
        return enough
    links = valid[:, enough].astype(np.float32)
    _, group = connected_components(links.T @ links >= fewest / 4, directed=False)
    return enough[group == np.argmax(np.bincount(group))]


def _solve(values: Array) -> Array:
    """Estimate the logarithms of the exposures, [V, C], with mean 0. Shared points must connect all pictures."""
    valid = np.all(np.isfinite(values), axis=-1)
    paired = valid.sum(axis=1) >= 2
    point, picture = np.nonzero(valid[paired])
    logs = np.log(values[paired][point, picture].astype(np.float64))
    size = int(paired.sum()), values.shape[1]
    return np.stack([_solve_channel(log, point, picture, size) for log in logs.T], axis=1)


def _solve_channel(
    log: Array, point: NDArray[np.int64], picture: NDArray[np.int64], size: tuple[int, int]
) -> Array:
    """Estimate the logarithms of the exposures of one channel.

    Args:
        log: logarithms of the intensities, one for each observation of a point in a picture.
        point: index of the point of each observation.
        picture: index of the picture of each observation.
        size: numbers of points and pictures.
    """
    rows, columns = size
    tracks = np.bincount(point, minlength=rows)
    weights = np.ones(len(log))
    solution = np.zeros(columns)
    for _ in range(_ROUNDS):
        before = solution
        total = np.bincount(point, weights, rows)
        # Eliminate the brightness of the points. A constant on all entries fixes the mean of the exposures at 0.
        matrix = coo_array((weights, (point, picture)), size).tocsr()
        share = coo_array((weights / total[point], (point, picture)), size).tocsr()
        normal = np.diag(np.bincount(picture, weights, columns)) - (matrix.T @ share).toarray()
        mean = np.bincount(point, weights * log, rows) / total
        right = np.bincount(picture, weights * (log - mean[point]), columns)
        scale = max(float(np.trace(normal)) / columns, 1e-12)
        solution = np.linalg.solve(normal + scale / columns, right)
        solution = solution - solution.mean()
        bright = np.bincount(point, weights * (log - solution[picture]), rows) / total
        residual = log - solution[picture] - bright[point]
        scatter = np.bincount(point, residual**2, rows) / np.maximum(tracks - 1, 1)
        weights = 1 / np.maximum(np.abs(residual), _SMALLEST) / np.maximum(scatter, _SMALLEST**2)[point]
        if np.abs(solution - before).max() < _SETTLED:
            break
    return solution


def _parts(places: Array, divisions: int) -> NDArray[np.int64]:
    """Divide points into parts by repeated bisection along the longest side, and return their part indices, [M]."""
    parts = np.zeros(len(places), np.int64)
    for _ in range(divisions):
        halved = 2 * parts
        for part in np.unique(parts):
            members = np.flatnonzero(parts == part)
            axis = int(np.argmax(np.subtract(*np.percentile(places[members], (90, 10), axis=0))))
            halved[members] += places[members, axis] > np.median(places[members, axis])
        parts = halved
    return parts


def _errors(values: Array, parts: NDArray[np.int64], logs: Array) -> Array:
    """Return the standard deviations of brightness and color over the parts of space, [2, V].

    A part is weighted by its number of points.
    """
    squares = np.zeros((2, len(logs)))
    total = np.zeros(len(logs))
    used = np.zeros(len(logs), np.int64)
    for part in np.unique(parts):
        members = values[parts == part]
        valid = np.all(np.isfinite(members), axis=-1)
        chosen = _connected(valid, FEWEST // 4)
        if len(chosen) < 2:
            continue
        number = valid[:, chosen].sum(axis=0)
        off = _solve(members[:, chosen]) - logs[chosen]
        off -= np.median(off, axis=0)
        bright = off.mean(axis=1)
        color = np.abs(off - bright[:, None]).max(axis=1)
        squares[:, chosen] += number * np.stack([bright, color]) ** 2
        total[chosen] += number
        used[chosen] += 1
    errors = np.full((2, len(logs)), np.inf)
    enough = used > 1
    errors[:, enough] = np.sqrt(squares[:, enough] / total[enough] * used[enough] / (used[enough] - 1))
    # Errors from few parts are uncertain. The median is their lower bound.
    return np.maximum(errors, np.median(errors, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class PointSamples:
    """Intensities of the K pictures of a view at the projections of N points.

    Attributes:
        values: mean linear intensities of the 3 x 3 pixels around each projection, [N, K, 3]. They are NaN outside the
            picture and next to unusable pixels.
        peaks: largest stored value of these pixels for each point, [N].
    """

    values: Array
    peaks: NDArray[Any]


def matte(values: Array) -> Array:
    """Return half of the unpolarized light, ``(S0 - |(S1, S2)|) / 2``, [N, C]. It is NaN if there is little light.

    It is used for the comparison of exposures because it contains fewer reflections.

    Args:
        values: intensities at 0, 45, 90 and 135 degrees, [N, 4, C].
    """
    first = values[:, 0] - values[:, 2], values[:, 1] - values[:, 3]
    least = values.mean(axis=1) - np.hypot(*first) / 2
    return np.where(least > _DARK / 4, least, np.nan)


@dataclass(frozen=True, eq=False)
class ComparedPoints:
    """3D points of a COLMAP model at which the exposures of its views are compared.

    Attributes:
        model: the COLMAP model.
        places: positions of the points, [N, 3].
        observed: mask of the points that each view observes, [N, V].
        columns: column of each view in ``observed`` by name.
    """

    model: ColmapModel
    places: NDArray[np.float64]
    columns: Mapping[str, int]
    observed: NDArray[np.bool_]

    @classmethod
    def of(cls, model: ColmapModel, views: Sequence[str]) -> ComparedPoints | None:
        """Select the points that most views observe. Return None if the model does not store the observations."""
        observed = model.observations(views).numpy()
        longest = np.argsort(-observed.sum(axis=1), kind="stable")[:MOST_POINTS]
        observed = observed[longest]
        if not observed.any():
            return None
        return cls(
            model,
            model.points.double().numpy()[longest],
            {view: column for column, view in enumerate(views)},
            observed,
        )

    def samples(
        self, view: str, raw: Sequence[NDArray[Any]], bad: NDArray[np.bool_] | None, transfer: str
    ) -> PointSamples | None:
        """Sample the stored pictures of a view at the points that it observes.

        Args:
            view: name of the view.
            raw: K stored pictures, [H, W, 3] each.
            bad: mask of unusable pixels, [H, W].
            transfer: encoding of the pictures.

        Returns:
            The samples, or None if the view has no pose.
        """
        if view not in self.columns:
            return None
        height, width = raw[0].shape[:2]
        places = self.places[self.observed[:, self.columns[view]]]
        camera = fit_camera(self.model.camera(view), width, height, folder=self.model.folder, view=view)
        local = places @ camera.rotation.numpy().T + camera.translation.numpy()
        depth = np.where(local[:, 2] > 0, local[:, 2], np.nan)
        column = np.floor(camera.fx * local[:, 0] / depth + camera.cx)
        row = np.floor(camera.fy * local[:, 1] / depth + camera.cy)
        inside = np.flatnonzero((column >= 1) & (column < width - 1) & (row >= 1) & (row < height - 1))
        around = np.mgrid[-1:2, -1:2].reshape(2, 1, 9)
        y, x = np.stack([row[inside], column[inside]]).astype(int)[..., None] + around
        values = np.full((len(places), len(raw), 3), np.nan)
        peaks = np.zeros(len(places), np.int64)
        for k, picture in enumerate(raw):
            patches = picture[y, x]
            values[inside, k] = linear_codes(patches, transfer).mean(axis=1) / _FULL
            peaks[inside] = np.maximum(peaks[inside], patches.max(axis=(1, 2)))
        if bad is not None:
            values[inside[bad[y, x].any(axis=1)]] = np.nan
        values[values.mean(axis=(1, 2)) < _DARK] = np.nan
        return PointSamples(values, peaks)

    def exposures(self, samples: Mapping[str, PointSamples | None], full_scale: int | None) -> PointExposures:
        """Estimate the exposures of views with pictures at 0, 45, 90 and 135 degrees.

        Args:
            samples: samples of each view; None for a view without a pose.
            full_scale: stored value at which pixels are saturated; None if no pixel is saturated.

        Returns:
            The exposures in the order of ``samples``.
        """
        values = np.full((len(self.places), len(samples), 3), np.nan, np.float32)
        for place, (view, sampled) in enumerate(samples.items()):
            if sampled is not None:
                fine = sampled.peaks < (np.inf if full_scale is None else full_scale)
                observed = self.observed[:, self.columns[view]]
                values[observed, place] = np.where(fine[:, None], matte(sampled.values), np.nan)
        return exposures_of_points(values, self.places)
