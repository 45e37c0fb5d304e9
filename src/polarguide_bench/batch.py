"""The verb ``polarguide batch``, which processes each capture of a collection and writes an overview page."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import pandas as pd

from polarguide.capture.layout import is_posed_scene, refuse_scene
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import check_out, make_folder, require_inside, write_text
from polarguide.core.options import ComputeOptions, PathLike
from polarguide.core.progress import SILENT, Reporter
from polarguide.inspection.inspect import FILE as INSPECTION_PAGE
from polarguide.methods import recipe_named
from polarguide.raster import choose_backend
from polarguide.results.evaluation.evaluate import read_metrics
from polarguide.results.evaluation.table import COLUMNS
from polarguide.runs.folder import CHECKPOINT, RunConfiguration
from polarguide.visualization.pages import page
from polarguide_bench.children import (
    FORMAT,
    INSPECTION,
    RECORD,
    RUN,
    SHARE,
    STEPS,
    Capture,
    CaptureRecord,
    Processing,
    Request,
    source_digest,
    source_stamp,
)
from polarguide_bench.compare import locked
from polarguide_bench.job_queue import Job, run_jobs, training_progress, workers
from polarguide_bench.options import BatchOptions
from polarguide_bench.plan import folder_of_recipe, jobs_at_a_time, own_gpus
from polarguide_bench.report import recorded_health
from polarguide_bench.tables import csv_text, formatted


@dataclass(frozen=True)
class CaptureRow:
    """Row of the overview page, which describes one capture with one recipe.

    Attributes:
        name: name of the capture.
        recipe: name of the recipe.
        source: path of its files.
        folder: folder of its results.
        state: "done", "failed" or "waiting".
        error: reason of a failure, in one line.
        record: progress and results of the capture.
    """

    name: str
    recipe: str
    source: str
    folder: Path
    state: str
    error: str
    record: CaptureRecord

    def scores(self) -> dict[str, Any]:
        """Return the scores by metric; empty before the evaluation."""
        if "eval" in self.record.done:
            with contextlib.suppress(OSError, PolarguideError):  # the user may have removed the file
                return dict(read_metrics(self.folder / RUN))
        return {}

    def remarks(self) -> tuple[str, ...]:
        """Return the findings of the inspection and the warnings of the training."""
        polarization, warnings = (
            recorded_health(self.folder / RUN) if "train" in self.record.done else (None, ())
        )
        evidence = () if polarization is None else (f"polarization: {polarization}",)
        return (*self.record.findings, *evidence, *warnings)

    def links(self) -> list[tuple[str, str]]:
        """Return the label of each existing result, and its path relative to the page."""
        results = {
            "inspect": ("inspection", f"{INSPECTION}/{INSPECTION_PAGE}"),
            "eval": ("where the errors are", f"{RUN}/errors.png"),
            "share": ("scene", SHARE),
        }
        named = [link for step, link in results.items() if step in self.record.done]
        named += [(Path(file).name, file) for file in self.record.files]
        at = f"{self.folder.parent.name}/{self.folder.name}"
        return [(label, f"{at}/{path}") for label, path in named if (self.folder / path).exists()]


def write_page(out: Path, rows: Sequence[CaptureRow]) -> None:
    """Write ``index.html`` and ``results.csv`` atomically. The page links to files in the folders of the captures."""
    scores = {(row.name, row.recipe): row.scores() for row in rows}
    columns = [
        column
        for column in COLUMNS
        if column.shown == "tables" and any(of.get(column.key) is not None for of in scores.values())
    ]
    counts = Counter(row.state for row in rows)
    html = page(
        "polarguide_bench",
        "batch.html",
        title=f"{len({row.name for row in rows})} captures",
        summary=", ".join(
            f"{counts[state]} {state}" for state in ("done", "failed", "waiting") if counts[state]
        ),
        columns=columns,
        several=len(rows) > len({row.name for row in rows}),
        rows=[
            (row, [formatted(scores[row.name, row.recipe].get(column.key), column) for column in columns])
            for row in rows
        ],
    )
    write_text(out / "index.html", html)
    frame = pd.DataFrame(
        [
            {
                "name": row.name,
                "recipe": row.recipe,
                "path": row.source,
                "state": row.state,
                "verdict": row.record.verdict,
                **{column.key: scores[row.name, row.recipe].get(column.key) for column in columns},
                "error": row.error,
            }
            for row in rows
        ]
    )
    write_text(out / "results.csv", csv_text(frame))


CAPTURES = "captures"
"""Name of the folder that contains the folders of all captures, for the first recipe of each."""
WORK_BYTES = 2_000_000_000
"""Memory request of a job of SLURM or PBS. The size of a capture is unknown before its preparation."""


def run_batch(
    captures: Sequence[Capture],
    out: PathLike,
    options: BatchOptions,
    *,
    reporter: Reporter = SILENT,
) -> list[CaptureRow]:
    """Prepare, inspect, train, score, share and export each capture in its own process.

    Each capture has a folder in ``captures/`` of ``out``. It contains the results of the first recipe; those of another
    recipe are in ``captures-RECIPE/``. ``index.html`` and ``results.csv`` list all captures and are
    updated at the end of each. A failed capture is a row with its error and does not affect others. Finished steps are
    not repeated. After a KeyboardInterrupt trainings save their states, and the same call resumes.

    Args:
        captures: captures with unique names.
        out: output folder.
        options: options of the computation, and formats of the export.
        reporter: receives messages and progress.

    Returns:
        The rows of the page.

    Raises:
        PolarguideError: there are no captures, a recipe is unknown, or another batch is writing to ``out``.
    """
    require(
        captures, "batch", expected="a capture", found="no capture", remedy="Specify at least one capture."
    )
    for capture in captures:
        for recipe in capture.recipes:
            recipe_named(recipe)
        require(
            len(set(capture.recipes)) == len(capture.recipes) > 0,
            f"{capture.name} (recipe)",
            expected="different recipes, at least one",
            found=" ".join(capture.recipes) or "none",
            remedy="List each recipe once.",
        )
    root = Path(out)
    check_out(root)
    refuse_scene(root)
    gpus = own_gpus(choose_backend(options.device)) if options.local else ()
    make_folder(root / CAPTURES)
    tasks = [_tasks(capture, root, options) for capture in captures]
    require_inside(root, *(Path(task.folder) for of in tasks for task in of))
    with locked(root, "batch"):
        failures: dict[str, str] = {}

        def rows() -> list[CaptureRow]:
            return [_row(task, failures) for of in tasks for task in of]

        unfinished = {row.name for row in rows() if row.state != "done"}
        todo = [of for of in tasks if of[0].name in unfinished]
        reporter.say(f"captures: {len(tasks)}, of them finished before: {len(tasks) - len(todo)}")

        def end(job: Job, error: str | None) -> None:
            if error is not None:
                failures[job.label] = error
            write_page(root, rows())

        write_page(root, rows())
        count = jobs_at_a_time(options, max(1, len(todo)), 0, gpus)
        if todo:
            with workers(
                options, count=count, threads=options.threads, memory=WORK_BYTES, gpus=gpus, reporter=reporter
            ) as at:
                run_jobs([_job(of) for of in todo], at, reporter=reporter, on_end=end)
        return rows()


def _tasks(capture: Capture, root: Path, options: BatchOptions) -> tuple[Processing, ...]:
    """Return a task for each recipe. The first one prepares and inspects the scene, which the others train on."""
    path = capture.path.absolute()
    folders = [
        (root / (f"{CAPTURES}-{folder_of_recipe(recipe)}" if number else CAPTURES) / capture.name).absolute()
        for number, recipe in enumerate(capture.recipes)
    ]
    stamp = source_stamp(path)
    earlier = None
    with contextlib.suppress(PolarguideError):  # the child reports an invalid record
        earlier = CaptureRecord.load(folders[0])
    request = Request(
        source=str(path),
        stamp=stamp,
        prepare=None if is_posed_scene(path) else capture.prepare.record(),
        recipe=capture.recipes[0],
        settings=capture.settings,
        reading=capture.reading,
        formats=options.formats,
        digest=source_digest(path, None if earlier is None else earlier.request, stamp),
    )
    compute = ComputeOptions(options.threads, options.device)
    return tuple(
        Processing(
            capture.name,
            str(folder),
            msgspec.structs.replace(request, recipe=recipe),
            compute,
            first=str(folders[0]) if folder != folders[0] else "",
        )
        for recipe, folder in zip(capture.recipes, folders, strict=True)
    )


def _job(tasks: Sequence[Processing]) -> Job:
    """Return the job that processes a capture. It counts as one unit of work, because its steps differ in length."""
    folders = [Path(task.folder) for task in tasks]

    def progress() -> tuple[int, str]:
        note = ""
        with contextlib.suppress(
            OSError, PolarguideError
        ):  # a missing or invalid file, which the child reports
            for task, folder in zip(tasks, folders, strict=True):
                record = CaptureRecord.load(folder)
                if record is None or record.at is None:
                    break
                note = f"{record.at} ({STEPS.index(record.at) + 1} of {len(STEPS)})"
                note += f", {task.request.recipe}" if len(tasks) > 1 else ""
                if record.at == "train":
                    steps = RunConfiguration.load(folder / RUN).settings.steps
                    step, quality = training_progress(folder / RUN, steps)
                    note = f"{note}: {step:,}/{steps:,}  {quality}"
        return 0, note

    saved = [folder / name for folder in folders for name in (RECORD, f"{RUN}/{CHECKPOINT}")]
    return Job(tasks[0].name, folders[0], lambda: tuple(tasks), 1, progress, tuple(saved))


def _row(task: Processing, failures: dict[str, str]) -> CaptureRow:
    """Return the row of a task from the files in its folder. The failure of a capture affects unfinished tasks."""
    folder = Path(task.folder)
    record = CaptureRecord(FORMAT, task.request)
    error = ""
    try:
        record = CaptureRecord.load(folder) or record
        record.require(task.request, folder)
    except PolarguideError as problem:
        error = str(problem)
    finished = set(record.done) == set(STEPS)
    if not finished:
        error = failures.get(task.name, error)
    state = "failed" if error else "done" if finished else "waiting"
    return CaptureRow(task.name, task.request.recipe, task.request.source, folder, state, error, record)
