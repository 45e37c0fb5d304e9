"""``polarguide eval``."""

from __future__ import annotations

import platform
import resource
import subprocess
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from rich.table import Table

import polarguide
from polarguide import _native
from polarguide.cli.common import OpenRun, console, open_run, use_threads
from polarguide.evaluation import score_view, write_metrics
from polarguide.evaluation.speed import frames_per_second
from polarguide.raster import DeviceName
from polarguide.training.run import RunLog

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
    run: Annotated[Path, tyro.conf.Positional], /, *, device: DeviceName = "auto", threads: int = 0
) -> None:
    """Score a run on its test views and write RUN/metrics.json.

    Args:
        run: Run folder.
        device: What to compute on.
        threads: Threads to use; 0 takes all cores.
    """
    use_threads(threads)
    evaluate_run(open_run(run, device=device))


def evaluate_run(opened: OpenRun) -> dict[str, Any]:
    """Score, write ``metrics.json``, print the table; returns the record."""
    views = {}
    for view in opened.scene.test_views:
        result = opened.render(view)
        invalid = view.invalid if bool(view.invalid.any()) else None
        views[view.name] = score_view(view.photograph(), invalid, view.truth, result)
    seconds, alone = RunLog(opened.folder).elapsed()
    record = write_metrics(
        opened.folder / METRICS,
        views=views,
        run={
            "fps": frames_per_second(
                lambda view: opened.render(view, normals=False), opened.scene.test_views
            ),
            "fps_layers": frames_per_second(
                lambda view: opened.render(view, depth=True), opened.scene.test_views
            ),
            "train_seconds": seconds if alone and seconds > 0 else None,
            "gaussians": len(opened.state.rows),
            "steps": opened.state.step,
            "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        },
        provenance=_provenance(opened),
    )
    _print(record, opened)
    return record


def _provenance(opened: OpenRun) -> dict[str, Any]:
    configuration = opened.configuration
    folder = Path(polarguide.__file__).parent
    git = subprocess.run(
        ["git", "-C", str(folder), "rev-parse", "HEAD"], capture_output=True, text=True, check=False
    )
    return {
        "recipe": configuration.recipe,
        "seed": configuration.settings.seed,
        "commit": git.stdout.strip() or None,
        "versions": {
            "polarguide": polarguide.__version__,
            "torch": torch.__version__,
            "python": platform.python_version(),
        },
        "device": f"{opened.backend.device} ({_native.simd()}, {_native.thread_count()} threads)",
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
