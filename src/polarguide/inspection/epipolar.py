"""Epipolar errors of feature matches between neighboring views: a test of the poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.camera import Camera
from polarguide.inspection.capture import Capture, InspectedView

NEIGHBORS = 4
FEATURES = 3000
FEWEST_MATCHES = 15
RATIO = 0.75
GATE_SHARE = 0.02
"""Matches farther from their epipolar line than this share of the picture's diagonal count as mismatches."""


@dataclass(frozen=True)
class PairError:
    """Median distance of matches from their epipolar lines between two views, in stored pixels."""

    first: str
    second: str
    matches: int
    error: float


def epipolar_errors(capture: Capture) -> list[PairError]:
    """Match every posed view with its nearest neighbors in position and viewing direction."""
    views = capture.posed
    features = [_features(view) for view in views]
    pairs = _neighbor_pairs([view.camera for view in views if view.camera is not None])
    found = []
    for i, j in pairs:
        error = _pair_error(views[i], views[j], features[i], features[j], capture.factor)
        if error is not None:
            found.append(error)
    return found


def view_errors(errors: Sequence[PairError]) -> dict[str, float]:
    """Each view's error: the lower quartile over its pairs, so that one bad view does not affect its neighbors."""
    by_view: dict[str, list[float]] = {}
    for pair in errors:
        for name in (pair.first, pair.second):
            by_view.setdefault(name, []).append(pair.error)
    return {name: float(np.quantile(values, 0.25)) for name, values in sorted(by_view.items())}


def _features(view: InspectedView) -> tuple[NDArray[np.float64], NDArray[np.float32] | None]:
    gray = view.codes.numpy().astype(np.float64).mean(axis=(0, 3))
    top = max(float(np.percentile(gray, 99.5)), 1.0)
    shown = (255 * np.clip(gray / top, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    keypoints, descriptors = cv2.SIFT_create(nfeatures=FEATURES, contrastThreshold=0.02).detectAndCompute(  # type: ignore[attr-defined]
        shown, None
    )
    # OpenCV has its first pixel center at 0, COLMAP at 0.5.
    places = np.array([point.pt for point in keypoints], dtype=np.float64).reshape(-1, 2) + 0.5
    return places, None if descriptors is None else np.sqrt(
        descriptors / (descriptors.sum(1, keepdims=True) + 1e-9)
    )


def _neighbor_pairs(cameras: Sequence[Camera]) -> list[tuple[int, int]]:
    centers = np.stack([camera.center.numpy() for camera in cameras])
    axes = np.stack([camera.rotation[2].numpy() for camera in cameras])
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    apart = apart / max(float(np.median(apart)), 1e-12) + 2 * (1 - axes @ axes.T)
    np.fill_diagonal(apart, np.inf)
    near = np.argsort(apart, axis=1)[:, : min(NEIGHBORS, len(cameras) - 1)]
    return sorted({(min(i, int(j)), max(i, int(j))) for i, row in enumerate(near) for j in row})


def _pair_error(
    first: InspectedView,
    second: InspectedView,
    features1: tuple[NDArray[np.float64], NDArray[np.float32] | None],
    features2: tuple[NDArray[np.float64], NDArray[np.float32] | None],
    factor: int,
) -> PairError | None:
    (x1, d1), (x2, d2) = features1, features2
    assert first.camera is not None
    assert second.camera is not None
    if d1 is None or d2 is None or min(len(d1), len(d2)) < 2:
        return None
    there = cv2.BFMatcher(cv2.NORM_L2).knnMatch(d1, d2, k=2)
    back = {m.queryIdx: m.trainIdx for m in cv2.BFMatcher(cv2.NORM_L2).match(d2, d1)}
    kept = [m for m, n in there if m.distance < RATIO * n.distance and back.get(m.trainIdx) == m.queryIdx]
    if len(kept) < FEWEST_MATCHES:
        return None
    p1 = np.concatenate([x1[[m.queryIdx for m in kept]], np.ones((len(kept), 1))], axis=1)
    p2 = np.concatenate([x2[[m.trainIdx for m in kept]], np.ones((len(kept), 1))], axis=1)
    matrix = _fundamental(first.camera, second.camera)
    along2, along1 = p1 @ matrix.T, p2 @ matrix
    value = np.abs((p2 * along2).sum(axis=1))
    distance = value / np.sqrt((along1[:, :2] ** 2).sum(1) + (along2[:, :2] ** 2).sum(1)) * np.sqrt(2)
    near = distance < GATE_SHARE * float(np.hypot(first.camera.width, first.camera.height))
    if near.sum() < FEWEST_MATCHES:
        return None
    return PairError(first.name, second.name, int(near.sum()), float(np.median(distance[near])) * factor)


def _fundamental(first: Camera, second: Camera) -> NDArray[np.float64]:
    """F with ``x2^T F x1 = 0`` for pixels of the two views (Hartley and Zisserman, Eq. 9.2)."""
    rotation = (second.rotation @ first.rotation.T).numpy()
    x, y, z = second.translation.numpy() - rotation @ first.translation.numpy()
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    inner1, inner2 = (np.linalg.inv(camera.intrinsics.numpy()) for camera in (first, second))
    return np.asarray(inner2.T @ cross @ rotation @ inner1)
