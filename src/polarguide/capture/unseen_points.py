"""Points of a model that no camera looks at: a sign that poses and points do not belong together."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from polarguide.camera import Camera

_SAMPLES = 2000
_MARGIN = 1.0
"""Of a picture's sides, by which a point may miss it: pictures of few points need not show one."""


def unseen_points(points: Tensor, cameras: Sequence[Camera]) -> list[str]:
    """The warning that no camera has points [M, 3] before it; only some thousands of many points are looked at."""
    if not cameras or not len(points):
        return []
    places = points[:: max(1, len(points) // _SAMPLES)].to(torch.float64)
    if any(_sees(camera, places) for camera in cameras):
        return []
    return [
        f"None of the {len(points)} points of the COLMAP model lies where one of the {len(cameras)} cameras looks: "
        "points and poses are not of one model, or one of them is turned."
    ]


def _sees(camera: Camera, places: Tensor) -> bool:
    """Whether a point lies before a camera, in its picture or beside it."""
    local = places @ camera.rotation.to(torch.float64).T + camera.translation.to(torch.float64)
    local = local[local[:, 2] > 0]
    x = camera.fx * local[:, 0] / local[:, 2] + camera.cx
    y = camera.fy * local[:, 1] / local[:, 2] + camera.cy
    across, down = _MARGIN * camera.width, _MARGIN * camera.height
    inside = (x >= -across) & (x <= camera.width + across) & (y >= -down) & (y <= camera.height + down)
    return bool(inside.any())
