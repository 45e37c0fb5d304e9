"""A viewer over a run, or over a training while it goes on."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager

import msgspec

from polarguide.capture import Scene
from polarguide.errors import PolarguideError
from polarguide.options import LOOPBACK, VisitorOptions
from polarguide.presentation import (
    PRESENTATION_FILE,
    Presentation,
    read_presentation,
    write_presentation,
)
from polarguide.progress import SILENT, Reporter
from polarguide.runs.families import AnyTrainer
from polarguide.runs.opened import OpenedRun
from polarguide.runs.train import Ends, Look
from polarguide.shading.model import ShadingModel
from polarguide.viewer.frusta import photographs
from polarguide.viewer.panel import NOTHING
from polarguide.viewer.server import Viewer
from polarguide.viewer.shown import Scenery, shown_run, shown_training

PATIENCE = 0.2  # seconds between two looks at whether a paused training should end


def view_run(
    run: OpenedRun,
    *,
    host: str = LOOPBACK[0],
    port: int = 8080,
    visitors: VisitorOptions = VisitorOptions(),
    reporter: Reporter = SILENT,
) -> None:
    """Serve a run to browsers: its layers from any side, beside the photographs. KeyboardInterrupt ends it.

    Args:
        run: the run; its scene is read.
        host: address to listen at. port: the next free one is taken if it is in use.
        visitors: who may look besides pages of this machine.
        reporter: told the address.

    Raises:
        PolarguideError: the address cannot be listened at.
    """
    shown, name = shown_run(run), run.folder.resolve().name
    place = (host, port, visitors)
    as_it_is = run.presentation
    with _opened(
        lambda: shown,
        run.scene,
        run.model.shading,
        name,
        place,
        reporter,
        presentation=as_it_is,
        save=functools.partial(save_to_run, run),
    ) as viewer:
        while True:
            viewer.serve(1.0)


def save_to_run(run: OpenedRun, chosen: Presentation) -> str:
    """Write white, up, scale and crop to the run's ``presentation.json``, and say so in plain text.

    What its scene says just so is left to the scene. The run's own credit stays.
    """
    own, above = read_presentation(run.folder), read_presentation(run.scene_folder)
    fields, kept = {}, []
    for name in ("white_balance", "up_axis", "meters_per_unit", "crop"):
        value, given = getattr(chosen, name), getattr(above, name)
        fields[name] = None if value == given else value
        if value is None and given is not None:
            kept.append(name)
    write_presentation(run.folder, msgspec.structs.replace(own, **fields))
    if kept:
        return f"Saved; the scene's own {', '.join(kept)} still counts"
    return f"Saved to {PRESENTATION_FILE}"


@contextmanager
def watched(
    trainer: AnyTrainer,
    host: str,
    port: int,
    visitors: VisitorOptions = VisitorOptions(),
    reporter: Reporter = SILENT,
) -> Iterator[Look]:
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
    place = (host, port, visitors)
    presentation = read_presentation(scene.root)
    with _opened(
        current, scene, trainer.shading, scene.name, place, reporter, trains=True, presentation=presentation
    ) as viewer:
        yield look


@contextmanager
def _opened(
    current: Callable[[], Scenery],
    scene: Scene,
    shading: ShadingModel,
    name: str,
    place: tuple[str, int, VisitorOptions],
    reporter: Reporter,
    *,
    trains: bool = False,
    presentation: Presentation = NOTHING,
    save: Callable[[Presentation], str] | None = None,
) -> Iterator[Viewer]:
    """A viewer: says where to look, and warns of strangers."""
    host, port, visitors = place
    viewer = Viewer(
        current,
        photographs(scene),
        shading=shading,
        trains=trains,
        host=host,
        port=port,
        visitors=visitors,
        presentation=presentation,
        save=save,
        title=f"polarguide {name}",
        warn=reporter.warn,
    )
    with closing(viewer):
        if host not in LOOPBACK:
            reporter.warn(f"whoever reaches {host} over the network can look: there is no password")
        reporter.say(f"viewer: {viewer.address}")
        yield viewer
