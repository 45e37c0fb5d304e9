"""The Python interface, as ``import polarguide`` gives it. The command line is a client of it.

Nothing here prints or installs signal handlers: progress and messages go to a ``Reporter``.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from importlib import resources
from pathlib import Path
from typing import Any

from polarguide.capture import Scene
from polarguide.errors import PolarguideError
from polarguide.evaluation import read_metrics
from polarguide.evaluation.evaluate import evaluate
from polarguide.export.formats import export, share
from polarguide.inspection.inspect import Inspection, inspect_scene, inspection_folder
from polarguide.inspection.record import write_inspection
from polarguide.inspection.settings import InspectSettings
from polarguide.options import LOOPBACK, DeviceName, ExportFormat, SceneOptions, SessionOptions
from polarguide.preparation.prepare import Prepared, prepare_scene
from polarguide.preparation.settings import PrepareSettings
from polarguide.progress import SILENT, Reporter
from polarguide.raster import choose_backend
from polarguide.rendering.film import write_film
from polarguide.rendering.pictures import write_pictures
from polarguide.rendering.priors import write_priors
from polarguide.rendering.relight import relight
from polarguide.runs import train as training
from polarguide.runs.opened import OpenedRun, read_scene
from polarguide.training.recipe import Recipe
from polarguide.training.settings import TrainSettings
from polarguide.training.trainer import Trainer
from polarguide.viewer.watch import view_run, watched

PathLike = str | os.PathLike[str]


class Run(OpenedRun):
    """A trained run: its layers from any camera, and everything that can be made of it.

    ``polarguide.train`` and ``polarguide.open_run`` give one.

    Example:
        >>> run = polarguide.open_run("runs/demo")                       # doctest: +SKIP
        >>> layers = run.render("v000", layers=["final", "normal"])      # doctest: +SKIP
        >>> layers["final"].shape                                        # doctest: +SKIP
        torch.Size([96, 128, 3])
    """

    def evaluate(self, *, speed: bool = False, reporter: Reporter = SILENT) -> dict[str, Any]:
        """Score the test views and write ``metrics.json``; see ``evaluation.evaluate.evaluate``."""
        return evaluate(self, speed=speed, reporter=reporter)

    def metrics(self) -> Mapping[str, Any]:
        """The record that ``evaluate`` wrote: means over the test views, and ``views`` by name.

        Raises:
            PolarguideError: the run has not been scored, or the file is not such a record.
        """
        return read_metrics(self.folder)

    def export(
        self,
        format: ExportFormat,
        out: PathLike | None = None,
        *,
        resolution: int = 192,
        reporter: Reporter = SILENT,
    ) -> list[Path]:
        """Write the files of other programs; returns their paths. See ``export.formats.export``."""
        return export(self, format, _path(out), resolution=resolution, reporter=reporter)

    def share(self, path: PathLike | None = None, *, title: str = "", caption: str = "") -> Path:
        """Write one web page that renders the run with its reflections; see ``export.formats.share``."""
        return share(self, _path(path), title=title, caption=caption)

    def relight(
        self, panorama: PathLike | None = None, degrees: float = 0.0, *, reporter: Reporter = SILENT
    ) -> None:
        """Let it reflect a panorama, or turn its light, in memory; see ``rendering.relight.relight``."""
        relight(self, _path(panorama), degrees, reporter=reporter)

    def write_pictures(
        self,
        out: PathLike | None = None,
        *,
        views: str = "test",
        layers: Sequence[str] | None = None,
        reporter: Reporter = SILENT,
    ) -> Path:
        """Write layers of views as PNG files, ``render`` in the run's folder by default, all layers by default.

        Returns the contact sheet's path; see ``rendering.pictures.write_pictures``.
        """
        folder = _path(out) or self.folder / "render"
        names = self.layers if layers is None else layers
        return write_pictures(self, folder, views=views, layers=names, reporter=reporter)

    def write_film(
        self,
        out: PathLike,
        *,
        path: str = "orbit",
        layers: Sequence[str] = ("final",),
        frames: int = 120,
        reporter: Reporter = SILENT,
    ) -> None:
        """Render along a path of cameras into an MP4 file or a folder; see ``rendering.film.write_film``."""
        write_film(self, Path(out), path=path, layers=layers, frames=frames, reporter=reporter)

    def view(self, *, host: str = LOOPBACK[0], port: int = 8080, reporter: Reporter = SILENT) -> None:
        """Serve it to browsers until KeyboardInterrupt; see ``viewer.watch.view_run``."""
        view_run(self, host=host, port=port, reporter=reporter)


def train(
    scene: Scene | PathLike,
    out: PathLike,
    *,
    recipe: Recipe | str = "polarguide-stokes",
    settings: TrainSettings = TrainSettings(),
    session: SessionOptions = SessionOptions(),
    reading: SceneOptions = SceneOptions(),
    resume: bool = False,
    reporter: Reporter = SILENT,
    should_stop: Callable[[], bool] = lambda: False,
) -> Run:
    """Train a recipe on a scene, into a run folder; see ``runs.train.train`` for all arguments.

    Example:
        >>> run = polarguide.train("scenes/cup", "runs/cup", recipe="polarguide")    # doctest: +SKIP
        >>> run.evaluate()["psnr"]                                                   # doctest: +SKIP
        31.4

    Raises:
        PolarguideError: wrong input, or a folder that does not suit.
        KeyboardInterrupt: it was stopped; the state is saved, and ``resume=True`` goes on to the same result.
    """

    def watch(trainer: Trainer) -> AbstractContextManager[training.Look]:
        return watched(trainer, session.viewer_host, session.viewer_port, reporter)

    opened = training.train(
        scene,
        out,
        recipe=recipe,
        settings=settings,
        session=session,
        reading=reading,
        resume=resume,
        reporter=reporter,
        should_stop=should_stop,
        watch=watch if session.viewer else None,
    )
    return Run(
        opened.folder,
        opened.configuration,
        opened.recipe,
        opened.model,
        scene=opened.scene,
        reporter=reporter,
    )


def open_run(
    folder: PathLike,
    *,
    recipe: Recipe | None = None,
    scene: Scene | PathLike | None = None,
    device: DeviceName = "auto",
    reporter: Reporter = SILENT,
) -> Run:
    """Open a run folder; see ``Run.open``. Warns if the recipe has changed since it was trained.

    Args:
        folder: what a training wrote.
        recipe: the recipe it was trained with, where that is not one of ours.
        scene: the scene or its folder, where that has moved since; read when it is first asked for.
        device: what to compute on.
        reporter: told what takes long.

    Raises:
        PolarguideError: it is no run folder, is damaged, or belongs to another version.
    """
    return Run.open(folder, recipe=recipe, scene=scene, device=device, reporter=reporter)


def prepare(
    source: PathLike, out: PathLike, *, settings: PrepareSettings | None = None, reporter: Reporter = SILENT
) -> Prepared:
    """Make a scene folder from camera files: raw mosaics, shots through a filter, published datasets.

    A preparation that was stopped goes on with the same call.

    Raises:
        PolarguideError: the source or a setting cannot be used, or ``out`` holds something else.
    """
    return prepare_scene(source, out, settings, reporter)


def inspect(
    scene: PathLike,
    out: PathLike | None = None,
    *,
    settings: InspectSettings = InspectSettings(),
    device: DeviceName = "auto",
    reporter: Reporter = SILENT,
) -> Inspection:
    """Find what is right and wrong with a capture; writes a page and a record.

    Args:
        scene: the scene folder; it may have no poses.
        out: folder to write; SCENE-inspection beside the scene by default.
        settings: how to inspect.
        device: what its short training computes on.
        reporter: told how far it is.

    Raises:
        PolarguideError: the scene cannot be read.
    """
    folder = inspection_folder(Path(scene), _path(out))
    backend = choose_backend(device, say=reporter.say)
    found = inspect_scene(Path(scene), folder, settings, backend, reporter)
    write_inspection(found, folder, reporter)
    return found


def priors(
    scene: Scene | PathLike,
    out: PathLike,
    *,
    run: OpenedRun | None = None,
    views: str = "test",
    refractive_index: float = 1.5,
    threshold: float = 0.05,
    reading: SceneOptions = SceneOptions(),
    reporter: Reporter = SILENT,
) -> Path:
    """Pictures of what polarization says about a scene; see ``rendering.priors.write_priors``."""
    loaded = scene if isinstance(scene, Scene) else read_scene(scene, reading, reporter)
    return write_priors(
        loaded,
        Path(out),
        run=run,
        views=views,
        refractive_index=refractive_index,
        threshold=threshold,
        reporter=reporter,
    )


@contextmanager
def demo_scene() -> Iterator[Path]:
    """The folder of the small scene that ships with the package: glossy objects, 27 views, four angles each.

    Raises:
        PolarguideError: the package is not whole.
    """
    with resources.as_file(resources.files("polarguide") / "data" / "demo") as scene:
        if not scene.is_dir():
            raise PolarguideError(
                scene, expected="the demo scene", found="nothing", remedy="Install the package again."
            )
        yield scene


def _path(path: PathLike | None) -> Path | None:
    return None if path is None else Path(path)
