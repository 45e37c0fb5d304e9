"""``polarguide batch``: each capture of a collection from its files to its exports, and one page over all."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from polarguide.capture.layout import find_layout, refuse_scene
from polarguide.core.errors import PolarguideError
from polarguide.core.files import check_out, make_folder, require_inside, write_text
from polarguide.core.options import ComputeOptions, PathLike, SceneOptions
from polarguide.core.progress import SILENT, Reporter
from polarguide.inspection.report import FILE as INSPECTION_PAGE
from polarguide.preparation.settings import PrepareSettings
from polarguide.raster import choose_backend
from polarguide.recipes import recipe_named
from polarguide.results.evaluation.record import read_metrics
from polarguide.results.evaluation.table import COLUMNS
from polarguide.runs.folder import CHECKPOINT, RunConfiguration
from polarguide.training.settings import TrainSettings
from polarguide.visualization.pages import page
from polarguide_bench.collection import (
    INSPECTION,
    RECORD,
    RUN,
    SHARE,
    STEPS,
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

PAGE = "index.html"
TABLE = "results.csv"


@dataclass(frozen=True)
class CaptureRow:
    """A capture on the page.

    Attributes:
        name, source: those of the capture. folder: folder of its results. state: "done", "failed" or "waiting".
        error: why it failed, in one line. record: how far it is.
    """

    name: str
    source: str
    folder: Path
    state: str
    error: str
    record: CaptureRecord | None

    def scores(self) -> dict[str, Any]:
        """By metric; empty before they are there."""
        if self.record is None or "eval" not in self.record.done:
            return {}
        try:
            return dict(read_metrics(self.folder / RUN))
        except (OSError, PolarguideError):  # it was removed
            return {}

    def remarks(self) -> tuple[str, ...]:
        """Findings of the inspection, and warnings of the training."""
        if self.record is None:
            return ()
        polarization, own = recorded_health(self.folder / RUN) if "train" in self.record.done else (None, ())
        evidence = () if polarization is None else (f"polarization: {polarization}",)
        return (*self.record.findings, *evidence, *own)

    def links(self) -> list[tuple[str, str]]:
        """Label and path of what there is, from the folder of all."""
        at = f"{self.folder.parent.name}/{self.folder.name}"
        if self.record is None:
            return []
        made_by = {
            "inspect": ("inspection", f"{INSPECTION}/{INSPECTION_PAGE}"),
            "eval": ("where the errors are", f"{RUN}/errors.png"),
            "share": ("scene", SHARE),
        }
        named = [link for step, link in made_by.items() if step in self.record.done]
        named += [(Path(file).name, file) for file in self.record.files]
        return [(label, f"{at}/{path}") for label, path in named if (self.folder / path).exists()]


def write_page(out: Path, rows: Sequence[CaptureRow]) -> None:
    """Write ``index.html`` and ``results.csv``, each in one step. The page links to files in the captures' folders."""
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
            {
                "row": row,
                "pictures": () if row.record is None else row.record.pictures,
                "verdict": "" if row.record is None else row.record.verdict,
                "cells": [formatted(scores[row.name].get(column.key), column) for column in columns],
                "remarks": row.remarks(),
                "links": row.links(),
            }
            for row in rows
        ],
    )
    write_text(out / PAGE, html)
    frame = pd.DataFrame(
        [
            {
                "name": row.name,
                "path": row.source,
                "state": row.state,
                "verdict": "" if row.record is None else row.record.verdict,
                **{column.key: scores[row.name].get(column.key) for column in columns},
                "error": row.error,
            }
            for row in rows
        ]
    )
    write_text(out / TABLE, csv_text(frame))


CAPTURES = "captures"
"""Folder of the captures' folders."""
WORK_BYTES = 2_000_000_000
"""Memory that a job of SLURM or PBS asks for: sizes of captures are not known before they are prepared."""


@dataclass(frozen=True)
class Capture:
    """A capture of a collection, and what to do with it.

    Attributes:
        name: name of its folder in the results. path: its files, or a scene.
        prepare: how to prepare it; not used for a scene.
        recipe, settings, reading: those of its training.
    """

    name: str
    path: Path
    prepare: PrepareSettings = field(default_factory=PrepareSettings)
    recipe: str = "polarguide-stokes"
    settings: TrainSettings = TrainSettings()
    reading: SceneOptions = SceneOptions()


