"""Steps of COLMAP that structure from motion and triangulation share: features, matches, and running them."""

from __future__ import annotations

import contextlib
import shutil
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from polarguide.capture.colmap.row_counter import RowCounter
from polarguide.capture.colmap.write import PosedCamera
from polarguide.capture.write import encoded_png
from polarguide.errors import PolarguideError
from polarguide.files import guarded, write_whole
from polarguide.progress import Reporter

_POLL_SECONDS = 0.5
# COLMAP logs every picture and pair; what fails comes as an exception.
_FATAL = 3


def match(
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
    """Features, matches and two-view geometries of the pictures, into the database.

    Args:
        database: made, or gone on with.
        images: folder of ``<view>.png``.
        sizes: width and height of every picture, by view.
        matching: "exhaustive" or "sequential".
        seed: of all random draws.
        reporter: for progress.
        cameras: intrinsics by view, where they are known.
        masks: folder of ``<view>.png``, outside of whose white parts nothing is looked at; may lack some or all.

    Returns:
        The numbers of each view's image and camera in the database, where ``cameras`` were given; else nothing.

    Raises:
        PolarguideError: COLMAP failed; the database is removed, for it may be the reason.
    """
    kinds = set(sizes.values()) if cameras is None else {camera.intrinsics for camera in cameras.values()}
    single = len(kinds) == 1
    mode = pycolmap.CameraMode.SINGLE if single else pycolmap.CameraMode.PER_IMAGE
    count = len(sizes)
    verify = pycolmap.TwoViewGeometryOptions()
    seeded(verify.ransac, seed)
    compare = pycolmap.match_exhaustive if matching == "exhaustive" else pycolmap.match_sequential
    pairs = count * (count - 1) // 2 if matching == "exhaustive" else None
    reading: dict[str, Any] = {}
    if masks is not None and masks.is_dir() and any(masks.iterdir()):
        reading["reader_options"] = pycolmap.ImageReaderOptions()
        reading["reader_options"].mask_path = str(_named_for_colmap(masks, sizes))
    try:
        with RowCounter(database, "keypoints") as counter:
            run(
                lambda: pycolmap.extract_features(database, images, camera_mode=mode, **reading),
                seed, reporter, "finding features", count, lambda: counter.rows,
            )  # fmt: skip
        numbers: dict[str, tuple[int, int]] = {}
        if cameras is not None:
            numbers = run(lambda: _know(database, cameras), seed, reporter, "known cameras", None, lambda: 0)
        with RowCounter(database, "two_view_geometries") as counter:
            run(
                lambda: compare(database, verification_options=verify),
                seed, reporter, "matching pairs", pairs, lambda: counter.rows,
            )  # fmt: skip
    except PolarguideError:
        for path in database.parent.glob(f"{database.name}*"):
            with contextlib.suppress(OSError):
                path.unlink()
        raise
    return numbers


def _named_for_colmap(masks: Path, sizes: Mapping[str, tuple[int, int]]) -> Path:
    """Masks under the names that COLMAP wants, ``<view>.png.png``; white for views without, which it would skip."""
    named = masks.with_name("colmap_masks")
    guarded(lambda: named.mkdir(exist_ok=True), named)
    for view, (width, height) in sizes.items():
        mask, wanted = masks / f"{view}.png", named / f"{view}.png.png"
        if mask.exists():
            guarded(lambda mask=mask, wanted=wanted: shutil.copyfile(mask, wanted), wanted)  # type: ignore[misc]
        else:
            write_whole(wanted, encoded_png(np.full((height, width), 255, np.uint8)))
    return named


def _know(database: Path, cameras: Mapping[str, PosedCamera]) -> dict[str, tuple[int, int]]:
    """Write known intrinsics over those that COLMAP guessed: numbers of images and cameras by view."""
    numbers = {}
    with pycolmap.Database.open(database) as link:
        for view, camera in cameras.items():
            image = link.read_image_with_name(f"{view}.png")
            assert image is not None
            numbers[view] = (int(image.image_id), int(image.camera_id))
            link.update_camera(
                pycolmap.Camera(
                    camera_id=image.camera_id,
                    model=camera.model,
                    width=camera.width,
                    height=camera.height,
                    params=list(camera.parameters),
                    has_prior_focal_length=True,
                )
            )
    return numbers


def run(
    work: Callable[[], Any],
    seed: int,
    reporter: Reporter,
    label: str,
    total: int | None,
    done: Callable[[], int],
) -> Any:
    """Run a step of COLMAP in a thread, so that progress shows and Ctrl-C ends the program at once.

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


def seeded(options: Any, seed: int) -> None:
    """Give COLMAP's options a seed, where this version of it takes one."""
    if hasattr(options, "random_seed"):
        options.random_seed = seed
