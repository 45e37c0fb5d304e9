"""What a comparison is asked for, beside scenes, recipes and the settings of its trainings. Does not import torch."""

from __future__ import annotations

import os
from dataclasses import dataclass

from polarguide.options import MOST_THREADS, DeviceName, SceneOptions, check_count

MOST_SEEDS = 1000
"""Each is a run of its own for every recipe and scene."""


@dataclass(frozen=True)
class CompareOptions(SceneOptions):
    """How runs are trained, timed and shown.

    Attributes:
        seeds: How many seeds: 3 trains with the seeds 0, 1 and 2, and shows mean and spread.
        jobs: Runs at a time; 0 takes as many as there are cores for their threads. Times are measured only with 1.
        threads: Threads of each run.
        speed: At the end time pictures, one run after the other, where that was not done alone before.
        report_views: Test views of each scene in the report; 0 leaves the pictures out.
        device: What to compute on.
        against: One of the recipes: tables have the difference of every other one to it.
    """

    seeds: int = 1
    jobs: int = 0
    threads: int = 1
    speed: bool = False
    report_views: int = 3
    device: DeviceName = "auto"
    against: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("seeds", self.seeds, 1, MOST_SEEDS)
        check_count("jobs", self.jobs, 0, MOST_THREADS)
        check_count("threads", self.threads, 1, MOST_THREADS)
        check_count("report_views", self.report_views, 0)

    @property
    def parallel(self) -> int:
        """How many runs work at a time."""
        return self.jobs or max(1, (os.cpu_count() or 1) // self.threads)
