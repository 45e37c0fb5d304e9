"""Camera files -> a scene folder: what ``polarguide prepare`` does."""

from polarguide.preparation.prepare import Prepared, prepare_scene
from polarguide.preparation.settings import ORIGINS, PrepareSettings
from polarguide.progress import Reporter

__all__ = ["ORIGINS", "PrepareSettings", "Prepared", "Reporter", "prepare_scene"]
