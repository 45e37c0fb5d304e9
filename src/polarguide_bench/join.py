"""The verb ``polarguide tables``, which joins the records of several comparisons and writes their tables.

The tables can also have the layout of PolarGuide-GSDR (Shan et al. 2026): measured values next to the published ones.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import msgspec
import pandas as pd

from polarguide.capture.layout import refuse_scene
from polarguide.core.errors import require
from polarguide.core.files import make_folder, write_text
from polarguide.core.options import PathLike, check_choice
from polarguide.core.records import shortened
from polarguide.results.evaluation.table import Metric
from polarguide_bench.options import LayoutName
from polarguide_bench.recipes import recipe_named
from polarguide_bench.report import REPORT, report_html
from polarguide_bench.results import (
    FORMAT,
    KNOWN_SCATTER,
    Provenance,
    RecipeRecord,
    Record,
    Results,
    RunRecord,
    SceneRecord,
    metric_of_runs,
    read_results,
    values_of,
)
from polarguide_bench.tables import (
    BY_KEY,
    Section,
    TableRow,
    leaders,
    notes,
    readable,
    score_cell,
    write_tables,
)

METRICS: Mapping[str, tuple[str, ...]] = {
    "PSNR": ("psnr",),
    "SSIM": ("ssim",),
    "LPIPS": ("lpips", "flip"),
    "FPS": ("fps",),
}
"""Keys of our metrics for each published metric, in order of preference. The first key with a value is used."""
_CAPTURES = (
    "The published values come from other captures. Compare differences between methods, not values.",
    "The publication gives different values of one method in its two tables: up to 0.2 dB, 0.006 SSIM and 0.01 LPIPS.",
)


@dataclass(frozen=True)
class PublicationLayout:
    """Layout of a table in the publication.

    Attributes:
        name: value of the option ``--layout`` and name of the files.
        title: heading.
        columns: heading and recipe of each method.
    """

    name: str
    title: str
    columns: Mapping[str, str]

    def published(self) -> pd.DataFrame:
        """Return the published values as text, with the columns dataset and metric and a column for each method."""
        source = files("polarguide_bench").joinpath("published", f"{self.name}.csv")
        with source.open(encoding="utf-8") as file:
            return pd.read_csv(file, dtype=str)


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
    """Write ``NAME.md`` and ``NAME.tex``, which contain the measured and the published table.

    Raises:
        PolarguideError: the record has fewer than two of the layout's recipes.
    """
    sections = [measured_section(results, layout), published_section(layout)]
    for ending in ("md", "tex"):
        write_text(out / f"{layout.name}.{ending}", readable(sections, f"results.{ending}"))


def measured_section(results: Results, layout: PublicationLayout) -> Section:
    """Return the values of a record in the layout of the publication.

    It has a block for each scene and a row for each metric.

    Raises:
        PolarguideError: the record has fewer than two of the layout's recipes.
    """
    columns = {heading: name for heading, name in layout.columns.items() if name in results.recipes}
    absent = [name for name in layout.columns.values() if name not in results.recipes]
    require(
        len(columns) >= 2,
        "--layout",
        expected="a record with " + ", ".join(layout.columns.values()),
        found=", ".join(results.recipes),
        remedy=f"Train them: polarguide compare SCENE ... --recipes {' '.join(absent)} --speed --out FOLDER",
    )
    measured = {key for row in results.table for key, cell in row.cells.items() if cell.count}
    metrics = {
        label: BY_KEY[next((key for key in keys if key in measured), keys[0])]
        for label, keys in METRICS.items()
    }
    blocks = [
        (scene, [_measured_row(results, scene, metric, columns) for metric in metrics.values()])
        for scene in results.scenes
    ]
    replaced = [
        f"{metric.label} stands for {label}." for label, metric in metrics.items() if metric.label != label
    ]
    stated = [*replaced, *notes(results), *_earlier_versions(results, columns.values())]
    if absent:
        stated.append(f"The record has no runs of {', '.join(absent)}.")
    if "fps" not in measured:
        stated.append("FPS was not measured: give the command of the comparison again with --speed.")
    return Section(layout.name, layout.title, ("metric",), [*columns], blocks, stated)


def _earlier_versions(results: Results, names: Iterable[str]) -> Iterator[str]:
    """Yield a sentence for each recipe whose recorded definition differs from its current definition."""
    trained = {recipe.name: recipe.data for recipe in results.record.recipes}
    for name in names:
        if recipe_named(name).differs(trained[name]):
            commit = results.record.provenance.commit
            yield f"{name} was trained with other values than it has in this version (commit {commit})."


def published_section(layout: PublicationLayout) -> Section:
    """Return the published table. The best picture quality is bold, as in the publication."""
    frame = layout.published()
    methods = list(frame.columns[2:])
    blocks: dict[str, list[TableRow]] = {}
    for _, row in frame.iterrows():
        metric = BY_KEY[METRICS[row["metric"]][0]]
        values = row[methods].astype(float)
        best = values.max() if metric.better == "higher" else values.min()
        cells = [(row[m], "", values[m] == best and row["metric"] != "FPS") for m in methods]
        blocks.setdefault(row["dataset"], []).append(([(_label(metric), False, "")], cells))
    title = f"{layout.title}, as published (Shan et al. 2026, arXiv:2512.02664)"
    return Section(
        f"{layout.name}-published", title, ("metric",), methods, list(blocks.items()), [*_CAPTURES]
    )


def _measured_row(results: Results, scene: str, metric: Metric, columns: Mapping[str, str]) -> TableRow:
    all_rows = [row for row in results.table if row.scene == scene]
    rows = {i: row for name in columns.values() for i, row in enumerate(all_rows) if row.recipe == name}
    values = values_of(results.record, metric_of_runs(metric.key), [scene])
    means = {i: mean for i, row in rows.items() if (mean := row.cells[metric.key].mean) is not None}
    bold = leaders(means, values, metric, KNOWN_SCATTER.get(metric.key))
    cells = [score_cell(row, metric, i in bold, results) for i, row in rows.items()]
    return [(_label(metric), False, "")], cells


def _label(metric: Metric) -> str:
    return f"{metric.label} {metric.arrow}".rstrip()


RECORD = "results.json"
_REMEDY = "Join records of one commit, with the same recipes and settings."
_FREE = ("jobs", "seeds", "against")
"""Settings that may differ between joined records. The joined record contains the largest count."""


def join_tables(
    parts: Sequence[PathLike],
    out: PathLike,
    *,
    against: str | None = None,
    layout: LayoutName | None = None,
) -> Results:
    """Join the records of several comparisons, and write their tables.

    Scenes, seeds and recipes may be distributed over machines in any way, but each run may occur only once. Writes
    ``results.json``, ``.md``, ``.csv``, ``.tex`` and a ``report.html`` without pictures to ``out``, and
    ``differences.csv`` and ``parts.csv`` if they have rows.

    Args:
        parts: records, or folders that contain ``results.json``. Their order defines the order of scenes and recipes.
        out: output folder.
        against: reference recipe. Tables show the difference between each recipe and the reference.
        layout: layout of a publication for an additional table, ``LAYOUT.md`` and ``LAYOUT.tex``.

    Raises:
        PolarguideError: a file is not a record or would be overwritten. Records differ in code, settings, scenes or
            recipes. A run occurs twice. ``against`` is unknown. The records lack recipes of the layout.
    """
    paths = [Path(part) / RECORD if Path(part).is_dir() else Path(part) for part in parts]
    require(paths, "tables", expected="a record", found="none", remedy="Name at least one results.json.")
    written = os.path.realpath(Path(out) / RECORD)
    require(
        len(paths) == 1 or written not in map(os.path.realpath, paths),
        out,
        expected="a folder that contains none of the joined records",
        found=f"the folder of a joined record, whose {RECORD} would be overwritten",
        remedy="Give another --out.",
    )
    joined = Results(join_records({str(path): read_results(path) for path in paths}, against=against))
    refuse_scene(Path(out))
    make_folder(Path(out))
    write_tables(Path(out), joined)
    if layout is not None:
        check_choice("layout", layout, list(LAYOUTS))
        write_publication_tables(Path(out), joined, LAYOUTS[layout])
    write_text(Path(out) / REPORT, report_html(joined, [], {}, ["Pictures are in the reports of the parts."]))
    return joined


def join_records(records: dict[str, Record], *, against: str | None = None) -> Record:
    """Join the runs of several records into one record.

    Args:
        records: at least one record, by the name that messages use for it.
        against: reference recipe; see ``join_tables``.

    Raises:
        PolarguideError: see ``join_tables``.
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
            data = recipes.setdefault(recipe.name, recipe).data
            _check_same(data, recipe.data, f"{name} (recipe {recipe.name})", "another record")
        for run in record.runs:
            place = (run.scene, run.recipe, run.seed)
            earlier = runs.setdefault(place, run)
            require(
                earlier is run or "missing" in (run.state, earlier.state),
                name,
                expected="runs that occur in only one record",
                found=f"{run.scene}, {run.recipe}, seed {run.seed} once more",
                remedy="List each record once, and no record that contains runs of another.",
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
            sources=_unique(of.sources for of in provenances),
            command=_unique(of.command for of in provenances),
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


def _unique(texts: Iterable[str]) -> str:
    return "; ".join(dict.fromkeys(texts))


def _check_same_code(ours: Provenance, theirs: Provenance, label: str, name: str) -> None:
    """Check that two records have the same version, and the same commit or digest.

    Digests of the same commit may differ, because they include the compiled library.
    """
    _check_same(ours.version, theirs.version, f"{name} (provenance.version)", label)
    if (ours.commit is None or ours.commit != theirs.commit) and ours.sources != theirs.sources:
        code, other_code = (f"{of.sources}, commit {of.commit}" for of in (ours, theirs))
        _check_same(code, other_code, f"{name} (provenance.sources)", label)


def _check_same(first: object, found: object, where: str, label: str) -> None:
    expected = f"{shortened(first)}, as {label} has it"
    require(first == found, where, expected=expected, found=shortened(found), remedy=_REMEDY)
