"""A viewer over a run, or over a training while it goes on."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager

from polarguide.capture import Scene
from polarguide.errors import PolarguideError
from polarguide.options import LOOPBACK
from polarguide.progress import SILENT, Reporter
from polarguide.runs.opened import OpenedRun
from polarguide.runs.train import Ends, Look
from polarguide.shading.model import ShadingModel
from polarguide.training.trainer import Trainer
from polarguide.viewer.frusta import photographs
from polarguide.viewer.server import Viewer
from polarguide.viewer.shown import Shown, shown_run, shown_training

PATIENCE = 0.2  # seconds between two looks at whether a paused training should end


def view_run(
    run: OpenedRun, *, host: str = LOOPBACK[0], port: int = 8080, reporter: Reporter = SILENT
) -> None:
    """Serve a run to browsers: its layers from any side, beside the photographs. KeyboardInterrupt ends it.

    Args:
        run: the run; its scene is read.
        host: address to listen at. port: the next free one is taken if it is in use.
        reporter: told the address.

    Raises:
        PolarguideError: the address cannot be listened at.
    """
    shown, name = shown_run(run), run.folder.resolve().name
    with _opened(lambda: shown, run.scene, run.model.shading, name, host, port, reporter) as viewer:
        while True:
            viewer.serve(1.0)


@contextmanager
def watched(trainer: Trainer, host: str, port: int, reporter: Reporter = SILENT) -> Iterator[Look]:
    """A viewer over a training; yields what is to be called between steps.

    Raises:
        PolarguideError: several processes train, or the address cannot be listened at.
    """
    if trainer.ranks.world > 1:
        raise PolarguideError(
            "viewer",
            expected="one process",
            found=f"{trainer.ranks.world}",
            remedy="Leave it out, and look at the checkpoints: polarguide view RUN.",
        )
    scene = trainer.scene

    def look(ends: Ends) -> None:
        viewer.refresh()
        viewer.serve()
        while viewer.paused and not ends():
            viewer.serve(PATIENCE)

    current = functools.partial(shown_training, trainer)
    with _opened(current, scene, trainer.shading, scene.name, host, port, reporter, trains=True) as viewer:
        yield look


@contextmanager
def _opened(
    current: Callable[[], Shown], scene: Scene, shading: ShadingModel, name: str, host: str, port: int,
    reporter: Reporter, *, trains: bool = False,
) -> Iterator[Viewer]:  # fmt: skip
    """A viewer: says where to look, and warns of strangers."""
    title = f"polarguide {name}"
    viewer = Viewer(
        current, photographs(scene), shading=shading, trains=trains, host=host, port=port, title=title
    )
    with closing(viewer):
        if host not in LOOPBACK:
            reporter.warn(f"whoever reaches {host} over the network can look: there is no password")
        reporter.say(f"viewer: {viewer.address}")
        yield viewer
