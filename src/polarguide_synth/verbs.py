"""Command ``synth``."""

from __future__ import annotations

import importlib
import shlex
import sys
from pathlib import Path
from typing import Annotated

import tyro

from polarguide.cli.console import ConsoleReporter, console, say, set_threads
from polarguide.core.errors import require
from polarguide.core.options import ThreadOptions
from polarguide.core.text import command
from polarguide_synth.settings import LONG_SECONDS, Overrides, SynthSettings, find_scene, rough_time


def synth(
    scene: Annotated[str, tyro.conf.Positional],
    /,
    *,
    out: Path,
    sweep: str | None = None,
    yes: bool = False,
    settings: Annotated[SynthSettings, tyro.conf.arg(name="")],
    overrides: Annotated[Overrides, tyro.conf.arg(name="")],
    compute: Annotated[ThreadOptions, tyro.conf.arg(name="")],
) -> None:
    """Render a polarized scene with ground truth: a preset (figure, kit, car, cup, water, proof, ...) or a scene file.

    Needs Mitsuba (pip install 'mitsuba==3.9.*'). Repeat the command to resume a stopped rendering.
    docs/reference/scene-files.md describes scene files and the files that are written.

    Args:
        scene: Name of a preset (docs/how-to/synthesize.md lists them), or path of a scene file in JSON.
        out: Scene folder to write.
        sweep: A family of scenes, such as views=9,18,36,63 or noise=0,1,2,4; also roughness, index and spacing.
        yes: Start a rendering of more than an hour without confirmation. Only a terminal asks for confirmation.
    """
    set_threads(compute.threads)
    spec = find_scene(scene)
    reporter = ConsoleReporter()
    render = importlib.import_module("polarguide_synth.render")
    if sweep is not None:
        family = (spec, out, settings, overrides, render.parse_sweep(sweep))
        _confirm(render.expected_time(render.sweep_plans(*family), reporter, threads=compute.threads), yes)
        folders = render.sweep_scenes(*family, reporter, threads=compute.threads)
        say(f"scenes: {shlex.join(map(str, folders))}")
        return
    plan = render.Plan(overrides.apply(spec), settings, out)
    _confirm(render.expected_time([plan], reporter, threads=compute.threads), yes)
    folder = importlib.import_module("polarguide_synth.folder")
    render.synthesize(plan.spec, out, settings, reporter, threads=compute.threads)
    say(f"scene: {out}   SHA-256 of its {folder.MANIFEST}: {folder.scene_digest(out)}")
    words: list[object] = ["prepare", out / "raw", "--out", f"{out}-prepared", "--poses", out]
    if settings.sensor == "ideal":
        words = ["train", out, "--out", f"runs/{out.name}"]
    elif settings.sensor != "filter":
        words += ["--sensor", settings.sensor.upper(), "--bits", 12, "--black-level", 64]
        words += ["--calibration", out / "calibration.json"]
    say(f"next: {command(*words)}")


def _confirm(seconds: float, yes: bool) -> None:
    """Request confirmation of a long rendering if a terminal is available.

    Raises:
        PolarguideError: the user declines.
    """
    if seconds <= LONG_SECONDS or yes or not (sys.stdin.isatty() and console.is_terminal):
        return
    try:
        answer = console.input("Start it? (y/N) ", markup=False)
    except EOFError:
        answer = ""
    require(
        answer.strip().lower() in ("y", "yes"),
        "the rendering",
        expected=f"yes to {rough_time(seconds)}",
        found="no",
        remedy="Nothing was written. Reduce --views, --samples or --size for a shorter rendering.",
    )
