"""Features, their matches, and structure from motion, with pycolmap."""

from __future__ import annotations

import contextlib
import functools
import math
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from polarguide.capture.colmap.files import PosedCamera, colmap_camera
from polarguide.capture.write import write_png
from polarguide.core.errors import PolarguideError
from polarguide.core.files import make_folder, writing
from polarguide.core.progress import Reporter
from polarguide.optics.color import srgb_encode_array

_POLL_SECONDS = 0.5
# COLMAP logs every picture and pair; what fails comes as an exception.
_FATAL = 3
_COUNT_ROWS = """
import pathlib, sqlite3, sys, time
link = pathlib.Path(sys.argv[1]).absolute().as_uri() + "?mode=ro"
while True:
    try:
        database = sqlite3.connect(link, uri=True, timeout=0.1)
        count = database.execute("SELECT COUNT(*) FROM " + sys.argv[2]).fetchone()[0]
        database.close()
        print(count, flush=True)
    except sqlite3.Error:
        print(0, flush=True)
    time.sleep(1)
"""


def match_features(
    database: Path,
    images: Path,
    sizes: dict[str, tuple[int, int]],
    *,
    matching: str,
    seed: int,
    reporter: Reporter,
    cameras: Mapping[str, PosedCamera] | None = None,
    masks: Path | None = None,
) -> dict[str, tuple[int, int]]:
    """Extract features, match them, and write features, matches and two-view geometries into the database.

    Args:
        database: the file; it is created, or continued where an earlier call stopped.
        images: folder of ``<view>.png``.
        sizes: width and height of every picture, by view.
        matching: "exhaustive" or "sequential".
        seed: seed of all random draws.
        reporter: for progress.
        cameras: intrinsics by view, where they are known.
        masks: folder of ``<view>.png``; features are extracted in white parts only. Views without a file have no mask.

    Returns:
        The ids of each view's image and camera in the database where ``cameras`` are given; else an empty dictionary.

    Raises:
        PolarguideError: COLMAP failed; the database is removed because it may be the cause.
    """
    groups = _sharing_a_camera(sizes, cameras)
    count = len(sizes)
    verify = pycolmap.TwoViewGeometryOptions()
    set_seed(verify.ransac, seed)
    compare = pycolmap.match_exhaustive if matching == "exhaustive" else pycolmap.match_sequential
    pairs = count * (count - 1) // 2 if matching == "exhaustive" else None
    reading: dict[str, Any] = {}
    if masks is not None and masks.is_dir() and any(masks.iterdir()):
        reading["reader_options"] = pycolmap.ImageReaderOptions()
        reading["reader_options"].mask_path = str(_named_for_colmap(masks, sizes))
    try:
        with _counted_rows(database, "keypoints") as rows:
            run_step(
                lambda: _extract(database, images, groups, reading),
                seed, reporter, "extracting features", count, rows,
            )  # fmt: skip
        numbers: dict[str, tuple[int, int]] = {}
        if cameras is not None:
            numbers = run_step(
                lambda: _write_intrinsics(database, cameras), seed, reporter, "setting intrinsics"
            )
        with _counted_rows(database, "two_view_geometries") as rows:
            run_step(
                lambda: compare(database, verification_options=verify),
                seed, reporter, "matching pairs", pairs, rows,
            )  # fmt: skip
    except PolarguideError:
        for path in database.parent.glob(f"{database.name}*"):
            with contextlib.suppress(OSError):
                path.unlink()
        raise
    return numbers


def _sharing_a_camera(
    sizes: Mapping[str, tuple[int, int]], cameras: Mapping[str, PosedCamera] | None
) -> list[list[str]]:
    """The views, in groups that share their intrinsics: those of one size, as where a camera was held upright or not.

    Known intrinsics that differ are each view's own.
    """
    if cameras is not None and len({camera.intrinsics for camera in cameras.values()}) > 1:
        return [[view] for view in sizes]
    return [[view for view in sizes if sizes[view] == size] for size in dict.fromkeys(sizes.values())]


def _extract(database: Path, images: Path, groups: Sequence[Sequence[str]], reading: dict[str, Any]) -> None:
    """Features of all pictures, with one camera for each group of views."""
    mode = pycolmap.CameraMode.SINGLE
    if all(len(group) == 1 for group in groups):
        pycolmap.extract_features(database, images, camera_mode=pycolmap.CameraMode.PER_IMAGE, **reading)
        return
    for group in groups:
        names = [f"{view}.png" for view in group]
        pycolmap.extract_features(database, images, image_names=names, camera_mode=mode, **reading)


def _named_for_colmap(masks: Path, sizes: Mapping[str, tuple[int, int]]) -> Path:
    """Copies of the masks as ``<view>.png.png``, which COLMAP expects; white for views without, which it would skip."""
    named = masks.with_name("colmap_masks")
    make_folder(named)
    for view, (width, height) in sizes.items():
        mask, wanted = masks / f"{view}.png", named / f"{view}.png.png"
        if mask.exists():
            with writing(wanted):
                shutil.copyfile(mask, wanted)
        else:
            write_png(wanted, np.full((height, width), 255, np.uint8))
    return named


