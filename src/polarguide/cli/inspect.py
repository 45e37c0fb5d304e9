"""``polarguide inspect``."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import cv2
import tyro
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from polarguide.cli.common import Transfer, console, use_threads
from polarguide.cli.train import check_count
from polarguide.errors import PolarguideError
from polarguide.files import atomic
from polarguide.inspection.fix import correction, fix_scene
from polarguide.inspection.inspect import Inspection, InspectSettings, Normals, inspect_scene
from polarguide.inspection.orders import ORDERS, PAIRINGS
from polarguide.inspection.page_html import FILE as PAGE
from polarguide.inspection.page_html import inspection_html
from polarguide.inspection.record import write_record
from polarguide.inspection.verdict import Verdict
from polarguide.raster import DeviceName, choose_backend

COLORS: dict[Verdict, str] = {"ok": "green", "look": "yellow", "wrong": "bold red", "n/a": "dim"}


def inspect(
    scene: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path | None = None,
    fix: Path | None = None,
    normals: Normals = "auto",
    steps: int = 600,
    refractive_index: float | None = None,
    downscale: int = 0,
    transfer: Transfer = "linear",
    device: DeviceName = "auto",
    threads: int = 0,
) -> None:
    """What is right and wrong with a capture: a page, a JSON file, and the order of its angles by geometry.

    Each check ends in ok, look, wrong or n/a, and says what to do. Works without poses; order, sense and zero of the
    angles take poses. docs/inspect.md describes the checks and what they cannot decide.

    Args:
        scene: Scene folder.
        out: Folder to write; without it SCENE-inspection beside the scene.
        fix: New folder for a corrected copy of the scene, if order, sense or zero are wrong and decided.
        normals: points uses points seen in several views alone; train also trains for normals, without polarization;
            auto does so where the points do not decide.
        steps: Optimizer steps of that training. It is kept in --out and goes on where it stopped.
        refractive_index: Of the surfaces; without it as scene.json says, else 1.5.
        downscale: Average the pictures over boxes of this many pixels first; 0 until they are at most 640 pixels wide.
        transfer: How the files encode radiance.
        device: What the training computes on.
        threads: Threads to use; 0 takes all cores.
    """
    use_threads(threads)
    if threads:
        cv2.setNumThreads(threads)
    check_count("--steps", steps)
    check_count("--downscale", downscale + 1)
    if refractive_index is not None and not 1.0 < refractive_index < 4.0:
        raise PolarguideError(
            "--refractive-index",
            expected="between 1 and 4",
            found=str(refractive_index),
            remedy="1.5 suits most.",
        )
    folder = out if out is not None else scene.resolve().with_name(scene.resolve().name + "-inspection")
    if folder.exists() and not folder.is_dir():
        raise PolarguideError(
            folder, expected="a folder to write", found="a file", remedy="Give another --out."
        )
    settings = InspectSettings(downscale, transfer, refractive_index, normals, steps)
    found = inspect_scene(scene, folder, settings, choose_backend(device), track=_track)
    folder.mkdir(parents=True, exist_ok=True)
    record = write_record(found, folder)
    with _track("drawing", len(found.capture.views)) as advance, atomic(folder / PAGE) as path:
        path.write_text(inspection_html(found, advance), encoding="utf-8")
    _say(found)
    console.print(f"page: {folder / PAGE}   figures: {record}", markup=False)
    if fix is not None:
        _fix(found, fix)


def _say(found: Inspection) -> None:
    """The checks and the odds of the orders on the console."""
    for check in found.checks:
        console.print(f"[{COLORS[check.verdict]}]{check.verdict:>5}[/]  ", end="")
        console.print(f"{check.title}: {check.finding}", markup=False)
        if check.remedy and check.verdict != "ok":
            console.print(f"       {check.remedy}", markup=False)
    odds = found.angles.odds
    if odds is not None:
        console.print("order of the pictures called 0, 45, 90, 135: probability (log-odds to the best)")
        ranked = sorted(zip(ORDERS, odds.probabilities, odds.log_odds, strict=True), key=lambda row: -row[1])
        for order, probability, against in ranked:
            files = ", ".join(f"{angle:3d}" for angle in order.files(PAIRINGS[found.angles.pairing]))
            console.print(
                f"  {files}   {probability:7.2%}  ({0.0 - against:.1f})  {order.label}", markup=False
            )
    for evidence in found.angles.sources:
        used = "" if evidence.usable else " (not used)"
        console.print(f"  {evidence.source}{used}: {evidence.note}", markup=False)


def _fix(found: Inspection, out: Path) -> None:
    """Write the corrected copy, or say that there is nothing to correct."""
    change = correction(found.capture, found.angles)
    if change is None:
        console.print("fix: order, sense and zero are right; nothing was written.")
        return
    with _track("fixing", len(found.capture.views)) as advance:
        done = fix_scene(found.capture, change, out, advance)
    console.print(f"fixed: {out}: {done}. {found.capture.root} is as it was.", markup=False)


@contextlib.contextmanager
def _track(label: str, total: int) -> Iterator[Callable[[int], None]]:
    """A progress bar; a total of 0 is one not known yet."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(label, total=total or None)
        yield lambda done: progress.update(task, completed=done)
