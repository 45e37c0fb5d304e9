"""The record of a comparison: ``results.json``, its types, and the check of it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, TypedDict, TypeVar

import msgspec

from polarguide.errors import PolarguideError
from polarguide.experiments.aggregate import Row, RunRecord
from polarguide.experiments.differences import Difference, differences
from polarguide.files import write_text
from polarguide.records import decode, read_record, shortened

FORMAT = "polarguide-results-2"
FORMER = "polarguide-results-1"
"""Lacks objects, materials, black pixels, the recipe to compare with, and differences; it is read as if it had them."""
STATES = ("done", "failed", "missing")
_REMEDY = "Give the command again to write the record anew."
_Item = TypeVar("_Item")
_Filled = Annotated[list[_Item], msgspec.Meta(min_length=1)]


class Provenance(TypedDict):
    """What made the record. ``sources``: digest of the program; ``date``: ISO 8601, UTC."""

    version: str
    commit: str | None
    sources: str
    command: str
    date: str


class Settings(TypedDict):
    """What all runs have in common; ``jobs`` of them worked at a time. ``against``: what others are compared with."""

    steps: int
    seeds: int
    downscale: int
    transfer: str
    refractive_index: float | None
    threads: int
    jobs: int
    against: str | None
    background: str
    materials: str


class _Scene(TypedDict):
    name: str
    digest: str
    views: Annotated[int, msgspec.Meta(ge=0)]
    test_views: list[str]
    black_share: Annotated[float, msgspec.Meta(ge=0, le=1)] | None


class SceneRecord(_Scene, total=False):
    """A scene: the digest of its files, how many views it has, and the names of those that scores are means over.

    ``black_share`` is the share of black pixels in its first test view, None where that is not known.
    ``warnings``, only where there are some, are what its scores do not mean because ground truth is missing.
    ``refractive_index`` is that of its runs, where ``Settings`` have null: each scene its own.
    """

    warnings: list[str]
    refractive_index: Annotated[float, msgspec.Meta(gt=1, lt=4)]


class _Recipe(TypedDict):
    name: str
    about: str
    data: dict[str, Any]


class RecipeRecord(_Recipe, total=False):
    """A recipe with all its values; ``steps`` only where it takes another number of them than ``Settings`` say."""

    steps: Annotated[int, msgspec.Meta(ge=1)]


class Results(TypedDict):
    """A comparison.

    ``table`` has a row for every scene and recipe, and with several scenes their means at the end; ``differences`` are
    those that finished runs give.
    """

    format: str
    provenance: Provenance
    settings: Settings
    scenes: _Filled[SceneRecord]
    recipes: _Filled[RecipeRecord]
    runs: _Filled[RunRecord]
    table: _Filled[Row]
    differences: list[Difference]


def write_results(path: Path, record: Results) -> None:
    """Write ``results.json`` in one step: a reader sees the old file or the whole new one."""
    write_text(path, json.dumps(record, indent=1, allow_nan=False) + "\n")


def read_results(path: Path) -> Results:
    """Read ``results.json``, of this version or the one before.

    Raises:
        PolarguideError: there is none, or it is not what ``write_results`` writes.
    """
    record = read_record(path, dict[str, Any], remedy=_REMEDY)
    settings = record.get("settings")
    if isinstance(
        settings, dict
    ):  # the first records lack them: surroundings were taken to be there, metals not sought
        record["settings"] = {"background": "scene", "materials": "dielectric", **settings}
        if settings.get("refractive_index") == 0:  # as earlier records have it for null
            record["settings"]["refractive_index"] = None
    if record.get("format") != FORMER:
        return validate_results(record, path)
    results = validate_results(_completed(record), path)
    results["differences"] = differences_of(results)
    return results


def _completed(record: dict[str, Any]) -> dict[str, Any]:
    """A record of the former version with what it lacks; what is wrong with it is left for the check."""

    def with_fields(items: Any, **fields: Any) -> Any:
        if not isinstance(items, list):
            return items
        return [{**fields, **item} if isinstance(item, dict) else item for item in items]

    settings = record.get("settings")
    return {
        **record,
        "format": FORMAT,
        "settings": {"against": None, **settings} if isinstance(settings, dict) else settings,
        "scenes": with_fields(record.get("scenes"), black_share=None),
        "runs": with_fields(record.get("runs"), objects={}, materials={}),
        "differences": [],
    }


def differences_of(record: Results) -> list[Difference]:
    """What belongs under ``differences``, from the runs of a record."""
    return differences(
        record["runs"],
        {scene["name"]: scene["black_share"] for scene in record["scenes"]},
        [recipe["name"] for recipe in record["recipes"]],
        record["settings"]["against"],
    )


def validate_results(record: Any, where: str | Path = "results.json") -> Results:
    """Check a record against the schema of ``results.json``.

    Args:
        record: the parsed file.
        where: what an error message calls it.

    Returns:
        The record.

    Raises:
        PolarguideError: naming the first key at fault, what was expected there, and what was found.
    """
    results = decode(record, Results, where, remedy=_REMEDY)
    if results["format"] != FORMAT:
        raise _fault(f"{where} (format)", FORMAT, results["format"])
    _check_relations(results, where)
    return results


def _check_relations(record: Results, where: str | Path) -> None:
    """What the types do not say: names that occur once, runs of these names, and a row for each of them."""
    scenes, recipes = ([item["name"] for item in items] for items in (record["scenes"], record["recipes"]))
    for key, names in (("scenes", scenes), ("recipes", recipes)):
        if len(set(names)) < len(names):
            raise _fault(f"{where} ({key})", "every name once", names)
    against = record["settings"]["against"]
    if against is not None and against not in recipes:
        raise _fault(f"{where} (settings.against)", f"one of the recipes {', '.join(recipes)}", against)
    for index, run in enumerate(record["runs"]):
        _check_run(run, scenes, recipes, where, f"runs[{index}]")
    places: list[str | None] = [*scenes, *([None] if len(scenes) > 1 else [])]
    wanted = [(scene, recipe) for scene in places for recipe in recipes]
    found = [(row["scene"], row["recipe"]) for row in record["table"]]
    if found != wanted:
        raise _fault(
            f"{where} (table)", f"a row for each of {len(wanted)} scenes and recipes, in order", found
        )


def _check_run(
    run: RunRecord, scenes: Sequence[str], recipes: Sequence[str], where: object, place: str
) -> None:
    for key, name, names in (("scene", run["scene"], scenes), ("recipe", run["recipe"], recipes)):
        if name not in names:
            raise _fault(f"{where} ({place}.{key})", f"one of the {key}s {', '.join(names)}", name)
    if run["state"] not in STATES:
        raise _fault(f"{where} ({place}.state)", "one of " + ", ".join(STATES), run["state"])
    if (run["metrics"] is not None) != (run["state"] == "done"):
        raise _fault(
            f"{where} ({place}.metrics)", "values for a run that is done and null for another", run["metrics"]
        )


def _fault(where: str, expected: str, found: object) -> PolarguideError:
    return PolarguideError(where, expected=expected, found=shortened(found), remedy=_REMEDY)
