"""Scoring a run on its test views, with its speed and where its numbers come from."""

from __future__ import annotations

import json
import platform
from pathlib import Path
from typing import Any

import torch

import polarguide
from polarguide import _native
from polarguide.capture import View
from polarguide.errors import PolarguideError
from polarguide.evaluation import ViewTarget, score_view, write_metrics
from polarguide.evaluation.record import RUN_KEYS, validate_metrics
from polarguide.evaluation.sources import commit, scoring_digest
from polarguide.evaluation.speed import frames_per_second
from polarguide.progress import SILENT, Reporter
from polarguide.runs.folder import RunLog
from polarguide.runs.opened import OpenedRun
from polarguide.system import peak_memory_mib

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


def evaluate(run: OpenedRun, *, speed: bool = False, reporter: Reporter = SILENT) -> dict[str, Any]:
    """Score a run's test views and write ``metrics.json`` into its folder.

    Args:
        run: the run; it is asked for layers only.
        speed: whether to measure frames a second, which makes sense only while nothing else runs.
        reporter: told how far it is.

    Returns:
        The record as written: means over the views, ``views`` by name, and ``provenance``.

    Raises:
        PolarguideError: the scene cannot be read, or has no test views.
    """
    tests = run.scene.test_views
    views = {}
    with reporter.track("scoring", len(tests)) as advance:
        for view in tests:
            # First what is known of it: copied later, it would have to wait until the rendering is done.
            target = ViewTarget.of(view.photograph(), view.invalid, view.ground_truth, run.model.device)
            views[view.name] = score_view(target, run.model.render(view.camera))
            advance(len(views))
    seconds, alone = RunLog(run.folder).elapsed()
    return write_metrics(
        run.folder / METRICS,
        views=views,
        run={
            "fps": _speed(run, normals=False) if speed else None,
            "fps_layers": _speed(run, depth=True) if speed else None,
            "train_seconds": seconds if alone and seconds > 0 else None,
            "gaussians": len(run.model),
            "steps": run.steps,
            "peak_memory_mib": peak_memory_mib(),
        },
        provenance=_provenance(run),
    )


def read_metrics(folder: Path) -> dict[str, Any]:
    """The record that ``evaluate`` wrote into a run's folder.

    Raises:
        PolarguideError: the run has not been scored, or the file is not such a record.
    """
    path = folder / METRICS
    try:
        record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        found = "none" if isinstance(error, FileNotFoundError) else f"no JSON ({error})"
        raise PolarguideError(
            path, expected="the scores of a run", found=found, remedy="Run polarguide eval."
        ) from None
    validate_metrics(record, where=path)
    return record


def shown_metrics(folder: Path) -> list[tuple[str, str]]:
    """Labels and values of a run's scores, for people; nothing where it has not been scored.

    Raises:
        PolarguideError: ``metrics.json`` is not what ``evaluate`` writes.
    """
    if not (folder / METRICS).exists():
        return []
    record = read_metrics(folder)
    return [
        (f"{label}, test views", f"{record[key]:.3f} {unit}".rstrip())
        for key, label, unit in SHOWN_KEYS
        if key not in RUN_KEYS and record[key] is not None
    ]


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
