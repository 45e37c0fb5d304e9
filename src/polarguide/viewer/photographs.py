"""The photographs that a viewer offers to go to."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import torch

from polarguide.capture import Scene, View
from polarguide.visualization import figures
from polarguide.visualization.figures import Picture

THUMBNAIL = 96  # pixels of the longer side


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph with its small picture, uint8 [h, w, 3], and whether training does not see it."""

    view: View
    thumbnail: Picture
    held_out: bool


def photographs(scene: Scene) -> dict[str, Photograph]:
    """All photographs of a scene by name."""
    tests = set(scene.test_names)
    return {view.name: Photograph(view, _thumbnail(view), view.name in tests) for view in scene.views}


def _thumbnail(view: View) -> Picture:
    picture = view.photograph().numpy()
    scale = min(1.0, THUMBNAIL / max(picture.shape[:2]))
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return figures.radiance_to_rgb(torch.from_numpy(small))
