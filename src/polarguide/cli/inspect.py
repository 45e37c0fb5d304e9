"""``polarguide inspect``."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Annotated, Any

import tyro

from polarguide.cli.console import ConsoleReporter, console, say, use_threads
from polarguide.core.errors import PolarguideError
from polarguide.core.options import ComputeOptions
from polarguide.inspection.settings import InspectSettings

COLORS = {"ok": "green", "warning": "yellow", "wrong": "bold red", "n/a": "dim", "not verified": "magenta"}


def inspect(
    scene: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path | None = None,
    fix: Path | None = None,
    settings: Annotated[InspectSettings, tyro.conf.arg(name="")],
    compute: Annotated[ComputeOptions, tyro.conf.arg(name="")],
) -> None:
    """Check a capture: a page, a JSON file, and the order of its angles by geometry.

    Each check ends in ok, warning, wrong or n/a, and says what to do. Works without poses; order, sense and zero of the
    angles take poses. docs/how-to/inspect.md describes the checks and what they cannot decide.

    Args:
        scene: Scene folder.
        out: Folder to write; without it SCENE-inspection beside the scene.
        fix: New folder for a corrected copy of the scene, if order, sense or zero are wrong and decided.
    """
    if fix is not None and settings.calibration is not None:
        raise PolarguideError(
            "--fix",
            expected="no --calibration beside it: the copy would be without it",
            found="both",
            remedy="Prepare the mosaics anew with --calibration, and fix that scene.",
        )
    use_threads(compute.threads)
    reporter = ConsoleReporter()
    inspection = importlib.import_module("polarguide.inspection.inspect")
    folder = inspection.inspection_folder(scene, out)
    backend = importlib.import_module("polarguide.raster").choose_backend(compute.device, say=reporter.say)
    inspected = inspection.inspect_scene(scene, folder, settings, backend, reporter)
    page, record = importlib.import_module("polarguide.inspection.report").write_inspection(
        inspected, folder, reporter
    )
    _print_checks(inspected.checks)
    if inspected.capture.four:
        _print_angles(inspected.angles)
    _print_verdict(inspected)
    say(f"page: {page}   figures: {record}")
    if fix is not None:
        _fix(inspected, fix, reporter)


def _fix(inspected: Any, out: Path, reporter: ConsoleReporter) -> None:
    """Write the corrected copy, or say that there is nothing to correct."""
    fixing = importlib.import_module("polarguide.inspection.corrections")
    if not inspected.capture.four:
        raise PolarguideError(
            "--fix",
            expected="a scene with four pictures of each view",
            found="one with other pictures, whose angles are given in a table",
            remedy="Correct SCENE/angles.csv as the report says, or repeat prepare.",
        )
    change = fixing.correction(inspected.capture, inspected.angles)
    if change is None:
        say("fix: order, sense and zero are right; nothing was written.")
        return
    copy = fixing.fix_scene(inspected.capture, change, out, reporter)
    say(f"fixed: {out}: {copy}. {inspected.capture.root} is as it was.")


def _print_checks(checks: Any) -> None:
    previous = ""
    for check in checks:
        console.print(f"[{COLORS[check.verdict]}]{check.verdict:>12}[/]  ", end="")
        say(f"{check.title}: {check.finding}")
        if check.remedy not in ("", previous) and check.verdict != "ok":
            previous = check.remedy
            say(f"{'':14}{check.remedy}")


def _print_verdict(inspected: Any) -> None:
    """The worst of all checks, and what nobody has verified."""
    open_ = [check.title.lower() for check in inspected.checks if check.verdict == "not verified"]
    beside = f"; not verified: {', '.join(open_)}" if open_ and inspected.verdict != "not verified" else ""
    beside = f": {', '.join(open_)}" if inspected.verdict == "not verified" else beside
    console.print(f"verdict: [{COLORS[inspected.verdict]}]{inspected.verdict}[/]{beside}")


def _print_angles(angles: Any) -> None:
    """The odds of the orders, and what they come from."""
    if angles.hypotheses:
        say("order of the pictures called 0, 45, 90, 135: probability (log-odds to the best)")
    for row in sorted(angles.hypotheses, key=lambda row: -row.probability):
        files = ", ".join(f"{angle:3d}" for angle in row.files)
        say(
            f"  {files}   {row.probability:7.2%}  ({0.0 - row.log_odds:.1f})  {row.order.label}",
        )
    for evidence in angles.sources:
        used = "" if evidence.usable else " (not used)"
        say(f"  {evidence.source}{used}: {evidence.note}")
