"""Undistort the pictures of a COLMAP camera, and scale its intrinsics to the pictures."""

from __future__ import annotations

import copy
import functools
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from polarguide.capture.colmap.model import is_pinhole
from polarguide.capture.filter.align import remapped_mask
from polarguide.errors import PolarguideError


@dataclass(frozen=True)
class Geometry:
    """Crop and scale of a developed picture: developed = (stored - crop) / step, in pixels from the corner.

    Attributes:
        stored: width and height of the stored picture, as displayed.
        crop: columns and rows cut at the left and top.
        step: stored pixels per developed pixel.
        size: width and height of the developed picture.
    """

    stored: tuple[int, int]
    crop: tuple[int, int]
    step: int
    size: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Undistortion:
    """The map from a picture to that of a pinhole camera.

    Attributes:
        source: the camera of the developed picture, as pycolmap's.
        target: the pinhole camera.
        moves: whether pixels move.
    """

    source: Any
    target: Any
    moves: bool

    def record(self) -> dict[str, Any] | None:
        """The distorted camera model, or None without distortion."""
        if not self.moves:
            return None
        return {"model": self.source.model_name, "parameters": [float(value) for value in self.source.params]}

    def apply_mask(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Resample an object mask [H, W]; pixels outside the picture are background."""
        if not self.moves:
            return mask
        x, y = self._map
        return np.asarray(cv2.remap(mask.astype(np.float32), x, y, cv2.INTER_LINEAR) >= 0.5)

    def apply(
        self, intensities: NDArray[np.float32], invalid: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Resample intensities [4, H, W, 3] with one map; pixels that use invalid or outside pixels become invalid."""
        if not self.moves:
            return intensities, invalid
        x, y = self._map
        moved = [cv2.remap(p, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for p in intensities]
        return np.stack(moved), remapped_mask(invalid, x, y)

    @functools.cached_property
    def _map(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Source coordinates of the target's pixels, in OpenCV's convention."""
        rows, columns = np.mgrid[: self.target.height, : self.target.width]
        places = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=1)  # COLMAP's pixel centers
        rays = self.target.cam_from_img(places)
        seen = self.source.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
        seen = np.nan_to_num(seen, nan=-10.0).reshape(*rows.shape, 2).astype(np.float32) - np.float32(0.5)
        return np.ascontiguousarray(seen[..., 0]), np.ascontiguousarray(seen[..., 1])


def camera_for_picture(camera: Any, geometry: Geometry, where: str) -> Any:
    """A COLMAP camera in the pixels of the developed picture."""
    width, height = geometry.size
    size = (camera.width, camera.height)
    if size == geometry.size:
        crop, step = (0.0, 0.0), 1.0
    elif size == geometry.stored:
        crop, step = (float(geometry.crop[0]), float(geometry.crop[1])), float(geometry.step)
    elif size[0] > 0 and size[0] * height == size[1] * width:
        crop, step = (0.0, 0.0), size[0] / width
    else:
        raise PolarguideError(
            where,
            expected=f"the size of the pictures, {width}x{height}, or of the files, "
            f"{geometry.stored[0]}x{geometry.stored[1]}",
            found=f"{size[0]}x{size[1]}",
            remedy="Give a model that was made from these pictures, without a crop.",
        )
    fitted = copy.copy(camera)
    params = np.array(camera.params, dtype=np.float64)
    params[list(camera.focal_length_idxs())] /= step
    for index, cut in zip(camera.principal_point_idxs(), crop, strict=True):
        params[index] = (params[index] - cut) / step
    fitted.params, fitted.width, fitted.height = params, width, height
    return fitted


def undistortion(camera: Any) -> Undistortion:
    """The undistortion of pictures of a COLMAP camera."""
    if not is_pinhole(camera):
        target = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
        return Undistortion(camera, target, True)
    inner = [camera.focal_length_x, camera.focal_length_y, camera.principal_point_x, camera.principal_point_y]
    target = pycolmap.Camera(
        model="PINHOLE", width=camera.width, height=camera.height, params=inner, camera_id=camera.camera_id
    )
    return Undistortion(camera, target, False)
