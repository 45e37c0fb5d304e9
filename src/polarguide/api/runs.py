"""Functions of the Python interface on runs, which the command line also uses.

Functions here do not print and install no signal handlers: progress and messages go to a ``Reporter``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from polarguide.capture import Scene
from polarguide.capture.view import figure, table
from polarguide.core.errors import PolarguideError
from polarguide.core.files import require_folder
from polarguide.core.options import PathLike, SceneOptions, SessionOptions, VisitorOptions
from polarguide.core.progress import SILENT, Reporter
from polarguide.results.evaluation import evaluate
from polarguide.results.evaluation.evaluate import read_metrics
from polarguide.results.evaluation.table import shown_metrics
from polarguide.results.export import formats, web_page
from polarguide.results.rendering import pictures, relight
from polarguide.runs import train as training
from polarguide.runs.opened import OpenedRun
from polarguide.training.callback import AnyCallback
from polarguide.training.recipe import Recipe
from polarguide.training.settings import TrainSettings
from polarguide.viewer import server

_PICTURED = 3
"""Number of rendered views that a notebook shows for a run."""


class Run(OpenedRun):
    """Trained run, which renders layers from any camera, computes scores, and exports files.

    ``polarguide.train`` and ``polarguide.open_run`` return a run.

    Example:
        >>> run = polarguide.open_run("runs/demo")                       # doctest: +SKIP
        >>> layers = run.render("v000", layers=["final", "normal"])      # doctest: +SKIP
        >>> layers["final"].shape                                        # doctest: +SKIP
        torch.Size([96, 128, 3])
    """

    evaluate = evaluate.evaluate
    export = formats.export
    relight = relight.relight
    share = web_page.share
    view = server.view_run
    write_film = pictures.write_film
    write_pictures = pictures.write_pictures

    def metrics(self) -> Mapping[str, Any]:
        """Return the scores that ``evaluate`` wrote: means over the test views, and scores by view in ``views``.

        Raises:
            PolarguideError: the run has no scores, or the file of scores is invalid.
        """
        return read_metrics(self.folder)

    def _repr_html_(self) -> str:
        """Return HTML for notebooks: rendered held-out views, counts, health and scores."""
        facts = {"run": str(self), "polarization": self._evidence()}
        pictures = ""
        try:  # the scene may have moved, and records may be damaged
            views = self.scene.test_views or self.scene.views
            for view in views[:_PICTURED]:
                drawn = self.render(view.camera)["final"]
                pictures += figure(drawn.cpu().numpy(), f"{view.name}, rendered")
            health = self.health
            facts["warnings"] = "\n".join(health.warnings) or "none" if health is not None else "not recorded"
            scores = shown_metrics(self.metrics(), scores_only=True)
            facts["scores"] = "\n".join(f"{label}: {text}" for label, text in scores)
        except PolarguideError as error:
            facts["error"] = str(error)
        return f"{pictures}{table(self.folder.name, facts)}"


open_run = Run.open


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
    callbacks: Sequence[AnyCallback] = (),
) -> Run:
    """Train a recipe on a scene, into a run folder; see ``runs.train.train_gaussians`` for all arguments.

    Example:
        >>> run = polarguide.train("scenes/cup", "runs/cup", recipe="polarguide")    # doctest: +SKIP
        >>> run.evaluate()["psnr"]                                                   # doctest: +SKIP
        31.4

    Raises:
        PolarguideError: the input is invalid, or the folder is not suitable.
        KeyboardInterrupt: the training was stopped. The state is saved, and ``resume=True`` continues to the same
            result.
    """

    looking = partial(
        server.watched,
        host=session.viewer_host,
        port=session.viewer_port,
        visitors=VisitorOptions(session.allow_host, session.allow_origin),
        reporter=reporter,
    )
    opened = training.train_gaussians(
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
        callbacks=callbacks,
    )
    return Run.of(opened)


def demo_scene() -> Path:
    """Return the folder of the small example scene: glossy objects, 50 views, four polarizer angles each.

    Example:
        >>> polarguide.load_scene(polarguide.demo_scene()).view("v000").camera.width    # doctest: +SKIP
        128

    Raises:
        PolarguideError: the package is incomplete.
    """
    scene = Path(__file__).parents[1] / "data" / "demo"
    require_folder(scene, expected="the demo scene", remedy="Install the package again.")
    return scene
