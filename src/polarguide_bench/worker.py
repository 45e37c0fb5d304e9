"""Child process of a comparison or a batch, which performs the task that it reads from standard input.

It stops when standard input closes. The task of a batch is one capture with all its steps: prepare, inspect, train,
eval, share and export.
"""

from __future__ import annotations

import _thread
import io
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from polarguide import __version__
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import make_folder
from polarguide.core.options import SessionOptions
from polarguide.core.records import decode
from polarguide.core.system import StopSignals, keep_freed_memory
from polarguide.inspection.inspect import inspect_scene, write_inspection
from polarguide.inspection.settings import InspectSettings
from polarguide.preparation.prepare import prepare_scene
from polarguide.raster import choose_backend, use_threads
from polarguide.results.evaluation.evaluate import code_digest, evaluate
from polarguide.results.export import formats, web_page
from polarguide.runs.folder import CONFIGURATION, writing_to
from polarguide.runs.opened import OpenedRun
from polarguide.runs.train import train_gaussians
from polarguide.training.recipe import Recipe
from polarguide.visualization import figures
from polarguide.visualization.figures import layer_picture
from polarguide.visualization.pages import data_uri
from polarguide_bench.children import (
    FORMAT,
    INSPECTION,
    RUN,
    SHARE,
    STEPS,
    CaptureRecord,
    Message,
    Processing,
    Step,
    Task,
    Training,
    files_digest,
    prepare_settings,
)
from polarguide_bench.gnerp.runs import FieldRun, train_field
from polarguide_bench.objects import register_definitions
from polarguide_bench.plan import open_compared
from polarguide_bench.recipes import recipe_named

THUMBNAIL = 320
"""Length of the longer side of pictures on the overview page, in pixels."""


def process(task: Processing) -> None:
    """Perform the remaining steps of a capture.

    Raises:
        PolarguideError: a step failed, or the folder belongs to another request.
        KeyboardInterrupt: the process was stopped. A training has saved its state. Other steps must start again.
    """
    folder = Path(task.folder)
    make_folder(folder)
    record = CaptureRecord.load(folder) or CaptureRecord(FORMAT, task.request)
    record.require(task.request, folder)
    scene = Path(task.request.source)
    if task.request.prepare is not None:
        scene = Path(task.first or folder) / "scene"
    for step in STEPS:
        if step not in record.done:
            record = msgspec.structs.replace(record, at=step)
            record.save(folder)
            results = _ACTIONS[step](task, scene, folder) or {}
            record = msgspec.structs.replace(record, done=(*record.done, step), **results)
            record.save(folder)


def _prepare(task: Processing, scene: Path, folder: Path) -> None:
    if task.request.prepare is not None and not task.first:
        prepared = prepare_scene(task.request.source, scene, prepare_settings(task.request.prepare))
        require(
            prepared.posed,
            prepared.folder,
            expected="a scene with poses",
            found="a scene without poses",
            remedy="Add --poses sfm or --poses PATH to the options of the capture.",
        )


def _inspect(task: Processing, scene: Path, folder: Path) -> dict[str, Any]:
    first = CaptureRecord.load(Path(task.first)) if task.first else None
    if first is not None:
        return {"verdict": first.verdict, "findings": first.findings}
    out = folder / INSPECTION
    settings = InspectSettings(
        refractive_index=task.request.settings.refractive_index, transfer=task.request.reading.transfer
    )
    inspected = inspect_scene(scene, settings, choose_backend(task.compute.device))
    write_inspection(inspected, out)
    findings = tuple(
        f"{check.verdict}: {check.title}: {check.finding}"
        for check in inspected.checks
        if check.verdict not in ("ok", "n/a")
    )
    return {"verdict": inspected.verdict, "findings": findings}


def _train(task: Processing, scene: Path, folder: Path) -> None:
    request = task.request
    _train_run(
        Training(
            str(scene), str(folder / RUN), request.recipe, request.settings, request.reading, task.compute
        )
    )


def _evaluate(task: Processing, scene: Path, folder: Path) -> dict[str, Any]:
    run = OpenedRun.open(folder / RUN, device=task.compute.device)
    evaluate(run, speed=False)
    view = (run.scene.test_views or run.scene.train_views)[0]
    result = run.model.render(view.camera, surface=True).to("cpu")
    pictures = {
        "photograph": figures.radiance_to_rgb(view.photograph()),
        **{layer: layer_picture(result, layer, view.camera) for layer in ("final", "specular", "normal")},
    }
    return {
        "pictures": tuple(
            (label, data_uri(picture, label, THUMBNAIL))
            for label, picture in pictures.items()
            if picture is not None
        )
    }


