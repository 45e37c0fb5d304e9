"""``polarguide measure``."""

from __future__ import annotations

import importlib
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro

from polarguide.cli.console import ConsoleReporter, console, print_error, say, use_threads
from polarguide.core.errors import PolarguideError
from polarguide.core.options import ThreadOptions
from polarguide.core.system import StopSignals
from polarguide.preparation.settings import CalibrationOptions
from polarguide.shots.options import MeasureOptions, ShotOptions, WatchOptions


def measure(
    paths: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="PATH ...")] = (),
    /,
    *,
    out: Path,
    options: Annotated[MeasureOptions, tyro.conf.arg(name="")],
    watching: Annotated[WatchOptions, tyro.conf.arg(name="")],
    reading: Annotated[ShotOptions, tyro.conf.arg(name="")],
    angles: Annotated[CalibrationOptions, tyro.conf.arg(name="")],
    compute: Annotated[ThreadOptions, tyro.conf.arg(name="")],
) -> int:
    """A table of many shots for inspection lines: S0, DoLP and AoLP by region, limits, a golden part.

    Writes table.csv (a line per region), table.jsonl (a line per shot), and pictures of shots beyond their limits.
    The same command goes on where it stopped: what is in the table is not measured again. The exit status is 3 if a
    shot is beyond a limit, else 2 if one could not be read. docs/how-to/inspection-line.md shows the whole way.

    Args:
        paths: Raw mosaics, shots of four files, scenes, or folders of them.
        out: Folder of the table.
    """
    use_threads(compute.threads)
    if bool(paths) == (watching.watch is not None):
        raise PolarguideError(
            "--watch",
            expected="shots to measure, or a folder to watch",
            found="both" if paths else "neither",
            remedy="Give files and folders for one pass, or --watch FOLDER.",
        )
    for name in ("settle", "patience", "idle"):
        if watching.watch is None and getattr(watching, name) != getattr(WatchOptions, name):
            raise PolarguideError(
                f"--{name}",
                expected="--watch",
                found="one pass over files",
                remedy="Leave it out, or watch a folder.",
            )
    reading = replace(reading, calibration=angles.read(), analyzers=angles.analyzers())
    heard = partial(_print_entry, every=watching.watch is not None)
    if watching.watch is None:
        line = importlib.import_module("polarguide.shots.measurement.line")
        outcome = line.measure_shots(paths, out, options, reading, heard=heard, reporter=ConsoleReporter())
    else:
        watch = importlib.import_module("polarguide.shots.measurement.watch")
        with StopSignals() as should_stop:
            outcome = watch.watch_folder(
                watching.watch, out, options, reading, watching,
                should_stop=should_stop, heard=heard, reporter=ConsoleReporter(),
            )  # fmt: skip
    _print_outcome(outcome)
    if outcome.trouble:  # why nothing was found in a watched folder
        print_error(outcome.trouble)
    if outcome.waiting:
        names = ", ".join(outcome.waiting[:4]) + (", ..." if len(outcome.waiting) > 4 else "")
        unmeasured = f"{len(outcome.waiting)} that are not, and were not measured ({names})"
        remedy = "Complete, rename or remove their files; the same command goes on."
        error = PolarguideError(watching.watch, expected="complete shots", found=unmeasured, remedy=remedy)
        print_error(str(error))
    status: int = outcome.exit_status
    return status


def _print_entry(entry: Any, *, every: bool) -> None:
    """Print a shot that is beyond a limit or could not be read; ``every``: also one without a fault."""
    if entry.status == "unread":
        print_error(entry.why)
    elif entry.status == "beyond":
        console.print("[bold red]beyond:[/] ", end="")
        faults = (f"{row['region']} {row['why']}" for row in entry.regions if row["why"])
        say(f"{entry.shot}: {'; '.join(faults)}")
    elif every:
        say(f"{entry.status}: {entry.shot}")


def _print_outcome(outcome: Any) -> None:
    counts = outcome.counts
    shots = ", ".join(
        f"{counts[status]} {status}"
        for status in ("measured", "within", "beyond", "unread")
        if counts[status]
    )
    before = f" ({outcome.earlier} of them earlier)" if outcome.earlier else ""
    say(f"shots: {shots or 'none'}{before}")
    pictures = f"   pictures: {outcome.folder}/beyond" if counts["beyond"] else ""
    say(f"table: {outcome.folder}/table.csv, .jsonl{pictures}")
