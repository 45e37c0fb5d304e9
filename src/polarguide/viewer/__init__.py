"""A local web viewer over our own rasterizer, for a trained run or one that is being trained."""

from polarguide.viewer.photographs import photographs
from polarguide.viewer.server import LOOPBACK, Viewer, viewing_address
from polarguide.viewer.shown import Shown, shown_run, shown_training

__all__ = ["LOOPBACK", "Shown", "Viewer", "photographs", "shown_run", "shown_training", "viewing_address"]
