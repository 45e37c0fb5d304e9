"""Exposures of pictures by the brightness of points that they have in common, with the errors of these exposures."""

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
from polarguide.geometry.camera import Camera

Array = NDArray[np.floating[Any]]
FEWEST = 20
"""Points of which fewer say nothing about a picture."""
MOST_POINTS = 20_000
"""Points that are compared, those with the longest tracks."""
_LEAST_TRACK = 3
_ROUNDS = 40
_SETTLED = 1e-4
# Residuals of logarithms that are no smaller than noise and rounding.
_SMALLEST = 0.03
# Times that space is halved, as far as pictures keep FEWEST points in most parts.
_LEAST_DIVISIONS = 2
_MOST_DIVISIONS = 4
# Probability that exposures which are all equal are called different.
_FALSE_ALARM = 0.01
_ERRORS = 2.0
# Linear intensity below which noise and rounding of 8 bits hide the exposure.
_DARK = 0.004
_FULL = 65535.0


@dataclass(frozen=True, eq=False)
class PointExposures:
    """Exposures of pictures.

    Attributes:
        logs: logarithms, [V, C] of C channels, mean 0; NaN for pictures with fewer than ``FEWEST`` points that they
            share with those of the largest connected set.
        errors: of their means over the channels, [V]; infinite where they cannot be told.
        color_errors: of what the channels deviate from these means, [V].
        points: number of points of each picture, [V].
    """

    logs: Array
    errors: Array
    color_errors: Array
    points: NDArray[np.int64]

    @property
    def significant(self) -> Array:
        """The logarithms, [V, C], without what is not significant; NaN where they are not known.

        Brightness and color are judged apart. Either is 0 in all pictures unless one of them differs from the mean with
        a probability of error of 1 % over all pictures; then it is 0 in pictures within two errors of the mean.
        """
        bright = self.logs.mean(axis=1)
        color = self.logs - bright[:, None]
        strongest = np.abs(color).max(axis=1)
        told = np.where(significant(np.abs(bright), self.errors), bright, 0.0)[:, None]
        tinted = np.where(significant(strongest, self.color_errors)[:, None], color, 0.0)
        return np.where(np.isfinite(self.logs), told + tinted, np.nan)

    def gains(self) -> list[tuple[float, float, float]]:
        """The significant gains of R, G and B of each picture; 1 where they are not known."""
        return [
            (float(r), float(g), float(b)) for r, g, b in np.exp(np.nan_to_num(self.significant)).round(6)
        ]


def significant(sizes: Array, errors: Array) -> NDArray[np.bool_]:
    """Which sizes of differences, [V], are significant, see ``PointExposures.significant``."""
    known = np.isfinite(sizes)
    limit = NormalDist().inv_cdf(1 - _FALSE_ALARM / (2 * max(1, int(known.sum()))))
    with np.errstate(invalid="ignore"):
        differ = bool((sizes[known] > limit * errors[known]).any())
        return np.asarray(differ & (sizes > _ERRORS * errors))


def exposures_of_points(values: Array, places: Array) -> PointExposures:
    """Exposures of pictures from intensities of points.

    Solves ``log(value) = exposure of the picture + brightness of the point`` with the least sum of absolute residuals
    (iteratively reweighted least squares), where a point counts less the more its own residuals scatter: reflections
    and polarization make points look different from picture to picture, and matte ones tell exposures best.

    Parts of space are solved alone, too. The error of an exposure is the standard deviation over these parts, however
    many there are: more of them do not make it smaller, because the reflections that mislead them are of one light.

    Args:
        values: [points, pictures, channels] positive linear intensities; NaN where a point is not seen or not measured.
        places: [points, 3] where the points are.
    """
    count, channels = values.shape[1:]
    unknown = np.full((count, channels), np.nan)
    errors = np.full((2, count), np.inf)
    valid = _measured(values)
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
    logs[chosen] = _solved(values[:, chosen])
    divisions = int(np.log2(max(1.0, float(np.median(numbers[chosen])) / FEWEST)))
    errors[:, chosen] = _errors(
        values[:, chosen],
        _parts(places, int(np.clip(divisions, _LEAST_DIVISIONS, _MOST_DIVISIONS))),
        logs[chosen],
    )
    return PointExposures(logs, errors[0], errors[1], numbers)


