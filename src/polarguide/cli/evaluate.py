"""``polarguide eval``."""

from __future__ import annotations

import importlib
from typing import Any

from rich.table import Table
from rich.text import Text

from polarguide.cli.console import RunFolder, console, opened, say, warn
from polarguide.core.options import ComputeOptions
from polarguide.core.text import printable

_MOST_OBJECTS = 100
"""Lines of the table: a terminal takes minutes to lay out the most that a scene may have."""


def evaluate(
    run: RunFolder,
    /,
    *,
    speed: bool = True,
    compute: ComputeOptions = ComputeOptions(),
) -> None:
    """Score a run on its test views and write RUN/metrics.json, and RUN/errors.png, where the errors are.

    Args:
        run: Run folder.
        speed: Measure frames a second; --speed makes sense only while nothing else runs.
    """
    trained, reporter = opened(run, compute)
    record = trained.evaluate(speed=speed, reporter=reporter)
    title = (
        f"{trained.configuration.recipe} on {trained.scene.name}: mean of {len(record['views'])} test views"
    )
    print_scores(record, title)
    health = trained.health
    for warning in () if health is None else health.warnings:
        warn(warning)
    say(f"polarization: {trained.polarization}")
    say("health: not recorded, the training was not checked" if health is None else health.summary)
    sheet = importlib.import_module("polarguide.results.evaluation.error_sheet").ERRORS_FILE
    say(f"metrics: {run / 'metrics.json'}")
    say(f"where the errors are: {run / sheet}")


def print_scores(record: dict[str, Any], title: str) -> None:
    """Print a run's record as tables: its metrics, and its errors by object and material."""
    metrics = importlib.import_module("polarguide.results.evaluation.table")
    table = Table(title=Text(printable(title)))
    table.add_column("metric")
    table.add_column("value", justify="right", overflow="fold")
    for label, text in metrics.shown_metrics(record):
        table.add_row(label, Text(printable(text)))
    console.print(table)
    if absent := metrics.absent_metrics(record):
        say(f"no ground truth, or no such layer, for: {', '.join(absent)}")
    if record["objects"]:
        columns = [metric for metric in metrics.METRICS if metric.key in metrics.OBJECT_METRICS]
        console.print(_errors(record, columns))
        if len(record["objects"]) > _MOST_OBJECTS:
            say(
                f"the {_MOST_OBJECTS} largest of {len(record['objects']):,} objects; metrics.json has all of them"
            )


def _errors(record: dict[str, Any], columns: list[Any]) -> Table:
    """Errors by object and by material, over the pixels of all test views; ``columns``: metrics."""
    table = Table(title="by object and material, over the pixels of all test views")
    table.add_column("object", no_wrap=True)
    table.add_column("pixels", justify="right", no_wrap=True)
    for metric in columns:
        table.add_column(metric.heading, justify="right", min_width=8)
    has_metals = any(errors.get("metal_share") is not None for errors in record["objects"].values())
    if has_metals:
        table.add_column("metal", justify="right", no_wrap=True)

    def add(name: str, errors: dict[str, Any]) -> None:
        values = [errors[metric.key] for metric in columns]
        texts = ["n/a" if v is None else f"{v:.{m.digits}f}" for m, v in zip(columns, values, strict=True)]
        share = errors.get("metal_share")
        texts += ["n/a" if share is None else f"{100 * share:.1f} %"] if has_metals else []
        table.add_row(Text(printable(name)), f"{errors['pixels']:,}", *texts)

    largest = sorted(record["objects"], key=lambda name: -record["objects"][name]["pixels"])[:_MOST_OBJECTS]
    for name in filter(set(largest).__contains__, record["objects"]):
        add(name, record["objects"][name])
    table.add_section()
    for kind, errors in record["materials"].items():
        add(f"all {kind}", errors)
    return table
