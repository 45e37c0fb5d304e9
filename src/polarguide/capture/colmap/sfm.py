"""Feature matching, structure from motion, and 3D points for known poses, with pycolmap."""

from __future__ import annotations

import contextlib
import functools
import json
import math
import shutil
import sqlite3
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from polarguide.capture.colmap import steps
from polarguide.capture.colmap.model import PosedCamera, colmap_camera, load_model, posed_model
from polarguide.capture.filter.camera_files import Lens
from polarguide.capture.formats.pictures import decode_mask, decode_picture
from polarguide.capture.formats.stored import read_picture
from polarguide.capture.write import write_png_file
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import make_folder, write_whole, writing
from polarguide.core.progress import Reporter
from polarguide.core.records import read_record
from polarguide.core.text import listed
from polarguide.optics.color import srgb_encode_array

_POLL_SECONDS = 0.5
_PROGRAM = Path(steps.__file__)


def match_features(
    database: Path,
    images: Path,
    sizes: dict[str, tuple[int, int]],
    *,
    matching: str,
    seed: int,
    reporter: Reporter,
    cameras: Mapping[str, PosedCamera] | None = None,
    lenses: Mapping[str, Lens] | None = None,
    masks: Path | None = None,
) -> dict[str, tuple[int, int]]:
    """Extract and match features, and write them with two-view geometries to a database.

    Args:
        database: path of the database. Work of an interrupted call is resumed.
        images: folder of ``<view>.png``.
        sizes: width and height of each picture by view.
        matching: "exhaustive" or "sequential".
        seed: seed of all random draws.
        reporter: reporter of the progress.
        cameras: known intrinsics by view.
        lenses: lenses by view from EXIF; views of one lens share their intrinsics.
        masks: folder of masks ``<view>.png``, or None. Features are extracted in the white parts of a mask, or in the
            whole picture if the view has no mask.

    Returns:
        The ids of the image and the camera in the database by view. The result is empty without ``cameras``.

    Raises:
        PolarguideError: COLMAP failed. The database is removed because it may have caused the failure.
    """
    groups = _group_by_camera(sizes, cameras, lenses)
    count = len(sizes)
    pairs = count * (count - 1) // 2 if matching == "exhaustive" else None
    where = {"database": str(database), "images": str(images)}
    masked = masks is not None and masks.is_dir() and any(masks.iterdir())
    extracted = {
        "groups": [[f"{view}.png" for view in group] for group in groups],
        "masks": str(_copy_masks(masks, sizes)) if masked and masks is not None else None,
    }
    numbers: dict[str, tuple[int, int]] = {}
    try:
        done = functools.partial(_rows, database, "keypoints")
        run_step("extract", where | extracted, seed, reporter, "extracting features", count, done)
        if cameras is not None:
            numbers = _write_intrinsics(database, cameras)
        elif len(groups) > 1 and lenses:
            _scale_focal_lengths(database, groups, lenses)
        done = functools.partial(_rows, database, "two_view_geometries")
        run_step(
            "match",
            {"database": str(database), "matching": matching},
            seed,
            reporter,
            "matching pairs",
            pairs,
            done,
        )
    except PolarguideError:
        for path in database.parent.glob(f"{database.name}*"):
            with contextlib.suppress(OSError):
                path.unlink()
        raise
    return numbers


def _group_by_camera(
    sizes: Mapping[str, tuple[int, int]],
    cameras: Mapping[str, PosedCamera] | None,
    lenses: Mapping[str, Lens] | None = None,
) -> list[list[str]]:
    """Group the views that share their intrinsics, because their lens and picture size are equal.

    If the known intrinsics differ, each view is a group of its own.
    """
    if cameras is not None and len({camera.intrinsics for camera in cameras.values()}) > 1:
        return [[view] for view in sizes]
    groups: dict[Any, list[str]] = {}
    for view, size in sizes.items():
        groups.setdefault((size, (lenses or {}).get(view)), []).append(view)
    return list(groups.values())


def _scale_focal_lengths(database: Path, groups: Sequence[Sequence[str]], lenses: Mapping[str, Lens]) -> None:
    """Scale COLMAP's initial focal lengths by their ratios in EXIF."""
    focals = [lens.focal if (lens := lenses.get(group[0])) is not None else None for group in groups]
    middle = median(focal for focal in focals if focal)
    with pycolmap.Database.open(database) as link:
        for group, focal in zip(groups, focals, strict=True):
            if focal:
                image = link.read_image_with_name(f"{group[0]}.png")
                assert image is not None
                camera = link.read_camera(image.camera_id)
                params: Any = np.array(camera.params)
                params[list(camera.focal_length_idxs())] *= focal / middle
                camera.params = params
                link.update_camera(camera)


