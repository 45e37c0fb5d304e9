"""Python interface for single shots and cameras: polarization maps, measurements and calibration."""

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
from polarguide.runs.opened import OpenedRun, read_scene
from polarguide_shots.calibration.calibrate import calibrate_sensor
from polarguide_shots.measurement.line import measure_shots
from polarguide_shots.options import ShotOptions
from polarguide_shots.prior_pictures import write_priors
from polarguide_shots.sets import known_indices
from polarguide_shots.write import FORMATS, WrittenShots, check_formats, write_shots, write_view_maps

_OF_MAPS = ("full_well", "read_noise", "snr")
"""Names of the options of shots that also apply to maps of views of a scene."""

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
    """Write polarization priors of views of a scene: pictures, a contact sheet, and maps in the requested formats.

    The priors use the masks, exposures and size of the views. For files of a camera, use ``shot_priors`` instead.

    Args:
        scene: a scene with poses, or its folder.
        out: folder to write.
        run: trained run of the scene, as in ``polarguide_shots.prior_pictures.write_priors``.
        views: views to write, as in ``write_priors``.
        refractive_index: refractive index of the surfaces. If None, the value in ``scene.json`` is used, or else 1.5.
        threshold: smallest DoLP of a used normal, as in ``write_priors``.
        reading: options of reading a scene folder.
        formats: formats of the maps of ``shot_priors`` (png, exr, npy, page). Each view gets its own folder.
        shots: options for the maps. Only ``full_well``, ``read_noise`` and ``snr`` apply.
        reporter: receiver of progress and messages.

    Returns:
        The path of the contact sheet.

    Raises:
        PolarguideError: the scene cannot be read, a view lacks pictures, or an option is invalid or does not apply.
    """
    given = [name for name in changed(shots) if not (formats and name in _OF_MAPS)]
    if given:
        hint = " With --formats it applies to the maps." if given[0] in _OF_MAPS else ""
        raise PolarguideError(
            shots.label(given[0]),
            expected="single shots, to which the option applies",
            found="a scene with poses",
            remedy=f"Remove the option, because a scene contains pictures and cameras that are ready to use.{hint}",
        )
    refuse_scene(Path(out))
    loaded = scene if isinstance(scene, Scene) else read_scene(scene, reading, reporter)
    index = index_of(refractive_index, loaded.refractive_index)
    chosen = views_named(loaded, views)
    if formats:
        check_formats(formats)
        for view in chosen:
            known_indices(view.name, view.exposures)
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
    """Write the polarization maps of single shots, without poses (see ``polarguide_shots.write.write_shots``).

    Args:
        paths: files and folders of shots, see ``find_shots``.
        out: folder to write, with a folder for each shot.
        refractive_index: refractive index of the surfaces. If None, the value in ``scene.json`` is used if there is
            only one folder, or else 1.5.
        shots: options of reading, see ``write_shots``.
        formats: formats of the maps, see ``write_shots``. If None, all formats are written.
        intrinsics: intrinsics of the developed pictures, see ``write_shots``.
        reporter: receiver of progress and messages.

    Raises:
        PolarguideError: no shot can be read, or an option is invalid or does not apply.
    """
    sources = [paths] if isinstance(paths, str | os.PathLike) else list(paths)
    metadata = Path(sources[0]) / "scene.json" if len(sources) == 1 else None
    stated = None
    if metadata is not None and metadata.is_file():
        stated = refractive_index_of(metadata, read_file(metadata))
    return write_shots(
        sources,
        out,
        shots,
        formats=FORMATS if formats is None else formats,
        intrinsics=intrinsics,
        refractive_index=index_of(refractive_index, stated),
        reporter=reporter,
    )
