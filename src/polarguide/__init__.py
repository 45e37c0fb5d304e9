"""polarguide: polarization photographs to a Gaussian splatting scene with its reflections separated.

``train`` trains on a scene folder and gives a ``Run``; ``open_run`` opens one that was trained before. Names are loaded
when they are first asked for, so that ``import polarguide`` costs nothing.
"""

from __future__ import annotations

import gc
import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from polarguide import optics
    from polarguide.api.captures import inspect, prepare, present
    from polarguide.api.runs import Run, demo_scene, open_run, train
    from polarguide.capture import Scene, load_scene
    from polarguide.capture.sensor.analyzers import AnalyzerCalibration, read_analyzers
    from polarguide.core.errors import PolarguideError, PolarguideWarning
    from polarguide.core.options import SceneOptions, SessionOptions
    from polarguide.core.progress import Reporter
    from polarguide.geometry.camera import Camera
    from polarguide.inspection.settings import InspectSettings
    from polarguide.methods.registry import recipes
    from polarguide.preparation.settings import PrepareSettings
    from polarguide.results.evaluation.metric import Metric
    from polarguide.training.recipe import Recipe
    from polarguide.training.settings import TrainSettings
    from polarguide_bench.compare import ablate, compare
    from polarguide_bench.options import CompareOptions
    from polarguide_shots.api import calibrate, measure, priors, shot_priors
    from polarguide_shots.calibration.settings import CalibrateSettings
    from polarguide_shots.exposures import find_shots
    from polarguide_shots.maps import ShotMaps
    from polarguide_shots.measurement.line import watch_folder
    from polarguide_shots.options import MeasureOptions, ShotOptions, WatchOptions
    from polarguide_shots.read import SurfaceMaps, read_shot, surface_maps

    __version__: str

_NAMES = {
    "polarguide.api.captures": ("inspect", "prepare", "present"),
    "polarguide.api.runs": ("Run", "demo_scene", "open_run", "train"),
    "polarguide.capture": ("Scene", "load_scene"),
    "polarguide.capture.sensor.analyzers": ("AnalyzerCalibration", "read_analyzers"),
    "polarguide.core.errors": ("PolarguideError", "PolarguideWarning"),
    "polarguide.core.options": ("SceneOptions", "SessionOptions"),
    "polarguide.core.progress": ("Reporter",),
    "polarguide.geometry.camera": ("Camera",),
    "polarguide.inspection.settings": ("InspectSettings",),
    "polarguide.methods.registry": ("recipes",),
    "polarguide.preparation.settings": ("PrepareSettings",),
    "polarguide.results.evaluation.metric": ("Metric",),
    "polarguide.training.recipe": ("Recipe",),
    "polarguide.training.settings": ("TrainSettings",),
    "polarguide_bench.compare": ("ablate", "compare"),
    "polarguide_bench.options": ("CompareOptions",),
    "polarguide_shots.api": ("calibrate", "measure", "priors", "shot_priors"),
    "polarguide_shots.calibration.settings": ("CalibrateSettings",),
    "polarguide_shots.exposures": ("find_shots",),
    "polarguide_shots.maps": ("ShotMaps",),
    "polarguide_shots.measurement.line": ("watch_folder",),
    "polarguide_shots.options": ("MeasureOptions", "ShotOptions", "WatchOptions"),
    "polarguide_shots.read": ("SurfaceMaps", "read_shot", "surface_maps"),
}
"""The public names by the module that defines them, of this package and of its neighbors."""
_MODULES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = [
    "AnalyzerCalibration",
    "CalibrateSettings",
    "Camera",
    "CompareOptions",
    "InspectSettings",
    "MeasureOptions",
    "Metric",
    "PolarguideError",
    "PolarguideWarning",
    "PrepareSettings",
    "Recipe",
    "Reporter",
    "Run",
    "Scene",
    "SceneOptions",
    "SessionOptions",
    "ShotMaps",
    "ShotOptions",
    "SurfaceMaps",
    "TrainSettings",
    "WatchOptions",
    "__version__",
    "ablate",
    "calibrate",
    "compare",
    "demo_scene",
    "find_shots",
    "inspect",
    "load_scene",
    "measure",
    "open_run",
    "optics",
    "prepare",
    "present",
    "priors",
    "read_analyzers",
    "read_shot",
    "recipes",
    "shot_priors",
    "surface_maps",
    "train",
    "watch_folder",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        value: Any = _version()
    elif name == "optics":
        return importlib.import_module("polarguide.optics")
    elif name in _MODULES:
        value = getattr(_imported(_MODULES[name], name), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def _imported(module: str, name: str) -> Any:
    """Import the module of a public name, without garbage collection, which would take 0.4 of 2.3 CPU seconds.

    Raises:
        PolarguideError: the module belongs to a neighboring package that is not installed.
    """
    errors = importlib.import_module("polarguide.core.errors")
    collects = gc.isenabled()
    gc.disable()
    try:
        return errors.import_part(module, name)
    finally:
        if collects:
            gc.enable()


def __dir__() -> list[str]:
    return sorted(__all__)


def _version() -> str:
    """Return the installed version, as pyproject.toml states it."""
    metadata = importlib.import_module("importlib.metadata")
    try:
        return str(metadata.version("polarguide"))
    except metadata.PackageNotFoundError:  # run from a checkout that is not installed
        return "0+unknown"
