"""Command ``synth``."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Annotated

import tyro

from polarguide.cli.console import ConsoleReporter, say, set_threads
from polarguide.core.options import ThreadOptions
from polarguide.core.text import command
from polarguide_synth.settings import Overrides, SynthSettings, find_scene


def synth(
    scene: Annotated[str, tyro.conf.Positional],
    /,
    *,
    out: Path,
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
    """
    set_threads(compute.threads)
    spec = find_scene(scene)
    reporter = ConsoleReporter()
    render = importlib.import_module("polarguide_synth.render")
    plan = render.Plan(overrides.apply(spec), settings, out)
    render.report_expected_time([plan], reporter, threads=compute.threads)
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
