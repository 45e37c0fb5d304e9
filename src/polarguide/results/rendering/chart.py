"""Color chart in a photograph: 24 patches, and a matrix from the camera's linear RGB to linear sRGB.

The chart is defined by McCamy, Marcus and Davidson (1976), "A color-rendition chart". ``LAB`` are its
manufacturer's values for charts since the end of 2014 (X-Rite, "New color specifications for ColorChecker SG
and Classic Charts"): CIELAB under D50, by rows from dark skin to black. The matrix minimizes squared
distances in CIELAB. Its error is the CIEDE2000 of each patch with the matrix of the other patches.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from polarguide.capture import View
from polarguide.capture.presentation import Chart
from polarguide.core.errors import PolarguideError, optional_import

Floats = NDArray[np.float64]
LAB: Floats = np.array([
    (37.54, 14.37, 14.92), (64.66, 19.27, 17.50), (49.32, -3.82, -22.54), (43.46, -12.74, 22.72),
    (54.94, 9.61, -24.79), (70.48, -32.26, -0.37), (62.73, 35.83, 56.50), (39.43, 10.75, -45.17),
    (50.57, 48.64, 16.67), (30.10, 22.54, -20.87), (71.77, -24.13, 58.19), (71.51, 18.24, 67.37),
    (28.37, 15.42, -49.80), (54.38, -39.72, 32.27), (42.43, 51.05, 28.62), (81.80, 2.67, 80.41),
    (50.63, 51.28, -14.12), (49.57, -29.71, -28.32), (95.19, -1.03, 2.93), (81.29, -0.57, 0.44),
    (66.89, -0.75, -0.06), (50.76, -0.13, 0.14), (35.63, -0.46, -0.48), (20.64, 0.07, -0.46),
])  # fmt: skip
_ORDERS = [[(begin + step * k) % 4 for k in range(4)] for begin in range(4) for step in (1, -1)]
"""The eight ways to go around four corners."""
COLUMNS = 6
ROWS = 4
XYZ_OF_SRGB: Floats = np.array(
    [(0.4360747, 0.3850649, 0.1430804), (0.2225045, 0.7168786, 0.0606169), (0.0139322, 0.0971045, 0.7141733)]
)
"""Linear sRGB to XYZ under D50, adapted after Bradford (Lindbloom, "RGB/XYZ matrices")."""
HALF_PATCH = 0.25
"""Half width of the evaluated square of a patch, in units of the distance of two patches."""
LEAST_PIXELS = 16
"""Least number of pixels of a patch, against noise and the mosaic's colors."""
LEAST_PATCHES = 18
"""Least number of patches, twice the unknowns of the matrix."""
WORST_FIT = 6.0
"""Largest mean CIEDE2000. Cameras reach 1 to 4; a larger error means wrong corners, another chart or uneven light."""


def chart_of(view: View, corners: Sequence[float]) -> Chart:
    """Return the color matrix of a photograph with a color chart.

    Args:
        view: view whose photograph shows the chart.
        corners: x, y in pixels of the centers of the four corner patches, around the chart, from any of them.

    Raises:
        PolarguideError: patches clip, are too small or too few, or no order of the corners fits.
    """
    quad = np.array(corners, dtype=np.float64).reshape(4, 2)
    fits = []
    for order in _ORDERS:
        colors = _patches(view, quad[order])
        used = np.asarray(np.isfinite(colors).all(axis=1))
        fits.append((_distance(_linear(colors[used], used), colors[used], used), colors, used))
    _, colors, used = min(fits, key=lambda fit: fit[0])
    if int(used.sum()) < LEAST_PATCHES:
        raise PolarguideError(
            "chart",
            expected=f"{LEAST_PATCHES} of {len(LAB)} patches with {LEAST_PIXELS} pixels and without clipping",
            found=f"{int(used.sum())} in {view.name}",
            remedy="Take a closer or darker photograph, or correct the corners.",
        )
    matrix = _fitted(colors[used], used)
    errors = _left_out(colors, used)
    if not errors.mean() <= WORST_FIT:
        raise PolarguideError(
            "chart",
            expected=f"patches that one matrix fits with a mean CIEDE2000 of at most {WORST_FIT:g}",
            found=f"{errors.mean():.1f}, up to {errors.max():.1f}, in {view.name}",
            remedy="Enter the centers of the four corner patches, around the chart, under even light.",
        )
    red, green, blue = ((float(a), float(b), float(c)) for a, b, c in matrix)
    return Chart((red, green, blue), float(errors.mean()), float(errors.max()), int(used.sum()), view.name)


