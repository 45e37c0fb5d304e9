"""The photographs' cameras in the scene, to be clicked, and the box of the crop."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from polarguide.scene_frame import SceneFrame
from polarguide.viewer.appearance import Crop
from polarguide.viewer.lens import quaternion
from polarguide.viewer.photographs import Photograph

SIZE, NEAR = 0.05, 0.4  # of the cameras' distance: of a frustum, and within which it is left out
COLOR, HELD_OUT_COLOR, BOX_COLOR = (60, 90, 160), (200, 120, 30), (240, 200, 40)
# The twelve edges of a box whose eight corners are counted with the last axis fastest.
EDGES = [(i, i | bit) for bit in (1, 2, 4) for i in range(8) if not i & bit]


class Frusta:
    """Camera frusta with their photographs.

    Args:
        scene: viser's, of one visitor. photographs: to be shown. around: of the scene. go: called with a view's name.
    """

    def __init__(
        self,
        scene: Any,
        photographs: Sequence[Photograph],
        around: SceneFrame,
        go: Callable[[str], None],
    ) -> None:
        self._scene, self._around = scene, around
        self._visible, self._far = True, np.ones(len(photographs), dtype=bool)
        self._centers = np.array([p.view.camera.center.numpy() for p in photographs]).reshape(-1, 3)
        self._reach = NEAR * around.distance
        self._handles: list[Any] = []
        for number, photograph in enumerate(photographs):
            camera, name = photograph.view.camera, photograph.view.name
            handle = scene.add_camera_frustum(
                f"/cameras/{number}",
                fov=2 * math.atan(0.5 * camera.height / camera.fy),
                aspect=camera.width / camera.height,
                scale=SIZE * around.distance,
                thickness=0.02 * SIZE * around.distance,
                color=HELD_OUT_COLOR if photograph.held_out else COLOR,
                image=photograph.thumbnail,
                jpeg_quality=80,
                wxyz=quaternion(camera),
                position=camera.center.numpy(),
                cast_shadow=False,
                receive_shadow=False,
            )
            handle.on_click(lambda _, name=name: go(name))
            self._handles.append(handle)
        self._box: Any = None

    def show(self, visible: bool) -> None:
        """Show all cameras, or none."""
        self._visible = visible
        self._update()

    def seen_from(self, position: np.ndarray | None) -> None:
        """Leave out the cameras close to where the visitor stands [3]; all of them at a photograph (None).

        They would cover the picture.
        """
        near = True if position is None else np.linalg.norm(self._centers - position, axis=1) < self._reach
        self._far = ~np.broadcast_to(near, len(self._handles))
        self._update()

    def _update(self) -> None:
        for handle, far in zip(self._handles, self._far, strict=True):
            visible = self._visible and bool(far)
            if handle.visible != visible:
                handle.visible = visible

    def box(self, crop: Crop | None) -> None:
        """Draw the crop's box, or take it away."""
        if self._box is not None:
            self._box.remove()
            self._box = None
        if crop is not None:
            corners = crop.corners(self._around).numpy()
            points = np.array([[corners[a], corners[b]] for a, b in EDGES], dtype=np.float32)
            width = 0.0015 * self._around.distance
            self._box = self._scene.add_line_segments("/crop", points, BOX_COLOR, thickness=width)
