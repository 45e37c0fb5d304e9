"""One exposure set without poses: its maps, their uncertainty, and which pixels say nothing.

``find_shots`` lists the exposure sets behind paths, ``read_shot`` reads one into ``ShotMaps``.
"""

from polarguide.shots.exposures import ExposureSet, find_shots
from polarguide.shots.maps import REASONS, NoiseModel, Reason, ShotMaps
from polarguide.shots.options import ShotOptions
from polarguide.shots.read import read_shot

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
