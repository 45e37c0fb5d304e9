"""One exposure set without poses: its maps, their uncertainty, and which pixels say nothing.

``find_shots`` lists the exposure sets behind paths, ``read_shot`` reads one into ``ShotMaps``. Names are loaded when
they are first asked for: options alone load neither torch nor OpenCV.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from polarguide.shots.exposures import ExposureSet, find_shots
    from polarguide.shots.maps import REASONS, NoiseModel, Reason, ShotMaps
    from polarguide.shots.options import ShotOptions
    from polarguide.shots.read import read_shot

_MODULES = {
    "ExposureSet": "exposures",
    "find_shots": "exposures",
    "REASONS": "maps",
    "NoiseModel": "maps",
    "Reason": "maps",
    "ShotMaps": "maps",
    "ShotOptions": "options",
    "read_shot": "read",
}

__all__ = [
    "REASONS",
    "ExposureSet",
    "NoiseModel",
    "Reason",
    "ShotMaps",
    "ShotOptions",
    "find_shots",
    "read_shot",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
