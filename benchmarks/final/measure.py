"""Train and score all methods on all scenes of the final measurement, part by part.

    python benchmarks/final/measure.py SCENES OUT [--parts four bench ...] [--only SCENE ...] [--recipes RECIPE ...]

Each JSON file in this folder is a part: scenes, recipes with their numbers of seeds, and settings. SCENES contains the
scene folders, in a subfolder if the part names one. SCENES/heldout is the output of benchmarks/heldout/render.py, and
SCENES/bench is the folder scenes of polarguide bench --render-only.

The runs of a scene are in OUT/PART/SCENE, and its record is benchmarks/results/final/PART/SCENE.json. The record is
written after the scene, and after Ctrl-C. The same command resumes. It repeats no recipe whose seeds are all in the
record, also on another machine without OUT. To add seeds, change the number in the part and repeat the command. A
record of other code or settings is refused. The tables are printed by

    python benchmarks/accuracy/bench_tables.py benchmarks/results/final/PART/*.json

Times and speeds are measured only with --jobs 1 on a machine without other work. On a busy machine, --no-speed saves
the time of measurements that would be refused.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

import msgspec

import polarguide
from polarguide.cli.console import ConsoleReporter
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import make_folder, write_text
from polarguide.core.options import check_choice
from polarguide.core.records import read_record
from polarguide.results.evaluation.evaluate import code_digest, commit
from polarguide.training.settings import TrainSettings
from polarguide_bench.join import join_records
from polarguide_bench.options import CompareOptions
from polarguide_bench.recipes import recipe_named
from polarguide_bench.results import Record, read_results

HERE = Path(__file__).resolve().parent
RECORDS = HERE.parent / "results" / "final"
PARTS = ("heldout", "four", "bench", "metals", "real", "publication", "ablations")
"""Parts in the order of the measurement."""


class Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Part of the final measurement.

    Attributes:
        about: description.
        scenes: names of the scene folders.
        steps: steps of each training.
        recipes: number of seeds of each recipe, in the order of the tables.
        steps_of: steps of recipes for which they differ from ``steps``.
        folder: subfolder of the scenes.
        downscale: factor by which pictures are reduced.
        refractive_index: refractive index of all scenes, or None if each scene has its own.
        against: reference recipe of the differences, or None without differences.
    """

    about: str
    scenes: list[str]
    steps: int
    recipes: dict[str, int]
    steps_of: dict[str, int] = {}
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


def read_finished(path: Path, part: Part, threads: int) -> Record | None:
    """Return the finished runs of a part's recipes in a record, or None if there are none.

    Raises:
        PolarguideError: the record is invalid, or it was written by other code or with other settings.
    """
    if not path.exists():
        return None
    record = read_results(path)
    provenance = record.provenance
    require(
        provenance.sources == code_digest()
        or (provenance.commit is not None and provenance.commit == commit()),
        path,
        expected=f"a record of this code, whose digest is {code_digest()}",
        found=f"the digest {provenance.sources} of commit {provenance.commit}",
        remedy="Check out that commit, or remove the records and OUT to measure again.",
    )
    for name, value in (
        ("steps", part.steps),
        ("downscale", part.downscale),
        ("refractive_index", part.refractive_index),
        ("threads", threads),
    ):
        require(
            getattr(record.settings, name) == value,
            f"{path} (settings.{name})",
            expected=str(value),
            found=str(getattr(record.settings, name)),
            remedy="Measure with the settings of the record, or remove the record.",
        )
    runs = [run for run in record.runs if run.state == "done" and run.recipe in part.recipes]
    recipes = [recipe for recipe in record.recipes if recipe.name in part.recipes]
    return msgspec.structs.replace(record, runs=runs, recipes=recipes) if runs else None


def selected(parts: Mapping[str, Part], scenes: Collection[str], recipes: Collection[str]) -> dict[str, Part]:
    """Return the parts that have at least one of the scenes and of the recipes, with these scenes only.

    An empty collection selects everything.

    Raises:
        PolarguideError: no part has one of the scenes or one of the recipes.
    """
    for scene in scenes:
        check_choice("--only", scene, sorted({scene for part in parts.values() for scene in part.scenes}))
    for recipe in recipes:
        check_choice("--recipes", recipe, sorted({name for part in parts.values() for name in part.recipes}))
    chosen = {}
    for name, part in parts.items():
        named = [scene for scene in part.scenes if not scenes or scene in scenes]
        if named and (not recipes or part.recipes.keys() & set(recipes)):
            chosen[name] = msgspec.structs.replace(part, scenes=named)
    return chosen


def missing_recipes(part: Part, scene: str, finished: Record | None, only: Collection[str]) -> dict[str, int]:
    """Return the recipes of a part with fewer finished runs on a scene than seeds, and their numbers of seeds.

    If ``only`` names recipes, all other recipes are left out.
    """
    runs = [] if finished is None else finished.runs
    done = Counter(run.recipe for run in runs if run.scene == scene)
    wanted = {recipe: seeds for recipe, seeds in part.recipes.items() if not only or recipe in only}
    return {recipe: seeds for recipe, seeds in wanted.items() if done[recipe] < seeds}


