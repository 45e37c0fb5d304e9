"""The verb ``polarguide run``, which goes from a folder of pictures to a scene in a browser by calling other verbs."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from polarguide.capture.sensor.pattern import SensorName
from polarguide.cli import app
from polarguide.cli.console import say, warn
from polarguide.core.errors import require
from polarguide.core.options import DeviceName, SceneOptions
from polarguide.core.records import option_name, read_record
from polarguide.core.text import canonical, command, printable
from polarguide.preparation.settings import PrepareSettings
from polarguide.training.settings import TrainSettings

CONFIGURATION = "run.json"
"""File that a training writes at its start."""
INSPECTION = "inspection.json"
"""File that contains the verdict of an inspection."""


@dataclass(frozen=True)
class InspectionSummary:
    """Fields of an inspection record that this verb reads.

    Attributes:
        verdict: verdict of the inspection.
        scene: description of the inspected scene.
    """

    verdict: str
    scene: dict[str, Any]


def run_folder(
    source: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path | None = None,
    sensor: SensorName | None = None,
    angles: str | None = None,
    shots_per_view: int | None = None,
    recipe: str | None = None,
    steps: int | None = None,
    downscale: int | None = None,
    open: bool = False,
    view: bool = True,
    threads: int | None = None,
    device: DeviceName | None = None,
) -> None:
    """Go from a folder of pictures to a scene in a browser: prepare, inspect, train, eval and view.

    Prints what the folder contains, and the commands that follow. Ctrl-C stops at any point, and the same command
    resumes. For other options, use the printed commands: a scene that prepare wrote is also a valid folder.

    Args:
        source: Folder of photographs, of shots through a polarizing filter, or of raw mosaics; a video; a published
            dataset; or a scene folder with poses.
        out: Folder to write, with scene/, inspection/ and run/. Default: runs/NAME, after the folder's name.
        sensor: Sensor of raw mosaics, such as IMX250MYR.
        angles: Polarizer angles of shots whose names state none, in the order of the files, such as 0,45,90,135; or
            unknown; or none for photographs without a filter.
        shots_per_view: Number of consecutive pictures of one view. By default, it is detected.
        recipe: Method of the training; default: polarguide-stokes.
        steps: Optimizer steps of the training.
        downscale: Factor by which the training reduces the pictures.
        open: Show the training in a browser, at the printed address.
        view: Open the viewer at the end.
        threads: Number of threads; default: all cores.
        device: Device of the computation: auto, cpu or cuda.
    """
    folder = out or Path("runs") / canonical(
        source.resolve().stem if source.is_file() else source.resolve().name
    )
    settings = PrepareSettings(sensor=sensor, angles=angles, shots_per_view=shots_per_view)
    preparation = _flags(sensor=sensor, angles=angles, shots_per_view=shots_per_view)
    training = _flags(recipe=recipe, steps=steps, downscale=downscale)
    machine = _flags(threads=threads)
    compute = [*machine, *_flags(device=device)]
    posed = importlib.import_module("polarguide.capture.layout").is_posed_scene(source)
    _require_usable(source, folder, preparation if posed else [])
    TrainSettings(steps=steps)
    SceneOptions(downscale=1 if downscale is None else downscale)
    if recipe is not None:
        importlib.import_module("polarguide.methods").recipe_named(recipe)
    scene = source if posed else folder / "scene"
    commands = [
        ["prepare", str(source), "--out", str(scene), *preparation, *machine],
        ["inspect", str(scene), "--out", str(folder / "inspection"), *compute],
        [
            "train",
            str(scene),
            "--out",
            str(folder / "run"),
            *training,
            *(["--viewer"] if open else []),
            *compute,
        ],
        ["eval", str(folder / "run"), *compute],
        ["view", str(folder / "run"), *compute],
    ]
    commands = commands[posed : len(commands) if view else -1]
    say(f"recognized: {'a scene with poses' if posed else _description(source, settings)}")
    for words in commands:
        say(f"  {command(*words)}")
    for words in commands:
        _call(words, scene, folder)


def _flags(**values: object) -> list[str]:
    """Return the options that have a value as words of a command line."""
    return [
        word
        for name, value in values.items()
        if value is not None
        for word in (option_name(name), str(value))
    ]


def _require_usable(source: Path, folder: Path, unused: Sequence[str]) -> None:
    """Refuse options without effect, and an output folder that belongs to another command.

    Raises:
        PolarguideError: an option has no effect on the source, or ``folder`` is the run folder of train.
    """
    require(
        not unused,
        source,
        expected="no options of prepare, because it is a prepared scene",
        found=" ".join(unused),
        remedy="Omit these options, or specify the folder of the camera files.",
    )
    require(
        not (folder / CONFIGURATION).exists(),
        folder,
        expected="a new folder, or a folder that polarguide run wrote",
        found=f"{CONFIGURATION} of a training",
        remedy="Choose another folder with --out.",
    )


def _description(source: Path, settings: PrepareSettings) -> str:
    description: str = importlib.import_module("polarguide.preparation.open_source").describe_source(
        source, settings
    )
    return description


def _call(words: Sequence[str], scene: Path, folder: Path) -> None:
    """Call a verb. An inspection of the unchanged scene is not repeated, and a training is resumed."""
    verb = words[0]
    resume = verb == "train" and (folder / "run" / CONFIGURATION).exists()
    say("")
    if verb == "inspect" and _is_current(folder / "inspection" / INSPECTION, scene):
        say(f"inspected before: {folder / 'inspection' / 'inspection.html'}")
    else:
        line = [*words, "--resume"] if resume else words
        say(f"> {command(*line)}")
        try:
            app.call(verb, line)
        except KeyboardInterrupt:
            say("To continue, repeat the same polarguide run command.")
            raise
    if verb == "inspect" and _verdict(folder) == "wrong":
        warn(
            "the verdict of the inspection is wrong, so the result may be wrong. The training starts nevertheless."
        )


def _verdict(folder: Path) -> str:
    """Return the verdict of the inspection."""
    return read_record(folder / "inspection" / INSPECTION, InspectionSummary).verdict


def _is_current(record: Path, scene: Path) -> bool:
    """Return True if the record of an inspection is of this scene and newer than all its files."""
    if not record.is_file():
        return False
    inspected = read_record(record, InspectionSummary).scene.get("path")
    newest = max(path.stat().st_mtime_ns for path in scene.rglob("*"))
    return inspected == printable(str(scene.resolve())) and record.stat().st_mtime_ns > newest
