"""Verbs that compare recipes: compare, ablate, bench, tables."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

import polarguide
from polarguide.cli.console import ConsoleReporter, say, set_threads
from polarguide.core.errors import PolarguideError
from polarguide.core.text import whole_number
from polarguide.training.settings import Background, Materials, TrainSettings
from polarguide_bench.options import BenchOptions, CompareOptions, LayoutName

if TYPE_CHECKING:
    from polarguide_bench.results import Results


def compared_settings(
    refractive_index: float | None = None,
    background: Background = TrainSettings.background,
    materials: Materials = TrainSettings.materials,
) -> TrainSettings:
    return TrainSettings(refractive_index=refractive_index, background=background, materials=materials)


# Of these options; the seeds are counted, the others are fixed.
compared_settings.__doc__ = TrainSettings.__doc__
Scenes = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SCENE ...")]
Settings = Annotated[TrainSettings, tyro.conf.arg(name="", constructor=compared_settings)]
Options = Annotated[CompareOptions, tyro.conf.arg(name="")]


def compare_recipes(
    scenes: Scenes,
    /,
    *,
    recipes: tuple[str, ...],
    out: Path,
    steps: tuple[str, ...] = (),
    settings: Settings,
    options: Options,
) -> None:
    """Train and score several recipes on several scenes, and set tables and a report of them.

    Writes results.json, .md, .csv, .tex and report.html to the folder given by --out, and the runs to its runs/.
    Finished runs are found again and not repeated. Can be stopped with Ctrl-C at any time: the same command goes on.

    Args:
        scenes: Scene folders, as for train.
        recipes: The recipes to compare, by name: 3dgs, 3dgs-dr, polarguide, polarguide:without-normals, ...
        out: Folder to write.
        steps: Optimizer steps of every run, without it 5,000, and RECIPE=STEPS for each recipe that takes its own
            number: 5000 gnerp=10000.
    """
    set_threads(options.threads)
    common, steps_of = chosen_steps(steps)
    results = polarguide.compare(
        scenes,
        recipes,
        out,
        settings=replace(settings, steps=common),
        options=options,
        steps_of=steps_of,
        reporter=ConsoleReporter(),
    )
    print_results(results, out)


def chosen_steps(values: tuple[str, ...]) -> tuple[int | None, dict[str, int]]:
    """The number of steps that all take, None where it is not given, and those of recipes by name.

    Raises:
        PolarguideError: a word that is neither, or one twice.
    """
    common: list[int] = []
    own: dict[str, int] = {}
    for word in values:
        name, _, text = word.rpartition("=")
        number = whole_number(text)
        if number is None or name in own or (not name and common):
            raise PolarguideError(
                "--steps",
                expected="a number of steps, and RECIPE=STEPS for a recipe of its own, each once",
                found=" ".join(values),
                remedy="For example --steps 5000 gnerp=10000.",
            )
        if name:
            own[name] = number
        else:
            common.append(number)
    return next(iter(common), None), own


def print_results(results: Results, out: Path) -> None:
    """Print where the results are.

    Raises:
        PolarguideError: runs have failed.
    """
    say(f"tables: {out}/results.md, .csv, .tex, .json   report: {out}/report.html")
    failed = [run for run in results.record.runs if run.state == "failed"]
    if failed:
        errors = ", ".join(f"{run.scene}, {run.recipe}, seed {run.seed}: {run.error}" for run in failed)
        raise PolarguideError(
            out,
            expected=f"{len(results.record.runs)} finished runs",
            found=f"that {len(failed)} failed ({errors})",
            remedy="What there is has been written. Remove the cause and give the same command again.",
        )


def ablate_recipe(
    scenes: Scenes,
    /,
    *,
    out: Path,
    steps: int | None = None,
    settings: Settings,
    options: Options,
    base: str = "polarguide-stokes",
    only: tuple[str, ...] = (),
    reference: tuple[str, ...] = (),
) -> None:
    """Compare a recipe with its ablations: the same with one thing changed, each.

    It is compare with the recipe and its ablations as rows, and shares runs with a comparison in the same --out.

    Args:
        scenes: Scene folders, as for train.
        out: Folder to write, as for compare.
        steps: Optimizer steps of every run, without it 5,000.
        base: The recipe whose ablations to train.
        only: Names of the ablations to take, such as without-normals; all if none is given.
        reference: Recipes to add as first rows, such as 3dgs-dr.
    """
    set_threads(options.threads)
    results = polarguide.ablate(
        scenes,
        base,
        out,
        only=only,
        reference=reference,
        settings=replace(settings, steps=steps),
        options=options,
        reporter=ConsoleReporter(),
    )
    print_results(results, out)


def bench(
    *,
    out: Path,
    options: Annotated[BenchOptions, tyro.conf.arg(name="")],
) -> None:
    """Render the scenes of the benchmark that are missing, then train and score every recipe on each scene.

    Scenes are written to scenes/ below the folder given by --out. Tables and the report are written to development/
    for the scenes on which constants are tuned, to held-back/ for the others. Finished results are verified and reused,
    so the same command resumes after Ctrl-C. Rendering needs Mitsuba, as ``synth`` does.

    Args:
        out: Output folder.
    """
    set_threads(options.threads)
    run_bench = importlib.import_module("polarguide_bench.bench").run_bench
    results = run_bench(out, options, reporter=ConsoleReporter())
    if results is None:
        say(f"scenes: {out / 'scenes'}")
    else:
        print_results(results, out / options.half)


Records = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RESULTS ...")]


def tables(
    records: Records, /, *, out: Path, against: str | None = None, layout: LayoutName | None = None
) -> None:
    """Join the records of comparisons that were run apart, and set their tables anew.

    For comparisons and benches that are spread over machines or days: scenes, seeds and recipes may be shared out in
    any way. Writes results.json, .md, .csv, .tex and report.html (without pictures) to the folder given by --out.

    Args:
        records: Records of compare, ablate or bench (results.json), or folders with one.
        out: Folder to write.
        against: One of the recipes: tables have the difference of every other one to it.
        layout: Also write a table of PolarGuide-GSDR in its own layout, with the published values below:
            publication-1 compares methods, publication-2 has its ablations.
    """
    join_tables = importlib.import_module("polarguide_bench.join").join_tables
    results = join_tables(records, out, against=against, layout=layout)
    if layout is not None:
        say(f"layout: {out}/{layout}.md, .tex")
    print_results(results, out)
