"""``polarguide calibrate``."""

from __future__ import annotations

import importlib
import shlex
from pathlib import Path
from typing import Annotated

import tyro

from polarguide.cli.console import ConsoleReporter, say, use_threads
from polarguide.core.options import ThreadOptions
from polarguide.shots.calibration.settings import CalibrateSettings


def calibrate(
    shots: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path,
    settings: Annotated[CalibrateSettings, tyro.conf.arg(name="")],
    compute: Annotated[ThreadOptions, tyro.conf.arg(name="")],
) -> None:
    """Calibrate a polarization camera: what each of its polarizers really measures, from shots of one before the lens.

    The file corrects extinction ratio, angle and throughput of every position; prepare, priors, measure and inspect
    take it as --calibration. docs/how-to/calibrate.md says how to take the shots.

    Args:
        shots: Folder of raw mosaics of a linear polarizer before a uniform light, at five or more angles.
        out: File to write, ending in .safetensors; a picture (PNG) of the same name goes beside it.
    """
    use_threads(compute.threads)
    calibration = importlib.import_module("polarguide.shots.calibration.calibrate")
    outcome = calibration.calibrate_sensor(shots, out, settings, ConsoleReporter())
    say(f"calibration: {outcome.path}   picture: {outcome.picture}")
    option = f"--sensor {settings.sensor} --calibration {shlex.quote(str(outcome.path))}"
    say(f"next: polarguide prepare RAW --out SCENE {option}")
