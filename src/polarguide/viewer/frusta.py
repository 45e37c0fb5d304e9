"""Photographs and their camera frusta in the scene, and the crop box."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch

from polarguide.camera import quaternion
from polarguide.capture import Scene, View
from polarguide.presentation import Crop
from polarguide.scene_frame import SceneFrame
from polarguide.visualization import figures
from polarguide.visualization.figures import Picture

THUMBNAIL = 96  # pixels of the longer side
# Shares of the cameras' distance: size of a frustum, and distance within which it is hidden.
SIZE, NEAR = 0.05, 0.4
COLOR, HELD_OUT_COLOR, BOX_COLOR = (60, 90, 160), (200, 120, 30), (240, 200, 40)
# The twelve edges of a box whose eight corners are ordered with the last axis fastest.
EDGES = [(i, i | bit) for bit in (1, 2, 4) for i in range(8) if not i & bit]


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph, its thumbnail (uint8 [h, w, 3] RGB), and whether it is held out from training."""

    view: View
    thumbnail: Picture
    held_out: bool


def photographs(scene: Scene) -> dict[str, Photograph]:
    """All photographs of a scene, by name of the view."""
    tests = set(scene.test_names)
    return {view.name: Photograph(view, _thumbnail(view), view.name in tests) for view in scene.views}


def _thumbnail(view: View) -> Picture:
    picture = view.photograph().numpy()
    scale = min(1.0, THUMBNAIL / max(picture.shape[:2]))
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return figures.radiance_to_rgb(torch.from_numpy(small))


class Frusta:
    """Clickable camera frusta with their photographs.

    Args:
        scene: viser's scene handle of one session. photographs: to be shown. scene_frame: of the scene.
        go: called with a view's name when its frustum is clicked.
    """

    def __init__(
        self,
        scene: Any,
        photographs: Sequence[Photograph],
        scene_frame: SceneFrame,
        go: Callable[[str], None],
    ) -> None:
        self._scene, self._scene_frame = scene, scene_frame
        self._visible, self._far = True, np.ones(len(photographs), dtype=bool)
        self._centers = np.array([p.view.camera.center.numpy() for p in photographs]).reshape(-1, 3)
        self._reach = NEAR * scene_frame.distance
        self._handles: list[Any] = []
        for number, photograph in enumerate(photographs):
            camera, name = photograph.view.camera, photograph.view.name
            handle = scene.add_camera_frustum(
                f"/cameras/{number}",
                fov=2 * math.atan(0.5 * camera.height / camera.fy),
                aspect=camera.width / camera.height,
                scale=SIZE * scene_frame.distance,
                thickness=0.02 * SIZE * scene_frame.distance,
                color=HELD_OUT_COLOR if photograph.held_out else COLOR,
                image=photograph.thumbnail,
                jpeg_quality=80,
                wxyz=quaternion(camera.rotation.T),
                position=camera.center.numpy(),
                cast_shadow=False,
                receive_shadow=False,
            )
            handle.on_click(lambda _, name=name: go(name))
            self._handles.append(handle)
        self._box: Any = None

    def show(self, visible: bool) -> None:
        """Show or hide all frusta."""
        self._visible = visible
        self._update()

    def hide_near(self, position: np.ndarray | None) -> None:
        """Hide the frusta near the camera position [3], which would cover the picture; all of them if it is None."""
        near = True if position is None else np.linalg.norm(self._centers - position, axis=1) < self._reach
        self._far = ~np.broadcast_to(near, len(self._handles))
        self._update()

    def _update(self) -> None:
        for handle, far in zip(self._handles, self._far, strict=True):
            visible = self._visible and bool(far)
            if handle.visible != visible:
                handle.visible = visible

    def show_box(self, crop: Crop | None) -> None:
        """Draw the crop box, or remove it."""
        if self._box is not None:
            self._box.remove()
            self._box = None
        if crop is not None:
            corners = crop.corners(self._scene_frame).numpy()
            points = np.array([[corners[a], corners[b]] for a, b in EDGES], dtype=np.float32)
            width = 0.0015 * self._scene_frame.distance
            self._box = self._scene.add_line_segments("/crop", points, BOX_COLOR, thickness=width)
