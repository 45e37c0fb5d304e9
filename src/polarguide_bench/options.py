"""Options of comparisons, batches and the bench, and the definition of the bench.

This module does not import torch, so that the command line starts quickly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Literal

from polarguide.core.errors import require
from polarguide.core.options import (
    EXPOSURES,
    MOST_THREADS,
    DeviceName,
    ExportFormat,
    Exposures,
    SceneOptions,
    check_choice,
    check_count,
)
from polarguide.training.settings import TrainSettings
from polarguide_synth.settings import SynthSettings

MOST_SEEDS = 1000
"""Largest number of seeds."""
LayoutName = Literal["publication-1", "publication-2"]
"""Tables of the publication PolarGuide-GSDR. The first compares methods, the second compares ablations."""


@dataclass(frozen=True)
class ClusterOptions:
    """Place of the computation.

    Attributes:
        jobs: Number of simultaneous runs. 0 uses the cores, memory and GPUs of this machine, or all jobs at once on a
            cluster. Times are measured only with 1 on this machine.
        threads: Threads of each run.
        scheduler: Address of a scheduler of dask.distributed, such as tcp://10.0.0.5:8786. Its workers need the same
            folders and the same version.
        slurm: Run jobs on SLURM. dask's jobqueue.yaml configures queue, account and time.
        pbs: Run jobs on PBS. dask's jobqueue.yaml configures queue, account and time.
    """

    jobs: int = 0
    threads: int = 1
    scheduler: str | None = None
    slurm: bool = False
    pbs: bool = False

    def __post_init__(self) -> None:
        check_count("jobs", self.jobs, 0, MOST_THREADS)
        check_count("threads", self.threads, 1, MOST_THREADS)
        places = [f"--{name}" for name in ("scheduler", "slurm", "pbs") if getattr(self, name)]
        require(
            len(places) <= 1,
            places[-1] if places else "",
            expected="at most one option that selects where the runs are computed",
            found=" and ".join(places),
            remedy="Omit all but one of these options.",
        )

    @property
    def manager(self) -> Literal["slurm", "pbs"] | None:
        """Cluster manager that runs the jobs, or None without a cluster."""
        if self.slurm:
            return "slurm"
        return "pbs" if self.pbs else None

    @property
    def local(self) -> bool:
        """True if the jobs run on this machine."""
        return self.scheduler is None and self.manager is None


@dataclass(frozen=True)
class CompareOptions(ClusterOptions, SceneOptions):
    """Options for training, timing and presentation of runs.

    Attributes:
        seeds: Number of seeds. 3 trains each recipe with the seeds 0, 1 and 2, and tables show mean and spread.
        speed: Measure the rendering speed of each run after all trainings, one run at a time. Runs that were already
            measured without other work on the machine are not measured again.
        report_views: Test views of each scene in the report; 0 leaves the pictures out.
        device: Device of trainings and renderings.
        against: Reference recipe. Tables show the difference of every other recipe to it.
        exposures: Kinds of captures, a row of the tables each, simulated from a scene with four pictures of each view.
            The values four, three (0, 60 and 120 degrees), two (at right angles), one and unknown (one at an unknown
            angle) hold for each view. The value mixed has four pictures of every fourth view, and the others without a
            filter. The value sparse has only every fourth view. The value none has no filter, and no polarization in
            the recipe.
    """

    seeds: int = 1
    speed: bool = False
    report_views: int = 3
    device: DeviceName = "auto"
    against: str | None = None
    exposures: tuple[Exposures, ...] = ()

    def __post_init__(self) -> None:
        ClusterOptions.__post_init__(self)
        SceneOptions.__post_init__(self)
        check_count("seeds", self.seeds, 1, MOST_SEEDS)
        require(
            self.local or not self.speed,
            "speed",
            expected="a comparison on this machine, because other jobs falsify times",
            found="a cluster",
            remedy="Omit this option. After all trainings, repeat the command with --speed and without the cluster.",
        )
        check_count("report_views", self.report_views, 0)
        for name in self.exposures:
            check_choice("exposures", name, EXPOSURES)
        require(
            len(set(self.exposures)) == len(self.exposures),
            "exposures",
            expected="different kinds",
            found=" ".join(self.exposures),
            remedy="List each kind once.",
        )


@dataclass(frozen=True)
class BatchOptions(ClusterOptions):
    """Options for processing captures.

    Attributes:
        formats: Export formats, as for --format of polarguide export.
        device: Device of trainings and renderings.
    """

    formats: tuple[ExportFormat, ...] = ("ply",)
    device: DeviceName = "auto"


@dataclass(frozen=True)
class Bench:
    """Benchmark: a fixed set of rendered scenes, and the recipes to compare on them.

    Attributes:
        development: presets or scene files for the development of methods.
        held_back: presets or scene files that must not be used for tuning.
        synth: settings of the rendering.
        views: views of each scene.
        rows: name and number of seeds of each recipe, in the order of the tables.
        training: settings of each training. Their seed is the first of the seeds.
    """

    development: tuple[str, ...]
    held_back: tuple[str, ...]
    synth: SynthSettings
    views: int
    rows: Mapping[str, int]
    training: TrainSettings


BENCH = Bench(
    development=("figure", "kit", "car", "water", "metals-a", "ceramic-a", "cup"),
    held_back=("metals-b", "ceramic-b", "rough", "lacquer"),
    synth=SynthSettings(size="192x144", samples=64, seed=0, points=5000, test_every=7),
    views=56,
    rows={
        "3dgs": 1,
        "3dgs-dr": 1,
        "3dgs-dr:consistent": 1,
        "ref-gs": 1,
        "polarguide-paper": 1,
        "polarguide-paper:kind": 1,
        "polarguide": 1,
        "polarguide:unpolarized": 1,
        "polarguide:unpolarized-without-consistency": 1,
        "polarguide-stokes": 3,
        "polarguide-stokes:unpolarized": 3,
        "polarguide-stokes:unpolarized-without-consistency": 3,
    },
    training=TrainSettings(steps=2500, seed=0, refractive_index=1.5),
)
"""Bench with which the published tables were made. Results of a changed bench are not comparable with these tables."""


@dataclass(frozen=True)
class BenchOptions(ClusterOptions):
    """Part of the bench, and place of the computation.

    Attributes:
        held_back: Use the held-back half instead of the development half, once for the final result of a change. It
            must not be used for tuning.
        render_only: Render the scenes without training.
        scenes: Scenes of the half; all if none is given. The rendering uses the threads of all runs together.
        device: Device of trainings and renderings.
    """

    held_back: bool = False
    render_only: bool = False
    scenes: tuple[str, ...] = ()
    device: DeviceName = "auto"

    @property
    def half(self) -> Literal["development", "held-back"]:
        """Name of the requested half of the bench."""
        return "held-back" if self.held_back else "development"

    def comparing(self, seeds: int) -> CompareOptions:
        """Return the options of the comparison, with a number of seeds."""
        place = {field.name: getattr(self, field.name) for field in fields(ClusterOptions)}
        return CompareOptions(**place, seeds=seeds, device=self.device)

    def chosen(self, bench: Bench) -> tuple[str, ...]:
        """Return the requested scenes in the order of the bench.

        Raises:
            PolarguideError: a scene belongs to the other half or is unknown.
        """
        half = bench.held_back if self.held_back else bench.development
        for name in self.scenes:
            require(
                self.held_back or name not in bench.held_back,
                "scenes",
                expected=f"a development scene ({', '.join(half)})",
                found=f"{name}, a held-back scene",
                remedy="Do not tune on held-back scenes. For the last run of a finished change, add --held-back.",
            )
            check_choice("scenes", name, half)
        return tuple(name for name in half if name in self.scenes or not self.scenes)
