"""The Python interface, as ``import polarguide`` gives it. The command line is a client of it.

Nothing here prints or installs signal handlers: progress and messages go to a ``Reporter``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

from polarguide.capture import Scene
from polarguide.errors import PolarguideError
from polarguide.evaluation import evaluate
from polarguide.evaluation.record import read_metrics
from polarguide.export import formats
from polarguide.inspection.inspect import Inspection, inspect_scene, inspection_folder
from polarguide.inspection.record import write_inspection
from polarguide.inspection.settings import InspectSettings
from polarguide.options import DeviceName, PathLike, SceneOptions, SessionOptions, VisitorOptions
from polarguide.preparation.prepare import prepare_scene
from polarguide.progress import SILENT, Reporter
from polarguide.raster import choose_backend
from polarguide.rendering import film, pictures, relight
from polarguide.rendering.priors import write_priors
from polarguide.runs import train as training
from polarguide.runs.opened import OpenedRun
from polarguide.training.recipe import Recipe
from polarguide.training.settings import TrainSettings
from polarguide.viewer import watch


class Run(OpenedRun):
    """A trained run: its layers from any camera, and everything that can be made of it.

    ``polarguide.train`` and ``polarguide.open_run`` give one.

    Example:
        >>> run = polarguide.open_run("runs/demo")                       # doctest: +SKIP
        >>> layers = run.render("v000", layers=["final", "normal"])      # doctest: +SKIP
        >>> layers["final"].shape                                        # doctest: +SKIP
        torch.Size([96, 128, 3])
    """

    evaluate = evaluate.evaluate
    export = formats.export
    relight = relight.relight
    share = formats.share
    view = watch.view_run
    write_film = film.write_film
    write_pictures = pictures.write_pictures

    def metrics(self) -> Mapping[str, Any]:
        """The record that ``evaluate`` wrote: means over the test views, and ``views`` by name.

        Raises:
            PolarguideError: the run has not been scored, or the file is not such a record.
        """
        return read_metrics(self.folder)


open_run = Run.open
prepare = prepare_scene
priors = write_priors


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

    looking = partial(
        watch.watched,
        host=session.viewer_host,
        port=session.viewer_port,
        visitors=VisitorOptions(session.allow_host, session.allow_origin),
        reporter=reporter,
    )
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
        watch=looking if session.viewer else None,
    )
    return Run.of(opened)


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
    folder = inspection_folder(Path(scene), None if out is None else Path(out))
    backend = choose_backend(device, say=reporter.say)
    found = inspect_scene(Path(scene), folder, settings, backend, reporter)
    write_inspection(found, folder, reporter)
    return found


@contextmanager
def demo_scene() -> Iterator[Path]:
    """The folder of the small scene that ships with the package: glossy objects, 50 views, four angles each.

    Raises:
        PolarguideError: the package is not whole.
    """
    with resources.as_file(resources.files("polarguide") / "data" / "demo") as scene:
        if not scene.is_dir():
            raise PolarguideError(
                scene, expected="the demo scene", found="nothing", remedy="Install the package again."
            )
        yield scene
