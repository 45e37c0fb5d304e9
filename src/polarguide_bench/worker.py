"""A child process of a comparison or a batch: does the task on standard input, as long as that is open.

Of a batch it takes one capture through all its steps: prepare, inspect, train, eval, share and export.
"""

from __future__ import annotations

import _thread
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from polarguide import __version__
from polarguide.core.errors import PolarguideError
from polarguide.core.files import make_folder
from polarguide.core.options import SessionOptions
from polarguide.core.records import decode
from polarguide.core.system import StopSignals, keep_freed_memory
from polarguide.inspection.inspect import inspect_scene
from polarguide.inspection.report import write_inspection
from polarguide.inspection.settings import InspectSettings
from polarguide.preparation.prepare import prepare_scene
from polarguide.raster import choose_backend, use_threads
from polarguide.results.evaluation.evaluate import evaluate
from polarguide.results.evaluation.record import code_digest
from polarguide.results.export import formats, web_page
from polarguide.runs.folder import CONFIGURATION, writing_to
from polarguide.runs.opened import OpenedRun
from polarguide.runs.train import train
from polarguide.training.recipe import Recipe
from polarguide.visualization import figures
from polarguide.visualization.layers import layer_picture
from polarguide.visualization.pages import data_uri
from polarguide_bench.children import Message, Scoring, Task, files_digest
from polarguide_bench.collection import (
    EXPORT,
    FORMAT,
    INSPECTION,
    RUN,
    SCENE,
    SHARE,
    STEPS,
    CaptureRecord,
    Processing,
    Step,
    prepare_settings,
)
from polarguide_bench.gnerp.runs import FieldRun, train_field
from polarguide_bench.opened import open_compared
from polarguide_bench.recipes import recipe_named

THUMBNAIL = 320
"""Longest side of the pictures on the page of a batch, in pixels."""


def process(task: Processing) -> None:
    """Take the steps that are still to be taken.

    Raises:
        PolarguideError: a step cannot be taken, or the folder was begun with something else.
        KeyboardInterrupt: stopped; a training has saved its state, other steps are begun again.
    """
    folder = Path(task.folder)
    make_folder(folder)
    record = CaptureRecord.load(folder) or CaptureRecord(FORMAT, task.request)
    record.require(task.request, folder)
    work = _Work(task, folder)
    for step in STEPS:
        if step in record.done:
            continue
        record = msgspec.structs.replace(record, at=step)
        record.save(folder)
        results = work.steps[step]()
        record = msgspec.structs.replace(record, done=(*record.done, step), **results)
        record.save(folder)


@dataclass
class _Work:
    """The steps of one capture; each returns what its record is to hold."""

    task: Processing
    folder: Path
    steps: dict[Step, Callable[[], dict[str, Any]]] = field(init=False)

    def __post_init__(self) -> None:
        self.steps = {
            "prepare": self._prepare,
            "inspect": self._inspect,
            "train": self._train,
            "eval": self._evaluate,
            "share": self._share,
            "export": self._export,
        }

    @property
    def _scene(self) -> Path:
        request = self.task.request
        return Path(request.source) if request.prepare is None else self.folder / SCENE

    def _prepare(self) -> dict[str, Any]:
        request = self.task.request
        if request.prepare is None:
            return {}
        prepared = prepare_scene(request.source, self._scene, prepare_settings(request.prepare))
        if not prepared.posed:
            raise PolarguideError(
                prepared.folder,
                expected="a scene with poses",
                found="none",
                remedy="Give --poses sfm or --poses PATH among its options.",
            )
        return {}

    def _inspect(self) -> dict[str, Any]:
        out = self.folder / INSPECTION
        reading = self.task.request.reading
        settings = self.task.request.settings
        inspect_settings = InspectSettings(
            refractive_index=settings.refractive_index, transfer=reading.transfer
        )
        inspected = inspect_scene(
            self._scene, out, inspect_settings, choose_backend(self.task.compute.device)
        )
        write_inspection(inspected, out)
        findings = tuple(
            f"{check.verdict}: {check.title}: {check.finding}"
            for check in inspected.checks
            if check.verdict not in ("ok", "n/a")
        )
        return {"verdict": inspected.verdict, "findings": findings}

    def _train(self) -> dict[str, Any]:
        request = self.task.request
        run = self.folder / RUN
        with StopSignals() as should_stop:
            train(
                self._scene,
                run,
                recipe=request.recipe,
                settings=request.settings,
                session=SessionOptions(self.task.compute.threads, self.task.compute.device),
                reading=request.reading,
                resume=os.path.lexists(run / CONFIGURATION),
                should_stop=should_stop,
            )
        return {}

    def _opened(self) -> OpenedRun:
        return OpenedRun.open(self.folder / RUN, device=self.task.compute.device)

    def _evaluate(self) -> dict[str, Any]:
        run = self._opened()
        evaluate(run, speed=False)
        view = (run.scene.test_views or run.scene.train_views)[0]
        pictures = [("photograph", figures.radiance_to_rgb(view.photograph()))]
        result = run.model.render(view.camera, surface=True).to("cpu")
        for layer in ("final", "specular", "normal"):
            picture = layer_picture(result, layer, view.camera)
            if picture is not None:
                pictures.append((layer, picture))
        return {
            "pictures": tuple((label, data_uri(picture, label, THUMBNAIL)) for label, picture in pictures)
        }

    def _share(self) -> dict[str, Any]:
        web_page.share(self._opened(), self.folder / SHARE, title=self.task.name)
        return {}

    def _export(self) -> dict[str, Any]:
        run = self._opened()
        out = self.folder / EXPORT
        files = [path for kind in self.task.request.formats for path in formats.export(run, kind, out)]
        return {"files": tuple(path.relative_to(self.folder).as_posix() for path in files)}


