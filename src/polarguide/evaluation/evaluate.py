"""Scoring a run on its test views, with its speed and where its numbers come from."""

from __future__ import annotations

import platform
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch

import polarguide
from polarguide import _native
from polarguide.capture import View
from polarguide.capture.view import listed
from polarguide.evaluation.error_sheet import ERRORS_FILE, ErrorSheet
from polarguide.evaluation.facts import SceneFacts
from polarguide.evaluation.held_out import cross_fitted
from polarguide.evaluation.maps import ErrorsByObject
from polarguide.evaluation.measures import HAZE_DEPTH
from polarguide.evaluation.mesh import mesh_scores
from polarguide.evaluation.record import METRICS_FILE, write_metrics
from polarguide.evaluation.scores import ViewScores, score_view
from polarguide.evaluation.sources import commit, scoring_digest
from polarguide.evaluation.target import ViewTarget
from polarguide.progress import SILENT, Reporter
from polarguide.runs.folder import RunLog
from polarguide.runs.opened import OpenedRun
from polarguide.system import peak_memory_mib
from polarguide.training.stopwatch import Stopwatch

MINIMUM_SECONDS = 1.5
NOT_ALONE = "other work ran on the machine meanwhile"


def evaluate(run: OpenedRun, *, speed: bool = False, reporter: Reporter = SILENT) -> dict[str, Any]:
    """Score a run's test views and write ``metrics.json`` and ``errors.png`` into its folder.

    Args:
        run: the run; it is asked for layers only.
        speed: whether to measure frames a second, which makes sense only while nothing else runs.
        reporter: told how far it is.

    Returns:
        The record as written: means over the views, ``views`` by name, ``objects``, ``materials`` and ``provenance``.

    Raises:
        PolarguideError: the scene cannot be read, or has no test views.
    """
    tests = run.scene.test_views
    facts = SceneFacts.of(run.scene)
    for warning in facts.warnings:
        reporter.warn(warning)
    fitted = [view.name for view in tests if not view.measures_radiance]
    if fitted:
        reporter.say(
            f"scored behind an analyzer that is fitted on the other half of the picture: {listed(fitted)}"
        )
    views, by_object, sheet = {}, ErrorsByObject(facts.objects), ErrorSheet(len(tests))
    with reporter.track("scoring", len(tests)) as advance:
        for view in tests:
            views[view.name] = _score(run, view, facts, by_object, sheet)
            advance(len(views))
    sheet.write(run.folder / ERRORS_FILE)
    memory = peak_memory_mib()  # before the mesh, which is no part of what a run needs
    with reporter.track("measuring the mesh"):
        mesh = mesh_scores(run.cameras, lambda camera: run.model.render(camera, depth=True), tests)
    objects, materials = by_object.records()
    seconds, alone = RunLog(run.folder).elapsed()
    fps = _speed(run, normals=False) if speed else None
    return write_metrics(
        run.folder / METRICS_FILE,
        views=views,
        run={
            "fps": fps,
            "fps_reason": None if fps is not None else NOT_ALONE if speed else "not asked for",
            "fps_layers": _speed(run, depth=True) if speed else None,
            "train_seconds": seconds if alone and seconds > 0 else None,
            "train_seconds_reason": None if alone and seconds > 0 else "no log of it" if alone else NOT_ALONE,
            "gaussians": len(run.model),
            "steps": run.steps,
            "peak_memory_mib": memory,
            **mesh,
        },
        objects=objects,
        materials=materials,
        provenance=_provenance(run),
    )


def _score(
    run: OpenedRun, view: View, facts: SceneFacts, by_object: ErrorsByObject, sheet: ErrorSheet
) -> ViewScores:
    """Score a view; its errors are added to those by object, and its pictures to the sheet."""
    # First what is known of it: copied later, it would have to wait until the rendering is done.
    target = ViewTarget.of_view(view, facts, run.model.device)
    result = run.model.render(view.camera, depth=True)
    stokes = run.model.stokes(result, view.camera)
    if not view.measures_radiance:
        result = replace(result, final=cross_fitted(view, result.final, stokes))
    in_front = None
    if target.depth is not None:
        in_front = run.model.alpha_in_front(view.camera, HAZE_DEPTH * target.depth)
    sheet.add(view, target, result, stokes)
    return score_view(target, result, stokes=stokes, in_front=in_front, by_object=by_object)


def _speed(run: OpenedRun, **layers: bool) -> float | None:
    def draw(view: View) -> None:
        run.model.render(view.camera, **layers)
        if run.model.device.type == "cuda":
            torch.cuda.synchronize(run.model.device)

    return frames_per_second(draw, run.scene.test_views)


def _device(device: torch.device) -> str:
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else _native.simd()
    return f"{device} ({name}, {_native.thread_count()} threads)"


def _provenance(run: OpenedRun) -> dict[str, Any]:
    configuration = run.configuration
    return {
        "recipe": configuration.recipe,
        "seed": configuration.settings.seed,
        "commit": commit(),
        "sources": scoring_digest(),
        "versions": {
            "polarguide": polarguide.__version__,
            "torch": torch.__version__,
            "python": platform.python_version(),
        },
        "device": _device(run.model.device),
        "downscale": configuration.downscale,
        "scene_hash": run.scene.digest,
        "scene": run.scene.name,
        "refractive_index": configuration.settings.refractive_index,
    }


def frames_per_second(draw: Callable[[View], object], views: Sequence[View]) -> float | None:
    """Median over views of 1 / seconds for ``draw``, after one warm-up of each; nothing is waited for but the call.

    Args:
        draw: renders one view and returns when it is done.
        views: what to render; each is timed at least three times.

    Returns:
        Frames a second, or None where other work ran on the machine meanwhile.
    """
    for view in views:
        draw(view)
    stopwatch = Stopwatch()
    times: dict[int, list[float]] = {index: [] for index in range(len(views))}
    begin = time.perf_counter()
    while len(times[0]) < 3 or time.perf_counter() - begin < MINIMUM_SECONDS:
        for index, view in enumerate(views):
            start = time.perf_counter()
            draw(view)
            times[index].append(time.perf_counter() - start)
    _, alone = stopwatch.read()
    return 1 / statistics.median(statistics.median(t) for t in times.values()) if alone else None
