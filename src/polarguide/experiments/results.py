"""The record of a comparison: ``results.json``, its schema, and the check of it."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from polarguide.errors import PolarguideError
from polarguide.evaluation.table import KEYS
from polarguide.experiments.aggregate import aggregate
from polarguide.files import atomic

FORMAT = "polarguide-results-1"
STATES = ("done", "failed", "missing")
PROVENANCE = {
    "version": (str,),
    "commit": (str, type(None)),
    "sources": (str,),
    "command": (str,),
    "date": (str,),
}
SETTINGS = {
    "steps": (int,),
    "seeds": (int,),
    "downscale": (int,),
    "transfer": (str,),
    "refractive_index": (int, float),
    "threads": (int,),
    "jobs": (int,),
}
SCENE = {"name": (str,), "digest": (str,), "views": (int,), "test_views": (list,)}
RECIPE = {"name": (str,), "about": (str,), "data": (dict,)}
RUN = {
    "scene": (str,),
    "recipe": (str,),
    "seed": (int,),
    "folder": (str,),
    "state": (str,),
    "error": (str, type(None)),
    "metrics": (dict, type(None)),
    "lpips_reason": (str, type(None)),
    "views": (dict,),
}
CELL = {"mean": (int, float, type(None)), "spread": (int, float, type(None)), "count": (int,)}
WORDS = {str: "text", int: "a whole number", float: "a number", list: "a list", dict: "an object"}


def make_results(
    *,
    provenance: Mapping[str, Any],
    settings: Mapping[str, Any],
    scenes: Sequence[Mapping[str, Any]],
    recipes: Sequence[Mapping[str, Any]],
    runs: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """The record of a comparison, with the table over its runs.

    Args:
        provenance, settings, scenes, recipes, runs: see ``PROVENANCE`` and the other schemas of this module. A run's
            ``metrics`` are its means over test views, its ``views`` the same for each view.

    Raises:
        PolarguideError: something that does not pass ``validate_results``.
    """
    record = {
        "format": FORMAT,
        "provenance": dict(provenance),
        "settings": dict(settings),
        "scenes": [dict(scene) for scene in scenes],
        "recipes": [dict(recipe) for recipe in recipes],
        "runs": [dict(run) for run in runs],
        "table": aggregate(runs, [s["name"] for s in scenes], [r["name"] for r in recipes]),
    }
    validate_results(record)
    return record


def write_results(path: Path, record: Mapping[str, Any]) -> None:
    """Write ``results.json`` in one step: a reader sees the old file or the whole new one."""
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(record, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def validate_results(record: Any, where: str | Path = "results.json") -> None:
    """Check a record against the schema of ``results.json``.

    Args:
        record: the parsed file.
        where: what an error message calls it.

    Raises:
        PolarguideError: naming the first key at fault, what was expected there, and what was found.
    """
    where = str(where)
    if not isinstance(record, dict):
        raise _fault(where, "an object", record)
    if record.get("format") != FORMAT:
        raise _fault(f"{where}: format", FORMAT, record.get("format"))
    _check_object(record.get("provenance"), PROVENANCE, f"{where}: provenance")
    _check_object(record.get("settings"), SETTINGS, f"{where}: settings")
    for key, schema in (("scenes", SCENE), ("recipes", RECIPE), ("runs", RUN)):
        for index, item in enumerate(_list(record, key, where)):
            _check_object(item, schema, f"{where}: {key}[{index}]")
    names = {key: [item["name"] for item in record[key]] for key in ("scenes", "recipes")}
    for key, values in names.items():
        if len(set(values)) < len(values):
            raise _fault(f"{where}: {key}", "every name once", values)
    for index, run in enumerate(record["runs"]):
        _check_run(run, names, f"{where}: runs[{index}]")
    _check_table(_list(record, "table", where), names, where)


def _check_run(run: Mapping[str, Any], names: Mapping[str, list[str]], where: str) -> None:
    for key in ("scene", "recipe"):
        if run[key] not in names[f"{key}s"]:
            raise _fault(f"{where}.{key}", f"one of the {key}s {', '.join(names[f'{key}s'])}", run[key])
    if run["state"] not in STATES:
        raise _fault(f"{where}.state", "one of " + ", ".join(STATES), run["state"])
    if (run["metrics"] is not None) != (run["state"] == "done"):
        raise _fault(f"{where}.metrics", "values for a run that is done and null for another", run["metrics"])
    for place, values in (
        ("metrics", run["metrics"] or {}),
        *((f"views.{n}", v) for n, v in run["views"].items()),
    ):
        if not isinstance(values, dict):
            raise _fault(f"{where}.{place}", "an object", values)
        for key in KEYS:
            if key in values and not _plain(values[key], (int, float, type(None))):
                raise _fault(f"{where}.{place}.{key}", "a finite number or null", values[key])


def _check_table(rows: list[Any], names: Mapping[str, list[str]], where: str) -> None:
    scenes: list[str | None] = [*names["scenes"], *([None] if len(names["scenes"]) > 1 else [])]
    wanted = [(scene, recipe) for scene in scenes for recipe in names["recipes"]]
    found = [(row.get("scene"), row.get("recipe")) if isinstance(row, dict) else row for row in rows]
    if found != wanted:
        raise _fault(
            f"{where}: table", f"a row for each of {len(wanted)} scenes and recipes, in order", found
        )
    for index, row in enumerate(rows):
        for key in KEYS:
            place = f"{where}: table[{index}].cells"
            if not isinstance(row.get("cells"), dict):
                raise _fault(place, "an object", row.get("cells"))
            _check_object(row["cells"].get(key), CELL, f"{place}.{key}")


def _check_object(value: Any, schema: Mapping[str, tuple[type, ...]], where: str) -> None:
    if not isinstance(value, dict):
        raise _fault(where, "an object", value)
    for key, kinds in schema.items():
        if key not in value or not _plain(value[key], kinds):
            expected = [
                WORDS[kind] for kind in kinds if kind in WORDS and not (kind is int and float in kinds)
            ]
            expected += ["null"] if type(None) in kinds else []
            raise _fault(f"{where}.{key}", " or ".join(expected), value.get(key, "no such key"))


def _list(record: Mapping[str, Any], key: str, where: str) -> list[Any]:
    value = record.get(key)
    if not isinstance(value, list) or not value:
        raise _fault(f"{where}: {key}", "a list that is not empty", value)
    return value


def _plain(value: Any, kinds: tuple[type, ...]) -> bool:
    """Whether a value is of these types; true and false are no numbers, NaN and infinity are not either."""
    finite = not isinstance(value, float) or math.isfinite(value)
    return isinstance(value, kinds) and not isinstance(value, bool) and finite


def _fault(where: str, expected: str, found: object) -> PolarguideError:
    return PolarguideError(
        where,
        expected=expected,
        found=repr(found)[:80],
        remedy="Give the command again to write the record anew.",
    )