def _measured(values: Array) -> NDArray[np.bool_]:
    """Where all channels [..., C] are measured."""
    return np.asarray(np.isfinite(values).all(axis=-1), np.bool_)


def _connected(valid: NDArray[np.bool_], fewest: int) -> NDArray[np.int64]:
    """The pictures of the largest set in which any two are linked by points in common."""
    enough = np.flatnonzero(valid.sum(axis=0) >= fewest)
    if len(enough) == 0:
        return enough
    links = valid[:, enough].astype(np.float32)
    _, group = connected_components(links.T @ links >= fewest / 4, directed=False)
    return enough[group == np.argmax(np.bincount(group))]


def _solved(values: Array) -> Array:
    """Logarithms of the exposures of connected pictures, [V, C], mean 0."""
    valid = _measured(values)
    paired = valid.sum(axis=1) >= 2
    point, picture = np.nonzero(valid[paired])
    logs = np.log(values[paired][point, picture].astype(np.float64))
    size = int(paired.sum()), values.shape[1]
    return np.stack([_solved_channel(log, point, picture, size) for log in logs.T], axis=1)


def _solved_channel(
    log: Array, point: NDArray[np.int64], picture: NDArray[np.int64], size: tuple[int, int]
) -> Array:
    """The exposures of one channel from logarithms of intensities at pairs of point and picture."""
    rows, columns = size
    tracks = np.bincount(point, minlength=rows)
    weights = np.ones(len(log))
    solution = np.zeros(columns)
    for _ in range(_ROUNDS):
        before = solution
        total = np.bincount(point, weights, rows)
        # The points' brightnesses are eliminated; adding a constant fixes the mean of the exposures at 0.
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
    """The part of space of each point, [M]: halved across the longest side, again and again."""
    parts = np.zeros(len(places), np.int64)
    for _ in range(divisions):
        halved = 2 * parts
        for part in np.unique(parts):
            mine = np.flatnonzero(parts == part)
            axis = int(np.argmax(np.subtract(*np.percentile(places[mine], (90, 10), axis=0))))
            halved[mine] += places[mine, axis] > np.median(places[mine, axis])
        parts = halved
    return parts


