"""Read a scene folder: views with four polarizer angles, a COLMAP model, ground truth."""

from polarguide.capture.colmap.model import ColmapModel, read_model
from polarguide.capture.reader import load_scene
from polarguide.capture.view import ANGLES, GroundTruth, Scene, View

__all__ = ["ANGLES", "ColmapModel", "GroundTruth", "Scene", "View", "load_scene", "read_model"]
