"""The steps of COLMAP, run as a program: a process of its own can be ended at any time, threads of C++ cannot.

It reads one line of JSON, ``{"step": name, "seed": number, "arguments": {...}}``, and writes lines of JSON: numbers of
finished units, then ``{"value": ...}`` or ``{"error": text}``. It ends when its standard input does, with the program
that started it. Nothing of polarguide is imported, so that it starts quickly.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any

if __name__ == "__main__":
    sys.path.pop(0)  # this folder, whose modules are called like others

import pycolmap

# COLMAP logs every picture and pair; what fails comes as an exception.
_FATAL = 3
LEAST_VIEWS = 3
"""Views of the smallest model."""
_WEAK_PAIR = 10
_WEAK_START = 50
_WEAK_POSE = 15
Report = Callable[[int], None]
"""Receives the number of finished units."""


def set_seed(options: Any, seed: int) -> None:
    """Set the seed of COLMAP's options, if this version of COLMAP has one."""
    if hasattr(options, "random_seed"):
        options.random_seed = seed


def _pipeline_options(seed: int) -> pycolmap.IncrementalPipelineOptions:
    """The options of mapping and triangulation, with all of their seeds."""
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
    """Features of all pictures, with one camera for each group of names."""
    reading: dict[str, Any] = {}
    if masks is not None:
        reading["reader_options"] = pycolmap.ImageReaderOptions()
        reading["reader_options"].mask_path = masks
    if all(len(group) == 1 for group in groups):
        pycolmap.extract_features(database, images, camera_mode=pycolmap.CameraMode.PER_IMAGE, **reading)
        return
    for group in groups:
        mode = pycolmap.CameraMode.SINGLE
        pycolmap.extract_features(database, images, image_names=list(group), camera_mode=mode, **reading)


def match(seed: int, report: Report, *, database: str, matching: str) -> None:
    """Match the features of pairs of pictures, and verify them."""
    verify = pycolmap.TwoViewGeometryOptions()
    set_seed(verify.ransac, seed)
    compare = pycolmap.match_exhaustive if matching == "exhaustive" else pycolmap.match_sequential
    compare(database, verification_options=verify)


def place(
    seed: int, report: Report, *, database: str, images: str, models: str, free: bool, weak: bool
) -> list[int]:
    """Incremental mapping into folders of ``models``, named by numbers; returns these.

    ``free`` intrinsics are estimated. ``weak`` asks for half as many matches as COLMAP usually does: small pictures
    have few, and fewer still where reflections change from shot to shot behind a filter.
    """
    options = _pipeline_options(seed)
    options.min_model_size = LEAST_VIEWS
    if weak:
        options.min_num_matches = _WEAK_PAIR
        options.mapper.init_min_num_inliers = _WEAK_START
        options.mapper.abs_pose_min_num_inliers = _WEAK_POSE
    options.ba_refine_focal_length = options.ba_refine_extra_params = free
    placed: list[None] = []

    def placed_one() -> None:
        placed.append(None)
        report(len(placed) + 2)  # the first call comes after the third picture

    made = pycolmap.incremental_mapping(database, images, models, options, next_image_callback=placed_one)
    for number, model in made.items():
        folder = os.path.join(models, str(number))
        os.makedirs(folder, exist_ok=True)
        model.write_binary(folder)
    return sorted(made)


def triangulate(seed: int, report: Report, *, database: str, images: str, start: str, out: str) -> None:
    """Points for the poses of the model in ``start``, which stay as they are; writes the model to ``out``."""
    options = _pipeline_options(seed)
    for name in ("focal_length", "principal_point", "extra_params"):
        setattr(options, f"ba_refine_{name}", False)
    model = pycolmap.Reconstruction(start)
    pycolmap.triangulate_points(model, database, images, out, options=options).write_binary(out)


STEPS: dict[str, Callable[..., Any]] = {
    "extract": extract,
    "match": match,
    "place": place,
    "triangulate": triangulate,
}


def _end_with(parent: Any) -> None:
    """End this process where its standard input ends."""
    parent.read()
    os._exit(1)


def main() -> None:
    """Run the step that standard input names."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # whatever C++ prints is no answer
    request = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with, args=(sys.stdin,), daemon=True).start()
    pycolmap.logging.minloglevel = _FATAL
    pycolmap.set_random_seed(request["seed"])
    try:
        step = STEPS[request["step"]]
        value = step(request["seed"], lambda count: print(count, file=answers), **request["arguments"])
        answer = {"value": value}
    except Exception as error:  # whatever C++ threw
        lines = str(error).strip().splitlines() or [type(error).__name__]
        answer = {"error": lines[0].rstrip(".")}
    print(json.dumps(answer), file=answers)
    answers.close()
    os._exit(0)  # destructors of C++ threads have nothing to add


if __name__ == "__main__":
    main()
