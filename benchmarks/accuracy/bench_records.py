"""Values of the records of comparisons by scene, recipe and seed, for scripts that print tables or draw figures."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from polarguide.core.errors import require
from polarguide.results.evaluation.table import METRICS
from polarguide_bench.results import read_results

BY_KEY = {metric.key: metric for metric in METRICS}
Value = Callable[[Any], float | None]
Seeds = Mapping[int, Any]
Rows = Mapping[str, Seeds]
"""Runs of a scene by recipe and seed."""
Scenes = Mapping[str, Rows]


def values(seeds: Seeds, value: Value) -> dict[int, float]:
    """Return the values of a metric by seed, for seeds with a value."""
    return {seed: number for seed, run in seeds.items() if (number := value(run)) is not None}


def of_run(key: str) -> Value:
    """Return a function that reads a metric of a run."""
    return lambda run: run["metrics"].get(key)


def of_object(name: str, key: str) -> Value:
    """Return a function that reads a metric of an object of a run."""
    return lambda run: run["objects"].get(name, {"metrics": {}})["metrics"].get(key)


def of_material(name: str, key: str) -> Value:
    """Return a function that reads a metric over the pixels of a material in a run."""
    return lambda run: (run["materials"] or {}).get(name, {"metrics": {}})["metrics"].get(key)


def by_scene(scenes: Scenes, recipe: str, value: Value) -> dict[str, float]:
    """Return the mean over seeds of a recipe by scene. Scenes without a value are left out."""
    means = {scene: list(values(rows.get(recipe, {}), value).values()) for scene, rows in scenes.items()}
    return {scene: statistics.fmean(known) for scene, known in means.items() if known}


def objects_of(rows: Rows, recipe: str) -> Mapping[str, Any]:
    """Return the objects of a scene by name, from the first run of a recipe."""
    objects: Mapping[str, Any] = next(iter(rows[recipe].values()))["objects"]
    return objects


def read_scenes(paths: Sequence[Path]) -> dict[str, dict[str, dict[int, Any]]]:
    """Return the finished runs of all records by scene, recipe and seed, in the order of the records.

    Raises:
        PolarguideError: a file is not a record, or two records have the same run.
    """
    scenes: dict[str, dict[str, dict[int, Any]]] = {}
    for path in paths:
        record = msgspec.to_builtins(read_results(path))
        for recipe in record["recipes"]:
            for run in record["runs"]:
                if run["recipe"] == recipe["name"] and run["state"] == "done":
                    seeds = scenes.setdefault(run["scene"], {}).setdefault(run["recipe"], {})
                    require(
                        run["seed"] not in seeds,
                        path,
                        expected="runs that no other record has",
                        found=f"{run['scene']}, {run['recipe']}, seed {run['seed']} for the second time",
                        remedy="Print tables of different sets of scenes one by one.",
                    )
                    seeds[run["seed"]] = run
    return scenes


def code_versions(paths: Sequence[Path]) -> list[str]:
    """Return the commits of the code that wrote the records, without repetition. Without a commit, it is the digest.

    Raises:
        PolarguideError: a file is not a record.
    """
    provenances = [read_results(path).provenance for path in paths]
    return list(dict.fromkeys(provenance.commit or provenance.sources for provenance in provenances))
