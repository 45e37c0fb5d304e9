"""3D points for known poses: triangulated from feature matches, or sampled in the visual hull."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from polarguide.capture.colmap.model import PosedCamera, colmap_camera, load_model, posed_model
from polarguide.capture.colmap.sfm import match_features, run_step
from polarguide.capture.formats.pictures import decode_mask, decode_picture, read_picture
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import make_folder, write_whole, writing
from polarguide.core.progress import Reporter
from polarguide.core.records import read_record

_ROUNDS = 4
"""Number of times that the sampled box shrinks."""
_BATCH = 100_000
"""Number of samples per batch."""
_SHARE_OF_VIEWS = 0.8
"""Share of the cameras that must see a point."""
_SHARE_IN_MASKS = 0.95
"""Share of these cameras whose mask must contain the point."""
_BATCHES = 40
"""Largest number of batches of samples."""

Points = NDArray[np.float64]


def sample_visual_hull(
    cameras: Mapping[str, PosedCamera],
    masks: Mapping[str, NDArray[np.bool_]],
    count: int,
    rng: np.random.Generator,
) -> Points:
    """Sample random points in the common field of view of most cameras, inside the foreground masks.

    A point counts if 80 % of the cameras see it, and 95 % of these inside their mask. If there are masks, only cameras
    with a mask count. The sampled box starts around the point nearest to all optical axes. Half of its side is the
    median distance of the cameras from this point. The box shrinks to the points that count.

    Args:
        cameras: cameras by view, with distortion.
        masks: foreground masks by view, [H, W] at the cameras' sizes; may be empty.
        count: requested number of points.
        rng: random generator.

    Returns:
        [N, 3] with N up to ``count``; empty if no point is visible in enough cameras.
    """
    used = {view: camera for view, camera in cameras.items() if not masks or view in masks}
    pixels = {view: colmap_camera(camera) for view, camera in used.items()}
    center, reach = _nearest_to_axes(list(used.values()))
    low = center - reach
    high = center + reach

    def samples_inside(batch: int) -> Points:
        places = rng.uniform(low, high, (batch, 3))
        return places[_visible_to_most(places, used, pixels, masks)]

    for _ in range(_ROUNDS):
        inner = samples_inside(_BATCH)
        if not len(inner):
            return inner
        margin = 0.05 * (inner.max(axis=0) - inner.min(axis=0)) + 0.01 * reach
        low = np.maximum(low, inner.min(axis=0) - margin)
        high = np.minimum(high, inner.max(axis=0) + margin)
    parts: list[Points] = []
    while len(parts) < _BATCHES and sum(map(len, parts)) < count:
        parts.append(samples_inside(_BATCH))
    return np.concatenate(parts)[:count]


def _nearest_to_axes(cameras: list[PosedCamera]) -> tuple[Points, float]:
    """Return the least-squares point nearest to all optical axes, and the cameras' median distance from it."""
    centers = np.stack([camera.center for camera in cameras])
    axes = np.stack([camera.rotation[2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    # A small weight of the cameras' mean keeps the system solvable for parallel axes.
    matrix = across.sum(axis=0) + 1e-6 * len(cameras) * np.eye(3)
    goal = (across @ centers[:, :, None]).sum(axis=0)[:, 0] + 1e-6 * centers.sum(axis=0)
    center = np.linalg.solve(matrix, goal)
    reach = float(np.median(np.linalg.norm(centers - center, axis=1)))
    return center, max(reach, 1e-6)


def _visible_to_most(
    places: Points,
    cameras: Mapping[str, PosedCamera],
    pixels: Mapping[str, pycolmap.Camera],
    masks: Mapping[str, NDArray[np.bool_]],
) -> NDArray[np.bool_]:
    """Return a mask [N] of the points [N, 3] that enough cameras see inside their masks."""
    counts = np.zeros(len(places))
    inside = np.zeros(len(places))
    for view, camera in cameras.items():
        local = places @ camera.rotation.T + camera.translation
        before = local[:, 2] > 1e-6
        where = np.full((len(places), 2), -1.0)
        where[before] = np.nan_to_num(np.asarray(pixels[view].img_from_cam(local[before])), nan=-1.0)
        hit = before & (where >= 0).all(axis=1) & (where < [camera.width, camera.height]).all(axis=1)
        counts += hit
        if view in masks:
            column, row = where[hit].astype(int).T
            inside[hit] += masks[view][row, column]
    enough = counts >= max(1.0, _SHARE_OF_VIEWS * len(cameras))
    return np.asarray(enough & (inside >= _SHARE_IN_MASKS * counts)) if masks else np.asarray(enough)


FEWEST = 200
"""Number of triangulated points below which points are sampled in the visual hull instead."""
SAMPLES = 20_000
"""Number of points that are sampled in the visual hull."""
NOTE_FILE = "points.json"
"""Name of the file with the origin and number of the points."""


def add_points(
    folder: Path,
    cameras: Mapping[str, PosedCamera],
    where: object,
    *,
    matching: str,
    seed: int,
    reporter: Reporter,
) -> tuple[Path, dict[str, Any]]:
    """Add 3D points to cameras without changing the cameras.

    Features of ``folder/images/<view>.png`` are matched and triangulated with fixed poses. If fewer than ``FEWEST``
    points result, points are sampled in the visual hull of ``folder/masks/<view>.png``, or in the common field of view
    without masks.

    Args:
        folder: working folder; results of an earlier call are reused.
        cameras: cameras of its pictures by view.
        where: origin of the poses for messages.
        matching: "exhaustive" or "sequential".
        seed: seed of all random draws.
        reporter: reporter of progress and messages.

    Returns:
        Folder of the model, and a record of the origin and number of its points.

    Raises:
        PolarguideError: the cameras have no common field of view, or a file cannot be written.
    """
    model = folder / "model"
    note = folder / NOTE_FILE
    if model.is_dir() and note.exists():
        return model, read_record(note, dict[str, Any])
    start = folder / "start"
    trial = folder / "triangulated"
    for path in (start, trial):
        shutil.rmtree(path, ignore_errors=True)
        make_folder(path)
    with writing(start):
        posed_model(cameras).write_binary(str(start))
    count, error = _triangulated(folder, start, trial, cameras, matching, seed, reporter)
    record: dict[str, Any] = {"from": "triangulation with fixed poses", "count": count}
    if error is not None:
        record["reprojection_error_pixels"] = round(error, 3)
    if count < FEWEST:
        record = _sample(folder, start, trial, cameras, count, where, seed, reporter)
    else:
        reporter.say(
            f"The poses have no points: {count} were triangulated, mean reprojection error {error:.2f} pixels."
        )
    with writing(model):
        shutil.rmtree(model, ignore_errors=True)
        trial.rename(model)
    write_whole(note, (json.dumps(record) + "\n").encode())
    return model, record


def _triangulated(
    folder: Path,
    start: Path,
    trial: Path,
    cameras: Mapping[str, PosedCamera],
    matching: str,
    seed: int,
    reporter: Reporter,
) -> tuple[int, float | None]:
    """Triangulate into ``trial`` and return the number of points with their mean reprojection error."""
    database = folder / "database.db"
    images = folder / "images"
    sizes = {view: (camera.width, camera.height) for view, camera in cameras.items()}
    try:
        numbers = match_features(
            database, images, sizes, matching=matching, seed=seed, reporter=reporter, cameras=cameras
        )
        with writing(start):
            posed_model(cameras, numbers).write_binary(str(start))
        paths = {"database": database, "images": images, "start": start, "out": trial}
        arguments = {name: str(path) for name, path in paths.items()}
        run_step("triangulate", arguments, seed, reporter, "triangulating")
    except PolarguideError as error:
        reporter.warn(f"Triangulation failed ({error.found}).")
        return 0, None
    model = load_model(trial, ".bin")
    count = len(model.points3D)
    return count, float(model.compute_mean_reprojection_error()) if count else None


def _sample(
    folder: Path,
    start: Path,
    trial: Path,
    cameras: Mapping[str, PosedCamera],
    triangulated: int,
    where: object,
    seed: int,
    reporter: Reporter,
) -> dict[str, Any]:
    """Sample points in the visual hull, write the model to ``trial`` and return a record of its points."""
    masks = {}
    for view in cameras:
        path = folder / "masks" / f"{view}.png"
        if path.exists():
            masks[view] = decode_mask(path, read_picture(path), any_value=True)
    places = sample_visual_hull(cameras, masks, SAMPLES, np.random.default_rng(seed))
    kind = "the hull of the masks" if masks else "the cameras' common field of view"
    require(
        len(places),
        where,
        expected="poses of cameras with a common field of view",
        found=f"{triangulated} triangulated points and an empty {kind.removeprefix('the ')}",
        remedy="Check the poses (world to camera, axes right, down, forward), or use a model with points.",
    )
    model = load_model(start, ".bin")
    for place, color in zip(places, _colors(folder, cameras, places), strict=True):
        model.add_point3D(place, pycolmap.Track(), color)
    shutil.rmtree(trial, ignore_errors=True)
    make_folder(trial)
    model.write_binary(str(trial))
    reporter.warn(
        f"The poses have no points, and only {triangulated} could be triangulated (fewer than {FEWEST}): "
        f"{len(places)} points were sampled at random in {kind} instead. They are not on the surface."
    )
    return {"from": f"random samples in {kind}", "count": len(places), "triangulated": triangulated}


def _colors(
    folder: Path, cameras: Mapping[str, PosedCamera], places: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Return the mean color of the photographs at the projections of points [N, 3], [N, 3] RGB."""
    total = np.zeros((len(places), 3))
    counts = np.zeros(len(places))
    views = sorted(cameras)
    for view in views[:: max(1, len(views) // 8)]:
        path = folder / "images" / f"{view}.png"
        picture = decode_picture(path, read_picture(path))
        camera = cameras[view]
        local = places @ camera.rotation.T + camera.translation
        plain = colmap_camera(camera)  # projected without distortion
        focal = np.array([plain.focal_length_x, plain.focal_length_y])
        center = np.array([plain.principal_point_x, plain.principal_point_y])
        pixel = local[:, :2] / np.maximum(local[:, 2:], 1e-9) * focal + center
        size = np.array([camera.width, camera.height])
        inside = (local[:, 2] > 0) & (pixel >= 0).all(axis=1) & (pixel < size).all(axis=1)
        column, row = pixel[inside].astype(int).T
        small = cv2.blur(picture, (3, 3))
        total[inside] += small[row, column]
        counts[inside] += 1
    gray = np.where(counts[:, None] > 0, total / np.maximum(counts, 1)[:, None], 128)
    return np.rint(gray).astype(np.uint8)
