"""From a browser's window to cameras: free ones, and those of photographs."""

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
    wxyz: Sequence[float], position: Sequence[float], fov: float, size: tuple[int, int]
) -> Camera:
    """A camera with square pixels and its axis in the middle.

    Args:
        wxyz: quaternion of the camera-to-world rotation, OpenCV's axes. position: in the world.
        fov: vertical, radians. size: width and height, pixels.
    """
    width, height = size
    w, x, y, z = (float(v) for v in wxyz)
    rotation = torch.from_numpy(Rotation.from_quat([x, y, z, w]).as_matrix().T.copy())
    center = torch.tensor([float(v) for v in position], dtype=torch.float64)
    focal = 0.5 * height / math.tan(0.5 * fov)
    return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height, rotation, -rotation @ center)


def quaternion(camera: Camera) -> tuple[float, float, float, float]:
    """(w, x, y, z) of a camera's camera-to-world rotation."""
    x, y, z, w = Rotation.from_matrix(camera.rotation.T.numpy()).as_quat()
    return float(w), float(x), float(y), float(z)


@dataclass(frozen=True)
class Fit:
    """Where a photograph lies in a window of another shape: as big as it fits, in the middle.

    Attributes:
        scale: window pixels per pixel of the photograph. left, top: of its corner, window pixels.
        size: of the window, width and height.
    """

    scale: float
    left: float
    top: float
    size: tuple[int, int]

    def camera(self, photograph: Camera) -> Camera:
        """The photograph's camera with the window's borders."""
        s, (width, height) = self.scale, self.size
        return replace(
            photograph,
            width=width,
            height=height,
            fx=s * photograph.fx,
            fy=s * photograph.fy,
            cx=s * photograph.cx + self.left,
            cy=s * photograph.cy + self.top,
        )

    def placed(self, picture: Picture) -> Picture:
        """A picture of the photograph's size in a window that is gray around it."""
        matrix = np.array([[self.scale, 0, self.left], [0, self.scale, self.top]])
        # warpAffine counts from the middle of the corner pixel, our cameras from its corner.
        matrix[:, 2] += 0.5 * self.scale - 0.5
        blend = cv2.INTER_LINEAR if self.scale >= 1 else cv2.INTER_AREA
        placed = cv2.warpAffine(picture, matrix, self.size, flags=blend, borderValue=(64, 64, 64))
        return np.ascontiguousarray(placed, dtype=np.uint8)


def fit(photograph: Camera, size: tuple[int, int]) -> Fit:
    """How a photograph fits into a window of ``size``, width and height."""
    scale = min(size[0] / photograph.width, size[1] / photograph.height)
    left, top = 0.5 * (size[0] - scale * photograph.width), 0.5 * (size[1] - scale * photograph.height)
    return Fit(scale, left, top, size)


def window_fov(photograph: Camera, aspect: float) -> float:
    """Vertical field of view, radians, with which a window of ``aspect`` (width over height) holds a photograph."""
    high, wide = (
        0.5 * photograph.height / photograph.fy,
        0.5 * photograph.width / photograph.fx,
    )
    return 2 * math.atan(max(high, wide / aspect))
