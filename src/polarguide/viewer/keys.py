"""A camera path that a visitor sets down pose by pose."""

from __future__ import annotations

import json
from dataclasses import replace

from polarguide.camera import Camera
from polarguide.trajectory import camera_record, interpolated

FRAMES_PER_SECOND = 30


class Keys:
    """Poses in the order in which they were set, and the smooth path through them.

    Args:
        size: of the pictures of the path, width and height.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self.cameras: list[Camera] = []

    def add(self, camera: Camera) -> None:
        """Set one more pose; the picture keeps what it shows from top to bottom."""
        width, height = self._size
        focal = camera.fy * height / camera.height
        self.cameras.append(
            replace(camera, width=width, height=height, fx=focal, fy=focal, cx=0.5 * width, cy=0.5 * height)
        )

    def path(self, seconds: float) -> list[Camera]:
        """The path with ``seconds`` from each pose to the next; the poses themselves where there are fewer than two."""
        if len(self.cameras) < 2:
            return list(self.cameras)
        frames = 1 + round((len(self.cameras) - 1) * seconds * FRAMES_PER_SECOND)
        return interpolated(self.cameras, frames)

    def file(self, seconds: float) -> str:
        """The path as ``polarguide render --path`` reads it."""
        records = [camera_record(camera) for camera in self.path(seconds)]
        return json.dumps({"frames_per_second": FRAMES_PER_SECOND, "cameras": records})
