"""The page over all captures of a batch, and the same as CSV."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from polarguide.core.errors import PolarguideError
from polarguide.core.files import write_text
from polarguide.experiments.collection import INSPECTION, RUN, SHARE, CaptureRecord
from polarguide.experiments.tables import formatted
from polarguide.experiments.writing import csv_text
from polarguide.inspection.report import FILE as INSPECTION_PAGE
from polarguide.results.evaluation.record import read_metrics
from polarguide.results.evaluation.table import COLUMNS, Metric
from polarguide.runs.health import Health
from polarguide.visualization.pages import page

PAGE, TABLE = "index.html", "results.csv"


@dataclass(frozen=True)
class Row:
    """A capture on the page.

    Attributes:
        name, source: of the capture. folder: of its results. state: "done", "failed" or "waiting".
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
        """What the inspection found, and what the training says of itself."""
        if self.record is None:
            return ()
        health = Health.load(self.folder / RUN) if "train" in self.record.done else None
        own = () if health is None else (f"polarization: {health.polarization.text}", *health.warnings)
        return (*self.record.findings, *own)

    def links(self) -> list[tuple[str, str]]:
        """Label and path of what there is, from the folder of all."""
        at = f"{self.folder.parent.name}/{self.folder.name}"
        done = () if self.record is None else self.record.done
        named = [("inspection", f"{INSPECTION}/{INSPECTION_PAGE}")] if "inspect" in done else []
        named += [("where the errors are", f"{RUN}/errors.png")] if "eval" in done else []
        named += [("scene", SHARE)] if "share" in done else []
        named += [] if self.record is None else [(Path(file).name, file) for file in self.record.files]
        return [(label, f"{at}/{path}") for label, path in named if (self.folder / path).exists()]


def write_page(out: Path, rows: Sequence[Row]) -> None:
    """Write ``index.html`` and ``results.csv``, each in one step."""
    scores = {row.name: row.scores() for row in rows}
    columns = [
        column
        for column in COLUMNS
        if column.shown == "tables" and any(of.get(column.key) is not None for of in scores.values())
    ]
    write_text(out / PAGE, batch_html(rows, scores, columns))
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


def batch_html(rows: Sequence[Row], scores: dict[str, dict[str, Any]], columns: Sequence[Metric]) -> str:
    """The page; all names and texts in it are escaped. It links to files in the captures' folders."""
    counts = {state: sum(row.state == state for row in rows) for state in ("done", "failed", "waiting")}
    return page(
        "polarguide.experiments",
        "batch.html",
        title=f"{len(rows)} captures",
        summary=", ".join(f"{count} {state}" for state, count in counts.items() if count),
        columns=columns,
        rows=[
            {
                "row": row,
                "pictures": () if row.record is None else row.record.pictures,
                "verdict": "" if row.record is None else row.record.verdict,
                "cells": [_cell(scores[row.name].get(column.key), column) for column in columns],
                "remarks": row.remarks(),
                "links": row.links(),
            }
            for row in rows
        ],
    )


def _cell(value: float | None, column: Metric) -> str:
    return "" if value is None else formatted(value, column)