def _patches(view: View, quad: Floats) -> Floats:
    """Return the mean linear colors of the patches, [24, 3]; NaN for clipped, invalid and too small patches."""
    ends = np.array([(0, 0), (COLUMNS - 1, 0), (COLUMNS - 1, ROWS - 1), (0, ROWS - 1)], np.float32)
    to_chart = cv2.getPerspectiveTransform(quad.astype(np.float32), ends)
    camera = view.camera
    low = np.maximum(np.floor(quad.min(axis=0) - 0.2 * np.ptp(quad, axis=0)), 0).astype(int)
    high = np.ceil(quad.max(axis=0) + 0.2 * np.ptp(quad, axis=0)).astype(int) + 1
    part = slice(low[1], min(int(high[1]), camera.height)), slice(low[0], min(int(high[0]), camera.width))
    picture = view.photograph()[part].double().numpy()
    bad = (view.invalid | view.saturated)[part].numpy()
    y, x = np.mgrid[0 : bad.shape[0], 0 : bad.shape[1]] + 0.5
    homogeneous = np.stack([x + low[0], y + low[1], np.ones_like(x)], axis=-1) @ to_chart.T
    place = homogeneous[..., :2] / homogeneous[..., 2:]
    nearest = np.rint(place)
    inside = (np.abs(place - nearest) < HALF_PATCH).all(axis=-1)
    inside &= ((nearest >= 0) & (nearest < (COLUMNS, ROWS))).all(axis=-1)
    index = (nearest[..., 1] * COLUMNS + nearest[..., 0])[inside].astype(int)
    counts = np.bincount(index, minlength=len(LAB))
    valid = (counts >= LEAST_PIXELS) & (np.bincount(index, bad[inside], len(LAB)) == 0)
    sums = np.stack([np.bincount(index, picture[inside][:, c], len(LAB)) for c in range(3)], axis=1)
    return np.where(valid[:, None], sums / np.maximum(counts, 1)[:, None], np.nan)


def _linear(colors: Floats, used: NDArray[np.bool_]) -> Floats:
    """Return the least-squares matrix [3, 3] in linear sRGB, or zeros if there are too few patches."""
    if len(colors) < LEAST_PATCHES:
        return np.zeros((3, 3))
    wanted = _skimage().lab2xyz(LAB, illuminant="D50")[used] @ np.linalg.inv(XYZ_OF_SRGB).T
    return np.asarray(np.linalg.lstsq(colors, wanted, rcond=None)[0].T)


def _lab(matrix: Floats, colors: Floats) -> Floats:
    return np.asarray(_skimage().xyz2lab(colors @ (XYZ_OF_SRGB @ matrix).T, illuminant="D50"))


def _distance(matrix: Floats, colors: Floats, used: NDArray[np.bool_]) -> float:
    """Return the mean CIEDE2000 of colors after a matrix."""
    if not len(colors):
        return np.inf
    return float(_skimage().deltaE_ciede2000(LAB[used], _lab(matrix, colors)).mean())


def _fitted(colors: Floats, used: NDArray[np.bool_]) -> Floats:
    def residuals(numbers: Floats) -> Floats:
        return np.asarray(_lab(numbers.reshape(3, 3), colors) - LAB[used]).ravel()

    return np.asarray(least_squares(residuals, _linear(colors, used).ravel(), x_scale="jac").x.reshape(3, 3))


def _left_out(colors: Floats, used: NDArray[np.bool_]) -> Floats:
    """Return the CIEDE2000 of each used patch by the matrix of the others."""
    one = np.eye(len(LAB), dtype=bool)
    others = used & ~one
    return np.array(
        [
            _distance(_fitted(colors[others[k]], others[k]), colors[one[k]], one[k])
            for k in np.flatnonzero(used)
        ]
    )


def _skimage() -> Any:
    return optional_import("skimage.color", "--chart")
