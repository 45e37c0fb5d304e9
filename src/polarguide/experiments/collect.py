"""The runs of a comparison -> its record and tables on disk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from polarguide import __version__
from polarguide.evaluation.sources import code_digest, commit
from polarguide.evaluation.table import COLUMNS, PART_METRICS
from polarguide.experiments.aggregate import PartScores, RunRecord, aggregate
from polarguide.experiments.forms import csv_text, differences_csv, latex, markdown, parts_csv
from polarguide.experiments.plan import Comparison, PlannedRun, SceneEntry, TableRow
from polarguide.experiments.results import (
    FORMAT,
    RecipeRecord,
    Results,
    SceneRecord,
    differences_of,
    validate_results,
    write_results,
)
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
    recipes = [row.name for row in comparison.rows]
    record = Results(
        format=FORMAT,
        provenance={
            "version": __version__,
            "commit": commit(),
            "sources": code_digest(),
            "command": comparison.command,
            "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        },
        settings={
            "steps": comparison.steps,
            "seeds": comparison.options.seeds,
            "downscale": comparison.options.downscale,
            "transfer": comparison.options.transfer,
            "refractive_index": comparison.settings.refractive_index,
            "threads": comparison.options.threads,
            "jobs": comparison.options.parallel,
            "against": comparison.options.against,
            "background": comparison.settings.background,
            "materials": comparison.settings.materials,
        },
        scenes=[_scene_record(scene, comparison) for scene in scenes],
        recipes=[_recipe_record(row) for row in comparison.rows],
        runs=runs,
        table=aggregate(runs, [scene.name for scene in scenes], recipes),
        differences=[],
    )
    record["differences"] = differences_of(record)
    return validate_results(record)


def _scene_record(scene: SceneEntry, comparison: Comparison) -> SceneRecord:
    record = SceneRecord(
        name=scene.name,
        digest=scene.digest,
        views=scene.views,
        test_views=list(scene.test_views),
        black_share=scene.black_share,
    )
    if scene.warnings:
        record["warnings"] = list(scene.warnings)
    if comparison.settings.refractive_index is None:
        record["refractive_index"] = comparison.index_of(scene)
    return record


def _recipe_record(row: TableRow) -> RecipeRecord:
    record = RecipeRecord(name=row.name, about=row.about, data=row.recipe.data())
    if row.steps is not None:
        record["steps"] = row.steps
    return record


def _run_record(comparison: Comparison, run: PlannedRun, failure: str | None) -> RunRecord:
    record = run.metrics() if run.state() == "done" else None
    metrics = None
    if record is not None:
        metrics = {m.key: record.get(m.key) for m in COLUMNS}
        if (run.folder / BESIDE_OTHERS).exists():
            metrics["train_seconds"] = None
    return {
        "scene": run.scene.name,
        "recipe": run.row.name,
        "seed": run.settings.seed,
        "folder": run.folder.relative_to(comparison.out).as_posix(),
        "state": "done" if metrics is not None else "failed" if failure is not None else "missing",
        "error": None if metrics is not None else failure,
        "metrics": metrics,
        "lpips_reason": (record or {}).get("lpips_reason"),
        "mesh_reason": (record or {}).get("mesh_fscore_1_reason"),
        "views": {
            name: {m.key: scores[m.key] for m in COLUMNS if m.key in scores}
            for name, scores in record["views"].items()
        }
        if record is not None
        else {},
        "objects": _parts((record or {}).get("objects")),
        "materials": _parts((record or {}).get("materials")),
    }


def _parts(found: Mapping[str, Mapping[str, Any]] | None) -> dict[str, PartScores]:
    """The scores by object or material of a run, as ``metrics.json`` has them, if it has any."""
    return {
        name: {
            "material": scores.get("material"),
            "pixels": scores["pixels"],
            "views": scores["views"],
            "metrics": {m.key: scores[m.key] for m in PART_METRICS if m.key in scores},
        }
        for name, scores in (found or {}).items()
    }


def write_tables(out: Path, results: Results) -> None:
    """Write ``results.json``, ``.md``, ``.csv`` and ``.tex``, each in one step, and what else there is as CSV."""
    write_results(out / "results.json", results)
    files = {
        "results.md": TITLE + markdown(results),
        "results.csv": csv_text(results),
        "results.tex": latex(results),
        "differences.csv": differences_csv(results),
        "parts.csv": parts_csv(results),
    }
    for name, text in files.items():
        if text is None:
            (out / name).unlink(missing_ok=True)  # of a comparison with other recipes
        else:
            write_text(out / name, text)
