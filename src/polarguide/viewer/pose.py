"""The pose of a photograph: move a browser's camera to it, and notice when the camera leaves it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from polarguide.camera import quaternion
from polarguide.capture import View
from polarguide.scene_frame import SceneFrame
from polarguide.viewer.viewport import window_fov

ARRIVAL = 5.0  # seconds within which a browser has to report a pose
# Tolerances of rounding: 1 - |cos| of half the angle, and a share of the cameras' distance.
TURNED, MOVED = 1e-6, 1e-4


@dataclass(eq=False)
class ViewPose:
    """The view at whose pose a session's camera is.

    Attributes:
        view: the view. wxyz, position: the pose that was sent to the browser. since: the time when it was sent.
        reached: whether the browser has reported this pose; until then it may report earlier poses.
    """

    view: View
    wxyz: np.ndarray
    position: np.ndarray
    since: float
    reached: bool = False

    def is_kept(self, camera: Any, now: float, distance: float) -> bool:
        """Whether a browser's camera has this pose, or may still be moving to it.

        Args:
            camera: viser's. now: time in seconds. distance: of the cameras from the scene's center.
        """
        turned = 1 - abs(float(np.dot(self.wxyz, camera.wxyz)))
        moved = float(np.linalg.norm(self.position - camera.position)) / distance
        here = turned < TURNED and moved < MOVED
        self.reached |= here
        return here or (not self.reached and now - self.since < ARRIVAL)


def move_to_view(client: Any, view: View, scene_frame: SceneFrame, now: float) -> ViewPose:
    """Move a browser's camera to the pose of a view, with a field of view that contains the photograph."""
    camera, target, center = client.camera, view.camera, view.camera.center
    # The orbit center lies on the optical axis, at the distance of the scene's center.
    ahead = target.rotation[2]
    distance = max(float((scene_frame.center - center) @ ahead), 0.1 * scene_frame.distance)
    with client.atomic():
        camera.fov = window_fov(target, camera.aspect)
        camera.up_direction = (-target.rotation[1]).numpy()
        camera.position = center.numpy()
        camera.look_at = (center + distance * ahead).numpy()
    # Not what viser has stored by now: a message of the browser may have replaced it.
    return ViewPose(view, np.array(quaternion(target.rotation.T)), center.numpy(), now)
