"""Comparison of several recipes, or of a recipe and its ablations, on several scenes."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from types import MappingProxyType

import msgspec
from msgspec import UNSET

from polarguide import __version__
from polarguide.capture import Scene
from polarguide.capture.layout import refuse_scene
from polarguide.capture.scene import IN_MEMORY
from polarguide.core.errors import require
from polarguide.core.files import check_out, make_folder, require_inside, write_text
from polarguide.core.options import (
    MOST,
    ComputeOptions,
    PathLike,
    SceneOptions,
    check_choice,
    check_count,
    index_of,
)
from polarguide.core.progress import Reporter, notebook_reporter
from polarguide.core.records import decode
from polarguide.core.system import only_writer
from polarguide.raster import choose_backend
from polarguide.results.evaluation.evaluate import code_digest, commit
from polarguide.results.evaluation.table import COLUMNS, PART_METRICS, Metric, register_metric
from polarguide.training.settings import TrainSettings
from polarguide_bench.children import Scoring, Task, Training
from polarguide_bench.figures import write_figures
from polarguide_bench.job_queue import Job, run_job, run_jobs, workers
from polarguide_bench.objects import chosen_recipes
from polarguide_bench.options import MOST_SEEDS, CompareOptions
from polarguide_bench.plan import (
    Comparison,
    PlannedRun,
    SceneEntry,
    compared_steps,
    jobs_at_a_time,
    most_memory,
    own_gpus,
    plan_runs,
    scene_entries,
)
from polarguide_bench.recipes import ABLATIONS, AnyRecipe, ablations_of
from polarguide_bench.report import write_report
from polarguide_bench.results import (
    FORMAT,
    REMEDY,
    PartScores,
    RecipeRecord,
    Record,
    Results,
    RunRecord,
    SceneRecord,
)
from polarguide_bench.tables import write_tables

BESIDE_OTHERS = "beside_others.txt"
"""Name of a file that marks a run whose training time does not count, because other jobs ran on the machine."""


def compare(
    scenes: Sequence[PathLike | Scene],
    recipes: Sequence[str | AnyRecipe],
    out: PathLike = "results",
    *,
    metrics: Sequence[Metric] = (),
    settings: TrainSettings = TrainSettings(),
    options: CompareOptions = CompareOptions(),
    seeds_of: Mapping[str, int] = MappingProxyType({}),
    steps_of: Mapping[str, int] = MappingProxyType({}),
    command_line: str = "",
    reporter: Reporter | None = None,
) -> Results:
    """Train and score each recipe on each scene with each seed, each run in its own processes.

    Writes tables (``results.json``, ``.md``, ``.csv`` and ``.tex``), figures (``results.pdf`` and ``.svg``) and
    ``report.html`` to ``out``, and the runs to its ``runs/``. If there are paired differences, they are written to
    ``differences.csv``. If there are scores by object and material, they are written to ``parts.csv``.

    Finished runs are not repeated. After a KeyboardInterrupt active runs save their states, and the same call resumes.

    Args:
        scenes: scene folders, or scenes read from folders, with unique names.
        recipes: recipes or their names, in the order of the tables. A recipe with a new name is known by this name in
            this process afterwards.
        out: output folder.
        metrics: additional metrics of views. They belong to all later scores of this process.
        settings: settings of each training. ``seed`` is the first of ``options.seeds``. The default of the steps is
            5,000, so that scenes of different sizes are comparable. Other defaults are those of ``train``.
        options: options for training, timing and presentation.
        seeds_of: number of seeds of each recipe for which it differs from ``options.seeds``.
        steps_of: number of steps of each recipe for which it differs from ``settings.steps``.
        command_line: command line to record if it differs from ``polarguide compare``.
        reporter: receives messages and progress. By default, a notebook displays them.

    Returns:
        The results as data frames. A failed run is listed in ``runs`` with its error, and does not affect other runs.

    Raises:
        PolarguideError: the input is invalid, or another comparison is writing to ``out``.
    """
    reporter = notebook_reporter() if reporter is None else reporter
    _require_lists(scenes=scenes, recipes=recipes, metrics=metrics)
    options = _read_alike(scenes, options)
    for metric in metrics:
        register_metric(metric)
    comparison = Comparison(
        scenes=tuple(scene.root if isinstance(scene, Scene) else Path(scene) for scene in scenes),
        recipes=chosen_recipes(recipes),
        settings=settings,
        options=options,
        out=Path(out),
        seeds_of=dict(seeds_of),
        steps_of=dict(steps_of),
        command_line=command_line,
    )
    names = [recipe.name for recipe in comparison.recipes]
    for option, counts, most in (("seeds_of", seeds_of, MOST_SEEDS), ("steps", steps_of, MOST)):
        for name, count in counts.items():
            check_choice(option, name, names)
            check_count(option, count, 1, most)
    require(scenes, "compare", expected="a scene", found="none", remedy="Name at least one scene.")
    check_out(comparison.out)
    refuse_scene(comparison.out)
    if options.against is not None:
        check_choice("against", options.against, [row.name for row in comparison.rows])
    if options.local:
        choose_backend(options.device)
    entries = scene_entries(comparison, reporter)
    _require_complete(scenes, entries)
    plan = plan_runs(comparison, entries)
    make_folder(comparison.out)
    require_inside(comparison.out, *(run.folder for run in plan))
    with locked(comparison.out):
        failures = _train(comparison, entries, plan, reporter)
        if options.speed:
            _time(comparison, plan, reporter)
        results = collect(comparison, entries, plan, failures)
        write_tables(comparison.out, results)
        write_report(comparison, entries, plan, results, reporter)
        write_figures(comparison.out, results)
    return results


def ablate(
    scenes: Sequence[PathLike | Scene],
    base: str,
    out: PathLike = "results",
    *,
    only: Sequence[str] = (),
    reference: Sequence[str | AnyRecipe] = (),
    settings: TrainSettings = TrainSettings(),
    metrics: Sequence[Metric] = (),
    options: CompareOptions = CompareOptions(),
    reporter: Reporter | None = None,
) -> Results:
    """Compare a recipe with its ablations. Comparisons in the same folder share their runs.

    Differences are relative to the recipe, unless ``options.against`` names another reference.

    Args:
        scenes, out, settings, metrics, options, reporter: see ``compare``.
        base: name of the recipe.
        only: names of the requested ablations, such as without-normals. If empty, all ablations are compared.
        reference: further recipes for the first rows.

    Raises:
        PolarguideError: the recipe has no ablations, an ablation is unknown, or the comparison fails, see ``compare``.
    """
    _require_lists(only=only, reference=reference)
    return compare(
        scenes,
        [*reference, *ablated(base, only)],
        out,
        settings=settings,
        metrics=metrics,
        options=replace(options, against=options.against or base),
        reporter=reporter,
    )


def _require_lists(**arguments: object) -> None:
    """Check that each argument is a collection, not a single object or text.

    Raises:
        PolarguideError: an argument is not a collection. The error has its name.
    """
    for name, value in arguments.items():
        require(
            isinstance(value, Collection) and not isinstance(value, str | bytes),
            name,
            expected=f"a list, {name}=[...]",
            found=f"a single {type(value).__name__}",
            remedy="Put it into a list, even if the list has only one element.",
        )


def _read_alike(scenes: Sequence[PathLike | Scene], options: CompareOptions) -> CompareOptions:
    """Return the options with the downscale and the transfer with which all scene objects were read.

    Specified options or else the first object determine both values.

    Raises:
        PolarguideError: an object is not a scene, is not in a folder, or was read in another way.
    """
    first = next((scene for scene in scenes if isinstance(scene, Scene)), None)
    for name, default in (("downscale", SceneOptions.downscale), ("transfer", SceneOptions.transfer)):
        if first is not None and getattr(options, name) == default:
            options = replace(options, **{name: getattr(first, name)})
    for scene in scenes:
        require(
            isinstance(scene, str | os.PathLike | Scene),
            "scenes",
            expected="scenes, or paths of scene folders",
            found=f"a {type(scene).__name__}",
            remedy="polarguide.load_scene reads a scene.",
        )
        if not isinstance(scene, Scene):
            continue
        require(
            scene.root != IN_MEMORY,
            "scenes",
            expected="scenes in folders, because other processes read them",
            found=f"the scene {scene.name} in memory",
            remedy="Write its pictures to a folder, and use polarguide.prepare.",
        )
        for name in ("downscale", "transfer"):
            stated = getattr(options, name)
            value = getattr(scene, name)
            require(
                value == stated,
                "scenes",
                expected=f"scenes that were read with {name} {stated}",
                found=f"{scene.name} with {name} {value}",
                remedy=f"Read all scenes with the same {name}.",
            )
    return options


def _require_complete(scenes: Sequence[PathLike | Scene], entries: Sequence[SceneEntry]) -> None:
    """Check that each scene object has the files and held-out views of its folder, which the trainings read.

    Raises:
        PolarguideError: a scene object differs from its folder.
    """
    for scene, entry in zip(scenes, entries, strict=True):
        require(
            not isinstance(scene, Scene)
            or (scene.digest, len(scene.views), scene.test_names)
            == (entry.digest, entry.views, entry.test_views),
            "scenes",
            expected=f"{entry.name} as its folder contains it",
            found="other files, views or held-out views",
            remedy="Read the whole scene again; split.json lists its held-out views.",
        )


def ablated(base: str, only: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the names of a recipe and of its ablations.

    Args:
        base: name of the recipe.
        only: names of the requested ablations, with or without the prefix ``base:``. If empty, all ablations.

    Raises:
        PolarguideError: the recipe has no ablations, or an ablation is unknown.
    """
    names = [recipe.name.removeprefix(f"{base}:") for recipe in ablations_of(base)]
    require(
        names,
        "base",
        expected="a recipe with ablations: " + ", ".join(ABLATIONS),
        found=base,
        remedy="Choose one of these recipes, or use compare.",
    )
    selected = [name.removeprefix(f"{base}:") for name in only]
    for name in selected:
        check_choice("only", name, names)
    return (base, *(f"{base}:{name}" for name in names if name in selected or not only))


