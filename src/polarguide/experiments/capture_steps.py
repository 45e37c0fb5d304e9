"""What a child of a batch does with one capture: prepare, inspect, train, eval, share and export, one after another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from polarguide.core.errors import PolarguideError
from polarguide.core.files import make_folder
from polarguide.core.options import SessionOptions
from polarguide.core.system import StopSignals
from polarguide.experiments.collection import (
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
from polarguide.inspection.inspect import inspect_scene
from polarguide.inspection.report import write_inspection
from polarguide.inspection.settings import InspectSettings
from polarguide.preparation.prepare import prepare_scene
from polarguide.raster import choose_backend
from polarguide.results.evaluation.evaluate import evaluate
from polarguide.results.export import formats
from polarguide.runs.folder import CONFIGURATION
from polarguide.runs.opened import OpenedRun
from polarguide.runs.train import train
from polarguide.visualization import figures
from polarguide.visualization.layers import layer_picture
from polarguide.visualization.pages import data_uri

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
        reading, settings = self.task.request.reading, self.task.request.settings
        asked = InspectSettings(refractive_index=settings.refractive_index, transfer=reading.transfer)
        inspected = inspect_scene(self._scene, out, asked, choose_backend(self.task.compute.device))
        write_inspection(inspected, out)
        findings = tuple(
            f"{check.verdict}: {check.title}: {check.finding}"
            for check in inspected.checks
            if check.verdict not in ("ok", "n/a")
        )
        return {"verdict": inspected.verdict, "findings": findings}

    def _train(self) -> dict[str, Any]:
        request, run = self.task.request, self.folder / RUN
        with StopSignals() as should_stop:
            train(
                self._scene,
                run,
                recipe=request.recipe,
                settings=request.settings,
                session=SessionOptions(self.task.compute.threads, self.task.compute.device),
                reading=request.reading,
                resume=(run / CONFIGURATION).exists(),
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
        formats.share(self._opened(), self.folder / SHARE, title=self.task.name)
        return {}

    def _export(self) -> dict[str, Any]:
        run, out = self._opened(), self.folder / EXPORT
        files = [path for kind in self.task.request.formats for path in formats.export(run, kind, out)]
        return {"files": tuple(path.relative_to(self.folder).as_posix() for path in files)}
