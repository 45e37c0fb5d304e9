"""What a comparison is asked for, beside scenes, recipes and the settings of its trainings. Does not import torch."""

from __future__ import annotations

import os
from dataclasses import dataclass

from polarguide.errors import PolarguideError
from polarguide.options import (
    EXPOSURES,
    MOST_THREADS,
    DeviceName,
    Exposures,
    SceneOptions,
    check_choice,
    check_count,
)

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
        exposures: A row for each: as if a scene with four pictures of each view had been captured with four; three (0,
            60, 120 degrees); two at right angles; one; one at an unknown angle; mixed, four of every fourth view and
            the rest without a filter; sparse, every fourth view alone; none, all without a filter, and without any
            polarization in the recipe.
    """

    seeds: int = 1
    jobs: int = 0
    threads: int = 1
    speed: bool = False
    report_views: int = 3
    device: DeviceName = "auto"
    against: str | None = None
    exposures: tuple[Exposures, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("seeds", self.seeds, 1, MOST_SEEDS)
        check_count("jobs", self.jobs, 0, MOST_THREADS)
        check_count("threads", self.threads, 1, MOST_THREADS)
        check_count("report_views", self.report_views, 0)
        for name in self.exposures:
            check_choice("exposures", name, EXPOSURES)
        if len(set(self.exposures)) < len(self.exposures):
            found = " ".join(self.exposures)
            raise PolarguideError(
                "exposures", expected="every word once", found=found, remedy="Name each once."
            )

    @property
    def parallel(self) -> int:
        """How many runs work at a time."""
        return self.jobs or max(1, (os.cpu_count() or 1) // self.threads)
