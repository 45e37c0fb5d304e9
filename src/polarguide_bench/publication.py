"""The two tables of PolarGuide-GSDR (Shan et al. 2026) in its own layout: measured values, then the published ones."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib.resources import files
from io import StringIO
from pathlib import Path

import pandas as pd

from polarguide.core.errors import PolarguideError
from polarguide.core.files import write_text
from polarguide.results.evaluation.table import COLUMNS, Metric
from polarguide_bench.recipes import recipe_named
from polarguide_bench.results import Results, metric_of_runs, scatter_on, values_of
from polarguide_bench.tables import Section, TableRow, leaders, notes, readable, score_cell

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
