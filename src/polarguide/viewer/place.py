"""Standing where a photograph was taken."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from polarguide.capture import View
from polarguide.scene_frame import SceneFrame
from polarguide.viewer.lens import window_fov

ARRIVAL = 5.0  # seconds that a browser has to reach a pose
TURNED, MOVED = (
    1e-6,
    1e-4,
)  # 1 - |cos| of half the angle, and a share of the cameras' distance: rounding on the way


@dataclass(eq=False)
class Place:
    """The photograph at whose pose a visitor stands.

    Attributes:
        view: it. wxyz, position: what the browser was told. since: when.
        reached: whether the browser has told that it is there; until then it may tell of where it was before.
    """

    view: View
    wxyz: np.ndarray
    position: np.ndarray
    since: float
    reached: bool = False

    def holds(self, camera: Any, now: float, distance: float) -> bool:
        """Whether a browser's camera is still there, or may still be on its way."""
        turned = 1 - abs(float(np.dot(self.wxyz, camera.wxyz)))
        moved = float(np.linalg.norm(self.position - camera.position)) / distance
        there = turned < TURNED and moved < MOVED
        self.reached |= there
        return there or (not self.reached and now - self.since < ARRIVAL)


def stand(client: Any, view: View, around: SceneFrame, now: float) -> Place:
    """Put a browser's camera where a photograph was taken, with a field of view that holds it."""
    camera, lens, center = client.camera, view.camera, view.camera.center
    # Turning goes round a point that the photograph sees, at the distance of the scene's center.
    ahead = lens.rotation[2]
    distance = max(float((around.center - center) @ ahead), 0.1 * around.distance)
    with client.atomic():
        camera.fov = window_fov(lens, camera.aspect)
        camera.up_direction = (-lens.rotation[1]).numpy()
        camera.position = center.numpy()
        camera.look_at = (center + distance * ahead).numpy()
    return Place(view, np.array(camera.wxyz), np.array(camera.position), now)
