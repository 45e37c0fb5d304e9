"""``polarguide tables``: the records of several comparisons -> one record with its tables."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from polarguide.capture.layout import refuse_scene
from polarguide.errors import PolarguideError
from polarguide.experiments.aggregate import RunRecord, aggregate
from polarguide.experiments.collect import write_tables
from polarguide.experiments.report import REPORT, report_html
from polarguide.experiments.results import (
    FORMAT,
    Results,
    SceneRecord,
    differences_of,
    read_results,
    validate_results,
)
from polarguide.files import make_folder, write_text
from polarguide.options import PathLike, check_choice
from polarguide.records import shortened

RECORD = "results.json"
_REMEDY = "Join records of one commit, with the same recipes and settings."
_FREE = ("jobs", "seeds", "against")
"""Settings in which parts of one comparison may differ: the largest counts, and what is asked for now."""


def join_tables(parts: Sequence[PathLike], out: PathLike, *, against: str | None = None) -> Results:
    """Join the records of comparisons that were run apart, and set their tables anew.

    Scenes, seeds and recipes may be spread over machines in any way, as long as no run is there twice. Writes
    ``results.json``, ``.md``, ``.csv``, ``.tex`` and a ``report.html`` without pictures to ``out``, and
    ``differences.csv`` and ``parts.csv`` where there is something for them.

    Args:
        parts: records, or folders with a ``results.json``; scenes and recipes keep the order in which they come.
        out: folder to write.
        against: a recipe; tables have the difference of every other one to it.

    Returns:
        The record as written.

    Raises:
        PolarguideError: a record that is none, or would be written over; records of other code, settings, scenes or
            recipes than the first; a run that two of them have; an unknown ``against``.
    """
    paths = [Path(part) / RECORD if Path(part).is_dir() else Path(part) for part in parts]
    if not paths:
        raise PolarguideError(
            "tables", expected="a record", found="none", remedy="Name at least one results.json."
        )
    if len(paths) > 1 and any(
        os.path.realpath(path) == os.path.realpath(Path(out) / RECORD) for path in paths
    ):
        raise PolarguideError(
            out,
            expected="a folder of its own",
            found=f"that of a part, whose {RECORD} would be written over",
            remedy="Give another --out.",
        )
    joined = join_results(
        [read_results(path) for path in paths], [str(path) for path in paths], against=against
    )
    refuse_scene(Path(out))
    make_folder(Path(out))
    write_tables(Path(out), joined)
    remark = "Pictures are in the reports of the parts."
    write_text(Path(out) / REPORT, report_html(joined, [], {}, [remark]))
    return joined


def join_results(records: Sequence[Results], names: Sequence[str], *, against: str | None = None) -> Results:
    """One record of the runs of several.

    Args:
        records: as ``read_results`` gives them.
        names: what error messages call each of them.
        against: as for ``join_tables``.

    Raises:
        PolarguideError: as ``join_tables``.
    """
    first = records[0]
    for record, name in zip(records[1:], names[1:], strict=True):
        _check_same_code(first, record, names[0], name)
        for key, value in first["settings"].items():
            if key not in _FREE:
                _check_same(value, record["settings"].get(key), f"{name} (settings.{key})", names[0])
    scenes: dict[str, SceneRecord] = {}
    recipes: dict[str, Any] = {}
    runs: dict[tuple[str, str, int], RunRecord] = {}
    for record, name in zip(records, names, strict=True):
        for scene in record["scenes"]:
            known = scenes.setdefault(scene["name"], scene)
            where = f"{name} (scene {scene['name']}"
            _check_same(known["digest"], scene["digest"], f"{where}, digest)", "another record")
            _check_same(known["test_views"], scene["test_views"], f"{where}, test_views)", "another record")
        for recipe in record["recipes"]:
            known_recipe = recipes.setdefault(recipe["name"], recipe)
            _check_same(
                known_recipe["data"], recipe["data"], f"{name} (recipe {recipe['name']})", "another record"
            )
        for run in record["runs"]:
            place = (run["scene"], run["recipe"], run["seed"])
            if place in runs and "missing" not in (run["state"], runs[place]["state"]):
                raise PolarguideError(
                    name,
                    expected="runs that no other record has",
                    found=f"{run['scene']}, {run['recipe']}, seed {run['seed']} once more",
                    remedy="Name every record once.",
                )
            if place not in runs or runs[place]["state"] == "missing":
                runs[place] = run
    if against is not None:
        check_choice("against", against, list(recipes))
    order = list(recipes)
    every = [runs[p] for p in sorted(runs, key=lambda p: (list(scenes).index(p[0]), order.index(p[1]), p[2]))]
    joined = Results(
        format=FORMAT,
        provenance={
            "version": first["provenance"]["version"],
            "commit": first["provenance"]["commit"],
            "sources": _each(r["provenance"]["sources"] for r in records),
            "command": _each(r["provenance"]["command"] for r in records),
            "date": max(r["provenance"]["date"] for r in records),
        },
        settings={
            **first["settings"],
            "seeds": max(r["settings"]["seeds"] for r in records),
            "jobs": max(r["settings"]["jobs"] for r in records),
            "against": against,
        },
        scenes=list(scenes.values()),
        recipes=list(recipes.values()),
        runs=every,
        table=aggregate(every, list(scenes), order),
        differences=[],
    )
    joined["differences"] = differences_of(joined)
    return validate_results(joined)


def _each(texts: Iterable[str]) -> str:
    """Every text once."""
    return "; ".join(dict.fromkeys(texts))


def _check_same_code(first: Results, other: Results, known: str, name: str) -> None:
    """Of one version, and of one commit or with equal digests: compilers may make other bytes of the same sources."""
    ours, theirs = first["provenance"], other["provenance"]
    _check_same(ours["version"], theirs["version"], f"{name} (provenance.version)", known)
    if ours["sources"] != theirs["sources"] and (
        ours["commit"] is None or ours["commit"] != theirs["commit"]
    ):
        _check_same(
            f"{ours['sources']}, commit {ours['commit']}",
            f"{theirs['sources']}, commit {theirs['commit']}",
            f"{name} (provenance.sources)",
            known,
        )


def _check_same(wanted: object, found: object, where: str, known: str) -> None:
    if wanted != found:
        raise PolarguideError(
            where, expected=f"{shortened(wanted)}, as {known} has it", found=shortened(found), remedy=_REMEDY
        )
