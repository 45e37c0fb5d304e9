"""The runs of a comparison -> its record and tables on disk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path

from polarguide import __version__
from polarguide.evaluation.sources import commit, scoring_digest
from polarguide.evaluation.table import COLUMNS
from polarguide.experiments.aggregate import RunRecord, aggregate
from polarguide.experiments.plan import Comparison, PlannedRun, SceneEntry
from polarguide.experiments.results import FORMAT, Results, validate_results, write_results
from polarguide.experiments.tables import csv_text, latex, markdown
from polarguide.files import write_text

BESIDE_OTHERS = "beside_others.txt"
"""Marks a run folder whose training shared the machine, so that its seconds do not count."""

TITLE = "# Comparison\n\n"


def collect(
    comparison: Comparison,
    scenes: Sequence[SceneEntry],
    plan: Sequence[PlannedRun],
    failures: Mapping[Path, str],
) -> Results:
    """The record of a comparison as far as its runs are.

    Args:
        comparison, scenes, plan: what was asked for.
        failures: last words of runs that failed, by their folders.
    """
    runs = [_run_record(comparison, run, failures.get(run.folder)) for run in plan]
    recipes = [recipe.name for recipe in comparison.recipes]
    record = Results(
        format=FORMAT,
        provenance={
            "version": __version__,
            "commit": commit(),
            "sources": scoring_digest(),
            "command": comparison.command,
            "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        },
        settings={
            "steps": comparison.settings.steps,
            "seeds": comparison.options.seeds,
            "downscale": comparison.options.downscale,
            "transfer": comparison.options.transfer,
            "refractive_index": comparison.settings.refractive_index,
            "threads": comparison.options.threads,
            "jobs": comparison.options.parallel,
        },
        scenes=[
            {"name": s.name, "digest": s.digest, "views": s.views, "test_views": list(s.test_views)}
            for s in scenes
        ],
        recipes=[
            {"name": recipe.name, "about": recipe.about, "data": recipe.data()}
            for recipe in comparison.recipes
        ],
        runs=runs,
        table=aggregate(runs, [scene.name for scene in scenes], recipes),
    )
    return validate_results(record)


def _run_record(comparison: Comparison, run: PlannedRun, failure: str | None) -> RunRecord:
    record = run.metrics() if run.state() == "done" else None
    metrics = None
    if record is not None:
        metrics = {m.key: record.get(m.key) for m in COLUMNS}
        if (run.folder / BESIDE_OTHERS).exists():
            metrics["train_seconds"] = None
    return {
        "scene": run.scene.name,
        "recipe": run.recipe.name,
        "seed": run.settings.seed,
        "folder": run.folder.relative_to(comparison.out).as_posix(),
        "state": "done" if metrics is not None else "failed" if failure is not None else "missing",
        "error": None if metrics is not None else failure,
        "metrics": metrics,
        "lpips_reason": record.get("lpips_reason") if record is not None else None,
        "views": {
            name: {m.key: scores[m.key] for m in COLUMNS if m.key in scores}
            for name, scores in record["views"].items()
        }
        if record is not None
        else {},
    }


def write_tables(out: Path, results: Results) -> None:
    """Write ``results.json``, ``.md``, ``.csv`` and ``.tex``, each in one step."""
    write_results(out / "results.json", results)
    files = {"md": TITLE + markdown(results), "csv": csv_text(results), "tex": latex(results)}
    for suffix, text in files.items():
        write_text(out / f"results.{suffix}", text)
