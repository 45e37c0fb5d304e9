"""A local web viewer over our own rasteriser, for a trained run or one that is being trained."""

from .photographs import photographs
from .server import LOOPBACK, Viewer, viewing_address
from .shown import Shown, shown_run, shown_training

__all__ = ["LOOPBACK", "Shown", "Viewer", "photographs", "shown_run", "shown_training", "viewing_address"]
