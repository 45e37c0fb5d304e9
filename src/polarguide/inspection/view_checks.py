"""Checks that compare views with each other at the points of the model: exposures and focal lengths."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.optimize import least_squares
from scipy.spatial import QhullError
from scipy.spatial.transform import Rotation
from torch import Tensor

from polarguide.capture.angle_evidence import TO_DEVIATION
from polarguide.capture.colmap.model import ColmapModel
from polarguide.capture.point_exposures import significant
from polarguide.capture.view import listed
from polarguide.geometry.camera import Camera, seen_at
from polarguide.geometry.coverage import Coverage, DepthMap
from polarguide.inspection.capture import Capture
from polarguide.inspection.settings import Check, first_outcome


class ViewLimits:
    """Thresholds of the checks that compare views.

    Attributes:
        fewest: smallest number of points for the estimate of a focal length.
        focal_differs: difference of the logarithm of a focal length that causes a warning. A difference of 1 % turns a
            ray at 30 degrees by 0.25 degrees.
        focal_wrong: difference of the logarithm of a focal length for the verdict "wrong".
        step: step of camera exposures in stops. If the error of an exposure is larger, equal exposures are not
            confirmed.
        unseen: largest share of a held-out view that no training view shows. Views with a larger share are named.
        cells: number of cells across a picture in which content is compared.
        most: approximate number of points from which the depths of these cells are computed.
    """

    fewest = 50
    focal_differs = 0.01
    focal_wrong = 0.05
    step = 1 / 3
    unseen = 0.1
    cells = 64
    most = 2000


def view_exposure_check(capture: Capture) -> Check:
    """Check that all views have equal exposure and white balance."""
    exposures = capture.exposures
    if exposures is None or not np.isfinite(exposures.logs).any():
        return Check("view_exposure", "n/a", "The model stores no points that views share.")
    logs = exposures.significant / math.log(2)
    known = np.isfinite(logs).all(axis=1)
    size = np.where(known, np.abs(logs).max(axis=1), 0.0)
    strongest = [int(k) for k in np.argsort(-size) if size[k] > 0]
    names = [view.name for view in capture.views]
    errors = [float(np.median(e[known])) / math.log(2) for e in (exposures.errors, exposures.color_errors)]
    figures = {
        "stops": {names[k]: [float(value) for value in logs[k]] for k in np.flatnonzero(known)},
        "error_stops": errors[0],
        "color_error_stops": errors[1],
        "unknown": int((~known).sum()),
    }
    precision = f"to {errors[0]:.2f} stops, colors to {errors[1]:.2f}"
    changes = [f"{names[k]} {logs[k][np.abs(logs[k]).argmax()]:+.2f}" for k in strongest]
    remedy = "Training and evaluation divide each color of these views by its gain."
    if capture.keeps_gains:
        remedy = "Prepare without --gains none, so that training divides each color of a view by its gain."
    outcome = first_outcome(
        (
            strongest,
            "warning",
            f"By shared points, exposure or white balance of {len(strongest)} of {len(names)} views differs from the "
            f"mean ({precision}). Stops: {listed(changes)}.",
            f"{remedy} Use fixed exposure and white balance for new captures.",
        ),
        (
            errors[0] > ViewLimits.step,
            "not verified",
            f"The views share too few points to compare their exposures ({precision}).",
            "Add views between the existing ones.",
        ),
        (True, "ok", f"Shared points are equally bright in all views ({precision}).", ""),
    )
    return Check("view_exposure", *outcome, tuple(names[k] for k in strongest), figures)


def held_out_check(capture: Capture) -> Check:
    """Check that training views show the content of the held-out views.

    The points of the model give the depth of each cell of a picture. Cells outside the convex hull of the points show
    background.
    """
    cameras = {view.name: camera for view, camera in capture.cameras}
    tests = [name for name in capture.test_names if name in cameras]
    if capture.model is None or not tests:
        return Check("held_out", "n/a", "No held-out view has a pose.")
    points = capture.model.points.double()
    points = points[:: max(1, len(points) // ViewLimits.most)]
    maps = {name: _point_depths(camera, points) for name, camera in cameras.items()}
    coverage = Coverage({name: maps[name] for name in tests})
    for name in maps.keys() - set(tests):
        coverage.add(maps[name])
    shares = {name: 1 - float(seen.double().mean()) for name, seen in coverage.seen.items()}
    named = sorted(
        (name for name in tests if shares[name] > ViewLimits.unseen), key=lambda name: -shares[name]
    )
    mean = sum(shares.values()) / len(shares)
    finding = f"Training views show {1 - mean:.0%} of the content of {len(tests)} held-out views."
    outcome = first_outcome(
        (not named, "ok", finding, ""),
        (
            True,
            "warning",
            f"{finding} Shares that none of them shows: {listed([f'{name} {shares[name]:.0%}' for name in named])}.",
            "Compare the scores of seen pixels, because other pixels can only be guessed. For new captures, add a low "
            "ring of views that shows the surroundings.",
        ),
    )
    return Check("held_out", *outcome, tuple(named), {"unseen": shares})


def _point_depths(camera: Camera, points: Tensor) -> DepthMap:
    """Return the depth of each cell of a picture, interpolated between the points [M, 3] that are visible in it."""
    cells = camera.downscaled(max(1, camera.width // ViewLimits.cells))
    _, depth, inside = seen_at(points - cells.center, cells)
    map_of_background = DepthMap(
        cells, torch.full((cells.height, cells.width), torch.inf, dtype=torch.float64)
    )
    local = cells.to_camera(points[inside] - cells.center).numpy()
    if len(local) < 3:
        return map_of_background
    places = local[:, :2] / local[:, 2:] * (cells.fx, cells.fy) + (cells.cx, cells.cy)
    rows, columns = np.mgrid[: cells.height, : cells.width] + 0.5
    try:
        inverse = LinearNDInterpolator(places, 1 / depth[inside].numpy(), fill_value=0.0)(columns, rows)
    except QhullError:  # all points on a line
        return map_of_background
    return DepthMap(cells, torch.from_numpy(inverse).reciprocal())


def lens_check(capture: Capture) -> Check:
    """Check that the focal length of each view agrees with the focal length that the view alone would have."""
    if capture.model is None:
        return Check("focal_lengths", "n/a", "There are no poses.")
    fits = {
        view.name: fit
        for view in capture.posed
        if (fit := _focal_length_alone(capture.model, view.name)) is not None
    }
    if len(fits) < 3:
        finding = f"Fewer than 3 views have {ViewLimits.fewest} points with positions in the pictures."
        return Check("focal_lengths", "n/a", finding)
    names = list(fits)
    logs, errors = np.array(list(fits.values())).T
    off = significant(np.abs(logs), errors) & (np.abs(logs) > ViewLimits.focal_differs)
    usual = float(np.sqrt(np.mean(logs**2)))
    order = [int(k) for k in np.argsort(-np.abs(logs)) if off[k]]
    changes = listed([f"{names[k]} {math.expm1(logs[k]):+.1%}" for k in order])
    finding = f"A fit of each view to fixed points changes its focal length by {usual:.1%} (rms)."
    outcome = first_outcome(
        (not order, "ok", finding, ""),
        (
            order,
            "wrong" if np.abs(logs[off]).max(initial=0) > ViewLimits.focal_wrong else "warning",
            f"{finding} It contradicts the model in {len(order)} views ({changes}).",
            "Poses are wrong if several cameras share one model: a phone that changed its lens, a zoom, or a crop. "
            "Prepare the original files, whose EXIF distinguishes them, or use a model with a camera for each.",
        ),
    )
    return Check(
        "focal_lengths",
        *outcome,
        tuple(names[k] for k in order),
        {"rms": usual, "views": dict(zip(names, (np.exp(logs) - 1).tolist(), strict=True))},
    )


def _focal_length_alone(model: ColmapModel, view: str) -> tuple[float, float] | None:
    """Estimate the focal length from one view alone, with fixed points, and compare it with the model.

    Pose and focal length minimize the distances in the picture. The error assumes independent distances.

    Returns:
        Logarithm of the ratio of the estimated focal length to the model's; and its standard error. None if there are
        too few points.
    """
    pixels, places = model.correspondences(view)
    if len(pixels) < ViewLimits.fewest:
        return None
    camera = model.camera(view)
    local = places @ camera.rotation.numpy().T + camera.translation.numpy()
    if not (local[:, 2] > 0).all():
        return None
    middle = local.mean(axis=0)
    depth = float(np.median(local[:, 2]))
    focal = np.array([camera.fx, camera.fy])
    center = np.array([camera.cx, camera.cy])

    def distances(change: NDArray[np.float64]) -> NDArray[Any]:
        rotated = (local - middle) @ Rotation.from_rotvec(change[:3]).as_matrix().T
        moved = rotated + middle + depth * change[3:6]
        projected = moved[:, :2] / moved[:, 2:] * np.exp(change[6]) * focal + center
        return np.asarray((projected - pixels).ravel())

    fitted = least_squares(distances, np.zeros(7), loss="soft_l1")
    deviation = TO_DEVIATION * float(np.median(np.abs(fitted.fun)))
    normal = fitted.jac.T @ fitted.jac
    if np.linalg.cond(normal) > 1e12:
        return None
    return float(fitted.x[6]), deviation * math.sqrt(float(np.linalg.inv(normal)[6, 6]))
