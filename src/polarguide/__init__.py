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
    from polarguide.api.captures import calibrate, inspect, measure, prepare, present, priors, shot_priors
    from polarguide.api.runs import Run, demo_scene, open_run, train
    from polarguide.capture import Scene, load_scene
    from polarguide.capture.sensor.analyzer_file import read_analyzers
    from polarguide.capture.sensor.analyzers import AnalyzerCalibration
    from polarguide.core.errors import PolarguideError, PolarguideWarning
    from polarguide.core.options import SceneOptions, SessionOptions
    from polarguide.core.progress import Reporter
    from polarguide.experiments.compare import ablate, compare
    from polarguide.experiments.options import CompareOptions
    from polarguide.geometry.camera import Camera
    from polarguide.inspection.settings import InspectSettings
    from polarguide.preparation.settings import PrepareSettings
    from polarguide.recipes.registry import recipe_names
    from polarguide.shots.calibration.settings import CalibrateSettings
    from polarguide.shots.exposures import find_shots
    from polarguide.shots.maps import ShotMaps
    from polarguide.shots.measurement.watch import watch_folder
    from polarguide.shots.options import MeasureOptions, ShotOptions, WatchOptions
    from polarguide.shots.read import SurfaceMaps, read_shot, surface_maps
    from polarguide.training.recipe import Recipe
    from polarguide.training.settings import TrainSettings

    __version__: str

_NAMES = {
    "api.captures": ("calibrate", "inspect", "measure", "prepare", "present", "priors", "shot_priors"),
    "api.runs": ("Run", "demo_scene", "open_run", "train"),
    "capture": ("Scene", "load_scene"),
    "capture.sensor.analyzer_file": ("read_analyzers",),
    "capture.sensor.analyzers": ("AnalyzerCalibration",),
    "core.errors": ("PolarguideError", "PolarguideWarning"),
    "experiments.compare": ("ablate", "compare"),
    "experiments.options": ("CompareOptions",),
    "geometry.camera": ("Camera",),
    "inspection.settings": ("InspectSettings",),
    "shots.measurement.watch": ("watch_folder",),
    "core.options": ("SceneOptions", "SessionOptions"),
    "preparation.settings": ("PrepareSettings",),
    "core.progress": ("Reporter",),
    "recipes.registry": ("recipe_names",),
    "shots.calibration.settings": ("CalibrateSettings",),
    "shots.exposures": ("find_shots",),
    "shots.maps": ("ShotMaps",),
    "shots.options": ("MeasureOptions", "ShotOptions", "WatchOptions"),
    "shots.read": ("SurfaceMaps", "read_shot", "surface_maps"),
    "training.recipe": ("Recipe",),
    "training.settings": ("TrainSettings",),
}
"""The public names by the module below the package that defines them."""
_MODULES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = [
    "AnalyzerCalibration",
    "CalibrateSettings",
    "Camera",
    "CompareOptions",
    "InspectSettings",
    "MeasureOptions",
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
    "recipe_names",
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
        value = getattr(_imported(f"polarguide.{_MODULES[name]}"), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def _imported(name: str) -> Any:
    """A module. Its names stay, so that nobody has to look for cycles among them meanwhile (0.4 of 2.3 CPU seconds)."""
    collects = gc.isenabled()
    gc.disable()
    try:
        return importlib.import_module(name)
    finally:
        if collects:
            gc.enable()


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})


def _version() -> str:
    """The installed version; pyproject.toml states it."""
    metadata = importlib.import_module("importlib.metadata")
    try:
        return str(metadata.version("polarguide"))
    except metadata.PackageNotFoundError:  # run from a checkout that is not installed
        return "0+unknown"
