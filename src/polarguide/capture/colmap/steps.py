"""Run one step of COLMAP as a separate process, which can be terminated at any time.

The process reads a line of JSON from standard input, ``{"step": name, "seed": number, "arguments": {...}}``. It writes
lines of JSON to standard output: numbers of finished units, and finally ``{"value": ...}`` or ``{"error": text}``. The
process ends when its standard input is closed, which also happens if its parent ends. It imports no other module of
polarguide, so it starts quickly.
"""

from __future__ import annotations

import itertools
import json
import os
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any

if __name__ == "__main__":
    sys.path.pop(0)  # this folder, whose modules have names of other packages

import pycolmap

# Log level of COLMAP. Failures raise exceptions.
_FATAL = 3
LEAST_VIEWS = 3
"""Smallest number of views in a model."""
_WEAK_PAIR = 10
_WEAK_START = 50
_WEAK_POSE = 15
Report = Callable[[int], None]
"""Callback for the number of finished units."""


def set_seed(options: Any, seed: int) -> None:
    """Set the random seed in COLMAP's options, if the installed version supports it."""
    if hasattr(options, "random_seed"):
        options.random_seed = seed


def _pipeline_options(seed: int) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    for part in (options, options.mapper, options.triangulation):
        set_seed(part, seed)
    return options


def extract(
    seed: int,
    report: Report,
    *,
    database: str,
    images: str,
    groups: Sequence[Sequence[str]],
    masks: str | None,
) -> None:
    """Extract the features of all pictures. The pictures of each group in ``groups`` share a camera."""
    reading: dict[str, Any] = {}
    if masks is not None:
        reading["reader_options"] = pycolmap.ImageReaderOptions()
        reading["reader_options"].mask_path = masks
    if all(len(group) == 1 for group in groups):
        pycolmap.extract_features(database, images, camera_mode=pycolmap.CameraMode.PER_IMAGE, **reading)
        return
    for group in groups:
        pycolmap.extract_features(
            database, images, image_names=list(group), camera_mode=pycolmap.CameraMode.SINGLE, **reading
        )


def match(seed: int, report: Report, *, database: str, matching: str) -> None:
    """Match the features of pairs of pictures and verify the matches."""
    verify = pycolmap.TwoViewGeometryOptions()
    set_seed(verify.ransac, seed)
    compare = pycolmap.match_exhaustive if matching == "exhaustive" else pycolmap.match_sequential
    compare(database, verification_options=verify)


def place(
    seed: int, report: Report, *, database: str, images: str, models: str, free: bool, weak: bool
) -> list[int]:
    """Run incremental mapping.

    Args:
        seed: seed of COLMAP's generators.
        report: callback for the number of registered pictures.
        database: path of the database.
        images: folder of the pictures.
        models: folder of the results. The name of a model's folder is its number.
        free: if True, intrinsics are estimated.
        weak: if True, half of COLMAP's default number of matches is sufficient. This helps for small pictures and for
            reflections that change behind a filter, which have few matches.

    Returns:
        Numbers of the models.
    """
    options = _pipeline_options(seed)
    options.min_model_size = LEAST_VIEWS
    if weak:
        options.min_num_matches = _WEAK_PAIR
        options.mapper.init_min_num_inliers = _WEAK_START
        options.mapper.abs_pose_min_num_inliers = _WEAK_POSE
    options.ba_refine_focal_length = options.ba_refine_extra_params = free
    counts = itertools.count(3)  # the first callback follows the third picture
    results = pycolmap.incremental_mapping(
        database, images, models, options, next_image_callback=lambda: report(next(counts))
    )
    for number, model in results.items():
        folder = os.path.join(models, str(number))
        os.makedirs(folder, exist_ok=True)
        model.write_binary(folder)
    return sorted(results)


def triangulate(seed: int, report: Report, *, database: str, images: str, start: str, out: str) -> None:
    """Triangulate points with the fixed poses of the model in ``start`` and write the model to ``out``."""
    options = _pipeline_options(seed)
    for name in ("focal_length", "principal_point", "extra_params"):
        setattr(options, f"ba_refine_{name}", False)
    pycolmap.triangulate_points(
        pycolmap.Reconstruction(start), database, images, out, options=options
    ).write_binary(out)


STEPS: dict[str, Callable[..., Any]] = {step.__name__: step for step in (extract, match, place, triangulate)}


def _exit_with(parent: Any) -> None:
    """End this process when its standard input is closed."""
    parent.read()
    os._exit(1)


def run_request() -> None:
    """Run the step that standard input requests."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # C++ code prints to standard error
    request = json.loads(sys.stdin.readline())
    threading.Thread(target=_exit_with, args=(sys.stdin,), daemon=True).start()
    pycolmap.logging.minloglevel = _FATAL
    pycolmap.set_random_seed(request["seed"])
    try:
        step = STEPS[request["step"]]
        answer = {
            "value": step(request["seed"], lambda count: print(count, file=answers), **request["arguments"])
        }
    except Exception as error:  # any C++ error
        lines = str(error).strip().splitlines() or [type(error).__name__]
        answer = {"error": lines[0].rstrip(".")}
    print(json.dumps(answer), file=answers)
    answers.close()
    os._exit(0)  # skip the destructors of C++ threads


if __name__ == "__main__":
    run_request()
