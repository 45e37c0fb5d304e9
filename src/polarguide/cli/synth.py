"""``polarguide synth``."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Annotated

import tyro

from polarguide.cli.console import say, use_threads
from polarguide.cli.progress import ConsoleReporter
from polarguide.options import ThreadOptions
from polarguide.synth.settings import Overrides, SynthSettings, find_scene


def synth(
    scene: Annotated[str, tyro.conf.Positional],
    /,
    *,
    out: Path,
    sweep: str | None = None,
    settings: Annotated[SynthSettings, tyro.conf.arg(name="")],
    overrides: Annotated[Overrides, tyro.conf.arg(name="")],
    compute: Annotated[ThreadOptions, tyro.conf.arg(name="")],
) -> None:
    """Render a polarized scene with ground truth: a preset (figure, kit, car, cup, water, proof, ...) or a scene file.

    Needs the extra polarguide[synth]. A rendering that was stopped goes on with the same command.
    docs/reference/scene-files.md describes scene files and what is written.

    Args:
        scene: Name of a preset (docs/how-to/synthesize.md lists them), or path of a scene file in JSON.
        out: Scene folder to write.
        sweep: A family of scenes, such as views=9,18,36,63 or noise=0,1,2,4; also roughness, index and spacing.
    """
    use_threads(compute.threads)
    spec, reporter = find_scene(scene), ConsoleReporter()
    if sweep is not None:
        sweeps = importlib.import_module("polarguide.synth.sweep")
        folders = sweeps.sweep_scenes(
            spec, out, settings, overrides, sweeps.parse_sweep(sweep), reporter, threads=compute.threads
        )
        say(f"scenes: {' '.join(str(folder) for folder in folders)}")
        return
    render = importlib.import_module("polarguide.synth.render")
    manifest = importlib.import_module("polarguide.synth.manifest")
    done = render.synthesize(overrides.apply(spec), out, settings, reporter, threads=compute.threads)
    say(
        f"scene: {done}   SHA-256 of its {manifest.MANIFEST}: {manifest.scene_digest(done)}",
    )
    if settings.sensor == "ideal":
        say(f"next: polarguide train {done} --out runs/{done.name}")
    elif settings.sensor == "filter":
        say(f"next: polarguide prepare {done / 'raw'} --out {done}-prepared --poses {done}")
    else:
        say(
            f"next: polarguide prepare {done / 'raw'} --out {done}-prepared --sensor {settings.sensor.upper()} "
            f"--bits 12 --black-level 64 --calibration {done / 'calibration.json'} --poses {done}",
        )
