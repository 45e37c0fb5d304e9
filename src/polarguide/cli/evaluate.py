"""``polarguide eval``."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.table import Table

import polarguide
from polarguide.cli.console import console
from polarguide.cli.progress import REPORTER
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
    polarguide.use_threads(compute.threads)
    opened = polarguide.open_run(run, device=compute.device, reporter=REPORTER)
    record = opened.evaluate(speed=speed, reporter=REPORTER)
    title = f"{opened.configuration.recipe} on {opened.scene.name}: mean of {len(record['views'])} test views"
    console.print(_table(record, title))
    console.print(f"metrics: {run / 'metrics.json'}")


def _table(record: dict[str, Any], title: str) -> Table:
    table = Table(title=title)
    table.add_column("metric")
    table.add_column("value", justify="right")
    for key, label, unit in importlib.import_module("polarguide.evaluation.evaluate").SHOWN_KEYS:
        value = record[key]
        text = "n/a" if value is None else f"{value:,}" if isinstance(value, int) else f"{value:.3f}"
        table.add_row(label, f"{text} {unit}".rstrip())
    lpips = record["lpips"]
    table.add_row("LPIPS", f"{lpips:.3f}" if lpips is not None else f"n/a ({record['lpips_reason']})")
    return table
