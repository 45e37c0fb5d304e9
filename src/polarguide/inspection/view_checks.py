"""Checks that compare views at the points of the model: their exposures and focal lengths."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from polarguide.capture.angle_evidence import TO_DEVIATION
from polarguide.capture.colmap.model import ColmapModel
from polarguide.capture.point_exposures import significant
from polarguide.capture.view import listed
from polarguide.inspection.capture import Capture
from polarguide.inspection.settings import Check, first_outcome


class ViewLimits:
    """Thresholds of the checks.

    Attributes:
        fewest: smallest number of points for the estimate of a focal length.
        focal_differs: difference of the logarithm of a focal length for a warning; 1 % turns a ray at 30 degrees by
            0.25 degrees.
        focal_wrong: the same for the verdict "wrong".
        step: step of camera exposures in stops; with a larger error, equal exposures are not confirmed.
    """

    fewest = 50
    focal_differs = 0.01
    focal_wrong = 0.05
    step = 1 / 3


def view_exposure_check(capture: Capture) -> Check:
    """Check whether the views have equal exposure and white balance."""
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


def lens_check(capture: Capture) -> Check:
    """Check whether each view alone agrees with its focal length in the model."""
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
    """Return the logarithm of the ratio of a view's own focal length to the model's, and its standard error.

    Points are fixed. Pose and focal length minimize the distances in the picture. The error assumes independent
    distances. Too few points give None.
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