STDIN = 0
PATIENCE_SECONDS = 120.0
"""How long to wait for a process that has lost its worker: it still saves the state that this one goes on from."""


def main() -> int:
    """Do the task on standard input, and stop where that ends; returns the exit status that ``obey`` gives."""
    # SIGTERM acts as Ctrl-C does, so that whatever is open is closed; a shell's background jobs ignore Ctrl-C.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.default_int_handler)
    keep_freed_memory()
    try:
        line = _read_line()
        if not line.endswith(b"\n"):  # nobody has sent a whole one
            return obey(line)
        threading.Thread(target=_stop_at_end_of_input, daemon=True).start()
        return obey(line)
    except KeyboardInterrupt:
        return 130


def _read_line() -> bytes:
    """A line of standard input. Unbuffered: a thread that waits for more would hold the buffer at the process's end."""
    data = b""
    while not data.endswith(b"\n") and (more := os.read(STDIN, 1 << 16)):
        data += more
    return data


def _stop_at_end_of_input() -> None:
    """Interrupt the main thread when nobody holds the other end of standard input any more.

    That is how a worker asks to stop, and what happens when it is killed: no child goes on unwatched.
    """
    while os.read(STDIN, 1 << 16):
        pass
    _thread.interrupt_main()


def obey(line: bytes) -> int:
    """Do a task; returns the exit status (0 done, 130 stopped, 2 wrong input, with one line)."""
    try:
        message: Any = decode(line, Message, "task")
        check_code(message)
        do(message.task)
    except PolarguideError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except OSError as error:  # missing rights, a full disk, a file where a folder should be
        print(f"{error.filename or 'files'}: {error.strerror or error}.", file=sys.stderr)
        return 2
    return 0


def check_code(message: Message) -> None:
    """Refuse to compute with other code than that of the command: results would be mixed. Comments do not count.

    Raises:
        PolarguideError: this installation differs.
    """
    if message.files != files_digest() and message.code != code_digest():
        raise PolarguideError(
            "worker",
            expected=f"the same code as the command that uses this worker (digest {message.code})",
            found=f"polarguide {__version__} with digest {code_digest()} in {Path(__file__).parents[1]}",
            remedy="Install identical code on all machines, and do not change it while the command runs.",
        )


def do(task: Task) -> None:
    """Train, score, or process a capture.

    Raises:
        PolarguideError: the input is wrong, or the training has diverged.
        KeyboardInterrupt: stopped; a training has saved its state.
    """
    use_threads(task.compute.threads)
    if isinstance(task, Processing):
        _wait_for_others(Path(task.folder) / RUN)
        process(task)
        return
    if isinstance(task, Scoring):
        score(task)
        return
    _wait_for_others(Path(task.folder))
    recipe = recipe_named(task.recipe)
    trains: Any = train if isinstance(recipe, Recipe) else train_field
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


def score(task: Scoring) -> None:
    """Score a run.

    Raises:
        PolarguideError: the run or its scene cannot be read.
    """
    run = open_compared(task.folder, task.compute.device)
    surface = run.surface if isinstance(run, FieldRun) else None
    evaluate(run, speed=task.speed, surface=surface)


def _wait_for_others(run: Path) -> None:
    """Wait until nobody writes to a run.

    Raises:
        PolarguideError: another training does not end.
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