def _share(task: Processing, scene: Path, folder: Path) -> None:
    run = OpenedRun.open(folder / RUN, device=task.compute.device)
    web_page.share(run, folder / SHARE, title=task.name)


def _export(task: Processing, scene: Path, folder: Path) -> dict[str, Any]:
    run = OpenedRun.open(folder / RUN, device=task.compute.device)
    files = [path for kind in task.request.formats for path in formats.export(run, kind, folder / "export")]
    return {"files": tuple(path.relative_to(folder).as_posix() for path in files)}


_ACTIONS: dict[Step, Callable[[Processing, Path, Path], dict[str, Any] | None]] = {
    "prepare": _prepare,
    "inspect": _inspect,
    "train": _train,
    "eval": _evaluate,
    "share": _share,
    "export": _export,
}
"""Function of each step of a capture. It returns new values for fields of the capture's record."""


PATIENCE_SECONDS = 120.0
"""Time to wait until a process that has lost its worker saves its state, in seconds. This process then resumes."""


def main() -> int:
    """Perform the task on standard input, and return the exit status of ``obey``. Stop if standard input closes."""
    # SIGTERM acts like Ctrl-C, so that open files are closed. Background jobs of a shell ignore Ctrl-C by default.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.default_int_handler)
    keep_freed_memory()
    # The input is not buffered, because a waiting thread would hold the buffer's lock when the process ends.
    stdin = io.FileIO(0, closefd=False)

    def stop_at_end_of_input() -> None:
        """Interrupt the main thread when the worker closes the input or is killed."""
        stdin.readall()
        _thread.interrupt_main()

    try:
        line = stdin.readline()
        if line.endswith(b"\n"):  # the input of an incomplete line has already ended
            threading.Thread(target=stop_at_end_of_input, daemon=True).start()
        return obey(line)
    except KeyboardInterrupt:
        return 130


def obey(line: bytes) -> int:
    """Perform the task of a message, and return an exit status.

    The status is 0 if the task is done, 130 if it was stopped, and 2 if the input is invalid. In the last case, one
    line explains the error. The input is also invalid if the sender runs other code than this process, because results
    of different code must not be mixed. Comments in the code may differ.
    """
    try:
        message: Any = decode(line, Message, "task")
        if message.files != files_digest() and message.code != code_digest():
            raise PolarguideError(
                "worker",
                expected=f"the same code as the command that uses this worker (digest {message.code})",
                found=f"polarguide {__version__} with digest {code_digest()} in {Path(__file__).parents[1]}",
                remedy="Install identical code on all machines, and do not change it while the command runs.",
            )
        if message.definitions is not None:
            register_definitions(message.definitions)
        _perform(message.task)
    except PolarguideError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except OSError as error:  # missing permissions, a full disk, a file instead of a folder
        print(f"{error.filename or 'files'}: {error.strerror or error}.", file=sys.stderr)
        return 2
    return 0


def _perform(task: Task) -> None:
    use_threads(task.compute.threads)
    if isinstance(task, Processing):
        _wait_for_others(Path(task.folder) / RUN)
        process(task)
    elif isinstance(task, Training):
        _wait_for_others(Path(task.folder))
        _train_run(task)
    else:
        run: Any = open_compared(task.folder, task.compute.device)
        evaluate(run, speed=task.speed, surface=run.surface if isinstance(run, FieldRun) else None)


def _train_run(task: Training) -> None:
    recipe = recipe_named(task.recipe)
    trains: Any = train_gaussians if isinstance(recipe, Recipe) else train_field
    with StopSignals() as should_stop:
        trains(
            task.scene,
            task.folder,
            recipe=recipe,
            settings=task.settings,
            session=SessionOptions(task.compute.threads, task.compute.device),
            reading=task.reading,
            resume=os.path.lexists(Path(task.folder) / CONFIGURATION),
            should_stop=should_stop,
        )


def _wait_for_others(run: Path) -> None:
    """Wait until no other process writes to a run.

    Raises:
        PolarguideError: another process still writes to the run after the timeout.
    """
    end = time.monotonic() + PATIENCE_SECONDS
    while True:
        try:
            with writing_to(run):
                return
        except PolarguideError:
            if time.monotonic() > end:
                raise
            time.sleep(0.2)
