"""``polarguide tables``: the records of several comparisons -> one record with its tables.

The two tables of PolarGuide-GSDR (Shan et al. 2026) in its own layout: measured values, then the published ones.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from io import StringIO
from pathlib import Path

import msgspec
import pandas as pd

from polarguide.capture.layout import refuse_scene
from polarguide.core.errors import PolarguideError
from polarguide.core.files import make_folder, write_text
from polarguide.core.options import PathLike, check_choice
from polarguide.core.records import shortened
from polarguide.results.evaluation.table import COLUMNS, Metric
from polarguide_bench.options import LayoutName
from polarguide_bench.recipes import recipe_named
from polarguide_bench.report import REPORT, report_html
from polarguide_bench.results import (
    FORMAT,
    Provenance,
    RecipeRecord,
    Record,
    Results,
    RunRecord,
    SceneRecord,
    metric_of_runs,
    read_results,
    scatter_on,
    values_of,
)
from polarguide_bench.tables import Section, TableRow, leaders, notes, readable, score_cell, write_tables

METRICS: Mapping[str, tuple[str, ...]] = {
    "PSNR": ("psnr",),
    "SSIM": ("ssim",),
    "LPIPS": ("lpips", "flip"),
    "FPS": ("fps",),
}
"""Keys of each published metric. Where no run has a value of the first key, the next one takes its place."""
_ARROWS = {"higher": "↑", "lower": "↓"}
_CAPTURES = (
    "The published values come from other captures. Compare differences between methods, not values.",
    "The publication gives different values of one method in its two tables: up to 0.2 dB, 0.006 SSIM and 0.01 LPIPS.",
)


@dataclass(frozen=True)
class PublicationLayout:
    """One table of the publication.

    Attributes:
        name: as given to ``--layout``; also the name of the files.
        title: heading.
        columns: heading of each method, and the recipe that stands for it.
    """

    name: str
    title: str
    columns: Mapping[str, str]

    def published(self) -> pd.DataFrame:
        """The published values: dataset, metric, and a column for each method. Texts, with the printed digits."""
        source = files("polarguide_bench").joinpath("published", f"{self.name}.csv")
        return pd.read_csv(StringIO(source.read_text("utf-8")), dtype=str)


LAYOUTS = {
    layout.name: layout
    for layout in (
        PublicationLayout(
            "publication-1",
            "Methods",
            {
                "GNeRP": "gnerp",
                "3DGS": "3dgs",
                "3DGS-DR": "3dgs-dr",
                "Ref-GS": "ref-gs",
                "PolarGuide-GSDR, to the letter": "polarguide-paper",
                "PolarGuide-GSDR, favorable reading": "polarguide-paper:kind",
                "polarguide-stokes": "polarguide-stokes",
            },
        ),
        PublicationLayout(
            "publication-2",
            "Ablations",
            {
                "3DGS-DR": "3dgs-dr",
                "to the letter, only polarization normals": "polarguide-paper:only-normals",
                "to the letter, without polarization normals": "polarguide-paper:without-normals",
                "to the letter": "polarguide-paper",
                "favorable reading, only polarization normals": "polarguide-paper:kind:only-normals",
                "favorable reading, without polarization normals": "polarguide-paper:kind:without-normals",
                "favorable reading": "polarguide-paper:kind",
            },
        ),
    )
}


def write_publication_tables(out: Path, results: Results, layout: PublicationLayout) -> None:
    """Write ``NAME.md`` and ``NAME.tex`` with the measured and the published table.

    Raises:
        PolarguideError: the record has fewer than two of the layout's recipes.
    """
    sections = [measured_section(results, layout), published_section(layout)]
    for ending in ("md", "tex"):
        write_text(out / f"{layout.name}.{ending}", readable(sections, f"results.{ending}"))


def measured_section(results: Results, layout: PublicationLayout) -> Section:
    """The values of a record in the publication's layout: a block for every scene, a row for every metric.

    Raises:
        PolarguideError: the record has fewer than two of the layout's recipes.
    """
    columns = {heading: name for heading, name in layout.columns.items() if name in results.recipes}
    absent = [name for name in layout.columns.values() if name not in results.recipes]
    if len(columns) < 2:
        raise PolarguideError(
            "--layout",
            expected="a record with " + ", ".join(layout.columns.values()),
            found=", ".join(results.recipes),
            remedy=f"Train them: polarguide compare SCENE ... --recipes {' '.join(absent)} --speed --out FOLDER",
        )
    metrics = {label: _metric(results, keys) for label, keys in METRICS.items()}
    blocks = [
        (scene, [_measured_row(results, scene, metric, columns) for metric in metrics.values()])
        for scene in results.scenes
    ]
    stated = notes(results)
    replaced = [
        f"{metric.label} stands for {label}." for label, metric in metrics.items() if metric.label != label
    ]
    stated += _earlier_versions(results, columns.values())
    if absent:
        stated.append(f"The record has no runs of {', '.join(absent)}.")
    if not any(row.cells["fps"].count for row in results.table):
        stated.append("FPS was not measured: give the command of the comparison again with --speed.")
    return Section(layout.name, layout.title, ("metric",), [*columns], blocks, [*replaced, *stated])


def _earlier_versions(results: Results, names: Iterable[str]) -> Iterator[str]:
    """A sentence for every recipe whose recorded values differ from those it has now."""
    trained = {recipe.name: recipe.data for recipe in results.record.recipes}
    for name in names:
        if recipe_named(name).differs(trained[name]):
            commit = results.record.provenance.commit
            yield f"{name} was trained with other values than it has in this version (commit {commit})."


def published_section(layout: PublicationLayout) -> Section:
    """The values that the publication prints; the best picture quality is bold, as there."""
    frame = layout.published()
    methods = list(frame.columns[2:])
    blocks: list[tuple[str, list[TableRow]]] = []
    for dataset, rows in frame.groupby("dataset", sort=False):
        block: list[TableRow] = []
        for _, row in rows.iterrows():
            metric = _column(METRICS[row["metric"]][0])
            values = row[methods].astype(float)
            best = values.max() if metric.better == "higher" else values.min()
            cells = [(row[m], "", values[m] == best and row["metric"] != "FPS") for m in methods]
            block.append(([(_label(metric), False, "")], cells))
        blocks.append((str(dataset), block))
    title = f"{layout.title}, as published (Shan et al. 2026, arXiv:2512.02664)"
    return Section(f"{layout.name}-published", title, ("metric",), methods, blocks, [*_CAPTURES])


def _measured_row(results: Results, scene: str, metric: Metric, columns: Mapping[str, str]) -> TableRow:
    all_rows = [row for row in results.table if row.scene == scene]
    rows = {i: row for name in columns.values() for i, row in enumerate(all_rows) if row.recipe == name}
    values = values_of(results.record, metric_of_runs(metric.key), [scene])
    means = {i: mean for i, row in rows.items() if (mean := row.cells[metric.key].mean) is not None}
    bold = leaders(means, values, metric, scatter_on(results.record, values, metric))
    cells = [score_cell(row, metric, i in bold, results) for i, row in rows.items()]
    return [(_label(metric), False, "")], cells


def _label(metric: Metric) -> str:
    return f"{metric.label} {_ARROWS.get(metric.better or '', '')}".rstrip()


def _metric(results: Results, keys: tuple[str, ...]) -> Metric:
    """The first of some metrics that any run has a value of; without any, the first."""
    measured = [key for key in keys if any(row.cells[key].count for row in results.table)]
    return _column((measured or keys)[0])


def _column(key: str) -> Metric:
    return next(column for column in COLUMNS if column.key == key)


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
