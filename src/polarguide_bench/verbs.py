"""Verbs of comparisons and collections: compare, ablate, bench, tables and batch."""

from __future__ import annotations

import contextlib
import importlib
import io
import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

import polarguide
from polarguide.cli.console import ConsoleReporter, say, set_threads
from polarguide.core.errors import PolarguideError, require, require_package
from polarguide.core.files import read_rows, stored
from polarguide.core.options import EXPORT_PACKAGES, SceneOptions
from polarguide.core.text import canonical, whole_number
from polarguide.preparation.settings import CalibrationOptions, PrepareSettings
from polarguide.training.settings import Background, Materials, TrainSettings
from polarguide_bench.children import Capture
from polarguide_bench.options import BatchOptions, BenchOptions, CompareOptions, LayoutName

if TYPE_CHECKING:
    from polarguide_bench.results import Results


def compared_settings(
    refractive_index: float | None = None,
    background: Background = TrainSettings.background,
    materials: Materials = TrainSettings.materials,
) -> TrainSettings:
    return TrainSettings(refractive_index=refractive_index, background=background, materials=materials)


# The command line reads the help of these options from the docstring.
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
    """Train and score several recipes on several scenes, and write tables and a report.

    Writes results.json, .md, .csv, .tex and report.html to the folder given by --out, and the runs to its runs/.
    Finished runs are not repeated. Ctrl-C stops at any time, and the same command resumes.

    Args:
        scenes: Scene folders, as for train.
        recipes: Names of the recipes: 3dgs, 3dgs-dr, polarguide, polarguide:without-normals, ...
        out: Output folder.
        steps: Optimizer steps of every run (default 5,000), and RECIPE=STEPS for each recipe with its own number:
            5000 gnerp=10000.
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
    """Parse numbers of steps.

    Returns:
        The number for all recipes, or None if it is not specified, and the numbers of individual recipes by name.

    Raises:
        PolarguideError: a value is invalid, or a recipe occurs twice.
    """
    steps: dict[str, int] = {}
    for value in values:
        name, _, text = value.rpartition("=")
        number = whole_number(text)
        if number is None or name in steps:
            raise PolarguideError(
                "--steps",
                expected="one number of steps for all recipes, and at most one RECIPE=STEPS for each recipe",
                found=" ".join(values),
                remedy="Follow the example --steps 5000 gnerp=10000.",
            )
        steps[name] = number
    return steps.pop("", None), steps


def print_results(results: Results, out: Path) -> None:
    """Print the paths of the results.

    Raises:
        PolarguideError: at least one run has failed.
    """
    say(f"tables: {out}/results.md, .csv, .tex, .json   report: {out}/report.html")
    runs = results.record.runs
    failed = [
        f"{run.scene}, {run.recipe}, seed {run.seed}: {run.error}" for run in runs if run.state == "failed"
    ]
    require(
        not failed,
        out,
        expected=f"{len(runs)} finished runs",
        found=f"{len(failed)} failed runs ({', '.join(failed)})",
        remedy="Results of the other runs have been written. Remove the cause, and repeat the command.",
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
    """Compare a recipe with its ablations. Each ablation changes one thing.

    It is compare with the recipe and its ablations as rows. A comparison in the same --out shares its runs.

    Args:
        scenes: Scene folders, as for train.
        out: Output folder, as for compare.
        steps: Optimizer steps of every run (default 5,000).
        base: The recipe.
        only: Names of the ablations, such as without-normals; all if none is given.
        reference: Recipes for additional first rows, such as 3dgs-dr.
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
    """Join the records of several comparisons, and write their tables.

    For comparisons and benches that are distributed over machines or days. Scenes, seeds and recipes may be distributed
    in any way. Writes results.json, .md, .csv, .tex and report.html (without pictures) to the folder given by --out.

    Args:
        records: Records of compare, ablate or bench (results.json), or folders with one.
        out: Output folder.
        against: Reference recipe. Tables show the difference of every other recipe to it.
        layout: Also write a table of PolarGuide-GSDR in its own layout, with the published values below:
            publication-1 compares methods, publication-2 has its ablations.
    """
    join_tables = importlib.import_module("polarguide_bench.join").join_tables
    results = join_tables(records, out, against=against, layout=layout)
    if layout is not None:
        say(f"layout: {out}/{layout}.md, .tex")
    print_results(results, out)


COLUMNS = ("name", "path", "sensor", "options")
"""Columns of a CSV file that lists captures."""
_NAME = re.compile(r"[^\s./\\][^/\\\x00-\x1f]*")
"""Name of a capture that is also valid as the name of a folder."""


def batch(
    collection: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path,
    options: str = "",
    settings: Annotated[BatchOptions, tyro.conf.arg(name="")],
) -> None:
    """Prepare, inspect, train, score, share and export every capture of a collection, with one overview page.

    Writes captures/NAME for each capture, and index.html and results.csv for all, to the folder given by --out. A
    failed capture is a row with its error and does not affect others. Ctrl-C stops at any time. The same command
    resumes, and retries failed captures.

    Args:
        collection: A folder with a folder for each capture; or a CSV file with the columns name, path (relative to
            the file) and, optionally, sensor and options.
        out: Output folder.
        options: Options of prepare and train for all captures: --options="--poses sfm --steps 3000". Those of a line of
            the CSV file override them. --recipe accepts several recipes.
    """
    set_threads(settings.threads)
    for kind in settings.formats:
        for package in EXPORT_PACKAGES.get(kind, ()):
            require_package(package, f"--formats {kind}")
    lines = _lines(collection, out)
    require(
        lines,
        collection,
        expected="a folder of captures, or a table of captures",
        found="no capture",
        remedy="Put each capture into its own folder, or write a CSV file with the columns name and path.",
    )
    module = importlib.import_module("polarguide_bench.batch")
    captures = [_capture(line, module.is_posed_scene(line.path), options) for line in lines]
    rows = module.run_batch(captures, out, settings, reporter=ConsoleReporter())
    say(f"page: {out / 'index.html'}   table: {out / 'results.csv'}")
    failed = {row.name: f"{row.name}: {row.error}" for row in rows if row.state == "failed"}
    require(
        not failed,
        out,
        expected=f"{len(captures)} finished captures",
        found=f"{len(failed)} failed captures ({'; '.join(failed.values())})",
        remedy="All other captures are finished. Remove the cause, and repeat the command.",
    )