def _train(
    comparison: Comparison, scenes: Sequence[SceneEntry], plan: Sequence[PlannedRun], reporter: Reporter
) -> dict[Path, str]:
    """Train and score unfinished runs, and return the errors by run folder."""
    unfinished = [run for run in plan if run.state() != "done"]
    reporter.say(f"runs: {len(plan)}, of them finished before: {len(plan) - len(unfinished)}")
    failures: dict[Path, str] = {}
    if not unfinished:
        return failures
    options = comparison.options
    gpus = own_gpus(choose_backend(options.device)) if options.local else ()
    memory = most_memory(unfinished)
    parallel = jobs_at_a_time(options, len(unfinished), memory, gpus)
    alone = options.local and parallel == 1
    jobs = [_job(comparison, run, alone=alone) for run in unfinished]

    def end(job: Job, error: str | None) -> None:
        if error is not None:
            failures[job.folder] = error
        write_tables(comparison.out, collect(comparison, scenes, plan, failures))

    try:
        with workers(
            options, count=parallel, threads=options.threads, memory=memory, gpus=gpus, reporter=reporter
        ) as at:
            run_jobs(jobs, at, reporter=reporter, on_end=end)
    except KeyboardInterrupt:
        reporter.say("Active runs have saved their states. Give the same command again to resume.")
        raise
    return failures


