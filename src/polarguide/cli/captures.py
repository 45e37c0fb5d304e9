"""Verbs of scene folders: prepare, inspect, present."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from polarguide.cli.console import ConsoleReporter, console, say, set_threads
from polarguide.core.options import ComputeOptions, ThreadOptions
from polarguide.core.text import command
from polarguide.inspection.settings import InspectSettings
from polarguide.preparation.settings import CalibrationOptions, PrepareSettings


def prepare_capture(
    source: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path,
    settings: Annotated[PrepareSettings, tyro.conf.arg(name="")],
    angles: Annotated[CalibrationOptions, tyro.conf.arg(name="")],
    compute: Annotated[ThreadOptions, tyro.conf.arg(name="")],
) -> None:
    """Convert camera files to a scene folder: raw mosaics, shots through a rotating filter, published datasets.

    The same command resumes a stopped preparation. docs/reference/formats.md describes the files.

    Args:
        source: Folder of raw mosaics (one file per view), filter shots (four subfolders, or four suffixes of names),
            ordinary photographs, or a dataset.
        out: Scene folder to write.
    """
    set_threads(compute.threads)
    preparation = importlib.import_module("polarguide.preparation.prepare")
    with_angles = replace(settings, calibration=angles.read(), analyzers=angles.analyzers())
    prepared = preparation.prepare_scene(source, out, with_angles, ConsoleReporter())
    without = f", {len(prepared.left_out)} left out" if prepared.left_out else ""
    say(f"scene: {prepared.folder} ({len(prepared.views)} views{without})")
    if prepared.posed:
        say(f"next: {command('inspect', prepared.folder)}")
        say(f"then: {command('train', prepared.folder, '--out', f'runs/{prepared.folder.name}')}")
    else:
        say("it has no poses: repeat the command with --poses sfm or --poses PATH and another --out")
        say(
            f"each view alone: {command('priors', prepared.folder, '--out', f'{prepared.folder.name}-priors')}"
        )


COLORS = {"ok": "green", "warning": "yellow", "wrong": "bold red", "n/a": "dim", "not verified": "magenta"}


def inspect_capture(
    scene: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path | None = None,
    settings: Annotated[InspectSettings, tyro.conf.arg(name="")],
    compute: Annotated[ComputeOptions, tyro.conf.arg(name="")],
) -> None:
    """Check a capture and its polarizer angles, and write a page and a JSON file.

    Each check results in ok, warning, wrong or n/a, and names a remedy. Camera poses are needed only to check the
    order, the direction of rotation and the zero of the angles. docs/how-to/inspect.md describes the checks
    and their limits.

    Args:
        scene: Scene folder.
        out: Folder for the page; default: SCENE-inspection next to the scene.
    """
    set_threads(compute.threads)
    reporter = ConsoleReporter()
    inspection = importlib.import_module("polarguide.inspection.inspect")
    folder = inspection.inspection_folder(scene, out)
    backend = importlib.import_module("polarguide.raster").choose_backend(compute.device, say=reporter.say)
    inspected = inspection.inspect_scene(scene, settings, backend, reporter)
    page, record = inspection.write_inspection(inspected, folder, reporter)
    _print_checks(inspected.checks)
    if inspected.capture.four:
        _print_angles(inspected.angles)
    _print_verdict(inspected)
    say(f"page: {page}   figures: {record}")


def _print_checks(checks: Any) -> None:
    previous = ""
    for check in checks:
        console.print(f"[{COLORS[check.verdict]}]{check.verdict:>12}[/]  ", end="")
        say(f"{check.title}: {check.finding}")
        if check.remedy not in ("", previous) and check.verdict != "ok":
            previous = check.remedy
            say(f"{'':14}{check.remedy}")


def _print_verdict(inspected: Any) -> None:
    """Print the worst result of all checks, and the checks that were not verified."""
    open_ = [check.title.lower() for check in inspected.checks if check.verdict == "not verified"]
    beside = f"; not verified: {', '.join(open_)}" if open_ and inspected.verdict != "not verified" else ""
    beside = f": {', '.join(open_)}" if inspected.verdict == "not verified" else beside
    console.print(f"verdict: [{COLORS[inspected.verdict]}]{inspected.verdict}[/]{beside}")


def _print_angles(angles: Any) -> None:
    """Print the probabilities of the orders and their sources."""
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


def present_folder(
    folder: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    white_balance: str = "",
    chart: str = "",
    exposure: str = "",
    tone_curve: str = "",
    up_axis: str = "",
    points: tuple[str, ...] = (),
    distance: str = "",
    meters_per_unit: str = "",
    crop: str = "",
    title: str = "",
    author: str = "",
    license: str = "",
    provenance: str = "",
    scene: Path | None = None,
    compute: ComputeOptions = ComputeOptions(),
) -> None:
    """Set how a scene or a run is shown and exported: color, up, scale, crop box, credit. Data and scores stay.

    The settings are in presentation.json in the folder. A scene's settings apply to all its runs; a run's own
    settings take precedence. Omitted options keep their values, "none" removes a value, and without options
    the settings are printed. `polarguide view RUN` sets crop box and exposure with the mouse. VIEW,X,Y is a pixel of a
    photograph, from its top left corner.

    Args:
        folder: Folder of a scene or a run.
        white_balance: gray (the photographs' mean becomes gray), gains such as 1.9,1,1.6, or VIEW,X,Y of something
            white or gray.
        chart: VIEW,X,Y,X,Y,X,Y,X,Y: the centers of the corner patches of a 24-patch color chart in a photograph,
            around it; or the folder of another scene with a chart. It replaces a white balance.
        exposure: Exposure compensation in stops, such as 0.5.
        tone_curve: soft compresses highlights smoothly instead of clipping them, in pictures but not in exports.
        up_axis: An axis such as z or --up-axis=-y, three numbers, or VIEW,X,Y of a level surface. Default: the up
            axis of the cameras.
        points: Two points of known distance: X,Y,Z in the scene, VIEW,X,Y on a surface, or VIEW for a camera's
            position.
        distance: Distance of the two points, such as 85mm.
        meters_per_unit: Length of a unit of the scene, in place of points and distance.
        crop: Box as --crop=left,right,down,up,front,back in percent of the cameras' distance; all: the whole scene.
            Default: the foreground of the scene's masks, or the region that most of the cameras see.
        title: Title, one line.
        author: Author of the capture.
        license: License, such as CC-BY-4.0.
        provenance: Place, time and equipment of the capture, or its inventory number.
        scene: New folder of a run's scene, if the scene was moved or is on another machine.
    """
    set_threads(compute.threads)
    presenting = importlib.import_module("polarguide.results.rendering.present")
    presented = presenting.present(
        folder,
        white_balance=white_balance or None,
        chart=chart or None,
        exposure=exposure or None,
        tone_curve=tone_curve or None,
        up_axis=up_axis or None,
        points=points,
        distance=distance or None,
        meters_per_unit=meters_per_unit or None,
        crop=crop or None,
        title=title or None,
        author=author or None,
        license=license or None,
        provenance=provenance or None,
        scene=scene,
        device=compute.device,
        reporter=ConsoleReporter(),
    )
    if scene is not None:
        say(f"the scene of {folder} is {scene}")
    for line in presenting.presentation_lines(presented):
        say(line)
