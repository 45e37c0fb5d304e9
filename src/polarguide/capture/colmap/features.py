"""Extract and match features with COLMAP, for structure from motion and for triangulation."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from polarguide.capture.colmap.files import PosedCamera, colmap_camera
from polarguide.capture.write import write_png
from polarguide.core.errors import PolarguideError
from polarguide.core.files import make_folder, writing
from polarguide.core.progress import Reporter

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
        seed: of all random draws.
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
        PolarguideError: it failed.
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
        said = str(outcome["error"]).strip().splitlines() or [type(outcome["error"]).__name__]
        raise PolarguideError(
            label,
            expected="COLMAP to succeed",
            found=said[0].rstrip("."),
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
