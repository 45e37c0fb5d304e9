"""``polarguide eval``."""

from __future__ import annotations

import importlib
from typing import Any

from rich.table import Table

from polarguide.cli.console import console
from polarguide.cli.runs import RunFolder, opened
from polarguide.options import ComputeOptions


def evaluate(
    run: RunFolder,
    /,
    *,
    speed: bool = True,
    compute: ComputeOptions = ComputeOptions(),
) -> None:
    """Score a run on its test views and write RUN/metrics.json.

    Args:
        run: Run folder.
        speed: Measure frames a second; --speed makes sense only while nothing else runs.
    """
    trained, reporter = opened(run, compute)
    record = trained.evaluate(speed=speed, reporter=reporter)
    title = (
        f"{trained.configuration.recipe} on {trained.scene.name}: mean of {len(record['views'])} test views"
    )
    console.print(_table(record, title))
    console.print(f"metrics: {run / 'metrics.json'}")


def _table(record: dict[str, Any], title: str) -> Table:
    table = Table(title=title)
    table.add_column("metric")
    table.add_column("value", justify="right")
    for label, text in importlib.import_module("polarguide.evaluation.table").shown_metrics(record):
        table.add_row(label, text)
    return table
