"""Train and score all methods on all scenes of the final measurement, part by part.

    python benchmarks/final/measure.py SCENES OUT [--parts four bench ...] [--jobs 1] [--threads 1]

Each JSON file in this folder is a part: scenes, recipes with their numbers of seeds, and settings. SCENES contains the
scene folders, in a subfolder if the part names one. SCENES/heldout is the output of benchmarks/heldout/render.py, and
SCENES/bench is the folder scenes of polarguide bench --render-only.

Each part is a comparison in OUT/PART. Its record is copied to benchmarks/results/final/PART.json after the part, and
after Ctrl-C. The same command resumes; finished runs are not repeated. To add seeds, change the number in the part and
repeat the command. The tables are printed by

    python benchmarks/accuracy/bench_tables.py benchmarks/results/final/PART.json

Times and speeds are measured only with --jobs 1 on a machine without other work.
"""

from __future__ import annotations

import argparse
import shlex
import shutil
import sys
from collections.abc import Iterable
from pathlib import Path

import msgspec

import polarguide
from polarguide.cli.console import ConsoleReporter
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import make_folder
from polarguide.core.records import read_record
from polarguide.training.settings import TrainSettings
from polarguide_bench.options import CompareOptions
from polarguide_bench.recipes import recipe_named
from polarguide_bench.results import Results
from polarguide_bench.verbs import print_results

HERE = Path(__file__).resolve().parent
RECORDS = HERE.parent / "results" / "final"
PARTS = ("heldout", "four", "bench", "real", "publication", "gnerp", "ablations")
"""Parts in the order of the measurement."""


class Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Part of the final measurement.

    Attributes:
        about: description.
        scenes: names of the scene folders.
        steps: steps of each training.
        recipes: number of seeds of each recipe, in the order of the tables.
        folder: subfolder of the scenes.
        downscale: factor by which pictures are reduced.
        refractive_index: refractive index of all scenes, or None if each scene has its own.
        against: reference recipe of the differences, or None without differences.
    """

    about: str
    scenes: list[str]
    steps: int
    recipes: dict[str, int]
    folder: str = ""
    downscale: int = 1
    refractive_index: float | None = None
    against: str | None = None


def read_part(path: Path) -> Part:
    """Read a part, and check the names of its recipes.

    Raises:
        PolarguideError: the file is invalid, or a recipe is unknown.
    """
    part = read_record(path, Part, remedy="Name a part of benchmarks/final, or a valid JSON file.")
    for name in part.recipes:
        recipe_named(name)
    return part


def check_scenes(parts: Iterable[Part], scenes: Path) -> None:
    """Check that the scene folders of all parts exist, before a measurement of days begins.

    Raises:
        PolarguideError: at least one folder is missing.
    """
    folders = [scenes / part.folder / name for part in parts for name in part.scenes]
    missing = sorted({str(folder) for folder in folders if not folder.is_dir()})
    require(
        not missing,
        scenes,
        expected="the scene folders of all parts",
        found=f"no folder {', '.join(missing)}",
        remedy="Render or copy these scenes, or choose other parts by --parts.",
    )


def measure(part: Part, scenes: Path, out: Path, *, jobs: int, threads: int) -> Results:
    """Train and score the runs of a part that are not finished, and return their results.

    Raises:
        PolarguideError: the comparison fails.
    """
    return polarguide.compare(
        [scenes / part.folder / name for name in part.scenes],
        list(part.recipes),
        out,
        settings=TrainSettings(steps=part.steps, refractive_index=part.refractive_index),
        options=CompareOptions(
            jobs=jobs,
            threads=threads,
            seeds=max(part.recipes.values()),
            speed=jobs == 1,
            downscale=part.downscale,
            against=part.against,
        ),
        seeds_of=part.recipes,
        command_line=shlex.join(["python", *sys.argv]),
        reporter=ConsoleReporter(),
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--parts", nargs="+", default=PARTS, help="names of parts, or JSON files")
    parser.add_argument("--records", type=Path, default=RECORDS)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    try:
        parts = {
            Path(name).stem: read_part(HERE / f"{name}.json" if name in PARTS else Path(name))
            for name in options.parts
        }
        check_scenes(parts.values(), options.scenes)
        make_folder(options.records)
        results = {}
        for name, part in parts.items():
            print(f"{name}: {part.about}", flush=True)
            out = options.out / name
            try:
                results[out] = measure(part, options.scenes, out, jobs=options.jobs, threads=options.threads)
            finally:
                if (out / "results.json").exists():
                    shutil.copyfile(out / "results.json", options.records / f"{name}.json")
        for out, part_results in results.items():
            print_results(part_results, out)
    except PolarguideError as error:
        parser.error(str(error))
    except KeyboardInterrupt:
        sys.exit("Stopped. The same command resumes.")


if __name__ == "__main__":
    main()
