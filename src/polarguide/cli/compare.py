"""``polarguide compare``."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import tyro

from polarguide.capture.view import listed
from polarguide.cli.common import Transfer, console, use_threads
from polarguide.cli.job_progress import JobProgress
from polarguide.cli.train import check_count, checked_settings
from polarguide.errors import PolarguideError
from polarguide.experiments.collect import BESIDE_OTHERS, collect, write_tables
from polarguide.experiments.jobs import STDERR, Job, run_jobs
from polarguide.experiments.plan import Comparison, PlannedRun, SceneEntry, plan_runs, scene_entries
from polarguide.experiments.report_views import REPORT, write_report
from polarguide.experiments.results import Results
from polarguide.experiments.study import read_study, study_svg
from polarguide.raster import DeviceName, choose_backend
from polarguide.recipes import recipe_named

LOCK, STUDY = ".lock", "study.svg"


def compare(
    scenes: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SCENE ...")],
    /,
    *,
    recipes: tuple[str, ...],
    out: Path,
    steps: int = 5000,
    seeds: int = 1,
    downscale: int = 1,
    transfer: Transfer = "linear",
    refractive_index: float = 1.5,
    jobs: int = 0,
    threads: int = 1,
    speed: bool = False,
    report_views: int = 3,
    device: DeviceName = "auto",
) -> None:
    """Train and score several recipes on several scenes, and set tables and a report of them.

    Writes results.json, .md, .csv, .tex and report.html to the folder given by --out, and the runs to its runs/.
    Finished runs are found again and not repeated. Can be stopped with Ctrl-C at any time: the same command goes on.

    Args:
        scenes: Scene folders, as for train.
        recipes: The recipes to compare, by name: 3dgs, 3dgs-dr, polarguide, polarguide:without-normals, ...
        out: Folder to write.
        steps: Optimizer steps of each run.
        seeds: How many seeds: 3 trains with the seeds 0, 1 and 2, and shows mean and spread.
        downscale: Average the pictures over boxes of this many pixels first.
        transfer: How the files encode radiance; srgb undoes the display curve of JPEGs.
        refractive_index: Of the surfaces: 1.5 for glass, plastic and glaze, 1.33 for water.
        jobs: Runs at a time; 0 takes as many as there are cores for their threads. Times are measured only with 1.
        threads: Threads of each run.
        speed: With --speed at the end time pictures, one run after the other, where that was not done alone before.
        report_views: Test views of each scene in the report; 0 leaves the pictures out.
        device: What to compute on.
    """
    chosen = tuple(recipe_named(name) for name in recipes)
    if not scenes or not chosen:
        what = "recipe" if scenes else "scene"
        raise PolarguideError(
            "compare", expected=f"a {what}", found="none", remedy=f"Name at least one {what}."
        )
    if len({recipe.name for recipe in chosen}) < len(chosen):
        raise PolarguideError(
            "--recipes", expected="every name once", found=" ".join(recipes), remedy="Name each once."
        )
    for name, count in (("--seeds", seeds), ("--threads", threads), ("--jobs", jobs or 1)):
        check_count(name, count)
    check_count("--report-views", report_views + 1)
    choose_backend(device)
    run_comparison(
        Comparison(
            scenes=scenes,
            recipes=chosen,
            settings=checked_settings(steps, 0, refractive_index),
            seeds=seeds,
            downscale=downscale,
            transfer=transfer,
            device=device,
            jobs=jobs or max(1, (os.cpu_count() or 1) // threads),
            threads=threads,
            speed=speed,
            report_views=report_views,
            out=out,
        )
    )


def run_comparison(comparison: Comparison) -> None:
    """Do what is left to do and write the tables and the report.

    Raises:
        PolarguideError: wrong input; or, after everything else is done and written, runs that failed.
        KeyboardInterrupt: stopped; the runs at work have saved their state.
    """
    use_threads(comparison.threads)
    scenes = scene_entries(comparison)
    plan = plan_runs(comparison, scenes)
    comparison.out.mkdir(parents=True, exist_ok=True)
    with _locked(comparison.out):
        failures = _train(comparison, scenes, plan)
        if comparison.speed:
            _time(comparison, plan)
        results = collect(comparison, scenes, plan, failures)
        write_tables(comparison.out, results)
        write_report(comparison, scenes, plan, results)
        _write_study(comparison, scenes, results)
    console.print(
        f"tables: {comparison.out}/results.md, .csv, .tex, .json   report: {comparison.out / REPORT}"
    )
    if failures:
        said = listed([f"{r.label}: {failures[r.folder]}" for r in plan if r.folder in failures])
        raise PolarguideError(
            comparison.out,
            expected=f"{len(plan)} finished runs",
            found=f"that {len(failures)} failed ({said})",
            remedy="What there is has been written. Remove the cause and give the same command again.",
        )


def _write_study(comparison: Comparison, scenes: Sequence[SceneEntry], results: Results) -> None:
    """Where the scenes are a family of ``polarguide synth --sweep``: the scores over the number under study."""
    drawn = study_svg(results, {scene.name: read_study(scene.path) for scene in scenes})
    if drawn is not None:
        (comparison.out / STUDY).write_text(drawn, encoding="utf-8")
        console.print(f"study: {comparison.out / STUDY}", markup=False)


def _train(
    comparison: Comparison, scenes: Sequence[SceneEntry], plan: Sequence[PlannedRun]
) -> dict[Path, str]:
    """Train and score what is missing; the last words of what failed, by run folder."""
    wanted = [run for run in plan if run.state() != "done"]
    parallel = min(comparison.jobs, len(wanted))
    console.print(f"runs: {len(plan)}, of them finished before: {len(plan) - len(wanted)}")
    jobs = [_job(comparison, run, alone=parallel == 1) for run in wanted]
    failures: dict[Path, str] = {}
    if not jobs:
        return failures
    with JobProgress(jobs) as progress:

        def end(job: Job, error: str | None) -> None:
            progress.ended(job, error)
            if error is None:
                (job.folder / STDERR).unlink(missing_ok=True)
            else:
                failures[job.folder] = error
            write_tables(comparison.out, collect(comparison, scenes, plan, failures))

        try:
            run_jobs(jobs, parallel=parallel, threads=comparison.threads, on_end=end, on_look=progress.look)
        except KeyboardInterrupt:
            console.print("the runs at work have saved their state; go on with the same command")
            raise
    return failures


def _job(comparison: Comparison, run: PlannedRun, *, alone: bool) -> Job:
    """The commands that finish a run."""
    state, folder = run.state(), str(run.folder)
    commands: list[tuple[str, ...]] = []
    if state in ("new", "begun"):
        if not alone:
            run.folder.mkdir(parents=True, exist_ok=True)
            (run.folder / BESIDE_OTHERS).write_text("Trained beside other runs: its seconds do not count.\n")
        settings = run.settings
        words = ["train", str(run.scene.path), "--out", folder, "--recipe", run.recipe.name]
        words += ["--steps", str(settings.steps), "--seed", str(settings.seed)]
        words += ["--refractive-index", repr(settings.refractive_index), "--downscale", str(run.downscale)]
        words += ["--transfer", run.transfer, "--device", comparison.device]
        commands.append((*words, *(["--resume"] if state == "begun" else [])))
    commands.append(_scoring(comparison, run, speed=alone))
    return Job(run.label, run.folder, tuple(commands), run.settings.steps)


def _scoring(comparison: Comparison, run: PlannedRun, *, speed: bool) -> tuple[str, ...]:
    flag = "--speed" if speed else "--no-speed"
    return ("eval", str(run.folder), flag, "--device", comparison.device)


def _time(comparison: Comparison, plan: Sequence[PlannedRun]) -> None:
    """Time the pictures of finished runs that have not been timed alone, one after the other."""
    untimed = [run for run in plan if (record := run.metrics()) is not None and record["fps"] is None]
    jobs = [
        Job(run.label, run.folder, (_scoring(comparison, run, speed=True),), run.settings.steps)
        for run in untimed
    ]
    if not jobs:
        return
    console.print(f"timing the pictures of {len(jobs)} runs, one after the other")
    with JobProgress(jobs) as progress:
        run_jobs(
            jobs,
            parallel=1,
            threads=comparison.threads,
            on_end=progress.ended,
            on_look=progress.look,
        )
    missed = [r.label for r in untimed if (m := r.metrics()) is None or m["fps"] is None]
    if missed:
        console.print(
            f"[yellow]warning:[/] no speed for {len(missed)} runs: they failed, or were not alone on the machine."
        )


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep two comparisons out of one folder. Children inherit the lock and hold it if the parent is killed."""
    with open(folder / LOCK, "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise PolarguideError(
                folder,
                expected="a folder that nobody is writing to",
                found="another comparison at work in it",
                remedy="Wait for it, or give another --out.",
            ) from None
        os.set_inheritable(file.fileno(), True)
        yield
