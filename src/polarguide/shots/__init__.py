"""One exposure set without poses: its maps, their uncertainty, and which pixels say nothing.

``find_shots`` lists the exposure sets behind paths, ``read_shot`` reads one into ``ShotMaps``, ``write_shots`` writes
the maps of many. Names are loaded when they are first asked for: the options need no torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from polarguide.shots.exposures import ExposureSet, find_shots
    from polarguide.shots.maps import REASONS, NoiseModel, Reason, ShotMaps
    from polarguide.shots.options import ShotOptions
    from polarguide.shots.read import read_shot
    from polarguide.shots.surface import SurfaceMaps, surface_maps
    from polarguide.shots.write import write_shots

_NAMES = {
    "exposures": ("ExposureSet", "find_shots"),
    "maps": ("REASONS", "NoiseModel", "Reason", "ShotMaps"),
    "options": ("ShotOptions",),
    "read": ("read_shot",),
    "surface": ("SurfaceMaps", "surface_maps"),
    "write": ("write_shots",),
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = [
    "REASONS",
    "ExposureSet",
    "NoiseModel",
    "Reason",
    "ShotMaps",
    "ShotOptions",
    "SurfaceMaps",
    "find_shots",
    "read_shot",
    "surface_maps",
    "write_shots",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value
