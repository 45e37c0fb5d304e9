"""Cameras for a browser window: free ones, and those of photographs with borders around them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from polarguide.camera import Camera
from polarguide.visualization.figures import Picture


def free_camera(
    wxyz: Sequence[float], position: Sequence[float], fov: float, frame_size: tuple[int, int]
) -> Camera:
    """A camera with square pixels and a centered principal point.

    Args:
        wxyz: quaternion of the camera-to-world rotation, OpenCV's axes. position: in the world.
        fov: vertical field of view in radians. frame_size: width and height in pixels.
    """
    width, height = frame_size
    w, x, y, z = (float(v) for v in wxyz)
    rotation = torch.from_numpy(Rotation.from_quat([x, y, z, w]).as_matrix().T.copy())
    center = torch.tensor([float(v) for v in position], dtype=torch.float64)
    focal = 0.5 * height / math.tan(0.5 * fov)
    return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height, rotation, -rotation @ center)


@dataclass(frozen=True)
class Letterbox:
    """The placement of a photograph in a window of another aspect ratio: as large as possible, centered.

    Attributes:
        scale: window pixels per pixel of the photograph. left, top: its corner in window pixels.
        frame_size: width and height of the window.
    """

    scale: float
    left: float
    top: float
    frame_size: tuple[int, int]

    def camera(self, photograph: Camera) -> Camera:
        """The photograph's camera, extended to the window."""
        scaled = photograph.scaled(self.scale, *self.frame_size)
        return replace(scaled, cx=scaled.cx + self.left, cy=scaled.cy + self.top)

    def apply(self, picture: Picture) -> Picture:
        """A picture of the photograph's size, resampled into the window with gray borders."""
        matrix = np.array([[self.scale, 0, self.left], [0, self.scale, self.top]])
        # The origin of warpAffine is the center of the corner pixel, that of our cameras its corner.
        matrix[:, 2] += 0.5 * self.scale - 0.5
        blend = cv2.INTER_LINEAR if self.scale >= 1 else cv2.INTER_AREA
        placed = cv2.warpAffine(picture, matrix, self.frame_size, flags=blend, borderValue=(64, 64, 64))
        return np.ascontiguousarray(placed, dtype=np.uint8)


def letterbox(photograph: Camera, frame_size: tuple[int, int]) -> Letterbox:
    """The placement of a photograph in a window of ``frame_size``, width and height."""
    scale = min(frame_size[0] / photograph.width, frame_size[1] / photograph.height)
    left = 0.5 * (frame_size[0] - scale * photograph.width)
    top = 0.5 * (frame_size[1] - scale * photograph.height)
    return Letterbox(scale, left, top, frame_size)


def window_fov(photograph: Camera, aspect: float) -> float:
    """Vertical field of view in radians with which a window of ``aspect`` (width / height) contains a photograph."""
    high, wide = 0.5 * photograph.height / photograph.fy, 0.5 * photograph.width / photograph.fx
    return 2 * math.atan(max(high, wide / aspect))