def _job(comparison: Comparison, run: PlannedRun, *, alone: bool) -> Job:
    """Return the job that trains and scores a run. ``alone`` means that no other job runs, so the speed is measured."""
    compute = ComputeOptions(comparison.options.threads, comparison.options.device)
    folder = str(run.folder.absolute())
    training = Training(
        scene=str(run.scene.path.absolute()),
        folder=folder,
        recipe=run.row.recipe.name,
        settings=run.settings,
        reading=run.reading,
        compute=compute,
    )
    scoring = Scoring(folder, alone, compute)

    def tasks() -> Sequence[Task]:
        if run.state() not in ("new", "begun"):
            return (scoring,)
        if not alone:
            make_folder(run.folder)
            write_text(run.folder / BESIDE_OTHERS, "Trained next to other runs: its time does not count.\n")
        return (training, scoring)

    return run_job(run.label, run.folder, tasks, run.steps)


def _time(comparison: Comparison, plan: Sequence[PlannedRun], reporter: Reporter) -> None:
    """Measure the rendering speed of finished runs without this measurement, one run at a time."""

    def speed(run: PlannedRun) -> float | None:
        return (run.metrics() or {}).get("fps")

    untimed = [run for run in plan if run.state() == "done" and speed(run) is None]
    if not untimed:
        return
    reporter.say(f"measuring the rendering speed of {len(untimed)} runs, one at a time")
    options = comparison.options
    gpus = own_gpus(choose_backend(options.device))
    with workers(options, count=1, threads=options.threads, memory=0, gpus=gpus, reporter=reporter) as at:
        run_jobs([_job(comparison, run, alone=True) for run in untimed], at, reporter=reporter)
    missed = sum(speed(run) is None for run in untimed)
    if missed:
        reporter.warn(f"no speed for {missed} runs: they failed, or were not alone on the machine.")


