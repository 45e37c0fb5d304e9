"""``polarguide tables``: the records of several comparisons -> one record with its tables."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import msgspec

from polarguide.capture.layout import refuse_scene
from polarguide.core.errors import PolarguideError
from polarguide.core.files import make_folder, write_text
from polarguide.core.options import PathLike, check_choice
from polarguide.core.records import shortened
from polarguide_bench.options import LayoutName
from polarguide_bench.publication import LAYOUTS, write_publication_tables
from polarguide_bench.record import (
    FORMAT,
    Provenance,
    RecipeRecord,
    Record,
    RunRecord,
    SceneRecord,
    read_results,
)
from polarguide_bench.report import REPORT, report_html
from polarguide_bench.results import Results
from polarguide_bench.tables import write_tables

RECORD = "results.json"
_REMEDY = "Join records of one commit, with the same recipes and settings."
_FREE = ("jobs", "seeds", "against")
"""Settings in which parts of one comparison may differ: the largest counts, and what is asked for now."""


def join_tables(
    parts: Sequence[PathLike],
    out: PathLike,
    *,
    against: str | None = None,
    layout: LayoutName | None = None,
) -> Results:
    """Join the records of comparisons that were run apart, and set their tables anew.

    Scenes, seeds and recipes may be spread over machines in any way, as long as no run is there twice. Writes
    ``results.json``, ``.md``, ``.csv``, ``.tex`` and a ``report.html`` without pictures to ``out``, and
    ``differences.csv`` and ``parts.csv`` where there is something for them.

    Args:
        parts: records, or folders with a ``results.json``; scenes and recipes keep the order in which they come.
        out: folder to write.
        against: a recipe; tables have the difference of every other one to it.
        layout: also write a table in the layout of a publication, as ``LAYOUT.md`` and ``LAYOUT.tex``.

    Raises:
        PolarguideError: a file that is not a record, or would be written over; records of other code, settings, scenes
            or recipes than the first; a run that two of them have; an unknown ``against``; a layout whose recipes the
            records do not have.
    """
    paths = [Path(part) / RECORD if Path(part).is_dir() else Path(part) for part in parts]
    if not paths:
        raise PolarguideError(
            "tables", expected="a record", found="none", remedy="Name at least one results.json."
        )
    written = os.path.realpath(Path(out) / RECORD)
    if len(paths) > 1 and written in map(os.path.realpath, paths):
        raise PolarguideError(
            out,
            expected="a folder that is none of the parts",
            found=f"that of a part, whose {RECORD} would be written over",
            remedy="Give another --out.",
        )
    joined = Results(join_records({str(path): read_results(path) for path in paths}, against=against))
    refuse_scene(Path(out))
    make_folder(Path(out))
    write_tables(Path(out), joined)
    if layout is not None:
        check_choice("layout", layout, list(LAYOUTS))
        write_publication_tables(Path(out), joined, LAYOUTS[layout])
    html = report_html(joined, [], {}, ["Pictures are in the reports of the parts."])
    write_text(Path(out) / REPORT, html)
    return joined


def join_records(records: dict[str, Record], *, against: str | None = None) -> Record:
    """One record of the runs of several.

    Args:
        records: at least one, by what error messages call it.
        against: as for ``join_tables``.

    Raises:
        PolarguideError: as ``join_tables``.
    """
    (name_of_first, first), *_ = records.items()
    scenes: dict[str, SceneRecord] = {}
    recipes: dict[str, RecipeRecord] = {}
    runs: dict[tuple[str, str, int], RunRecord] = {}
    for name, record in records.items():
        _check_same_code(first.provenance, record.provenance, name_of_first, name)
        for key in record.settings.__struct_fields__:
            if key not in _FREE:
                ours, theirs = (getattr(of.settings, key) for of in (first, record))
                _check_same(ours, theirs, f"{name} (settings.{key})", name_of_first)
        for scene in record.scenes:
            same = scenes.setdefault(scene.name, scene)
            for key in ("digest", "test_views"):
                where = f"{name} (scene {scene.name}, {key})"
                _check_same(getattr(same, key), getattr(scene, key), where, "another record")
        for recipe in record.recipes:
            values_of = recipes.setdefault(recipe.name, recipe).data
            _check_same(values_of, recipe.data, f"{name} (recipe {recipe.name})", "another record")
        for run in record.runs:
            place = (run.scene, run.recipe, run.seed)
            earlier = runs.setdefault(place, run)
            if earlier is not run and "missing" not in (run.state, earlier.state):
                raise PolarguideError(
                    name,
                    expected="runs that no other record has",
                    found=f"{run.scene}, {run.recipe}, seed {run.seed} once more",
                    remedy="Name every record once.",
                )
            if earlier.state == "missing":
                runs[place] = run
    if against is not None:
        check_choice("against", against, list(recipes))
    order = {name: index for names in (scenes, recipes) for index, name in enumerate(names)}
    settings = [record.settings for record in records.values()]
    provenances = [record.provenance for record in records.values()]
    return Record(
        format=FORMAT,
        provenance=msgspec.structs.replace(
            first.provenance,
            sources=_each(of.sources for of in provenances),
            command=_each(of.command for of in provenances),
            date=max(of.date for of in provenances),
        ),
        settings=msgspec.structs.replace(
            first.settings,
            seeds=max(of.seeds for of in settings),
            jobs=max(of.jobs for of in settings),
            against=against,
        ),
        scenes=list(scenes.values()),
        recipes=list(recipes.values()),
        runs=[runs[place] for place in sorted(runs, key=lambda p: (order[p[0]], order[p[1]], p[2]))],
    )


def _each(texts: Iterable[str]) -> str:
    """Every text once."""
    return "; ".join(dict.fromkeys(texts))


def _check_same_code(ours: Provenance, theirs: Provenance, label: str, name: str) -> None:
    """Of one version, and of one commit or with equal digests: compilers may make other bytes of the same sources."""
    _check_same(ours.version, theirs.version, f"{name} (provenance.version)", label)
    if ours.commit is None or ours.commit != theirs.commit:
        (code, other_code) = (f"{of.sources}, commit {of.commit}" for of in (ours, theirs))
        if ours.sources != theirs.sources:
            _check_same(code, other_code, f"{name} (provenance.sources)", label)


def _check_same(first: object, found: object, where: str, label: str) -> None:
    if first != found:
        raise PolarguideError(
            where, expected=f"{shortened(first)}, as {label} has it", found=shortened(found), remedy=_REMEDY
        )
