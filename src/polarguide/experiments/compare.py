"""Train and score several recipes on several scenes, and set tables and a report of them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from polarguide.capture.layout import refuse_scene
from polarguide.errors import PolarguideError
from polarguide.experiments.collect import BESIDE_OTHERS, collect, write_tables
from polarguide.experiments.exposure_figure import write_exposure_figure
from polarguide.experiments.jobs import STDERR, Job, run_jobs
from polarguide.experiments.options import MOST_SEEDS, CompareOptions
from polarguide.experiments.plan import Comparison, PlannedRun, SceneEntry, plan_runs, scene_entries
from polarguide.experiments.report import write_report
from polarguide.experiments.results import Results
from polarguide.experiments.study import write_study
from polarguide.experiments.worker import Scoring, Task, Training
from polarguide.files import check_out, make_folder, require_inside, write_text
from polarguide.options import ComputeOptions, PathLike, check_choice, check_count
from polarguide.progress import SILENT, Reporter
from polarguide.raster import choose_backend
from polarguide.recipes import recipe_named
from polarguide.system import only_writer
from polarguide.training.recipe import Method
from polarguide.training.settings import TrainSettings

LOCK = ".lock"


def compare(
    scenes: Sequence[PathLike],
    recipes: Sequence[str | Method],
    out: PathLike,
    *,
    settings: TrainSettings = TrainSettings(),
    options: CompareOptions = CompareOptions(),
    seeds_of: Mapping[str, int] = MappingProxyType({}),
    steps_of: Mapping[str, int] = MappingProxyType({}),
    asked: str = "",
    reporter: Reporter = SILENT,
) -> Results:
    """Train and score every recipe on every scene with every seed, each run in processes of its own.

    Writes ``results.json``, ``.md``, ``.csv``, ``.tex`` and ``report.html`` to ``out``, and the runs to its ``runs/``;
    paired differences go to ``differences.csv``, scores by object and material to ``parts.csv``, where there are any;
    with ``options.exposures``, ``exposures.svg`` has the scores over the number of pictures taken.
    Finished runs are found again and not repeated. KeyboardInterrupt is passed on after the runs at work have saved
    their state; the same call goes on with them.

    Args:
        scenes: scene folders with names of their own.
        recipes: the methods in the order of the tables, by name, or as they are registered.
        out: folder to write.
        settings: of each training; ``seed`` is the first of ``options.seeds``. None takes 5,000 steps, since those of
            scenes of different sizes are to be comparable; the rest as ``train`` does for every scene.
        options: how runs are trained, timed and shown.
        seeds_of: by the name of a recipe, how many seeds where that is not ``options.seeds``.
        steps_of: by the name of a recipe, how many steps where that is not ``settings.steps``.
        asked: the command line that asked, for the record, if not ``polarguide compare``.
        reporter: receives messages and progress.

    Returns:
        The record as written. A run that failed is in it, with its error; the others are not affected.

    Raises:
        PolarguideError: wrong input, or another comparison at work in ``out``.
    """
    comparison = Comparison(
        scenes=tuple(Path(scene) for scene in scenes),
        recipes=_checked_recipes(recipes),
        settings=settings,
        options=options,
        out=Path(out),
        seeds_of=dict(seeds_of),
        steps_of=dict(steps_of),
        asked=asked,
    )
    for name, count in seeds_of.items():
        check_choice("seeds_of", name, [recipe.name for recipe in comparison.recipes])
        check_count("seeds_of", count, 1, MOST_SEEDS)
    for name, count in steps_of.items():
        check_choice("steps", name, [recipe.name for recipe in comparison.recipes])
        check_count("steps", count)
    if not scenes:
        raise PolarguideError("compare", expected="a scene", found="none", remedy="Name at least one scene.")
    check_out(comparison.out)
    refuse_scene(comparison.out)
    if options.against is not None:
        check_choice("against", options.against, [row.name for row in comparison.rows])
    choose_backend(options.device)
    entries = scene_entries(comparison, reporter)
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
        write_study(comparison.out, results, {entry.name: entry.path for entry in entries})
        write_exposure_figure(comparison, results)
    return results


def _checked_recipes(recipes: Sequence[str | Method]) -> tuple[Method, ...]:
    """The recipes as they are registered: runs are trained in other processes, which know recipes by name."""
    found = tuple(recipe_named(recipe if isinstance(recipe, str) else recipe.name) for recipe in recipes)
    for asked, known in zip(recipes, found, strict=True):
        if isinstance(asked, Method) and asked != known:
            raise PolarguideError(
                "recipes",
                expected=f"the registered recipe {known.name}",
                found="one of this name with other values",
                remedy="Give it a name of its own, and register it under the entry points polarguide.recipes.",
            )
    if not found:
        raise PolarguideError(
            "compare", expected="a recipe", found="none", remedy="Name at least one recipe."
        )
    names = [recipe.name for recipe in found]
    if len(set(names)) < len(names):
        raise PolarguideError(
            "recipes", expected="every name once", found=" ".join(names), remedy="Name each once."
        )
    return found


def _train(
    comparison: Comparison, scenes: Sequence[SceneEntry], plan: Sequence[PlannedRun], reporter: Reporter
) -> dict[Path, str]:
    """Train and score what is missing; the last words of what failed, by run folder."""
    wanted = [run for run in plan if run.state() != "done"]
    parallel = min(comparison.options.parallel, len(wanted))
    reporter.say(f"runs: {len(plan)}, of them finished before: {len(plan) - len(wanted)}")
    jobs = [_job(comparison, run, alone=parallel == 1) for run in wanted]
    failures: dict[Path, str] = {}
    if not jobs:
        return failures

    def end(job: Job, error: str | None) -> None:
        if error is None:
            (job.folder / STDERR).unlink(missing_ok=True)
        else:
            failures[job.folder] = error
        write_tables(comparison.out, collect(comparison, scenes, plan, failures))

    try:
        run_jobs(jobs, parallel=parallel, reporter=reporter, on_end=end)
    except KeyboardInterrupt:
        reporter.say("The runs at work have saved their state: the same comparison goes on with them.")
        raise
    return failures


def _job(comparison: Comparison, run: PlannedRun, *, alone: bool) -> Job:
    """The tasks that finish a run."""
    state, compute = run.state(), _compute(comparison)
    tasks: list[Task] = []
    if state in ("new", "begun"):
        if not alone:
            make_folder(run.folder)
            write_text(run.folder / BESIDE_OTHERS, "Trained beside other runs: its seconds do not count.\n")
        tasks.append(
            Training(
                scene=str(run.scene.path),
                folder=str(run.folder),
                recipe=run.recipe.name,
                settings=run.settings,
                reading=run.reading,
                compute=compute,
                resume=state == "begun",
            )
        )
    tasks.append(Scoring(str(run.folder), alone, compute))
    return Job(run.label, run.folder, tuple(tasks), run.steps)


def _compute(comparison: Comparison) -> ComputeOptions:
    return ComputeOptions(comparison.options.threads, comparison.options.device)


def _time(comparison: Comparison, plan: Sequence[PlannedRun], reporter: Reporter) -> None:
    """Time the pictures of finished runs that have not been timed alone, one after the other."""
    untimed = [run for run in plan if (record := run.metrics()) is not None and record["fps"] is None]
    if not untimed:
        return
    reporter.say(f"timing the pictures of {len(untimed)} runs, one after the other")
    jobs = [
        Job(run.label, run.folder, (Scoring(str(run.folder), True, _compute(comparison)),), run.steps)
        for run in untimed
    ]
    run_jobs(jobs, parallel=1, reporter=reporter)
    missed = [run for run in untimed if (record := run.metrics()) is None or record["fps"] is None]
    if missed:
        reporter.warn(f"no speed for {len(missed)} runs: they failed, or were not alone on the machine.")


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep two comparisons out of an existing folder. Children inherit the lock and hold it if the parent is killed."""
    with only_writer(
        folder / LOCK,
        expected="a folder that nobody is writing to",
        found="another comparison at work in it",
    ):
        yield
