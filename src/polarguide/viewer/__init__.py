"""Local web viewer for trained runs and for trainings in progress."""

from polarguide.core.options import LOOPBACK
from polarguide.viewer.scenery import Scenery, photographs, run_scenery, training_scenery
from polarguide.viewer.server import Viewer, viewing_address

__all__ = [
    "LOOPBACK",
    "Scenery",
    "Viewer",
    "photographs",
    "run_scenery",
    "training_scenery",
    "viewing_address",
]