@dataclass(frozen=True)
class _Line:
    """Capture in a collection. ``where`` names its folder or its line of the CSV file in messages."""

    where: str
    name: str
    path: Path
    sensor: str = ""
    options: str = ""


def _lines(collection: Path, out: Path) -> list[_Line]:
    """Return the captures of a collection in the order of the folders or lines.

    Raises:
        PolarguideError: the collection is neither a folder of folders nor a valid CSV file.
    """
    lines = _table(collection) if collection.is_file() else _folders(collection, out)
    places: dict[str, str] = {}
    for line in lines:
        require(
            _NAME.fullmatch(line.name),
            line.where,
            expected="a valid folder name",
            found=repr(line.name[:100]),
            remedy="Change the name.",
        )
        first = places.setdefault(line.name.lower(), line.where)
        require(
            first is line.where,
            line.where,
            expected="different names",
            found=f"{line.name}, as in {first}",
            remedy="Name each capture once.",
        )
    return lines


def _folders(collection: Path, out: Path) -> list[_Line]:
    require(
        collection.is_dir(),
        collection,
        expected="a folder of captures, or a CSV file",
        found="no such file or folder",
        remedy="Check the name.",
    )
    folders = sorted(path for path in collection.iterdir() if path.is_dir() and path.name[0] not in ".")
    return [
        _Line(str(path), canonical(path.name), path) for path in folders if path.resolve() != out.resolve()
    ]


def _table(file: Path) -> list[_Line]:
    rows = read_rows(file, "Save it as CSV in UTF-8.")
    columns = [name.lower() for name in rows[0][1]] if rows else []
    require(
        {"name", "path"} <= set(columns) <= set(COLUMNS) and len(set(columns)) == len(columns),
        f"{file} (first line)",
        expected="the columns name and path, and optionally sensor and options",
        found=", ".join(map(repr, columns)) or "nothing",
        remedy="Write the names of the columns into the first line.",
    )
    lines = []
    for number, row in rows[1:]:
        where = f"{file} (line {number})"
        require(
            len(row) == len(columns),
            where,
            expected=f"{len(columns)} values",
            found="more values" if len(row) > len(columns) else "fewer values",
            remedy="Put each value that contains a delimiter into double quotes.",
        )
        values = dict(zip(columns, row, strict=True))
        require(values["path"], where, expected="a path", found="an empty value", remedy="Name its folder.")
        path = stored(file.parent / values.pop("path"))
        lines.append(_Line(where, canonical(values.pop("name")), path, **values))
    return lines


def _capture(line: _Line, scene: bool, common: str) -> Capture:
    """Parse the options of a capture.

    Raises:
        PolarguideError: an option is unknown, or a value is invalid.
    """
    words = [*_words(common, "--options"), *(["--sensor", line.sensor] if line.sensor and not scene else ())]
    words += _words(line.options, line.where)
    try:
        prepare, rest = (PrepareSettings(), words) if scene else _parsed(_prepared, words)
        (recipes, settings, reading), unknown = _parsed(_trained, rest)
    except SystemExit:
        unknown = words
    except PolarguideError as error:
        where = f"{line.where}, {error.where}"
        raise PolarguideError(
            where, expected=error.expected, found=error.found, remedy=error.remedy
        ) from None
    require(
        not unknown,
        f"{line.where} (options)",
        expected="options of train" if scene else "options of prepare and train",
        found=shlex.join(words),
        remedy="polarguide train --help and polarguide prepare --help list them.",
    )
    return Capture(line.name, line.path, prepare, recipes, settings, reading)


def _words(text: str, where: str) -> list[str]:
    try:
        return shlex.split(text)
    except ValueError as error:
        raise PolarguideError(
            where,
            expected="options as on the command line",
            found=f"{text!r}: {error}",
            remedy="Close the quotes.",
        ) from None


def _parsed(kind: Callable[..., Any], words: Sequence[str]) -> tuple[Any, list[str]]:
    """Call a function with command-line options, and return its result and the unknown options.

    Raises:
        SystemExit: a value is invalid.
    """
    function = tyro.conf.configure(tyro.conf.OmitArgPrefixes)(kind)
    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
        return tyro.cli(function, args=words, return_unknown_args=True)


def _prepared(
    settings: Annotated[PrepareSettings, tyro.conf.arg(name="")],
    angles: Annotated[CalibrationOptions, tyro.conf.arg(name="")],
) -> PrepareSettings:
    return replace(settings, calibration=angles.read(), analyzers=angles.analyzers()).checked()


def _trained(
    recipe: tuple[str, ...] = Capture.recipes,
    settings: TrainSettings = TrainSettings(),
    reading: SceneOptions = SceneOptions(),
) -> tuple[tuple[str, ...], TrainSettings, SceneOptions]:
    return recipe, settings, reading
