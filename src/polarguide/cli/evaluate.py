"""``polarguide eval``."""

from __future__ import annotations

import platform
import resource
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from rich.table import Table

import polarguide
from polarguide import _native
from polarguide.capture import View
from polarguide.cli.common import OpenRun, console, open_run, use_threads
from polarguide.evaluation import ViewTarget, score_view, write_metrics
from polarguide.evaluation.record import METRICS_FILE
from polarguide.evaluation.sources import commit, scoring_digest
from polarguide.evaluation.speed import frames_per_second
from polarguide.evaluation.table import shown_metrics
from polarguide.raster import DeviceName
from polarguide.runs.folder import RunLog


def evaluate(
    run: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    speed: bool = True,
    device: DeviceName = "auto",
    threads: int = 0,
) -> None:
    """Score a run on its test views and write RUN/metrics.json.

    Args:
        run: Run folder.
        speed: Measure frames a second; --speed makes sense only while nothing else runs.
        device: What to compute on.
        threads: Threads to use; 0 takes all cores.
    """
    use_threads(threads)
    evaluate_run(open_run(run, device=device), speed=speed)


def evaluate_run(opened: OpenRun, *, speed: bool = True) -> dict[str, Any]:
    """Score, write ``metrics.json``, print the table; returns the record. Without ``speed`` its keys are null."""
    views = {}
    for view in opened.scene.test_views:
        # First what is known of it: copied later, it would have to wait until the rendering is done.
        target = ViewTarget.of(view.photograph(), view.invalid, view.ground_truth, opened.backend.device)
        views[view.name] = score_view(target, opened.draw(view))
    seconds, alone = RunLog(opened.folder).elapsed()
    record = write_metrics(
        opened.folder / METRICS_FILE,
        views=views,
        run={
            "fps": _speed(opened, normals=False) if speed else None,
            "fps_layers": _speed(opened, depth=True) if speed else None,
            "train_seconds": seconds if alone and seconds > 0 else None,
            "gaussians": len(opened.state.gaussians),
            "steps": opened.state.step,
            "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        },
        provenance=_provenance(opened),
    )
    _print(record, opened)
    return record


def _speed(opened: OpenRun, **layers: bool) -> float | None:
    def draw(view: View) -> None:
        opened.draw(view, **layers)
        if opened.backend.device.type == "cuda":
            torch.cuda.synchronize(opened.backend.device)

    return frames_per_second(draw, opened.scene.test_views)


def _device(opened: OpenRun) -> str:
    device = opened.backend.device
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else _native.simd()
    return f"{device} ({name}, {_native.thread_count()} threads)"


def _provenance(opened: OpenRun) -> dict[str, Any]:
    configuration = opened.configuration
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
        "device": _device(opened),
        "downscale": configuration.downscale,
        "scene_hash": opened.scene.digest,
        "scene": opened.scene.name,
        "refractive_index": configuration.settings.refractive_index,
    }


def _print(record: dict[str, Any], opened: OpenRun) -> None:
    configuration = opened.configuration
    table = Table(
        title=f"{configuration.recipe} on {opened.scene.name}: mean of {len(record['views'])} test views"
    )
    table.add_column("metric")
    table.add_column("value", justify="right")
    for label, text in shown_metrics(record):
        table.add_row(label, text)
    console.print(table)
    console.print(f"metrics: {opened.folder / METRICS_FILE}")
