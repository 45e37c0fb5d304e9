"""``polarguide eval``."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.table import Table

import polarguide
from polarguide.cli.console import console
from polarguide.cli.progress import ConsoleReporter
from polarguide.cli.threads import use_threads
from polarguide.options import ComputeOptions


def evaluate(
    run: Annotated[Path, tyro.conf.Positional],
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
    use_threads(compute.threads)
    reporter = ConsoleReporter()
    opened = polarguide.open_run(run, device=compute.device, reporter=reporter)
    record = opened.evaluate(speed=speed, reporter=reporter)
    title = f"{opened.configuration.recipe} on {opened.scene.name}: mean of {len(record['views'])} test views"
    console.print(_table(record, title))
    console.print(f"metrics: {run / 'metrics.json'}")


def _table(record: dict[str, Any], title: str) -> Table:
    table = Table(title=title)
    table.add_column("metric")
    table.add_column("value", justify="right")
    for label, text in importlib.import_module("polarguide.evaluation.table").shown_metrics(record):
        table.add_row(label, text)
    return table