def run_batch(
    captures: Sequence[Capture],
    out: PathLike,
    options: BatchOptions,
    *,
    reporter: Reporter = SILENT,
) -> list[CaptureRow]:
    """Prepare, inspect, train, score, share and export every capture, each in a process of its own.

    Writes a folder for each to ``captures/`` of ``out``, and ``index.html`` and ``results.csv`` over all whenever one
    has ended. One that fails is a row with its error; the others go on. What is done is found again and not repeated;
    KeyboardInterrupt is passed on after trainings have saved their state, and the same call goes on with them.

    Args:
        captures: with names of their own.
        out: folder to write.
        options: where to compute, and what to export.
        reporter: receives messages and progress.

    Returns:
        The rows of the page.

    Raises:
        PolarguideError: no capture, a recipe that does not exist, or another batch at work in ``out``.
    """
    if not captures:
        raise PolarguideError("batch", expected="a capture", found="none", remedy="Name at least one.")
    for capture in captures:
        recipe_named(capture.recipe)
    root = Path(out)
    check_out(root)
    refuse_scene(root)
    gpus = own_gpus(choose_backend(options.device)) if options.local else ()
    make_folder(root / CAPTURES)
    tasks = {capture.name: _task(capture, root, options) for capture in captures}
    require_inside(root, *(Path(task.folder) for task in tasks.values()))
    with locked(root, "batch"):
        failures: dict[str, str] = {}
        rows = _rows(tasks, failures)
        todo = [task for task, row in zip(tasks.values(), rows, strict=True) if row.state != "done"]
        reporter.say(f"captures: {len(tasks)}, of them finished before: {len(tasks) - len(todo)}")

        def end(job: Job, error: str | None) -> None:
            if error is not None:
                failures[job.label] = error
            write_page(root, _rows(tasks, failures))

        write_page(root, rows)
        count = jobs_at_a_time(options, max(1, len(todo)), 0, gpus)
        if todo:
            with workers(
                options, count=count, threads=options.threads, memory=WORK_BYTES, gpus=gpus, reporter=reporter
            ) as at:
                run_jobs([_job(task) for task in todo], at, reporter=reporter, on_end=end)
        return _rows(tasks, failures)


def is_scene(folder: Path) -> bool:
    """Whether a folder is a scene with poses, which needs no preparation."""
    with contextlib.suppress(PolarguideError, OSError):
        return (folder / "sparse").is_dir() and bool(find_layout(folder))
    return False


def _task(capture: Capture, root: Path, options: BatchOptions) -> Processing:
    path = capture.path.absolute()
    folder = (root / CAPTURES / capture.name).absolute()
    stamp = source_stamp(path)
    earlier = None
    with contextlib.suppress(PolarguideError):  # the child says what is wrong with its record
        earlier = CaptureRecord.load(folder)
    request = Request(
        source=str(path),
        stamp=stamp,
        prepare=None if is_scene(path) else capture.prepare.record(),
        recipe=capture.recipe,
        settings=capture.settings,
        reading=capture.reading,
        formats=options.formats,
        digest=source_digest(path, None if earlier is None else earlier.request, stamp),
    )
    return Processing(capture.name, str(folder), request, ComputeOptions(options.threads, options.device))


def _job(task: Processing) -> Job:
    """The job that processes a capture. It counts as one piece of work, since its steps take very different times."""
    folder = Path(task.folder)

    def progress() -> tuple[int, str]:
        try:
            record = CaptureRecord.load(folder)
        except PolarguideError:  # the child says what is wrong with it
            return 0, ""
        if record is None or record.at is None:
            return 0, ""
        note = f"{record.at} ({STEPS.index(record.at) + 1} of {len(STEPS)})"
        with contextlib.suppress(OSError, PolarguideError):  # it is about to be written
            if record.at == "train":
                steps = RunConfiguration.load(folder / RUN).settings.steps
                step, words = training_progress(folder / RUN, steps)
                note = f"{note}: {step:,}/{steps:,}  {words}"
        return 0, note

    saved = (folder / RECORD, folder / RUN / CHECKPOINT)
    return Job(task.name, folder, lambda: (task,), 1, progress, saved)


def _rows(tasks: dict[str, Processing], failures: dict[str, str]) -> list[CaptureRow]:
    """A row for each capture, by what its folder holds."""
    rows = []
    for name, task in tasks.items():
        folder = Path(task.folder)
        error = failures.get(name, "")
        record = None
        try:
            record = CaptureRecord.load(folder)
            if record is not None:
                record.require(task.request, folder)
        except PolarguideError as problem:
            error = error or str(problem)
        state = "failed" if error else "waiting"
        if record is not None and not error and set(record.done) == set(STEPS):
            state = "done"
        rows.append(CaptureRow(name, task.request.source, folder, state, error, record))
    return rows
