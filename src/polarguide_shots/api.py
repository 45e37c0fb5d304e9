"""The Python interface of shots and cameras: priors, measurements and calibration."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from polarguide.capture import Scene
from polarguide.capture.layout import refuse_scene
from polarguide.capture.metadata import refractive_index_of
from polarguide.capture.raw_options import changed
from polarguide.core.errors import PolarguideError
from polarguide.core.files import read_file
from polarguide.core.options import PathLike, SceneOptions, index_of
from polarguide.core.progress import SILENT, Reporter
from polarguide.results.rendering.pictures import views_named
from polarguide.results.rendering.priors import write_priors
from polarguide.runs.opened import OpenedRun, read_scene
from polarguide_shots.calibration.calibrate import calibrate_sensor
from polarguide_shots.measurement.line import measure_shots
from polarguide_shots.options import ShotOptions
from polarguide_shots.sets import known_places
from polarguide_shots.write import FORMATS, WrittenShots, check_formats, write_shots, write_view_maps

_OF_MAPS = ("full_well", "read_noise", "snr")
"""Options of shots that maps of views of a scene depend on."""

calibrate = calibrate_sensor
measure = measure_shots


def priors(
    scene: Scene | PathLike,
    out: PathLike,
    *,
    run: OpenedRun | None = None,
    views: str = "test",
    refractive_index: float | None = None,
    threshold: float = 0.05,
    reading: SceneOptions = SceneOptions(),
    formats: Sequence[str] = (),
    shots: ShotOptions = ShotOptions(),
    reporter: Reporter = SILENT,
) -> Path:
    """Polarization priors of views of a scene: pictures and a contact sheet, and maps if ``formats`` are given.

    All of it is of the scene's views as they are: with their masks, exposures and size. ``shot_priors`` is the same for
    files of a camera.

    Args:
        scene: a scene with poses, or its folder, which is read as ``reading`` says.
        out: folder to write.
        run, views, threshold: as ``results.rendering.priors.write_priors`` takes them.
        refractive_index: refractive index of the surfaces; None: as ``scene.json`` says, else 1.5.
        formats: of maps as ``shot_priors`` writes them, a folder for each view: png, exr, npy, page.
        shots: ``full_well``, ``read_noise`` and ``snr`` for the maps.

    Returns:
        The contact sheet.

    Raises:
        PolarguideError: the scene cannot be read, a view has no such pictures, or an option is wrong or means nothing
            here.
    """
    given = [name for name in changed(shots) if not (formats and name in _OF_MAPS)]
    if given:
        hint = " With --formats it applies to the maps." if given[0] in _OF_MAPS else ""
        raise PolarguideError(
            shots.called(given[0]),
            expected="shots",
            found="a scene with poses",
            remedy=f"Leave it out: the scene has developed pictures and cameras.{hint}",
        )
    refuse_scene(Path(out))
    loaded = scene if isinstance(scene, Scene) else read_scene(scene, reading, reporter)
    index = index_of(refractive_index, loaded.refractive_index)
    chosen = views_named(loaded, views)
    if formats:
        check_formats(formats)
        for view in chosen:
            known_places(view.name, view.exposures)
    sheet = write_priors(
        loaded, out, run=run, views=views, refractive_index=index, threshold=threshold, reporter=reporter
    )
    if formats:
        write_view_maps(chosen, out, shots, formats=formats, refractive_index=index, reporter=reporter)
    return sheet


def shot_priors(
    paths: PathLike | Sequence[PathLike],
    out: PathLike,
    *,
    refractive_index: float | None = None,
    shots: ShotOptions = ShotOptions(),
    formats: Sequence[str] | None = None,
    intrinsics: str | None = None,
    reporter: Reporter = SILENT,
) -> WrittenShots:
    """Polarization maps of single shots, without poses: all maps of every shot (``shots.write.write_shots``).

    Args:
        paths: files and folders of shots as ``find_shots`` takes them.
        out: folder to write, a folder for each shot in it.
        refractive_index: of the surfaces; None: as the ``scene.json`` in the only folder says, else 1.5.
        shots, formats, intrinsics: as ``write_shots`` takes them; None: all formats.

    Raises:
        PolarguideError: nothing can be read, or an option is wrong or means nothing here.
    """
    many = [paths] if isinstance(paths, str | os.PathLike) else list(paths)
    metadata = Path(many[0]) / "scene.json" if len(many) == 1 else None
    stated = None
    if metadata is not None and metadata.is_file():
        stated = refractive_index_of(metadata, read_file(metadata))
    return write_shots(
        many,
        out,
        shots,
        formats=FORMATS if formats is None else formats,
        intrinsics=intrinsics,
        refractive_index=index_of(refractive_index, stated),
        reporter=reporter,
    )
