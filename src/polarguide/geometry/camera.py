"""Pinhole cameras with a pose.

Camera axes are the axes of OpenCV: x right, y down, z forward. A pose maps world to camera coordinates,
``x_cam = R x_world + t``. The center of the top-left pixel is at (0.5, 0.5), as in COLMAP.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from torch import Tensor

from polarguide.core.errors import PolarguideError
from polarguide.geometry.vectors import unit, unit_array

FARTHEST = 1e9
"""Upper bound of coordinates and focal lengths, beyond which single precision is too coarse."""
FARTHEST_CENTER = 1e4
"""Maximum distance of the principal point from the picture's corner, in units of the picture's longer side.

Cropped pictures may have a distant principal point.
"""
SHORTEST_FOCAL = 1e-4
"""Minimum focal length, in units of the picture's longer side."""
MOST_STRETCH = 100.0
"""Maximum ratio of the two focal lengths; anamorphic lenses have a ratio of 2."""
LENS = (
    f"positive focal lengths, at most {MOST_STRETCH:g} times one another, and a principal point, at most "
    f"{FARTHEST_CENTER:g} sides of the picture away"
)
"""Description of a valid lens, for messages."""


def can_be_lens(size: ArrayLike, focal: ArrayLike, center: ArrayLike) -> bool:
    """Return True if the intrinsics are valid and also remain valid in single precision; False for NaN.

    Args:
        size: width and height in pixels.
        focal: both focal lengths in pixels.
        center: principal point in pixels.
    """
    side = max(float(np.max(size)), 1.0)  # other checks reject pictures without pixels
    lengths = np.asarray(focal, np.float64)
    places = np.abs(np.asarray(center, np.float64))
    sound = (lengths <= FARTHEST).all() and (places <= min(FARTHEST, FARTHEST_CENTER * side)).all()
    alike = lengths.max() <= MOST_STRETCH * lengths.min()
    return bool(sound and alike and (lengths >= SHORTEST_FOCAL * side).all())


