"""A local web viewer for trained runs and for trainings in progress."""

from polarguide.options import LOOPBACK
from polarguide.viewer.frusta import photographs
from polarguide.viewer.server import Viewer, viewing_address
from polarguide.viewer.shown import Shown, shown_run, shown_training

__all__ = ["LOOPBACK", "Shown", "Viewer", "photographs", "shown_run", "shown_training", "viewing_address"]
