"""Functions of the Python interface on captures. They are in a separate module, so that a training starts sooner."""

from __future__ import annotations

from pathlib import Path

from polarguide.core.options import DeviceName, PathLike
from polarguide.core.progress import SILENT, Reporter
from polarguide.inspection.inspect import Inspection, inspect_scene, inspection_folder, write_inspection
from polarguide.inspection.settings import InspectSettings
from polarguide.preparation.prepare import prepare_scene
from polarguide.raster import choose_backend
from polarguide.results.rendering import present as presenting

present = presenting.present
prepare = prepare_scene


def inspect(
    scene: PathLike,
    out: PathLike | None = None,
    *,
    settings: InspectSettings = InspectSettings(),
    device: DeviceName = "auto",
    reporter: Reporter = SILENT,
) -> Inspection:
    """Check a capture, and write a web page and a record of the findings.

    Args:
        scene: the scene folder; it may have no poses.
        out: folder to write. None writes to SCENE-inspection next to the scene.
        settings: settings of the inspection.
        device: device of the short training that the inspection includes.
        reporter: receives progress.

    Raises:
        PolarguideError: the scene cannot be read.
    """
    folder = inspection_folder(Path(scene), None if out is None else Path(out))
    backend = choose_backend(device, say=reporter.say)
    inspection = inspect_scene(Path(scene), settings, backend, reporter)
    write_inspection(inspection, folder, reporter)
    return inspection