def _write_intrinsics(database: Path, cameras: Mapping[str, PosedCamera]) -> dict[str, tuple[int, int]]:
    """Replace the intrinsics that COLMAP guessed by the known ones; returns ids of image and camera by view."""
    numbers = {}
    with pycolmap.Database.open(database) as link:
        for view, camera in cameras.items():
            image = link.read_image_with_name(f"{view}.png")
            assert image is not None
            numbers[view] = (int(image.image_id), int(image.camera_id))
            link.update_camera(colmap_camera(camera, camera_id=image.camera_id, has_prior_focal_length=True))
    return numbers


def run_step(
    work: Callable[[], Any],
    seed: int,
    reporter: Reporter,
    label: str,
    total: int | None = None,
    done: Callable[[], int] = lambda: 0,
) -> Any:
    """Run a step of COLMAP in a thread, so that progress is shown and Ctrl-C ends the program at once.

    Args:
        work: the step. seed: of COLMAP's generators.
        reporter: for progress, under the name ``label``.
        total: number of units of work; None if it is unknown.
        done: returns the number of finished units.

    Raises:
        PolarguideError: the step failed.
    """
    outcome: dict[str, Any] = {}

    def target() -> None:
        level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, _FATAL
        try:
            pycolmap.set_random_seed(seed)  # each thread has its own generator
            outcome["value"] = work()
        except Exception as error:  # whatever C++ threw
            outcome["error"] = error
        finally:
            pycolmap.logging.minloglevel = level

    thread = threading.Thread(target=target, daemon=True)
    with reporter.track(label, total) as advance:
        thread.start()
        while thread.is_alive():
            thread.join(_POLL_SECONDS)
            advance(done())
    if "error" in outcome:
        message = str(outcome["error"]).strip().splitlines() or [type(outcome["error"]).__name__]
        raise PolarguideError(
            label,
            expected="COLMAP to succeed",
            found=message[0].rstrip("."),
            remedy="Repeat the command, or bring a model with --poses PATH.",
        ) from outcome["error"]
    return outcome["value"]


def set_seed(options: Any, seed: int) -> None:
    """Set the seed of COLMAP's options, if this version of COLMAP has one."""
    if hasattr(options, "random_seed"):
        options.random_seed = seed


def pipeline_options(seed: int) -> pycolmap.IncrementalPipelineOptions:
    """The options of mapping and triangulation, with all of their seeds."""
    options = pycolmap.IncrementalPipelineOptions()
    for part in (options, options.mapper, options.triangulation):
        set_seed(part, seed)
    return options


@contextlib.contextmanager
def _counted_rows(database: Path, table: str) -> Iterator[Callable[[], int]]:
    """Counts the rows of a table from a process of its own; yields a function that returns the latest count.

    COLMAP brings its own copy of SQLite. Two copies in one process undo each other's file locks (those of POSIX
    belong to processes), and the database is destroyed: it must never be opened, nor even closed, from here.
    """
    rows = 0
    command = [sys.executable, "-I", "-S", "-c", _COUNT_ROWS, str(database), table]

    def listen(lines: Iterable[str]) -> None:
        nonlocal rows
        for line in lines:
            rows = max(rows, int(line))

    try:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    except OSError:  # without a second process there is no progress, but all else
        yield lambda: 0
        return
    with process:
        listener = threading.Thread(target=listen, args=(process.stdout,), daemon=True)
        listener.start()
        try:
            yield lambda: rows
        finally:
            process.kill()
            listener.join()


SAMPLE = 7
"""Matches that determine an epipolar geometry."""


def log_false_alarms(matches: int, agreeing: int, share: float) -> float:
    """Natural logarithm of the number of geometries expected by chance that fit as many of the matches.

    Args:
        matches: matches of the two pictures. agreeing: those of them that fit.
        share: share of the picture's area that fits an epipolar line, at most: the probability that a wrong match does.
    """
    if agreeing <= SAMPLE:
        return math.inf
    choices = _log_choices(matches, agreeing) + _log_choices(agreeing, SAMPLE)
    return math.log(matches - SAMPLE) + choices + (agreeing - SAMPLE) * math.log(min(share, 1.0))


def _log_choices(count: int, chosen: int) -> float:
    return math.lgamma(count + 1) - math.lgamma(chosen + 1) - math.lgamma(count - chosen + 1)


