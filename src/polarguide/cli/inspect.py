"""``polarguide inspect``."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

import polarguide
from polarguide.cli.console import console
from polarguide.cli.progress import REPORTER
from polarguide.errors import PolarguideError
from polarguide.options import ComputeOptions, Transfer, check_count

COLORS = {"ok": "green", "look": "yellow", "wrong": "bold red", "n/a": "dim"}


def inspect(
    scene: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path | None = None,
    fix: Path | None = None,
    normals: Literal["auto", "points", "train"] = "auto",
    steps: int = 600,
    refractive_index: float | None = None,
    downscale: int = 0,
    transfer: Transfer = "linear",
    compute: ComputeOptions = ComputeOptions(),
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
    """
    polarguide.use_threads(compute.threads)
    check_count("steps", steps)
    check_count("downscale", downscale, 0)
    if refractive_index is not None and not 1.0 < refractive_index < 4.0:
        raise PolarguideError(
            "refractive_index",
            expected="between 1 and 4",
            found=str(refractive_index),
            remedy="1.5 suits most.",
        )
    inspection = import_module("polarguide.inspection.inspect")
    settings = inspection.InspectSettings(downscale, transfer, refractive_index, normals, steps)
    found = polarguide.inspect(scene, out, settings=settings, device=compute.device, reporter=REPORTER)
    _say(found)
    folder = out or import_module("polarguide.api").inspection_folder(scene)
    console.print(f"page: {folder}/inspection.html   figures: {folder}/inspection.json", markup=False)
    if fix is not None:
        _fix(found, fix)


def _say(found: Any) -> None:
    """The checks and the odds of the orders on the console."""
    for check in found.checks:
        console.print(f"[{COLORS[check.verdict]}]{check.verdict:>5}[/]  ", end="")
        console.print(f"{check.title}: {check.finding}", markup=False)
        if check.remedy and check.verdict != "ok":
            console.print(f"       {check.remedy}", markup=False)
    orders = import_module("polarguide.inspection.orders")
    odds = found.angles.odds
    if odds is not None:
        console.print("order of the pictures called 0, 45, 90, 135: probability (log-odds to the best)")
        ranked = sorted(
            zip(orders.ORDERS, odds.probabilities, odds.log_odds, strict=True), key=lambda row: -row[1]
        )
        for order, probability, against in ranked:
            files = ", ".join(f"{angle:3d}" for angle in order.files(orders.PAIRINGS[found.angles.pairing]))
            console.print(
                f"  {files}   {probability:7.2%}  ({0.0 - against:.1f})  {order.label}", markup=False
            )
    for evidence in found.angles.sources:
        used = "" if evidence.usable else " (not used)"
        console.print(f"  {evidence.source}{used}: {evidence.note}", markup=False)


def _fix(found: Any, out: Path) -> None:
    """Write the corrected copy, or say that there is nothing to correct."""
    fix = import_module("polarguide.inspection.fix")
    change = fix.correction(found.capture, found.angles)
    if change is None:
        console.print("fix: order, sense and zero are right; nothing was written.")
        return
    with REPORTER.track("fixing", len(found.capture.views)) as advance:
        done = fix.fix_scene(found.capture, change, out, advance)
    console.print(f"fixed: {out}: {done}. {found.capture.root} is as it was.", markup=False)
