"""Sample 3D points in the visual hull: where most cameras see them, inside their object masks."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pycolmap
from numpy.typing import NDArray

from polarguide.capture.colmap.write import PosedCamera, colmap_camera

_ROUNDS = 4
_BATCH = 100_000
_SHARE_OF_VIEWS = 0.8
_SHARE_IN_MASKS = 0.95
_BATCHES = 40

Points = NDArray[np.float64]


def sample_visual_hull(
    cameras: Mapping[str, PosedCamera],
    masks: Mapping[str, NDArray[np.bool_]],
    count: int,
    rng: np.random.Generator,
) -> Points:
    """Random points that most cameras see, inside the object masks where there are any.

    A point counts if 80 % of the cameras (those with masks, where there are any) see it, and 95 % of these see
    it inside their mask. The box to sample from starts around the point nearest to all optical axes, with the
    cameras' median distance from it as half its side, and shrinks to the points found.

    Args:
        cameras: by view; distortion is respected.
        masks: object masks by view, [H, W] at the cameras' sizes; may be empty.
        count: how many points are wanted.
        rng: for the draws.

    Returns:
        [N, 3] with N up to ``count``; N is 0 if enough cameras see no common point.
    """
    used = {view: camera for view, camera in cameras.items() if not masks or view in masks}
    pixels = {view: colmap_camera(camera) for view, camera in used.items()}
    center, reach = _nearest_to_axes(list(used.values()))
    low, high = center - reach, center + reach

    def kept(batch: int) -> Points:
        places = rng.uniform(low, high, (batch, 3))
        return places[_seen_by_most(places, used, pixels, masks)]

    for _ in range(_ROUNDS):
        found = kept(_BATCH)
        if len(found) == 0:
            return found
        margin = 0.05 * (found.max(axis=0) - found.min(axis=0)) + 0.01 * reach
        low, high = np.maximum(low, found.min(axis=0) - margin), np.minimum(high, found.max(axis=0) + margin)
    parts, total = [], 0
    for _ in range(_BATCHES):
        parts.append(kept(_BATCH))
        total += len(parts[-1])
        if total >= count:
            break
    return np.concatenate(parts)[:count]


def _nearest_to_axes(cameras: list[PosedCamera]) -> tuple[Points, float]:
    """The point nearest to all optical axes (least squares), and the cameras' median distance from it."""
    centers = np.stack([camera.center for camera in cameras])
    axes = np.stack([camera.rotation[2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    # A little weight at the cameras' mean keeps parallel axes solvable.
    matrix = across.sum(axis=0) + 1e-6 * len(cameras) * np.eye(3)
    goal = (across @ centers[:, :, None]).sum(axis=0)[:, 0] + 1e-6 * centers.sum(axis=0)
    center = np.linalg.solve(matrix, goal)
    reach = float(np.median(np.linalg.norm(centers - center, axis=1)))
    return center, max(reach, 1e-6)


def _seen_by_most(
    places: Points,
    cameras: Mapping[str, PosedCamera],
    pixels: Mapping[str, pycolmap.Camera],
    masks: Mapping[str, NDArray[np.bool_]],
) -> NDArray[np.bool_]:
    """Which points [N, 3] enough cameras see, inside their masks: [N]."""
    seen, inside = np.zeros(len(places)), np.zeros(len(places))
    for view, camera in cameras.items():
        local = places @ camera.rotation.T + camera.translation
        before = local[:, 2] > 1e-6
        where = np.full((len(places), 2), -1.0)
        where[before] = np.nan_to_num(np.asarray(pixels[view].img_from_cam(local[before])), nan=-1.0)
        hit = before & (where >= 0).all(axis=1) & (where < [camera.width, camera.height]).all(axis=1)
        seen += hit
        if view in masks:
            column, row = where[hit].astype(int).T
            inside[hit] += masks[view][row, column]
    enough = seen >= max(1.0, _SHARE_OF_VIEWS * len(cameras))
    return np.asarray(enough & (inside >= _SHARE_IN_MASKS * seen)) if masks else np.asarray(enough)