def locked(folder: Path, what: str = "comparison") -> contextlib.AbstractContextManager[None]:
    """Lock an existing folder against other work of the kind ``what``.

    Child processes on this machine inherit the lock. If the parent is killed, they hold the lock until they have saved
    their states.
    """
    return only_writer(
        folder / ".lock",
        expected="a folder to which no other command is writing",
        found=f"another {what} at work in it",
    )


def collect(
    comparison: Comparison,
    scenes: Sequence[SceneEntry],
    plan: Sequence[PlannedRun],
    failures: Mapping[Path, str],
) -> Results:
    """Collect the results of all runs that are finished now.

    Args:
        comparison: the requested comparison.
        scenes: scenes of the comparison.
        plan: runs of the comparison.
        failures: errors of failed runs, by run folder.
    """
    options = comparison.options
    settings = comparison.settings
    content = {
        "format": FORMAT,
        "provenance": {
            "version": __version__,
            "commit": commit(),
            "sources": code_digest(),
            "command": comparison.command,
            "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        },
        "settings": {
            "steps": compared_steps(settings.steps),
            "seeds": options.seeds,
            "downscale": options.downscale,
            "transfer": options.transfer,
            "refractive_index": settings.refractive_index,
            "threads": options.threads,
            "jobs": options.jobs,
            "against": options.against,
            "background": settings.background,
            "materials": settings.materials,
        },
        "scenes": [
            SceneRecord(
                name=scene.name,
                digest=scene.digest,
                views=scene.views,
                test_views=list(scene.test_views),
                warnings=list(scene.warnings) or UNSET,
                refractive_index=UNSET
                if settings.refractive_index is not None
                else index_of(None, scene.refractive_index),
            )
            for scene in scenes
        ],
        "recipes": [
            RecipeRecord(row.name, row.about, row.recipe.data(), UNSET if row.steps is None else row.steps)
            for row in comparison.rows
        ],
        "runs": [_run_record(comparison, run, failures.get(run.folder)) for run in plan],
    }
    return Results(decode(msgspec.to_builtins(content), Record, "results.json", remedy=REMEDY))


def _run_record(comparison: Comparison, run: PlannedRun, failure: str | None) -> RunRecord:
    record = RunRecord(
        scene=run.scene.name,
        recipe=run.row.name,
        seed=run.settings.seed,
        folder=run.folder.relative_to(comparison.out).as_posix(),
        state="missing" if failure is None else "failed",
        error=failure,
        metrics=None,
        lpips_reason=None,
        mesh_reason=None,
        views={},
    )
    scores = run.metrics() if run.state() == "done" else None
    if scores is None:
        return record
    metrics = {metric.key: scores.get(metric.key) for metric in COLUMNS}
    if (run.folder / BESIDE_OTHERS).exists():
        metrics["train_seconds"] = None
    parts = {
        kind: {
            name: PartScores(
                part.get("material"),
                part["pixels"],
                part["views"],
                {m.key: part[m.key] for m in PART_METRICS if m.key in part},
            )
            for name, part in (scores.get(kind) or {}).items()
        }
        for kind in ("objects", "materials")
    }
    return msgspec.structs.replace(
        record,
        state="done",
        error=None,
        metrics=metrics,
        lpips_reason=scores.get("lpips_reason"),
        mesh_reason=scores.get("mesh_fscore_1_reason"),
        views={
            name: {m.key: of[m.key] for m in COLUMNS if m.key in of} for name, of in scores["views"].items()
        },
        **parts,
    )
