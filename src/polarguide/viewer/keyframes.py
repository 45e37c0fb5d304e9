"""Camera keyframes and the path through them."""

from __future__ import annotations

import json
from dataclasses import replace

from polarguide.camera import Camera
from polarguide.trajectory import camera_record, interpolated

FRAMES_PER_SECOND = 30
MOST_KEYFRAMES = 50


class Keyframes:
    """Keyframes in the order in which they were added, and the smooth path through them.

    Args:
        frame_size: width and height of the pictures of the path.
    """

    def __init__(self, frame_size: tuple[int, int]) -> None:
        self._size = frame_size
        self.cameras: list[Camera] = []

    def add(self, camera: Camera) -> None:
        """Append a keyframe, up to ``MOST_KEYFRAMES``; its vertical field of view is kept."""
        if len(self.cameras) >= MOST_KEYFRAMES:
            return
        width, height = self._size
        focal = camera.fy * height / camera.height
        self.cameras.append(
            replace(camera, width=width, height=height, fx=focal, fy=focal, cx=0.5 * width, cy=0.5 * height)
        )

    def path(self, seconds: float) -> list[Camera]:
        """The path with ``seconds`` between keyframes; fewer than two keyframes are returned as they are."""
        if len(self.cameras) < 2:
            return list(self.cameras)
        frames = 1 + round((len(self.cameras) - 1) * seconds * FRAMES_PER_SECOND)
        return interpolated(self.cameras, frames)

    def to_json(self, seconds: float) -> str:
        """The path as JSON that ``polarguide render --path`` reads."""
        records = [camera_record(camera) for camera in self.path(seconds)]
        return json.dumps({"frames_per_second": FRAMES_PER_SECOND, "cameras": records})