def joined(finished: Record | None, measured: Record, part: Part) -> Record:
    """Return the runs of a new record, and earlier finished runs that it does not have, in the order of the part."""
    done = {(run.recipe, run.seed) for run in measured.runs if run.state == "done"}
    earlier = [] if finished is None else finished.runs
    kept = {(run.recipe, run.seed): run for run in earlier if (run.recipe, run.seed) not in done}
    runs = [run for run in measured.runs if (run.recipe, run.seed) not in kept]
    records = {"the measurement": msgspec.structs.replace(measured, runs=runs)}
    if finished is not None and kept:
        records["the earlier record"] = msgspec.structs.replace(finished, runs=list(kept.values()))
    known = {recipe.name for record in records.values() for recipe in record.recipes}
    record = join_records(records, against=part.against if part.against in known else None)
    order = list(part.recipes)
    return msgspec.structs.replace(
        record,
        recipes=sorted(record.recipes, key=lambda recipe: order.index(recipe.name)),
        runs=sorted(record.runs, key=lambda run: (order.index(run.recipe), run.seed)),
    )


def measure(
    part: Part,
    scene: Path,
    out: Path,
    path: Path,
    *,
    only: Collection[str] = (),
    speed: bool = False,
    jobs: int = 1,
    threads: int = 1,
) -> Record:
    """Train and score the runs of a part on a scene that are not in its record, and write the record.

    Args:
        part: recipes and settings.
        scene: scene folder.
        out: folder for the runs.
        path: record of the scene.
        only: recipes to train now; empty for all recipes of the part.
        speed: measure frames per second after all trainings.
        jobs: number of simultaneous runs.
        threads: threads of each run.

    Raises:
        PolarguideError: the comparison fails, or other code wrote the record.
    """
    finished = read_finished(path, part, threads)
    missing = missing_recipes(part, scene.name, finished, only)
    if finished is not None and not missing:
        return finished
    written = out / "results.json"
    written.unlink(missing_ok=True)  # of an earlier call, perhaps of other code
    try:
        polarguide.compare(
            [scene],
            list(missing),
            out,
            settings=TrainSettings(steps=part.steps, refractive_index=part.refractive_index),
            options=CompareOptions(
                jobs=jobs,
                threads=threads,
                seeds=max(missing.values()),
                speed=speed,
                downscale=part.downscale,
            ),
            seeds_of=missing,
            steps_of={name: steps for name, steps in part.steps_of.items() if name in missing},
            command_line=f"python benchmarks/final/measure.py SCENES OUT --parts {path.parent.name}",
            reporter=ConsoleReporter(),
        )
    finally:
        if written.exists():
            record = joined(finished, read_results(written), part)
            write_text(path, json.dumps(msgspec.to_builtins(record), indent=1, allow_nan=False) + "\n")
    return record


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--parts", nargs="+", default=PARTS, help="names of parts, or JSON files")
    parser.add_argument("--only", nargs="+", default=(), metavar="SCENE", help="names of scenes")
    parser.add_argument(
        "--recipes", nargs="+", default=(), help="recipes to train now; a later call adds others"
    )
    parser.add_argument("--records", type=Path, default=RECORDS)
    parser.add_argument("--no-speed", action="store_true", help="leave out frames per second")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    try:
        parts = {
            Path(name).stem: read_part(HERE / f"{name}.json" if name in PARTS else Path(name))
            for name in options.parts
        }
        parts = selected(parts, options.only, options.recipes)
        check_scenes(parts.values(), options.scenes)
        records = {
            options.records / name / f"{scene}.json": (name, part, scene)
            for name, part in parts.items()
            for scene in part.scenes
        }
        for path, (_, part, _) in records.items():
            read_finished(path, part, options.threads)
        failed = []
        for path, (name, part, scene) in records.items():
            print(f"{name}: {part.about}: {scene}", flush=True)
            make_folder(path.parent)
            folder = options.scenes / part.folder / scene
            out = options.out / name / scene
            record = measure(
                part,
                folder,
                out,
                path,
                only=options.recipes,
                speed=options.jobs == 1 and not options.no_speed,
                jobs=options.jobs,
                threads=options.threads,
            )
            failed += [
                f"{path}, {run.recipe}, seed {run.seed}: {run.error}" for run in record.runs if run.error
            ]
        print(f"records: {options.records}")
    except PolarguideError as error:
        parser.error(str(error))
    except KeyboardInterrupt:
        sys.exit("Stopped. The same command resumes.")
    if failed:
        sys.exit("These runs have failed. Remove the cause and repeat the command.\n" + "\n".join(failed))


if __name__ == "__main__":
    main()
