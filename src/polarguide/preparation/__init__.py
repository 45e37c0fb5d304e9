"""Prepare a scene folder from camera files (``polarguide prepare``)."""

from polarguide.preparation.prepare import Prepared, prepare_scene
from polarguide.preparation.settings import ORIGINS, PrepareSettings
from polarguide.progress import Reporter

__all__ = ["ORIGINS", "PrepareSettings", "Prepared", "Reporter", "prepare_scene"]
