"""3D points for given poses: triangulated from feature matches, or sampled in the visual hull."""

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

from polarguide.capture.colmap.features import match_features, pipeline_options, run_step
from polarguide.capture.colmap.model import load_model
from polarguide.capture.colmap.visual_hull import sample_visual_hull
from polarguide.capture.colmap.write import PosedCamera, colmap_camera, write_cameras
from polarguide.capture.formats.headers import read_picture
from polarguide.capture.formats.pictures import decode_mask, decode_picture
from polarguide.errors import PolarguideError
from polarguide.files import make_folder, write_whole, writing
from polarguide.progress import Reporter
from polarguide.records import read_record

FEWEST = 200
"""With fewer triangulated points than this, points are sampled in the visual hull instead."""
SAMPLES = 20_000
FOUND = "points.json"


def add_points(
    folder: Path,
    cameras: Mapping[str, PosedCamera],
    where: object,
    *,
    matching: str,
    seed: int,
    reporter: Reporter,
) -> tuple[Path, dict[str, Any]]:
    """Add 3D points to given cameras; the cameras stay as they are.

    Features of ``folder/images/<view>.png`` are matched and triangulated with the poses held fixed. If fewer
    than ``FEWEST`` points result, points are sampled in the visual hull of ``folder/masks/<view>.png``, or in the
    cameras' common field of view if there are no masks.

    Args:
        folder: working folder; results of an earlier call in it are used.
        cameras: of the pictures in it, by view.
        where: the origin of the poses, for messages.
        matching: "exhaustive" or "sequential".
        seed: of all random draws.
        reporter: for progress and messages.

    Returns:
        The folder of the model, and a record of the origin and number of its points.

    Raises:
        PolarguideError: the cameras have no common field of view, or a file cannot be written.
    """
    model, note = folder / "model", folder / FOUND
    if model.is_dir() and note.exists():
        return model, read_record(note, dict[str, Any])
    start, trial = folder / "start", folder / "triangulated"
    for path in (start, trial):
        shutil.rmtree(path, ignore_errors=True)
        make_folder(path)
    with writing(start):
        write_cameras(start, cameras)
    count, error = _triangulated(folder, start, trial, cameras, matching, seed, reporter)
    found: dict[str, Any] = {"from": "triangulation with fixed poses", "count": count}
    if error is not None:
        found["reprojection_error_pixels"] = round(error, 3)
    if count < FEWEST:
        found = _sample(folder, start, trial, cameras, count, where, seed, reporter)
    else:
        reporter.say(
            f"The poses came without points: {count} were triangulated, mean reprojection error {error:.2f} pixels."
        )
    with writing(model):
        shutil.rmtree(model, ignore_errors=True)
        trial.rename(model)
    write_whole(note, (json.dumps(found) + "\n").encode())
    return model, found


def _triangulated(
    folder: Path,
    start: Path,
    trial: Path,
    cameras: Mapping[str, PosedCamera],
    matching: str,
    seed: int,
    reporter: Reporter,
) -> tuple[int, float | None]:
    """Triangulate into ``trial``; returns the number of points and their mean reprojection error."""
    database, images = folder / "database.db", folder / "images"
    sizes = {view: (camera.width, camera.height) for view, camera in cameras.items()}
    try:
        numbers = match_features(
            database, images, sizes, matching=matching, seed=seed, reporter=reporter, cameras=cameras
        )
        with writing(start):
            write_cameras(start, cameras, numbers)
        model = load_model(start, ".bin")
        options = pipeline_options(seed)
        for name in ("focal_length", "principal_point", "extra_params"):
            setattr(options, f"ba_refine_{name}", False)
        made = run_step(
            lambda: pycolmap.triangulate_points(model, database, images, trial, options=options),
            seed, reporter, "triangulating",
        )  # fmt: skip
    except PolarguideError as error:
        reporter.warn(f"Triangulation failed ({error.found}).")
        return 0, None
    made.write_binary(str(trial))
    count = len(made.points3D)
    return count, float(made.compute_mean_reprojection_error()) if count else None


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
    masks = {}
    for view in cameras:
        path = folder / "masks" / f"{view}.png"
        if path.exists():
            masks[view] = decode_mask(path, read_picture(path), any_value=True)
    places = sample_visual_hull(cameras, masks, SAMPLES, np.random.default_rng(seed))
    kind = "the hull of the masks" if masks else "the cameras' common field of view"
    if len(places) == 0:
        raise PolarguideError(
            where,
            expected="poses of cameras with a common field of view",
            found=f"{triangulated} triangulated points, and nothing in {kind}",
            remedy="Check the poses (world to camera, axes right, down, forward), or bring a model with points.",
        )
    model = load_model(start, ".bin")
    for place, color in zip(places, _colors(folder, cameras, places), strict=True):
        model.add_point3D(place, pycolmap.Track(), color)
    shutil.rmtree(trial, ignore_errors=True)
    make_folder(trial)
    model.write_binary(str(trial))
    reporter.warn(
        f"The poses came without points, and only {triangulated} could be triangulated (fewer than {FEWEST}): "
        f"{len(places)} points were sampled at random in {kind} instead. They do not lie on the surface."
    )
    return {"from": f"random samples in {kind}", "count": len(places), "triangulated": triangulated}


def _colors(
    folder: Path, cameras: Mapping[str, PosedCamera], places: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Mean color of the photographs at the projections of points [N, 3], [N, 3] RGB."""
    total, seen = np.zeros((len(places), 3)), np.zeros(len(places))
    views = sorted(cameras)
    for view in views[:: max(1, len(views) // 8)]:
        path = folder / "images" / f"{view}.png"
        picture = decode_picture(path, read_picture(path))
        camera = cameras[view]
        local = places @ camera.rotation.T + camera.translation
        plain = colmap_camera(camera)  # without its distortion
        focal = np.array([plain.focal_length_x, plain.focal_length_y])
        center = np.array([plain.principal_point_x, plain.principal_point_y])
        pixel = local[:, :2] / np.maximum(local[:, 2:], 1e-9) * focal + center
        size = np.array([camera.width, camera.height])
        inside = (local[:, 2] > 0) & (pixel >= 0).all(axis=1) & (pixel < size).all(axis=1)
        column, row = pixel[inside].astype(int).T
        small = cv2.blur(picture, (3, 3))
        total[inside] += small[row, column]
        seen[inside] += 1
    gray = np.where(seen[:, None] > 0, total / np.maximum(seen, 1)[:, None], 128)
    return np.rint(gray).astype(np.uint8)
