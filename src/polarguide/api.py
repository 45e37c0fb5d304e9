"""The Python interface, as ``import polarguide`` gives it. The command line is a client of it.

Nothing here prints or installs signal handlers: progress and messages go to a ``Reporter``.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from polarguide.capture import Scene
from polarguide.capture.layout import refuse_scene
from polarguide.capture.metadata import refractive_index_of
from polarguide.errors import PolarguideError
from polarguide.evaluation import evaluate
from polarguide.evaluation.record import read_metrics
from polarguide.export import formats
from polarguide.files import read_file, require_folder
from polarguide.inspection.inspect import Inspection, inspect_scene, inspection_folder
from polarguide.inspection.record import write_inspection
from polarguide.inspection.settings import InspectSettings
from polarguide.measurement.line import measure_shots
from polarguide.options import DeviceName, PathLike, SceneOptions, SessionOptions, VisitorOptions, index_of
from polarguide.preparation.prepare import prepare_scene
from polarguide.progress import SILENT, Reporter
from polarguide.raster import choose_backend
from polarguide.records import option_name
from polarguide.rendering import film, pictures, relight
from polarguide.rendering import present as presenting
from polarguide.rendering.pictures import select_views
from polarguide.rendering.priors import write_priors
from polarguide.runs import train as training
from polarguide.runs.opened import OpenedRun, read_scene
from polarguide.sensor_calibration.calibrate import calibrate_sensor
from polarguide.shots.exposures import find_shots
from polarguide.shots.options import ShotOptions
from polarguide.shots.write import FORMATS, WrittenShots, write_shots
from polarguide.training.recipe import Recipe
from polarguide.training.settings import TrainSettings
from polarguide.viewer import watch

_OF_MAPS = ("full_well", "read_noise", "snr")
"""Options of shots that maps of a scene with poses depend on."""


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
calibrate = calibrate_sensor
measure = measure_shots
present = presenting.present
prepare = prepare_scene


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


def priors(
    paths: Scene | PathLike | Sequence[PathLike],
    out: PathLike,
    *,
    run: OpenedRun | None = None,
    views: str = "test",
    refractive_index: float | None = None,
    threshold: float | None = None,
    reading: SceneOptions = SceneOptions(),
    shots: ShotOptions | None = None,
    formats: Sequence[str] | None = None,
    intrinsics: str | None = None,
    reporter: Reporter = SILENT,
) -> Path | WrittenShots:
    """What polarization says, with poses or without: of one scene with poses, or of shots.

    Of a scene with poses, pictures of some views and a contact sheet (``rendering.priors.write_priors``), and their
    maps if ``formats`` are given. Of anything else, all maps of every shot (``shots.write.write_shots``).

    Args:
        paths: a scene, its folder, or files and folders of shots as ``find_shots`` takes them.
        out: folder to write.
        run, views, threshold, reading: as ``write_priors`` takes them, for a scene with poses alone.
        refractive_index: of the surfaces; None: as ``scene.json`` says, else 1.5.
        shots, intrinsics: as ``write_shots`` takes them, for shots alone; noise and ``snr`` for maps of scenes, too.
        formats: of the maps: png, exr, npy, page; None: all of them for shots, none for a scene with poses.

    Returns:
        The contact sheet of a scene with poses; else what was written.

    Raises:
        PolarguideError: nothing can be read, or an option is wrong or means nothing here.
    """
    many = (
        [] if isinstance(paths, Scene) else [paths] if isinstance(paths, str | os.PathLike) else list(paths)
    )
    posed = isinstance(paths, Scene) or (len(many) == 1 and os.path.lexists(Path(many[0]) / "sparse"))
    if not posed:
        _refuse_for_shots(run, views, threshold, reading, shots)
        return write_shots(
            many,
            out,
            shots,
            formats=FORMATS if formats is None else formats,
            intrinsics=intrinsics,
            refractive_index=index_of(refractive_index, _said_index(many)),
            reporter=reporter,
        )
    _refuse_with_poses(intrinsics, shots, reading, bool(formats))
    refuse_scene(Path(out))
    scene = paths if isinstance(paths, Scene) else read_scene(many[0], reading, reporter)
    index = index_of(refractive_index, scene.refractive_index)
    sheet = write_priors(
        scene,
        out,
        run=run,
        views=views,
        refractive_index=index,
        threshold=0.05 if threshold is None else threshold,
        reporter=reporter,
    )
    if formats:
        chosen = {view.name for view in select_views(scene, views)}
        options = replace(shots or ShotOptions(), transfer=reading.transfer)
        sets = [
            replace(found, downscale=reading.downscale)
            for found in find_shots([scene.root], options)
            if found.view in chosen
        ]
        write_shots(sets, out, options, formats=formats, refractive_index=index, reporter=reporter)
    return sheet


def _said_index(paths: Sequence[PathLike]) -> float | None:
    """The refractive index in the ``scene.json`` of shots from one folder; None where it has none."""
    file = Path(paths[0]) / "scene.json" if len(paths) == 1 else None
    return refractive_index_of(file, read_file(file)) if file is not None and file.is_file() else None


def _refuse_for_shots(
    run: OpenedRun | None,
    views: str,
    threshold: float | None,
    reading: SceneOptions,
    shots: ShotOptions | None,
) -> None:
    """Refuse what means something for a scene with poses alone."""
    default = SceneOptions()
    for name, given in (
        ("run", run is not None),
        ("views", views != "test"),
        ("threshold", threshold is not None),
        ("memory", reading.memory != default.memory),
        ("split", reading.split != default.split),
        (
            "transfer",
            reading.transfer not in (default.transfer, (shots or ShotOptions()).transfer),
        ),
    ):
        if given:
            raise PolarguideError(
                option_name(name),
                expected="a scene with poses",
                found="shots",
                remedy="Leave it out, or name the scene.",
            )
    if reading.downscale != 1:
        raise PolarguideError(
            "downscale",
            expected="1 for shots",
            found=str(reading.downscale),
            remedy="Use --demosaic quarter.",
        )


def _refuse_with_poses(
    intrinsics: str | None, shots: ShotOptions | None, reading: SceneOptions, maps: bool
) -> None:
    """Refuse what means something for shots alone; ``maps``: maps of the views are written, too."""
    changed = [] if shots is None else shots.changed()
    if shots is not None and shots.transfer in ("auto", reading.transfer):
        changed = [name for name in changed if name != "transfer"]
    given = (["intrinsics"] if intrinsics is not None else []) + [
        name for name in changed if not (maps and name in _OF_MAPS)
    ]
    if given:
        more = " With --formats it applies to the maps." if given[0] in _OF_MAPS else ""
        raise PolarguideError(
            (shots or ShotOptions()).called(given[0]),
            expected="shots",
            found="a scene with poses",
            remedy=f"Leave it out: the scene has developed pictures and cameras.{more}",
        )


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


def demo_scene() -> Path:
    """The folder of the small scene that ships with the package: glossy objects, 50 views, four angles each.

    Example:
        >>> polarguide.load_scene(polarguide.demo_scene()).view("v000").camera.width    # doctest: +SKIP
        128

    Raises:
        PolarguideError: the package is not whole.
    """
    scene = Path(__file__).parent / "data" / "demo"
    require_folder(scene, expected="the demo scene", remedy="Install the package again.")
    return scene