def connected_views(database: Path, sizes: Mapping[str, tuple[int, int]]) -> int:
    """How many views there are in the largest group that pairs connect which agree better than by chance.

    Args:
        database: of COLMAP, with matches and verified geometries of ``<view>.png``.
        sizes: width and height of every picture, by view.
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
# With a smaller share of the views, mapping is tried again with fewer matches.
_ENOUGH_SHARE = 0.9
_WEAK_PAIR, _WEAK_START, _WEAK_POSE = 10, 50, 15
LEAST_VIEWS = 3
ADVICE = (
    "Take more pictures between those that are left out and their neighbors (15 degrees or less apart), put a textured "
    "ground under the object, and remove blurred pictures."
)


class NotConnectedError(PolarguideError):
    """Structure from motion found no place for enough of the views."""


def tone_mapped(intensities: NDArray[np.float32], pictures: str = "photograph") -> NDArray[np.uint8]:
    """The photograph of a view as an 8-bit sRGB picture, [H, W, 3] RGB, with the 99th percentile at white.

    Args:
        intensities: [4, H, W, 3] linear.
        pictures: "photograph" for S0/2, "minimum" for the least of the four, which has less glare.
    """
    photograph = intensities.min(axis=0) if pictures == "minimum" else intensities.mean(axis=0)
    white = max(float(np.percentile(photograph, 99.0)), 1e-4)
    encoded = srgb_encode_array(np.clip(photograph / white, 0.0, 1.0))
    return np.rint(255.0 * encoded).astype(np.uint8)


def reconstruct(
    folder: Path,
    sizes: dict[str, tuple[int, int]],
    *,
    matching: str,
    seed: int,
    reporter: Reporter,
    untried: str,
    intrinsics: tuple[str, tuple[float, ...]] | None = None,
    refine: bool = True,
) -> Path:
    """Estimate poses, intrinsics and points from ``folder/images/<view>.png``.

    With a mask ``folder/masks/<view>.png``, features come from its white parts only. Features and matches are kept
    in a database, so that an interrupted run does not repeat them. Where less than nine tenths of the views are
    registered, mapping is tried again with half as many matches. The largest model is used.

    Args:
        folder: holds the pictures; the database and the model are written there.
        sizes: width and height of every picture, by view.
        matching: "exhaustive", or "sequential" for views taken in the order of their names.
        seed: seed of the random numbers.
        reporter: for progress and messages.
        untried: the options that may connect more views, for messages.
        intrinsics: model and parameters of all pictures, where they are known.
        refine: whether to refine known intrinsics.

    Returns:
        The folder of the model, with one camera for pictures of one size: of the model given, or SIMPLE_RADIAL.

    Raises:
        NotConnectedError: fewer than three views were registered, or than matches connect better than by chance.
        PolarguideError: COLMAP failed.
    """
    model = folder / "model"
    if model.is_dir():
        return model
    database, images, trial = folder / "database.db", folder / "images", folder / "models"
    cameras = None
    if intrinsics is not None:
        still = np.eye(3), np.zeros(3)
        cameras = {view: PosedCamera(*size, *intrinsics, *still) for view, size in sizes.items()}
    match_features(
        database, images, sizes,
        matching=matching, seed=seed, reporter=reporter, cameras=cameras, masks=folder / "masks",
    )  # fmt: skip
    free = intrinsics is None or refine
    models = _map(database, images, trial, len(sizes), seed, reporter, free, weak=False)
    if _registered(models) < _ENOUGH_SHARE * len(sizes):
        reporter.say(
            f"{_registered(models)} of {len(sizes)} views registered; trying with fewer matches a view."
        )
        others = _map(database, images, trial, len(sizes), seed, reporter, free, weak=True)
        models = max(models, others, key=_registered)
    best = max(models.values(), key=lambda candidate: candidate.num_reg_images(), default=None)
    registered = _registered(models)
    by_chance = best is not None and connected_views(database, sizes) < LEAST_VIEWS
    if best is None or registered < LEAST_VIEWS or by_chance:
        why = ", by matches that agree no better than wrong ones would" if by_chance else ""
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
        f"{best.compute_mean_reprojection_error():.2f} pixels; {len(models)} model(s) found."
    )
    if registered < _FEW_SHARE * len(sizes):
        reporter.warn(f"Only {share}. {ADVICE} {untried}")
    return model


def _registered(models: dict[int, Any]) -> int:
    """Views of the largest model."""
    return max((model.num_reg_images() for model in models.values()), default=0)


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
) -> dict[int, Any]:
    """Incremental mapping: pycolmap's models, by number; ``free`` intrinsics are estimated.

    ``weak`` asks for half as many matches as COLMAP usually does: small pictures have few, and fewer still where
    reflections change from shot to shot behind a filter.
    """
    shutil.rmtree(trial, ignore_errors=True)
    make_folder(trial)
    options = pipeline_options(seed)
    options.min_model_size = LEAST_VIEWS
    if weak:
        options.min_num_matches, options.mapper.init_min_num_inliers = _WEAK_PAIR, _WEAK_START
        options.mapper.abs_pose_min_num_inliers = _WEAK_POSE
    options.ba_refine_focal_length = options.ba_refine_extra_params = free
    placed: list[None] = []
    step = functools.partial(placed.append, None)
    models: dict[int, Any] = run_step(
        lambda: pycolmap.incremental_mapping(database, images, trial, options, next_image_callback=step),
        seed, reporter, "registering images", count, lambda: len(placed) + 2 if placed else 0,
    )  # fmt: skip
    return models
