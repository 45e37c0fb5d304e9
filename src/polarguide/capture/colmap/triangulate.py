"""3D points for poses that have none: matched and triangulated, else sampled where the cameras look."""

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

from polarguide.capture.colmap.features import match, run, seeded
from polarguide.capture.colmap.model import load_model
from polarguide.capture.colmap.sample import region_samples
from polarguide.capture.colmap.write import PosedCamera, write_cameras
from polarguide.capture.formats.pictures import decode_mask, decode_picture, read_file
from polarguide.errors import PolarguideError
from polarguide.files import guarded, write_whole
from polarguide.progress import Reporter
from polarguide.records import parse_json

FEWEST = 200
"""Fewer triangulated points than this are no shape to start from."""
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
    """A model with the given cameras, as they are, and points.

    Features of ``folder/images/<view>.png`` are matched and triangulated with the poses held fixed. If fewer
    than ``FEWEST`` points come out, points are sampled inside the hull of ``folder/masks/<view>.png``, or where
    the cameras' pictures overlap if there are no masks.

    Args:
        folder: for work; finished work in it is taken over.
        cameras: of the pictures in it, by view.
        where: the poses came from, for messages.
        matching: "exhaustive" or "sequential".
        seed: of all random draws.
        reporter: for progress and what was found.

    Returns:
        The folder of the model, and how its points came about.

    Raises:
        PolarguideError: nothing lies before enough cameras to sample from, or a file cannot be written.
    """
    model, note = folder / "model", folder / FOUND
    if model.is_dir() and note.exists():
        return model, parse_json(note, read_file(note))
    start, trial = folder / "start", folder / "triangulated"
    for path in (start, trial):
        shutil.rmtree(path, ignore_errors=True)
        guarded(lambda path=path: path.mkdir(parents=True), path)  # type: ignore[misc]
    guarded(lambda: write_cameras(start, cameras), start)
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
    guarded(lambda: _replace(model, trial), model)
    write_whole(note, (json.dumps(found) + "\n").encode())
    return model, found


def _replace(old: Path, new: Path) -> None:
    shutil.rmtree(old, ignore_errors=True)
    new.rename(old)


def _triangulated(
    folder: Path,
    start: Path,
    trial: Path,
    cameras: Mapping[str, PosedCamera],
    matching: str,
    seed: int,
    reporter: Reporter,
) -> tuple[int, float | None]:
    """Triangulate into ``trial``: number of points, and their mean reprojection error."""
    database, images = folder / "database.db", folder / "images"
    sizes = {view: (camera.width, camera.height) for view, camera in cameras.items()}
    try:
        numbers = match(
            database, images, sizes, matching=matching, seed=seed, reporter=reporter, cameras=cameras
        )
        guarded(lambda: write_cameras(start, cameras, numbers), start)
        model = load_model(start, ".bin")
        options = pycolmap.IncrementalPipelineOptions()
        for part in (options, options.mapper, options.triangulation):
            seeded(part, seed)
        options.ba_refine_focal_length = options.ba_refine_principal_point = (
            options.ba_refine_extra_params
        ) = False
        made = run(
            lambda: pycolmap.triangulate_points(model, database, images, trial, options=options),
            seed, reporter, "triangulating", None, lambda: 0,
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
            masks[view] = decode_mask(path, read_file(path), any_value=True)
    places = region_samples(cameras, masks, SAMPLES, np.random.default_rng(seed))
    kind = "the hull of the masks" if masks else "the cameras' common field of view"
    if len(places) == 0:
        raise PolarguideError(
            where,
            expected="poses whose cameras look at one place",
            found=f"{triangulated} triangulated points, and nothing in {kind}",
            remedy="Check the poses (world to camera, axes right, down, forward), or bring a model with points.",
        )
    model = load_model(start, ".bin")
    for place, color in zip(places, _colors(folder, cameras, places), strict=True):
        model.add_point3D(place, pycolmap.Track(), color)
    shutil.rmtree(trial, ignore_errors=True)
    guarded(trial.mkdir, trial)
    model.write_binary(str(trial))
    reporter.warn(
        f"The poses came without points, and only {triangulated} could be triangulated (fewer than {FEWEST}): "
        f"{len(places)} points were sampled at random in {kind} instead. They know nothing of the surface."
    )
    return {"from": f"random samples in {kind}", "count": len(places), "triangulated": triangulated}


def _colors(
    folder: Path, cameras: Mapping[str, PosedCamera], places: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Mean color of the photographs where points [N, 3] would be seen, [N, 3] RGB."""
    total, seen = np.zeros((len(places), 3)), np.zeros(len(places))
    views = sorted(cameras)
    for view in views[:: max(1, len(views) // 8)]:
        path = folder / "images" / f"{view}.png"
        picture = decode_picture(path, read_file(path))
        camera = cameras[view]
        local = places @ camera.rotation.T + camera.translation
        focal, center = _inner(camera)
        pixel = local[:, :2] / np.maximum(local[:, 2:], 1e-9) * focal + center
        size = np.array([camera.width, camera.height])
        inside = (local[:, 2] > 0) & (pixel >= 0).all(axis=1) & (pixel < size).all(axis=1)
        column, row = pixel[inside].astype(int).T
        small = cv2.blur(picture, (3, 3))
        total[inside] += small[row, column]
        seen[inside] += 1
    gray = np.where(seen[:, None] > 0, total / np.maximum(seen, 1)[:, None], 128)
    return np.rint(gray).astype(np.uint8)


def _inner(camera: PosedCamera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Focal lengths and principal point of any of COLMAP's models, distortion left out."""
    made = pycolmap.Camera(
        model=camera.model, width=camera.width, height=camera.height, params=list(camera.parameters)
    )
    return (
        np.array([made.focal_length_x, made.focal_length_y]),
        np.array([made.principal_point_x, made.principal_point_y]),
    )
