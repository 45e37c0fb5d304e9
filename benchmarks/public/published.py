"""Prepare, train and score the captures of a published dataset, and compare the scores with published ones.

    python benchmarks/public/published.py pandora FOLDER --out OUT

``FOLDER`` is a capture of the dataset in its published layout, or a folder of such captures (``gnome``, ``owl``, ...).
The prepared scenes are in ``OUT/scenes``, and the results of ``polarguide compare`` are in ``OUT/NAME``. The file
``OUT/published.md`` has the measured scores, the published ones, and a table of their different conditions. After a
stop, the same command resumes.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import polarguide
from polarguide.cli.console import ConsoleReporter
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import write_text
from polarguide.preparation.datasets import detect_dataset
from polarguide_bench.join import LAYOUTS, measured_section, published_section
from polarguide_bench.results import Results
from polarguide_bench.tables import Section, readable
from polarguide_bench.verbs import print_results

RECIPES = ("3dgs", "3dgs-dr", "ref-gs", "polarguide-paper", "polarguide-paper:kind", "polarguide-stokes")
"""Recipes of the first table of PolarGuide-GSDR, without GNeRP, which trains for hours."""
LAYOUT = LAYOUTS["publication-1"]
"""Layout of the measured and of the published table."""
NOT_STATED = "not stated"
VALUES = "Compare differences between methods, not values. The last table lists the conditions."


@dataclass(frozen=True)
class PublishedDataset:
    """A published dataset and the published scores of its captures.

    Attributes:
        source: publication of the dataset.
        downscale: default width of the pixel blocks that are averaged. The longer side is then about 600 pixels.
        blocks: heading of a capture in the table of PolarGuide-GSDR, by the name of the capture's folder.
        notes: sentences on published scores that are not in that table.
    """

    source: str
    downscale: int
    blocks: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


_UNRECORDED = "The scores in the publication of the dataset itself are not recorded here."
PUBLISHED_DATASETS = {
    "pandora": PublishedDataset(
        "PANDORA (Dave et al. 2022, arXiv:2203.13458)", 2, {"gnome": "Gnome (indoor)"}, (_UNRECORDED,)
    ),
    "pisr": PublishedDataset(
        "PISR (Chen et al. 2024, arXiv:2409.14331)",
        2,
        {"gundam": "Gundam (indoor)"},
        (
            "PISR reports an L1 Chamfer distance of 0.5 mm and an F-score of 99.5 % at 1 mm for its surfaces. Both "
            "need a ground-truth mesh, which prepare does not read.",
        ),
    ),
    "nersp": PublishedDataset("NeRSP (Han et al. 2024, arXiv:2406.07111)", 1, notes=(_UNRECORDED,)),
    "neisf": PublishedDataset("NeISF (Li et al. 2024, arXiv:2311.13187)", 1, notes=(_UNRECORDED,)),
}
"""Published datasets by the name of their format."""


def find_captures(folder: Path, name: str) -> list[Path]:
    """Return the captures of a dataset: the folder itself, or its subfolders in the layout of the dataset.

    Raises:
        PolarguideError: there is no such capture.
    """
    places = [folder, *sorted(path for path in folder.iterdir() if path.is_dir())] if folder.is_dir() else []
    captures = [place for place in places if detect_dataset(place) == name]
    require(
        captures,
        folder,
        expected=f"a capture of {PUBLISHED_DATASETS[name].source}, or a folder of its captures",
        found=", ".join(sorted({detect_dataset(place) or "another layout" for place in places}))
        or "no folder",
        remedy="Unpack the dataset as published; docs/reference/formats.md lists its files.",
    )
    return captures[:1] if captures[0] == folder else captures


def check_recipes(recipes: Sequence[str]) -> None:
    """Check that the recipes have at least two columns in the table of PolarGuide-GSDR.

    Raises:
        PolarguideError: there are fewer columns.
    """
    columns = [*LAYOUT.columns.values()]
    require(
        len({*recipes} & {*columns}) >= 2,
        "--recipes",
        expected="at least two of " + ", ".join(columns),
        found=" ".join(recipes),
        remedy="Add recipes of the table. Other recipes are possible, but the table leaves them out.",
    )


def published_sections(results: Results, name: str) -> list[Section]:
    """Return the tables: measured scores, published scores of the same captures, and their conditions."""
    dataset = PUBLISHED_DATASETS[name]
    measured = measured_section(results, LAYOUT)
    wanted = [dataset.blocks[scene] for scene in results.scenes if scene in dataset.blocks]
    published = published_section(LAYOUT)
    blocks = [block for block in published.blocks if block[0] in wanted]
    published = published._replace(blocks=blocks, notes=[VALUES])
    absent = [scene for scene in results.scenes if scene not in dataset.blocks]
    notes = list(dataset.notes)
    if absent:
        notes.append(f"No published scores are recorded for {', '.join(absent)}.")
    return [
        measured._replace(title=f"Measured on {dataset.source}"),
        *([published] if wanted else []),
        conditions_section(results, notes),
    ]


def conditions_section(results: Results, notes: Sequence[str]) -> Section:
    """Return the table of the conditions of measured and published scores."""
    settings = results.record.settings
    views = "; ".join(
        f"{scene.name}: {len(scene.test_views)} of {scene.views}" for scene in results.record.scenes
    )
    rows = {
        "unit": ("displayed photograph (S0/2), linear light encoded as sRGB", NOT_STATED),
        "mask": ("none: all valid pixels, background included", NOT_STATED),
        "held-out views": (f"{views}; names in results.json", NOT_STATED),
        "size": (f"of the prepared pictures, divided by {settings.downscale}", NOT_STATED),
        "steps": (f"{settings.steps:,}", NOT_STATED),
        "poses": ("of the dataset", "not stated; Gnome starts from COLMAP points"),
        "FPS": (f"of this machine, with {settings.threads} threads", NOT_STATED),
        "differences between methods": ("comparable", "comparable"),
    }
    cells = [
        ([(subject, False, "")], [(here, "", False), (there, "", False)])
        for subject, (here, there) in rows.items()
    ]
    remarks = ["Scores with different units, masks, held-out views or sizes are not comparable.", *notes]
    return Section(
        "conditions",
        "Conditions",
        ("condition",),
        ["measured", "PolarGuide-GSDR"],
        [("all captures", cells)],
        remarks,
    )


def parsed() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", choices=PUBLISHED_DATASETS)
    parser.add_argument("folder", type=Path, help="a capture, or a folder of captures")
    parser.add_argument("--out", type=Path, required=True, help="output folder")
    parser.add_argument("--recipes", nargs="+", default=RECIPES, help="at least two recipes")
    parser.add_argument("--downscale", type=int, help="width of averaged pixel blocks; default by dataset")
    parser.add_argument("--steps", type=int, help="steps of each training; default 5,000")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="auto")
    return parser.parse_args()


def main() -> None:
    options = parsed()
    check_recipes(options.recipes)
    dataset = PUBLISHED_DATASETS[options.dataset]
    reporter = ConsoleReporter()
    scenes = []
    for capture in find_captures(options.folder, options.dataset):
        scenes.append(options.out / "scenes" / capture.resolve().name)
        settings = polarguide.PrepareSettings(format=options.dataset)
        polarguide.prepare(capture, scenes[-1], settings, reporter)
    results = polarguide.compare(
        scenes,
        options.recipes,
        options.out / options.dataset,
        settings=polarguide.TrainSettings(steps=options.steps),
        options=polarguide.CompareOptions(
            jobs=1,
            threads=options.threads,
            seeds=options.seeds,
            speed=True,
            downscale=dataset.downscale if options.downscale is None else options.downscale,
            device=options.device,
        ),
        reporter=reporter,
    )
    table = options.out / "published.md"
    write_text(table, readable(published_sections(results, options.dataset), "results.md"))
    reporter.say(f"table: {table}")
    print_results(results, options.out / options.dataset)


if __name__ == "__main__":
    try:
        main()
    except PolarguideError as error:
        raise SystemExit(f"error: {error}") from None