def _errors(values: Array, parts: NDArray[np.int64], logs: Array) -> Array:
    """Standard deviations over parts of space, weighted by their numbers of points: of brightness and color, [2, V]."""
    squares = np.zeros((2, len(logs)))
    total = np.zeros(len(logs))
    used = np.zeros(len(logs), np.int64)
    for part in np.unique(parts):
        mine = values[parts == part]
        seen = _measured(mine)
        chosen = _connected(seen, FEWEST // 4)
        if len(chosen) < 2:
            continue
        number = seen[:, chosen].sum(axis=0)
        off = _solved(mine[:, chosen]) - logs[chosen]
        off -= np.median(off, axis=0)
        bright = off.mean(axis=1)
        color = np.abs(off - bright[:, None]).max(axis=1)
        squares[:, chosen] += number * np.stack([bright, color]) ** 2
        total[chosen] += number
        used[chosen] += 1
    errors = np.full((2, len(logs)), np.inf)
    enough = used > 1
    errors[:, enough] = np.sqrt(squares[:, enough] / total[enough] * used[enough] / (used[enough] - 1))
    # Errors of few parts are uncertain themselves: none is taken to be smaller than usual.
    return np.maximum(errors, np.median(errors, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class PointSamples:
    """Intensities of pictures around the projections of points.

    Attributes:
        values: means over 3 x 3 pixels, linear, [N, K, 3]; NaN outside and beside bad pixels.
        peaks: largest stored values of these pixels, [N].
    """

    values: Array
    peaks: NDArray[Any]


def samples_at(
    places: Array,
    camera: Camera,
    pictures: Sequence[NDArray[Any]],
    bad: NDArray[np.bool_] | None,
    transfer: str,
) -> PointSamples:
    """Sample K stored pictures [H, W, 3] of one view at points.

    Args:
        places: [N, 3]. camera: at the size of the pictures. bad: pixels without use, [H, W]. transfer: the encoding.
    """
    local = places @ camera.rotation.numpy().T + camera.translation.numpy()
    depth = np.where(local[:, 2] > 0, local[:, 2], np.nan)
    column = np.floor(camera.fx * local[:, 0] / depth + camera.cx)
    row = np.floor(camera.fy * local[:, 1] / depth + camera.cy)
    height, width = pictures[0].shape[:2]
    inside = np.flatnonzero((column >= 1) & (column < width - 1) & (row >= 1) & (row < height - 1))
    around = np.mgrid[-1:2, -1:2].reshape(2, 1, 9)
    y, x = np.stack([row[inside], column[inside]]).astype(int)[..., None] + around
    values = np.full((len(places), len(pictures), 3), np.nan)
    peaks = np.zeros(len(places), np.int64)
    for k, picture in enumerate(pictures):
        patches = picture[y, x]
        values[inside, k] = linear_codes(patches, transfer).mean(axis=1) / _FULL
        peaks[inside] = np.maximum(peaks[inside], patches.max(axis=(1, 2)))
    if bad is not None:
        values[inside[bad[y, x].any(axis=1)]] = np.nan
    values[values.mean(axis=(1, 2)) < _DARK] = np.nan
    return PointSamples(values, peaks)


def matte(values: Array) -> Array:
    """Half of the unpolarized light, (S0 - |(S1, S2)|) / 2, of four angles [N, 4, C]: it has less of the reflections.

    NaN where hardly any is left.
    """
    first = values[:, 0] - values[:, 2], values[:, 1] - values[:, 3]
    least = values.mean(axis=1) - np.hypot(*first) / 2
    return np.where(least > _DARK / 4, least, np.nan)


@dataclass(frozen=True, eq=False)
class ComparedPoints:
    """The points of a model by which the exposures of its views are compared.

    Attributes:
        model: the model. places: [N, 3]. columns: views by name. observed: which views observe each point, [N, V].
    """

    model: ColmapModel
    places: NDArray[np.float64]
    columns: Mapping[str, int]
    observed: NDArray[np.bool_]

    @classmethod
    def of(cls, model: ColmapModel, views: Sequence[str]) -> ComparedPoints | None:
        """The points with the longest tracks; None where no tracks are stored."""
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
        """Samples of a view's stored pictures at the points that it observes; None without a pose."""
        if view not in self.columns:
            return None
        height, width = raw[0].shape[:2]
        return samples_at(
            self.places[self.observed[:, self.columns[view]]],
            fit_camera(self.model.camera(view), width, height, folder=self.model.folder, view=view),
            raw,
            bad,
            transfer,
        )

    def exposures(self, samples: Mapping[str, PointSamples | None], full_scale: int | None) -> PointExposures:
        """Exposures of views of four angles, in their order.

        Args:
            samples: by view; None without a pose. full_scale: stored value at which they saturate, if they do.
        """
        values = np.full((len(self.places), len(samples), 3), np.nan, np.float32)
        for place, (view, sampled) in enumerate(samples.items()):
            if sampled is not None:
                fine = sampled.peaks < (np.inf if full_scale is None else full_scale)
                seen = self.observed[:, self.columns[view]]
                values[seen, place] = np.where(fine[:, None], matte(sampled.values), np.nan)
        return exposures_of_points(values, self.places)
