"""The verb ``polarguide batch``, which processes each capture of a collection and writes an overview page."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from polarguide.capture.layout import is_posed_scene, refuse_scene
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import check_out, make_folder, require_inside, write_text
from polarguide.core.options import ComputeOptions, PathLike
from polarguide.core.progress import SILENT, Reporter
from polarguide.inspection.report import FILE as INSPECTION_PAGE
from polarguide.raster import choose_backend
from polarguide.recipes import recipe_named
from polarguide.results.evaluation.record import read_metrics
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
from polarguide_bench.plan import jobs_at_a_time, own_gpus
from polarguide_bench.report import recorded_health
from polarguide_bench.tables import csv_text, formatted


@dataclass(frozen=True)
class CaptureRow:
    """Row of the overview page, which describes one capture.

    Attributes:
        name: name of the capture.
        source: path of its files.
        folder: folder of its results.
        state: "done", "failed" or "waiting".
        error: reason of a failure, in one line.
        record: progress and results of the capture.
    """

    name: str
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
    scores = {row.name: row.scores() for row in rows}
    columns = [
        column
        for column in COLUMNS
        if column.shown == "tables" and any(of.get(column.key) is not None for of in scores.values())
    ]
    counts = Counter(row.state for row in rows)
    html = page(
        "polarguide_bench",
        "batch.html",
        title=f"{len(rows)} captures",
        summary=", ".join(
            f"{counts[state]} {state}" for state in ("done", "failed", "waiting") if counts[state]
        ),
        columns=columns,
        rows=[
            (row, [formatted(scores[row.name].get(column.key), column) for column in columns]) for row in rows
        ],
    )
    write_text(out / "index.html", html)
    frame = pd.DataFrame(
        [
            {
                "name": row.name,
                "path": row.source,
                "state": row.state,
                "verdict": row.record.verdict,
                **{column.key: scores[row.name].get(column.key) for column in columns},
                "error": row.error,
            }
            for row in rows
        ]
    )
    write_text(out / "results.csv", csv_text(frame))


CAPTURES = "captures"
"""Name of the folder that contains the folders of all captures."""
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

    Each capture has a folder in ``captures/`` of ``out``. ``index.html`` and ``results.csv`` list all captures and are
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
        recipe_named(capture.recipe)
    root = Path(out)
    check_out(root)
    refuse_scene(root)
    gpus = own_gpus(choose_backend(options.device)) if options.local else ()
    make_folder(root / CAPTURES)
    tasks = [_task(capture, root, options) for capture in captures]
    require_inside(root, *(Path(task.folder) for task in tasks))
    with locked(root, "batch"):
        failures: dict[str, str] = {}
        rows = [_row(task, failures) for task in tasks]
        todo = [task for task, row in zip(tasks, rows, strict=True) if row.state != "done"]
        reporter.say(f"captures: {len(tasks)}, of them finished before: {len(tasks) - len(todo)}")

        def end(job: Job, error: str | None) -> None:
            if error is not None:
                failures[job.label] = error
            write_page(root, [_row(task, failures) for task in tasks])

        write_page(root, rows)
        count = jobs_at_a_time(options, max(1, len(todo)), 0, gpus)
        if todo:
            with workers(
                options, count=count, threads=options.threads, memory=WORK_BYTES, gpus=gpus, reporter=reporter
            ) as at:
                run_jobs([_job(task) for task in todo], at, reporter=reporter, on_end=end)
        return [_row(task, failures) for task in tasks]


def _task(capture: Capture, root: Path, options: BatchOptions) -> Processing:
    path = capture.path.absolute()
    folder = (root / CAPTURES / capture.name).absolute()
    stamp = source_stamp(path)
    earlier = None
    with contextlib.suppress(PolarguideError):  # the child reports an invalid record
        earlier = CaptureRecord.load(folder)
    request = Request(
        source=str(path),
        stamp=stamp,
        prepare=None if is_posed_scene(path) else capture.prepare.record(),
        recipe=capture.recipe,
        settings=capture.settings,
        reading=capture.reading,
        formats=options.formats,
        digest=source_digest(path, None if earlier is None else earlier.request, stamp),
    )
    return Processing(capture.name, str(folder), request, ComputeOptions(options.threads, options.device))


def _job(task: Processing) -> Job:
    """Return the job that processes a capture. It counts as one unit of work, because its steps differ in length."""
    folder = Path(task.folder)

    def progress() -> tuple[int, str]:
        note = ""
        with contextlib.suppress(
            OSError, PolarguideError
        ):  # a missing or invalid file, which the child reports
            record = CaptureRecord.load(folder)
            if record is not None and record.at is not None:
                note = f"{record.at} ({STEPS.index(record.at) + 1} of {len(STEPS)})"
                if record.at == "train":
                    steps = RunConfiguration.load(folder / RUN).settings.steps
                    step, quality = training_progress(folder / RUN, steps)
                    note = f"{note}: {step:,}/{steps:,}  {quality}"
        return 0, note

    return Job(task.name, folder, lambda: (task,), 1, progress, (folder / RECORD, folder / RUN / CHECKPOINT))


def _row(task: Processing, failures: dict[str, str]) -> CaptureRow:
    """Return the row of a capture from the files in its folder."""
    folder = Path(task.folder)
    error = failures.get(task.name, "")
    record = CaptureRecord(FORMAT, task.request)
    try:
        record = CaptureRecord.load(folder) or record
        record.require(task.request, folder)
    except PolarguideError as problem:
        error = error or str(problem)
    finished = "done" if set(record.done) == set(STEPS) else "waiting"
    return CaptureRow(task.name, task.request.source, folder, "failed" if error else finished, error, record)
