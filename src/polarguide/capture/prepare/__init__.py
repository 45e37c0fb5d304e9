"""Camera files -> a scene folder: what ``polarguide prepare`` does."""

from polarguide.capture.prepare.reporter import Reporter
from polarguide.capture.prepare.run import Prepared, prepare_scene
from polarguide.capture.prepare.settings import ORIGINS, PrepareSettings

__all__ = ["ORIGINS", "PrepareSettings", "Prepared", "Reporter", "prepare_scene"]
