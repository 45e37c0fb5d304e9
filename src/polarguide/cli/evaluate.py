"""``polarguide eval``."""

from __future__ import annotations

import json
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
from polarguide.errors import PolarguideError
from polarguide.evaluation import ViewTarget, score_view, write_metrics
from polarguide.evaluation.record import RUN_KEYS, validate_metrics
from polarguide.evaluation.sources import commit, scoring_digest
from polarguide.evaluation.speed import frames_per_second
from polarguide.raster import DeviceName
from polarguide.runs.folder import RunLog

METRICS = "metrics.json"
SHOWN_KEYS = (
    ("psnr", "PSNR", "dB"),
    ("psnr_foreground", "PSNR, foreground", "dB"),
    ("psnr_reflective", "PSNR, reflective", "dB"),
    ("ssim", "SSIM", ""),
    ("normal_mae_deg", "normal error", "degrees"),
    ("normal_within_11", "normals within 11.25 degrees", ""),
    ("specular_psnr", "specular layer PSNR", "dB"),
    ("diffuse_psnr", "diffuse layer PSNR", "dB"),
    ("fps", "frames a second", ""),
    ("gaussians", "Gaussians", ""),
    ("train_seconds", "training", "s"),
)


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
        opened.folder / METRICS,
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


def shown_metrics(run: Path) -> list[tuple[str, str]]:
    """Labels and values of a run's scores, for people; nothing where it has not been scored.

    Raises:
        PolarguideError: ``metrics.json`` is not what ``eval`` writes.
    """
    path = run / METRICS
    if not path.exists():
        return []
    try:
        record = json.loads(path.read_text())
    except ValueError as error:
        raise PolarguideError(
            path,
            expected="the scores of a run",
            found=f"no JSON ({error})",
            remedy="Run polarguide eval again.",
        ) from None
    validate_metrics(record, where=path)
    return [
        (f"{label}, test views", f"{record[key]:.3f} {unit}".rstrip())
        for key, label, unit in SHOWN_KEYS
        if key not in RUN_KEYS and record[key] is not None
    ]


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
    for key, label, unit in SHOWN_KEYS:
        value = record[key]
        text = "n/a" if value is None else f"{value:,}" if isinstance(value, int) else f"{value:.3f}"
        table.add_row(label, f"{text} {unit}".rstrip())
    lpips = record["lpips"]
    table.add_row("LPIPS", f"{lpips:.3f}" if lpips is not None else f"n/a ({record['lpips_reason']})")
    console.print(table)
    console.print(f"metrics: {opened.folder / METRICS}")
