"""``polarguide prepare``."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro

from polarguide.cli.console import ConsoleReporter, say, use_threads
from polarguide.core.options import ThreadOptions
from polarguide.preparation.settings import CalibrationOptions, PrepareSettings


def prepare(
    source: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path,
    settings: Annotated[PrepareSettings, tyro.conf.arg(name="")],
    angles: Annotated[CalibrationOptions, tyro.conf.arg(name="")],
    compute: Annotated[ThreadOptions, tyro.conf.arg(name="")],
) -> None:
    """Camera files to a scene folder: raw mosaics, shots through a rotating filter, published datasets.

    A preparation that was stopped goes on with the same command. docs/reference/formats.md describes the files.

    Args:
        source: Folder of raw mosaics (one file a view), of filter shots (four folders or suffixes), or of a dataset.
        out: Scene folder to write.
    """
    use_threads(compute.threads)
    preparation = importlib.import_module("polarguide.preparation.prepare")
    with_angles = replace(settings, calibration=angles.read(), analyzers=angles.analyzers())
    prepared = preparation.prepare_scene(source, out, with_angles, ConsoleReporter())
    without = f", {len(prepared.left_out)} left out" if prepared.left_out else ""
    say(f"scene: {prepared.folder} ({len(prepared.views)} views{without})")
    if prepared.posed:
        say(f"next: polarguide inspect {prepared.folder}")
        say(f"then: polarguide train {prepared.folder} --out runs/{prepared.folder.name}")
    else:
        say("it has no poses: repeat the command with --poses sfm or --poses PATH")
        say(
            f"each view alone: polarguide priors {prepared.folder} --out {prepared.folder.name}-priors",
        )
