"""What runs take, and how many of them work at a time."""

from __future__ import annotations

import os
from collections.abc import Sequence

import torch

from polarguide.capture.layout import SHARE
from polarguide.core.system import free_memory
from polarguide.experiments.options import ClusterOptions
from polarguide.experiments.plan import PlannedRun
from polarguide.raster import Backend
from polarguide.runs.forecast import pixels_of
from polarguide.runs.train import expected_memory


def most_memory(runs: Sequence[PlannedRun]) -> int:
    """Bytes that the process of any of the trainings takes at most, as far as headers tell.

    Raises:
        PolarguideError: a scene has gone, or its ``--memory`` is too small.
    """
    pixels = {run.scene.path: run.reading.downscale for run in runs}
    counts = {path: pixels_of(path, downscale) for path, downscale in pixels.items()}
    kinds = {(run.scene.path, run.row.name): run for run in runs}.values()  # seeds take the same
    peaks = (expected_memory(counts[r.scene.path], r.recipe, r.settings, r.reading) for r in kinds)
    return max(peaks, default=0)


def own_gpus(backend: Backend) -> tuple[str, ...]:
    """The GPUs of this machine, as CUDA_VISIBLE_DEVICES calls them; none where the CPU computes."""
    if backend.device.type != "cuda":
        return ()
    visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    return tuple(visible or map(str, range(torch.cuda.device_count())))


def jobs_at_a_time(options: ClusterOptions, count: int, memory: int, gpus: Sequence[str]) -> int:
    """How many jobs work at a time: at least one, and no more than there are.

    Args:
        options: where, and how many if that was specified.
        count: how many there are to do.
        memory: bytes that each takes at most. gpus: of this machine, each for one job.
    """
    if options.jobs or not options.local:
        return max(1, min(options.jobs or count, count))
    room = len(gpus) or (os.cpu_count() or 1) // options.threads
    free = free_memory()
    if free is not None and memory:
        room = min(room, int(SHARE * free) // memory)
    return max(1, min(room, count))
