"""Where the cameras of a capture stand: what they look at, which way is up, and how far away they are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import unit

# Optical axes that are nearly parallel do not say where they meet: the cameras' own distance from each other does then.
_LEAST_SPREAD = 1e-4
# The pictures' rows say what is level if they fan out by so much (variance of unit vectors) and roll by less than so.
_LEAST_FAN = 0.03
_MOST_ROLL = 0.2


@dataclass(frozen=True, eq=False)
class SceneFrame:
    """A frame for moving cameras about a scene.

    Attributes:
        center: [3] float64, what the cameras look at.
        up: [3] float64, unit.
        distance: distance of the cameras from the center, their median; world units, positive.
    """

    center: Tensor
    up: Tensor
    distance: float

    def turn(self, degrees: float) -> Tensor:
        """Rotation [3, 3] float64 about ``up``, counter-clockwise as seen from above."""
        x, y, z = self.up.tolist()
        cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
        angle = math.radians(degrees)
        eye = torch.eye(3, dtype=torch.float64)
        return eye + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross

    def panorama_axes(self) -> Tensor:
        """Axes of an upright panorama, [3, 3] float64: columns are its right, its up, and the back (middle is ahead).

        Ahead is the world axis that is most level, the first of equals, made level.
        """
        level = torch.zeros(3, dtype=torch.float64)
        level[int(self.up.abs().round(decimals=6).argmin())] = 1.0
        ahead = unit(level - (level @ self.up) * self.up, 1e-9)
        return torch.stack((torch.linalg.cross(ahead, self.up), self.up, -ahead), dim=1)


def scene_frame(cameras: Sequence[Camera]) -> SceneFrame:
    """The frame of some cameras, at least one.

    The center is the point nearest to all optical axes (least squares). Parallel axes, as of a camera shifted along a
    line, meet nowhere: then it lies ahead of the cameras' mean by as much as they spread. Up is the direction to which
    the pictures' rows are most nearly perpendicular (least squares), as people hold cameras level while they look down;
    where the rows do not tell, it is the mean of the pictures' upward directions.
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
    """Unit [3] float64; see ``scene_frame``."""
    mean = -torch.stack([camera.rotation[1] for camera in cameras]).mean(dim=0)
    if float(mean.norm()) < 0.05:  # cameras all around, or rolled: no common up
        mean = -cameras[0].rotation[1]
    mean = mean / mean.norm()
    rows = torch.stack([camera.rotation[0] for camera in cameras])
    values, axes = torch.linalg.eigh(rows.T @ rows / len(rows))
    axis = axes[:, 0]
    # The rows have to spread over a plane, with little out of it, and the cameras to be upright rather than on end.
    is_level = float(values[1]) > _LEAST_FAN and float(values[0]) < _MOST_ROLL * float(values[1])
    if not is_level or abs(float(axis @ mean)) < 0.5:
        return mean
    return axis if float(axis @ mean) > 0 else -axis
