"""Readers of captures: pictures at several polarizer angles, camera poses, and optional ground truth."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from polarguide.capture.colmap.model import ColmapModel, read_model
    from polarguide.capture.metadata import GroundTruth
    from polarguide.capture.scene import Scene, load_scene
    from polarguide.capture.view import View

# Module of each public name. A module is imported when its name is first used, so some modules need no torch.
_MODULES = {
    "ColmapModel": "colmap.model",
    "GroundTruth": "metadata",
    "Scene": "scene",
    "View": "view",
    "load_scene": "scene",
    "read_model": "colmap.model",
}

__all__ = ["ColmapModel", "GroundTruth", "Scene", "View", "load_scene", "read_model"]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
