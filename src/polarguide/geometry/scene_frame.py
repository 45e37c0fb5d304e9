"""Frame of a scene, estimated from its cameras: center, upward direction and distance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import unit

_LEAST_SPREAD = 1e-4
"""Smallest eigenvalue of the least-squares system for which optical axes count as intersecting."""
_LEAST_FAN = 0.03
"""Minimum variance of the directions of picture rows within a level plane."""
_MOST_ROLL = 0.2
"""Maximum variance of the directions of picture rows across the level plane, as a share of the variance within it."""


@dataclass(frozen=True, eq=False)
class SceneFrame:
    """Frame of a scene for paths around it.

    Attributes:
        center: [3] float64, point at which the cameras look.
        up: [3] float64, unit upward direction.
        distance: median distance of the cameras from the center, in world units; positive.
    """

    center: Tensor
    up: Tensor
    distance: float

    def turn(self, degrees: float) -> Tensor:
        """Return the rotation [3, 3] float64 about ``up``, counter-clockwise as seen from above."""
        return torch.from_numpy(Rotation.from_rotvec(degrees * self.up.numpy(), degrees=True).as_matrix())

    def panorama_axes(self) -> Tensor:
        """Return the axes of an upright panorama, [3, 3] float64. The columns are right, up and back.

        The middle of the panorama shows the world axis that is closest to level, projected onto the level plane. Ties
        go to the first axis.
        """
        level = torch.zeros(3, dtype=torch.float64)
        level[int(self.up.abs().round(decimals=6).argmin())] = 1.0
        ahead = unit(level - (level @ self.up) * self.up, 1e-9)
        return torch.stack((torch.linalg.cross(ahead, self.up), self.up, -ahead), dim=1)


def scene_frame(cameras: Sequence[Camera]) -> SceneFrame:
    """Estimate the frame of one or more cameras.

    The center is the point nearest to all optical axes (least squares). If the axes are parallel, as for a camera that
    moves sideways, the center lies in front of the mean camera position. Its distance from there is the spread of the
    cameras. The upward direction is perpendicular to the rows of the pictures (least squares), because people hold
    cameras level. If the rows do not determine it, it is the mean of the pictures' upward directions.
    """
    centers = torch.stack([camera.center for camera in cameras])
    forward = torch.stack([camera.rotation[2] for camera in cameras])
    eye = torch.eye(3, dtype=torch.float64)
    across = eye - forward[:, :, None] * forward[:, None, :]
    system = across.mean(dim=0)
    middle = centers.mean(dim=0)
    ahead = unit(forward.mean(dim=0), 1e-9)
    if float(torch.linalg.eigvalsh(system)[0]) > _LEAST_SPREAD:
        center = torch.linalg.solve(system, (across @ centers[:, :, None])[..., 0].mean(dim=0))
    else:
        spread = float((centers - middle).norm(dim=1).max())
        center = middle + ahead * max(spread, 1.0)
    distance = float((centers - center).norm(dim=1).median())
    return SceneFrame(center, _common_up(cameras), max(distance, 1e-6))


def _common_up(cameras: Sequence[Camera]) -> Tensor:
    """Return the unit upward direction [3] float64; see ``scene_frame``."""
    mean = -torch.stack([camera.rotation[1] for camera in cameras]).mean(dim=0)
    if float(mean.norm()) < 0.05:  # the directions cancel, as for cameras on all sides or rolled cameras
        mean = -cameras[0].rotation[1]
    mean = mean / mean.norm()
    rows = torch.stack([camera.rotation[0] for camera in cameras])
    values, axes = torch.linalg.eigh(rows.T @ rows / len(rows))
    axis = axes[:, 0]
    # The rows must spread over a plane, and the cameras must be upright rather than on edge.
    is_level = float(values[1]) > _LEAST_FAN and float(values[0]) < _MOST_ROLL * float(values[1])
    if not is_level or abs(float(axis @ mean)) < 0.5:
        return mean
    return axis if float(axis @ mean) > 0 else -axis
