"""A viewer over a run, or over a training while it goes on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager

from polarguide.errors import PolarguideError
from polarguide.options import LOOPBACK
from polarguide.progress import SILENT, Reporter
from polarguide.runs.opened import OpenedRun
from polarguide.runs.train import Ends, Look
from polarguide.training.trainer import Trainer
from polarguide.viewer.frusta import photographs
from polarguide.viewer.server import Viewer
from polarguide.viewer.shown import shown_run, shown_training

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
    shown = shown_run(run)
    viewer = Viewer(
        lambda: shown,
        photographs(run.scene),
        shading=run.model.shading,
        host=host,
        port=port,
        title=f"polarguide {run.folder.resolve().name}",
    )
    with closing(viewer):
        _announce(viewer, host, reporter)
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
    viewer = Viewer(
        lambda: shown_training(trainer),
        photographs(scene),
        shading=trainer.shading,
        trains=True,
        host=host,
        port=port,
        title=f"polarguide {scene.name}",
    )

    def look(ends: Ends) -> None:
        viewer.refresh()
        viewer.serve()
        while viewer.paused and not ends():
            viewer.serve(PATIENCE)

    with closing(viewer):
        _announce(viewer, host, reporter)
        yield look


def _announce(viewer: Viewer, host: str, reporter: Reporter) -> None:
    """Say where to look, and warn of strangers."""
    if host not in LOOPBACK:
        reporter.warn(f"whoever reaches {host} over the network can look: there is no password")
    reporter.say(f"viewer: {viewer.address}")