@lru_cache(maxsize=4)
def _pixel_rays(
    size: tuple[int, int],
    focal: tuple[float, float],
    center: tuple[float, float],
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor:
    """Return the rays through all pixel centers.

    They are cached, because views share intrinsics and each rendering reads the rays.
    """
    x, y = (
        (torch.arange(n, dtype=dtype, device=device) + 0.5 - c) / f
        for n, f, c in zip(size, focal, center, strict=True)
    )
    grid_y, grid_x = torch.meshgrid(y, x, indexing="ij")
    return unit(torch.stack((grid_x, grid_y, torch.ones_like(grid_x)), dim=-1))


class Pose(NamedTuple):
    """Pose of a camera as tensors on one device, in one dtype.

    Attributes:
        rotation: world-to-camera rotation, [3, 3].
        translation: world-to-camera translation, [3].
        center: camera center in the world, [3].
    """

    rotation: Tensor
    translation: Tensor
    center: Tensor


@dataclass(frozen=True, eq=False)
class Camera:
    """Pinhole camera.

    Attributes:
        width, height: picture size in pixels.
        fx, fy, cx, cy: focal lengths and principal point in pixels.
        rotation: world-to-camera rotation, [3, 3] float64 on the CPU.
        translation: world-to-camera translation, [3] float64 on the CPU.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    rotation: Tensor
    translation: Tensor

    @classmethod
    def from_matrices(
        cls, intrinsics: ArrayLike | Tensor, world_to_camera: ArrayLike | Tensor, width: int, height: int
    ) -> Camera:
        """Create a camera from two matrices as used by OpenCV and COLMAP.

        Args:
            intrinsics: [3, 3], focal lengths and principal point in pixels, without skew.
            world_to_camera: [3, 4] or [4, 4], axes right, down, forward.
            width, height: picture size in pixels.

        Raises:
            PolarguideError: the matrices have another shape or do not describe a camera.
        """
        inner, outer = (
            torch.as_tensor(m).cpu().numpy().astype(np.float64) for m in (intrinsics, world_to_camera)
        )
        if inner.shape != (3, 3) or outer.shape not in ((3, 4), (4, 4)):
            found = f"{list(inner.shape)} and {list(outer.shape)}"
            raise _no_matrices("intrinsics [3, 3] and world_to_camera [3, 4] or [4, 4]", found)
        rotation = outer[:3, :3]
        translation = outer[:3, 3]
        is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-5) and np.linalg.det(rotation) > 0
        if not is_rotation or not (np.abs(translation) <= FARTHEST).all():
            found = np.array2string(outer[:3], precision=4).replace("\n", "")
            raise _no_matrices(f"a rotation (determinant 1) and a translation up to {FARTHEST:g}", found)
        lens = (inner[0, 0], inner[1, 1]), (inner[0, 2], inner[1, 2])
        rest = inner - np.array([[inner[0, 0], 0, inner[0, 2]], [0, inner[1, 1], inner[1, 2]], [0, 0, 1]])
        if min(width, height) < 1 or not can_be_lens((width, height), *lens) or np.abs(rest).max() > 1e-9:
            found = np.array2string(inner, precision=4).replace("\n", "")
            raise _no_matrices(f"no skew, and {LENS}", f"{found} for {width}x{height} pixels")
        (fx, fy), (cx, cy) = ((float(a), float(b)) for a, b in lens)
        return cls(width, height, fx, fy, cx, cy, torch.from_numpy(rotation), torch.from_numpy(translation))

    @property
    def center(self) -> Tensor:
        """Camera center in the world, [3] float64."""
        return -self.rotation.T @ self.translation

    @property
    def intrinsics(self) -> Tensor:
        """Matrix of focal lengths and principal point, [3, 3] float64."""
        matrix = [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        return torch.tensor(matrix, dtype=torch.float64)

    @property
    def world_to_camera(self) -> Tensor:
        """Matrix of the pose, [4, 4] float64."""
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:3, :3], matrix[:3, 3] = self.rotation, self.translation
        return matrix

    def pose(self, dtype: torch.dtype, device: torch.device) -> Pose:
        """Return the pose on a device. It is cached, so callers must not write to it."""
        poses: dict[tuple[torch.dtype, torch.device], Pose] = self.__dict__.setdefault("_poses", {})
        key = (dtype, device)
        if key not in poses:
            poses[key] = Pose(*(t.to(device, dtype) for t in (self.rotation, self.translation, self.center)))
        return poses[key]

    def rays(self, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Tensor:
        """Return unit rays through the pixel centers in camera axes, [height, width, 3]; callers must not edit them."""
        size = (self.width, self.height)
        focal = (self.fx, self.fy)
        center = (self.cx, self.cy)
        return _pixel_rays(size, focal, center, dtype, torch.device(device))

    def world_rays(self, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Tensor:
        """Return unit rays through the pixel centers in world axes, [height, width, 3]."""
        return self.rays(dtype=dtype, device=device) @ self.pose(dtype, torch.device(device)).rotation

    def to_world(self, vectors: Tensor) -> Tensor:
        """Turn direction vectors [..., 3] from camera axes into world axes."""
        return vectors @ self.pose(vectors.dtype, vectors.device).rotation

    def to_camera(self, vectors: Tensor) -> Tensor:
        """Turn direction vectors [..., 3] from world axes into camera axes."""
        return vectors @ self.pose(vectors.dtype, vectors.device).rotation.T

    def scaled(self, factor: float, width: int, height: int) -> Camera:
        """Return a camera of the same view with another picture size; intrinsics are multiplied by ``factor``."""
        inner = {name: factor * getattr(self, name) for name in ("fx", "fy", "cx", "cy")}
        return replace(self, width=width, height=height, **inner)

    def extended(self, width: int, height: int) -> Camera:
        """Return a camera of another picture size that shows all of this view, centered and as large as possible."""
        factor = min(width / self.width, height / self.height)
        scaled = self.scaled(factor, width, height)
        return replace(
            scaled,
            cx=scaled.cx + 0.5 * (width - factor * self.width),
            cy=scaled.cy + 0.5 * (height - factor * self.height),
        )

    def downscaled(self, factor: int) -> Camera:
        """Return the camera of a picture that is averaged over squares of ``factor`` x ``factor`` pixels.

        Pixels at the right and bottom that fill no square are cut off.
        """
        inner = {name: getattr(self, name) / factor for name in ("fx", "fy", "cx", "cy")}
        return replace(self, width=self.width // factor, height=self.height // factor, **inner)


def _no_matrices(expected: str, found: str) -> PolarguideError:
    return PolarguideError(
        "camera",
        expected=expected,
        found=found,
        remedy="Correct the matrices. Invert a pose that is camera-to-world.",
    )


def seen_at(offsets: Tensor, camera: Camera) -> tuple[tuple[Tensor, Tensor], Tensor, Tensor]:
    """Project points into a picture.

    Args:
        offsets: [N, 3] vectors from the camera center to the points, world axes.
        camera: the view.

    Returns:
        A tuple of three items. The first is the nearest pixel of each point, as row and column, each [N] int64. The
        second is the camera depth [N]. The third is a mask [N], True for points that lie in the picture.
    """
    x, y, z = camera.to_camera(offsets).unbind(-1)
    safe = z.clamp(min=1e-6)
    column = (camera.fx * x / safe + camera.cx).floor().clamp(-1, camera.width).long()
    row = (camera.fy * y / safe + camera.cy).floor().clamp(-1, camera.height).long()
    inside = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return (row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)), z, inside


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike) -> tuple[Tensor, Tensor]:
    """Return the pose of a camera that looks at a point.

    Args:
        eye: [3] center of the camera in the world.
        target: [3] point on the optical axis, not ``eye``.
        up: [3] upward direction in the picture, not parallel to the optical axis.

    Returns:
        A tuple of the world-to-camera rotation [3, 3] and translation [3], float64.
    """
    center = np.asarray(eye, np.float64)
    forward = unit_array(np.asarray(target, np.float64) - center)
    right = unit_array(np.cross(forward, np.asarray(up, np.float64)))
    rotation = np.stack((right, np.cross(forward, right), forward))
    return torch.from_numpy(rotation), torch.from_numpy(-rotation @ center)


def quaternion(rotation: ArrayLike) -> tuple[float, float, float, float]:
    """Return a unit quaternion (w, x, y, z) of a rotation matrix [3, 3]; its sign is arbitrary."""
    x, y, z, w = Rotation.from_matrix(np.asarray(rotation)).as_quat().tolist()
    return w, x, y, z
