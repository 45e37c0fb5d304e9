"""Options of a comparison and of the bench, and the bench as data. Does not import torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Literal

from polarguide.core.errors import PolarguideError
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
"""Each is a run of its own for every recipe and scene."""
Manager = Literal["slurm", "pbs"]
LayoutName = Literal["publication-1", "publication-2"]
"""Tables of PolarGuide-GSDR: its comparison of methods, and its ablations."""


@dataclass(frozen=True)
class ClusterOptions:
    """Where runs are trained.

    Attributes:
        jobs: Runs at a time; 0 takes as many as this machine has cores, memory and GPUs for, and with a cluster as many
            as there are. Times are measured only with 1, on this machine.
        threads: Threads of each run.
        scheduler: Address of a scheduler of dask.distributed, such as tcp://10.0.0.5:8786: its workers train. They need
            the same folders and the same version.
        slurm: Let jobs of SLURM train; dask's jobqueue.yaml has queue, account and time.
        pbs: The same with PBS.
    """

    jobs: int = 0
    threads: int = 1
    scheduler: str | None = None
    slurm: bool = False
    pbs: bool = False

    def __post_init__(self) -> None:
        check_count("jobs", self.jobs, 0, MOST_THREADS)
        check_count("threads", self.threads, 1, MOST_THREADS)
        named = [f"--{name}" for name in ("scheduler", "slurm", "pbs") if getattr(self, name)]
        if len(named) > 1:
            raise PolarguideError(
                named[1], expected="one place to train at", found=" and ".join(named), remedy="Leave one out."
            )

    @property
    def manager(self) -> Manager | None:
        """Whose jobs train."""
        return "slurm" if self.slurm else "pbs" if self.pbs else None

    @property
    def local(self) -> bool:
        """Whether this machine trains."""
        return self.scheduler is None and self.manager is None


@dataclass(frozen=True)
class CompareOptions(ClusterOptions, SceneOptions):
    """How runs are trained, timed and shown.

    Attributes:
        seeds: Number of seeds. 3 trains each recipe with the seeds 0, 1 and 2, and tables show mean and spread.
        speed: Measure the rendering speed of each run after all trainings, one run at a time. Runs that were already
            measured without other work on the machine are not measured again.
        report_views: Test views of each scene in the report; 0 leaves the pictures out.
        device: The device of trainings and renderings.
        against: Reference recipe. Tables show the difference of every other recipe to it.
        exposures: Ways to capture, a row of the tables each, imitated with a scene of four pictures a view.
            four: all four. three: 0, 60 and 120 degrees. two: two at right angles. one: one. unknown: one, at an
            unknown angle. mixed: four of every fourth view, the others without a filter. sparse: every fourth view
            alone. none: no filter, and no polarization in the recipe.
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
        if self.speed and not self.local:
            raise PolarguideError(
                "speed",
                expected="this machine, where nothing else runs meanwhile",
                found="a cluster",
                remedy="Leave it out, and repeat the command with --speed, without the cluster, when all is trained.",
            )
        check_count("report_views", self.report_views, 0)
        for name in self.exposures:
            check_choice("exposures", name, EXPOSURES)
        if len(set(self.exposures)) < len(self.exposures):
            kinds = " ".join(self.exposures)
            raise PolarguideError(
                "exposures", expected="every word once", found=kinds, remedy="Name each once."
            )

    @property
    def own_device(self) -> DeviceName:
        """The device on which this machine renders for the report, if others train."""
        return self.device if self.local else "auto"


@dataclass(frozen=True)
class BatchOptions(ClusterOptions):
    """How captures are processed.

    Attributes:
        formats: What to export of each: ply, spz, sog, mesh, points, environment or cameras.
        device: The device of trainings and renderings.
    """

    formats: tuple[ExportFormat, ...] = ("ply",)
    device: DeviceName = "auto"


Half = Literal["development", "held-back"]


@dataclass(frozen=True)
class Bench:
    """A fixed set of rendered scenes and of rows to compare on them.

    Attributes:
        development: presets or scene files that methods are developed beside.
        held_back: those that nobody tunes on.
        synth, views: how each is rendered.
        rows: names of recipes in the order of the tables, and how many seeds each is trained with.
        training: settings of every training; the first seed, from which others count up.
    """

    development: tuple[str, ...]
    held_back: tuple[str, ...]
    synth: SynthSettings
    views: int
    rows: Mapping[str, int]
    training: TrainSettings

    def scenes(self, half: Half) -> tuple[str, ...]:
        """The scenes of a half."""
        return self.held_back if half == "held-back" else self.development


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
"""Numbers of different benches are not comparable: a change here makes all published tables old."""


@dataclass(frozen=True)
class BenchOptions(ClusterOptions):
    """Which part of the bench to run, and on what.

    Attributes:
        held_back: The held-back half in place of the development half: once, at the end of a change that claims
            something. Nobody tunes on it.
        render_only: Render the scenes and train nothing.
        scenes: Some scenes of the half; all if none is given. Rendering takes the threads of all runs together.
        device: The device of trainings and renderings.
    """

    held_back: bool = False
    render_only: bool = False
    scenes: tuple[str, ...] = ()
    device: DeviceName = "auto"

    def __post_init__(self) -> None:
        self.comparing(1)

    @property
    def half(self) -> Half:
        """The requested half."""
        return "held-back" if self.held_back else "development"

    def comparing(self, seeds: int) -> CompareOptions:
        """The options of the comparison."""
        where = {field.name: getattr(self, field.name) for field in fields(ClusterOptions)}
        return CompareOptions(**where, seeds=seeds, device=self.device)

    def chosen(self, bench: Bench) -> tuple[str, ...]:
        """The requested scenes, in the order of the bench.

        Raises:
            PolarguideError: a scene of the other half, or none of the bench.
        """
        half = bench.scenes(self.half)
        for name in self.scenes:
            if name in bench.held_back and not self.held_back:
                raise PolarguideError(
                    "scenes",
                    expected=f"a development scene ({', '.join(half)})",
                    found=f"{name}, a held-back scene",
                    remedy="Do not tune on held-back scenes. For the last run of a finished change, add --held-back.",
                )
            check_choice("scenes", name, half)
        return tuple(name for name in half if name in self.scenes or not self.scenes)