def _copy_masks(masks: Path, sizes: Mapping[str, tuple[int, int]]) -> Path:
    """Copy masks to the names ``<view>.png.png``, which COLMAP requires.

    A view without a mask gets a white mask, because COLMAP skips pictures without a mask.
    """
    folder = masks.with_name("colmap_masks")
    make_folder(folder)
    for view, (width, height) in sizes.items():
        mask = masks / f"{view}.png"
        copy = folder / f"{view}.png.png"
        if mask.exists():
            with writing(copy):
                shutil.copyfile(mask, copy)
        else:
            write_png_file(copy, np.full((height, width), 255, np.uint8))
    return folder


def _write_intrinsics(database: Path, cameras: Mapping[str, PosedCamera]) -> dict[str, tuple[int, int]]:
    """Replace COLMAP's initial intrinsics by known intrinsics.

    Return the ids of the image and the camera in the database by view.
    """
    numbers = {}
    with pycolmap.Database.open(database) as link:
        for view, camera in cameras.items():
            image = link.read_image_with_name(f"{view}.png")
            assert image is not None
            numbers[view] = (int(image.image_id), int(image.camera_id))
            link.update_camera(colmap_camera(camera, camera_id=image.camera_id, has_prior_focal_length=True))
    return numbers


def run_step(
    step: str,
    arguments: Mapping[str, Any],
    seed: int,
    reporter: Reporter,
    label: str,
    total: int | None = None,
    done: Callable[[], int] | None = None,
) -> Any:
    """Run a step of COLMAP as a process, which is terminated when this call is interrupted.

    Args:
        step: name of the step, a key of ``steps.STEPS``.
        arguments: arguments of the step.
        seed: seed of COLMAP's generators.
        reporter: reporter of the progress.
        label: name of the step for the user.
        total: number of units of work, if known.
        done: function that returns the number of finished units. By default, the step reports this number.

    Returns:
        Return value of the step.

    Raises:
        PolarguideError: the step failed.
    """
    answers: list[Any] = []

    def listen(lines: Iterable[str]) -> None:
        answers.extend(json.loads(line) for line in lines)

    process = subprocess.Popen(
        [sys.executable, str(_PROGRAM)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL, text=True, start_new_session=True,
    )  # fmt: skip
    assert process.stdin is not None
    assert process.stdout is not None
    listener = threading.Thread(target=listen, args=(process.stdout,), daemon=True)
    try:
        with reporter.track(label, total) as advance:
            request = {"step": step, "seed": seed, "arguments": dict(arguments)}
            with contextlib.suppress(BrokenPipeError):  # the failure is reported below
                process.stdin.write(json.dumps(request) + "\n")
                process.stdin.flush()
            listener.start()
            while listener.is_alive():
                listener.join(_POLL_SECONDS)
                reported = max((answer for answer in answers if isinstance(answer, int)), default=0)
                advance(reported if done is None else done())
            process.wait()
    finally:
        process.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()
    last = answers[-1] if answers and isinstance(answers[-1], dict) else {}
    require(
        "value" in last,
        label,
        expected="COLMAP to succeed",
        found=last.get("error", f"its process ended with status {process.returncode}"),
        remedy="Repeat the command, or use an existing model with --poses PATH.",
    )
    return last["value"]


def _rows(database: Path, table: str) -> int:
    """Count the rows of a database table; 0 while another process locks it."""
    link = f"{database.absolute().as_uri()}?mode=ro"
    with (
        contextlib.suppress(sqlite3.Error),
        contextlib.closing(sqlite3.connect(link, uri=True, timeout=0.1)) as connection,
    ):
        return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
    return 0


SAMPLE = 7
"""Number of matches that determine an epipolar geometry."""


def log_false_alarms(matches: int, agreeing: int, share: float) -> float:
    """Return the natural logarithm of the expected number of chance geometries with as many inliers.

    Source: Moisan and Stival, A Probabilistic Criterion to Detect Rigid Point Matches, IJCV 57(3), 2004.

    Args:
        matches: number of matches of the two pictures.
        agreeing: number of inliers.
        share: upper bound of the probability that a wrong match fits: share of the picture near an epipolar line.
    """
    if agreeing <= SAMPLE:
        return math.inf
    choices = _log_choices(matches, agreeing) + _log_choices(agreeing, SAMPLE)
    return math.log(matches - SAMPLE) + choices + (agreeing - SAMPLE) * math.log(min(share, 1.0))


def _log_choices(count: int, chosen: int) -> float:
    return math.lgamma(count + 1) - math.lgamma(chosen + 1) - math.lgamma(count - chosen + 1)


def connected_views(database: Path, sizes: Mapping[str, tuple[int, int]]) -> int:
    """Return the size of the largest group of views that is connected by pairs better than chance.

    Args:
        database: COLMAP database with matches and verified geometries of ``<view>.png``.
        sizes: width and height of each picture by view.
    """
    error = pycolmap.TwoViewGeometryOptions().ransac.max_error
    with pycolmap.Database.open(database) as link:
        names = {image.image_id: image.name.removesuffix(".png") for image in link.read_all_images()}
        matches = dict(zip(*link.read_all_matches(), strict=True))
        verified = dict(zip(*link.read_two_view_geometries(), strict=True))
    group = {name: {name} for name in names.values()}
    for pair, geometry in verified.items():
        first, second = (names[number] for number in pycolmap.pair_id_to_image_pair(pair))
        width, height = sizes[second]
        share = 2 * error * math.hypot(width, height) / (width * height)
        if log_false_alarms(len(matches[pair]), len(geometry.inlier_matches), share) < 0:
            joined = group[first] | group[second]
            group |= dict.fromkeys(joined, joined)
    return max(map(len, group.values()), default=0)


_FEW_SHARE = 0.8
"""Share of registered views below which the user is warned."""
_ENOUGH_SHARE = 0.9
"""Share of registered views below which mapping is retried with fewer matches."""
LEAST_VIEWS = steps.LEAST_VIEWS
ADVICE = (
    "Take more pictures between unregistered views and their neighbors (15 degrees or less apart), put a textured "
    "ground under the object, and remove blurred pictures."
)


class NotConnectedError(PolarguideError):
    """Failure of structure from motion to register enough views."""


def tone_mapped(intensities: NDArray[np.float32], pictures: str = "photograph") -> NDArray[np.uint8]:
    """Return the photograph of a view as 8-bit sRGB, [H, W, 3] RGB, with the 99th percentile at white.

    Args:
        intensities: linear intensities, [4, H, W, 3].
        pictures: "photograph" for S0/2, or "minimum" for the minimum of the four intensities with less glare.
    """
    photograph = intensities.min(axis=0) if pictures == "minimum" else intensities.mean(axis=0)
    white = max(float(np.percentile(photograph, 99.0)), 1e-4)
    return np.rint(255.0 * srgb_encode_array(np.clip(photograph / white, 0.0, 1.0))).astype(np.uint8)


def reconstruct(
    folder: Path,
    sizes: dict[str, tuple[int, int]],
    *,
    matching: str,
    seed: int,
    reporter: Reporter,
    untried: str,
    intrinsics: tuple[str, tuple[float, ...]] | None = None,
    lenses: Mapping[str, Lens] | None = None,
) -> Path:
    """Estimate poses, intrinsics and points from ``folder/images/<view>.png``.

    If a view has a mask ``folder/masks/<view>.png``, features are extracted in its white parts only. Features and
    matches are stored in a database, so an interrupted run can be resumed. If fewer than nine tenths of the views are
    registered, mapping is repeated with a smaller required number of matches. The largest model is used.

    Args:
        folder: folder of the pictures, the database and the model.
        sizes: width and height of each picture by view.
        matching: "exhaustive", or "sequential" for views taken in the order of their names.
        seed: seed of the random numbers.
        reporter: reporter of progress and messages.
        untried: options that may connect more views, which an error message suggests.
        intrinsics: known camera model and parameters of all pictures, or None.
        lenses: lenses by view from EXIF.

    Returns:
        Folder of the model. Pictures of one lens and size share a camera of the specified model or SIMPLE_RADIAL.

    Raises:
        NotConnectedError: fewer than three views were registered, or their matches are no better than chance.
        PolarguideError: COLMAP failed.
    """
    model = folder / "model"
    if model.is_dir():
        return model
    database = folder / "database.db"
    images = folder / "images"
    trial = folder / "models"
    if lenses:
        counts = Counter(lenses.values())
        cameras_text = listed(
            [f"{lens.camera} {lens.focal or ''}: {count} views" for lens, count in counts.items()]
        )
        scope = "one camera each" if intrinsics is None else "as specified for all"
        reporter.say(
            f"EXIF states {len(counts)} cameras or focal lengths ({cameras_text}); intrinsics: {scope}."
        )
    cameras = None
    if intrinsics is not None:
        pose = np.eye(3), np.zeros(3)
        cameras = {view: PosedCamera(*size, *intrinsics, *pose) for view, size in sizes.items()}
    match_features(
        database, images, sizes,
        matching=matching, seed=seed, reporter=reporter, cameras=cameras, lenses=lenses,
        masks=folder / "masks",
    )  # fmt: skip
    free = intrinsics is None
    models = _map(database, images, trial, len(sizes), seed, reporter, free, weak=False)
    if _registered(models) < _ENOUGH_SHARE * len(sizes):
        reporter.say(
            f"{_registered(models)} of {len(sizes)} views registered; retrying with fewer matches per view."
        )
        models = max(
            models,
            _map(database, images, trial, len(sizes), seed, reporter, free, weak=True),
            key=_registered,
        )
    best = max(models, key=lambda candidate: candidate.num_reg_images(), default=None)
    registered = _registered(models)
    by_chance = best is not None and connected_views(database, sizes) < LEAST_VIEWS
    if best is None or registered < LEAST_VIEWS or by_chance:
        why = ", by matches that agree no better than chance" if by_chance else ""
        raise NotConnectedError(
            images,
            expected="pictures that structure from motion can connect",
            found=f"{registered} of {len(sizes)} views registered{why}",
            remedy=f"{ADVICE} {untried}",
        )
    chosen = folder / "chosen"
    shutil.rmtree(chosen, ignore_errors=True)
    make_folder(chosen)
    best.write_binary(str(chosen))
    chosen.rename(model)
    share = f"{registered} of {len(sizes)} views registered"
    reporter.say(
        f"{share}, {best.num_points3D()} points, mean reprojection error "
        f"{best.compute_mean_reprojection_error():.2f} pixels; number of models: {len(models)}."
    )
    if registered < _FEW_SHARE * len(sizes):
        reporter.warn(f"Only {share}. {ADVICE} {untried}")
    return model


def _registered(models: Sequence[Any]) -> int:
    """Return the number of views of the largest model."""
    return max((model.num_reg_images() for model in models), default=0)


def _map(
    database: Path,
    images: Path,
    trial: Path,
    count: int,
    seed: int,
    reporter: Reporter,
    free: bool,
    *,
    weak: bool,
) -> list[Any]:
    """Run ``steps.place`` and read its models with pycolmap."""
    shutil.rmtree(trial, ignore_errors=True)
    make_folder(trial)
    arguments = {
        "database": str(database),
        "images": str(images),
        "models": str(trial),
        "free": free,
        "weak": weak,
    }
    numbers = run_step("place", arguments, seed, reporter, "registering images", count)
    return [load_model(trial / str(number), ".bin") for number in numbers]


_ROUNDS = 4
"""Number of times that the sampled box shrinks to the accepted points."""
_BATCH = 100_000
"""Number of samples per batch."""
_SHARE_OF_VIEWS = 0.8
"""Share of the cameras in which a point must be visible."""
_SHARE_IN_MASKS = 0.95
"""Share of the cameras that see a point in which the point must be inside the mask."""
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

    A point is accepted if it is visible in 80 % of the cameras, and inside the mask in 95 % of the cameras that see it.
    If there are masks, cameras without a mask are ignored. The first sampled box is centered at the point nearest to
    all optical axes. Half of its side is the median distance of the cameras from this point. The box then shrinks to
    the accepted points.

    Args:
        cameras: cameras by view, with distortion.
        masks: foreground masks by view, [H, W] at the cameras' sizes; may be empty.
        count: requested number of points.
        rng: random generator.

    Returns:
        Points [N, 3], where N is at most ``count``. The array is empty if no point is accepted.
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
    """Find the point nearest to all optical axes by least squares.

    Returns:
        The point [3], and the median distance of the cameras from it.
    """
    centers = np.stack([camera.center for camera in cameras])
    axes = np.stack([camera.rotation[2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    # A small weight of the cameras' mean keeps the system solvable for parallel axes.
    matrix = across.sum(axis=0) + 1e-6 * len(cameras) * np.eye(3)
    goal = (across @ centers[:, :, None]).sum(axis=0)[:, 0] + 1e-6 * centers.sum(axis=0)
    center = np.linalg.solve(matrix, goal)
    reach = float(np.median(np.linalg.norm(centers - center, axis=1)))
    return center, max(reach, 1e-6)


def _projected(
    places: Points, camera: PosedCamera, lens: pycolmap.Camera
) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
    """Project points [N, 3] into a picture.

    Returns:
        A mask [N] of the points in the picture; and the row and the column of the pixel of each of them.
    """
    local = places @ camera.rotation.T + camera.translation
    before = local[:, 2] > 1e-6
    where = np.full((len(places), 2), -1.0)
    where[before] = np.nan_to_num(np.asarray(lens.img_from_cam(local[before])), nan=-1.0)
    hit = before & (where >= 0).all(axis=1) & (where < [camera.width, camera.height]).all(axis=1)
    column, row = where[hit].astype(np.int64).T
    return hit, row, column


def _visible_to_most(
    places: Points,
    cameras: Mapping[str, PosedCamera],
    pixels: Mapping[str, pycolmap.Camera],
    masks: Mapping[str, NDArray[np.bool_]],
) -> NDArray[np.bool_]:
    """Return a mask [N] of the points [N, 3] that are visible in enough cameras and inside enough masks."""
    counts = np.zeros(len(places))
    inside = np.zeros(len(places))
    for view, camera in cameras.items():
        hit, row, column = _projected(places, camera, pixels[view])
        counts += hit
        if view in masks:
            inside[hit] += masks[view][row, column]
    enough = counts >= max(1.0, _SHARE_OF_VIEWS * len(cameras))
    return np.asarray(enough & (inside >= _SHARE_IN_MASKS * counts)) if masks else np.asarray(enough)


FEWEST = 200
"""Smallest sufficient number of triangulated points. Otherwise, points are sampled in the visual hull."""
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
    """Create 3D points for cameras with known poses, which do not change.

    Features of ``folder/images/<view>.png`` are matched, and points are triangulated. If there are fewer than
    ``FEWEST`` points, points are sampled in the visual hull of the masks ``folder/masks/<view>.png`` instead. Without
    masks, they are sampled in the common field of view of the cameras.

    Args:
        folder: working folder. Results of an earlier call are reused.
        cameras: cameras of the pictures by view.
        where: source of the poses for messages.
        matching: "exhaustive" or "sequential".
        seed: seed of all random draws.
        reporter: reporter of progress and messages.

    Returns:
        The folder of the model; and a record of the source and the number of its points.

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
    """Triangulate points, and write the model to the folder ``trial``.

    Returns:
        The number of points; and their mean reprojection error in pixels, or None without points.
    """
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
        run_step(
            "triangulate", {name: str(path) for name, path in paths.items()}, seed, reporter, "triangulating"
        )
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
    for place, color in zip(places, colors_of_points(folder, cameras, places), strict=True):
        model.add_point3D(place, pycolmap.Track(), color)
    shutil.rmtree(trial, ignore_errors=True)
    make_folder(trial)
    model.write_binary(str(trial))
    reporter.warn(
        f"The poses have no points, and only {triangulated} could be triangulated (fewer than {FEWEST}): "
        f"{len(places)} points were sampled at random in {kind} instead. They are not on the surface."
    )
    return {"from": f"random samples in {kind}", "count": len(places), "triangulated": triangulated}


def colors_of_points(
    folder: Path, cameras: Mapping[str, PosedCamera], places: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Return the color of each point [N, 3] as RGB, [N, 3]. It is the mean over the photographs that show the point."""
    total = np.zeros((len(places), 3))
    counts = np.zeros(len(places))
    views = sorted(cameras)
    for view in views[:: max(1, len(views) // 8)]:
        path = folder / "images" / f"{view}.png"
        picture = decode_picture(path, read_picture(path))
        inside, row, column = _projected(places, cameras[view], colmap_camera(cameras[view]))
        total[inside] += cv2.blur(picture, (3, 3))[row, column]
        counts[inside] += 1
    return np.rint(np.where(counts[:, None] > 0, total / np.maximum(counts, 1)[:, None], 128)).astype(
        np.uint8
    )
