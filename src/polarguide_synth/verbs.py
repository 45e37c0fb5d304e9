"""The verb synth."""

from __future__ import annotations

import importlib
import shlex
import sys
from pathlib import Path
from typing import Annotated

import tyro

from polarguide.cli.console import ConsoleReporter, console, say, set_threads
from polarguide.core.errors import PolarguideError
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

    Needs Mitsuba (pip install 'mitsuba==3.9.*'). A rendering that was stopped goes on with the same command.
    docs/reference/scene-files.md describes scene files and what is written.

    Args:
        scene: Name of a preset (docs/how-to/synthesize.md lists them), or path of a scene file in JSON.
        out: Scene folder to write.
        sweep: A family of scenes, such as views=9,18,36,63 or noise=0,1,2,4; also roughness, index and spacing.
        yes: Start a rendering of more than an hour without a question. Without a terminal there is no question.
    """
    set_threads(compute.threads)
    spec = find_scene(scene)
    reporter = ConsoleReporter()
    render = importlib.import_module("polarguide_synth.render")
    if sweep is not None:
        family = render.parse_sweep(sweep)
        plans = render.sweep_plans(spec, out, settings, overrides, family)
        _confirm(render.expected_time(plans, reporter, threads=compute.threads), yes)
        folders = render.sweep_scenes(
            spec, out, settings, overrides, family, reporter, threads=compute.threads
        )
        say(f"scenes: {shlex.join(map(str, folders))}")
        return
    plan = render.Plan(overrides.apply(spec), settings, out)
    _confirm(render.expected_time([plan], reporter, threads=compute.threads), yes)
    folder = importlib.import_module("polarguide_synth.folder")
    rendered = render.synthesize(plan.spec, out, settings, reporter, threads=compute.threads)
    say(f"scene: {rendered}   SHA-256 of its {folder.MANIFEST}: {folder.scene_digest(rendered)}")
    prepared = ("prepare", rendered / "raw", "--out", f"{rendered}-prepared", "--poses", rendered)
    if settings.sensor == "ideal":
        say(f"next: {command('train', rendered, '--out', f'runs/{rendered.name}')}")
    elif settings.sensor == "filter":
        say(f"next: {command(*prepared)}")
    else:
        calibration = rendered / "calibration.json"
        sensor = ("--sensor", settings.sensor.upper(), "--bits", 12, "--black-level", 64)
        say(f"next: {command(*prepared, *sensor, '--calibration', calibration)}")


def _confirm(seconds: float, yes: bool) -> None:
    """Ask before a rendering that takes long, if somebody sits at a terminal.

    Raises:
        PolarguideError: the user declines.
    """
    if seconds <= LONG_SECONDS or yes or not (sys.stdin.isatty() and console.is_terminal):
        return
    try:
        answer = console.input("Start it? (y/N) ", markup=False)
    except EOFError:
        answer = ""
    if answer.strip().lower() not in ("y", "yes"):
        raise PolarguideError(
            "the rendering",
            expected=f"yes to {rough_time(seconds)}",
            found="no",
            remedy="Nothing was written. Fewer --views or --samples or a smaller --size take less.",
        )
