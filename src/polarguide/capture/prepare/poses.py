"""A COLMAP model for the developed pictures: matched by name, scaled, and undistorted with one map for all angles."""

from __future__ import annotations

import copy
import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from polarguide.capture.colmap import PINHOLES, find_model, load_model, posed_images
from polarguide.capture.prepare.source import Geometry
from polarguide.capture.view import listed
from polarguide.errors import PolarguideError

Key = tuple[int, Geometry]


@dataclass(frozen=True, eq=False)
class Warp:
    """How a picture becomes that of a pinhole camera.

    Attributes:
        source: the camera of the developed picture, as pycolmap's.
        target: the pinhole camera.
        moves: whether pixels move.
    """

    source: Any
    target: Any
    moves: bool

    def record(self) -> dict[str, Any] | None:
        """The camera that was taken out, or None."""
        if not self.moves:
            return None
        return {"model": self.source.model_name, "parameters": [float(value) for value in self.source.params]}

    def apply(
        self, intensities: NDArray[np.float32], invalid: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Resample intensities [4, H, W, 3] with one map; a pixel is invalid if it uses one, or none inside."""
        if not self.moves:
            return intensities, invalid
        x, y = self._map
        moved = [cv2.remap(p, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for p in intensities]
        wrong = cv2.remap(
            invalid.astype(np.float32),
            x,
            y,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=1.0,
        )
        return np.stack(moved), np.asarray(wrong > 0)

    @functools.cached_property
    def _map(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Where the pixels of the target lie in the source, in OpenCV's pixels."""
        rows, columns = np.mgrid[: self.target.height, : self.target.width]
        places = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=1)  # COLMAP's pixel centres
        rays = self.target.cam_from_img(places)
        seen = self.source.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
        seen = np.nan_to_num(seen, nan=-10.0).reshape(*rows.shape, 2).astype(np.float32) - np.float32(0.5)
        return np.ascontiguousarray(seen[..., 0]), np.ascontiguousarray(seen[..., 1])


class Poses:
    """A COLMAP model and the views of a capture that it has poses for."""

    def __init__(self, path: Path, views: list[str]) -> None:
        """Read a model and match its images with views by stem.

        Args:
            path: a folder with the model's files, or with ``sparse/0`` or ``sparse``.
            views: view names of the capture.

        Raises:
            PolarguideError: there is no readable model, none of its images is a view, two images claim one,
                or a pose or camera has broken numbers.
        """
        self.folder, kind = find_model(path)
        self._model = load_model(self.folder, kind)
        images = posed_images(self._model)
        if not self._model.points3D:
            raise PolarguideError(
                self.folder,
                expected="3D points to start from",
                found="none",
                remedy="Triangulate points with the known poses (colmap point_triangulator).",
            )
        self.views = [view for view in views if view in images]
        self.missing = [view for view in views if view not in images]
        if not self.views:
            raise PolarguideError(
                self.folder,
                expected=f"images called like the views ({listed(views, 3)}), with any suffix",
                found=listed(sorted(images), 3) or "no posed image",
                remedy="Rename the images in the model or the pictures; names are matched without folder and suffix.",
            )
        self._images = {view: images[view][0] for view in self.views}
        for view in self.views:
            if len(images[view]) > 1:
                raise PolarguideError(
                    self.folder,
                    expected=f"one image called {view}",
                    found=", ".join(sorted(image.name for image in images[view])),
                    remedy="Keep the one that is meant.",
                )
            self._require_numbers(view)
        self._warps: dict[Key, Warp] = {}
        self._of_camera: dict[int, Warp] = {}

    def warp(self, view: str, geometry: Geometry) -> Warp:
        """What the view's picture has to go through.

        Raises:
            PolarguideError: the camera is neither of the stored nor the developed size, nor a resized one.
        """
        number = self._images[view].camera_id
        key = (number, geometry)
        if key not in self._warps:
            camera = _fitted(self._model.cameras[number], geometry, f"{self.folder} (camera of view {view})")
            self._warps[key] = _warp(camera)
        warp = self._warps[key]
        if self._of_camera.setdefault(number, warp) is not warp:
            raise PolarguideError(
                f"{self.folder} (camera of view {view})",
                expected="pictures of one size for one camera",
                found=f"{geometry.size[0]}x{geometry.size[1]} beside another size",
                remedy="Give each size a camera of its own in the model.",
            )
        return warp

    def write(self, folder: Path) -> None:
        """Write the model for the developed pictures, binary; ``warp`` was called for every view."""
        model = copy.deepcopy(self._model)
        for image in model.images.values():
            if image.camera_id in self._of_camera and len(image.points2D):
                self._move_points(image, model.cameras[image.camera_id], self._of_camera[image.camera_id])
        for number, warp in self._of_camera.items():
            camera = model.cameras[number]
            camera.model, camera.width, camera.height = (
                warp.target.model,
                warp.target.width,
                warp.target.height,
            )
            camera.params = warp.target.params
        model.write_binary(str(folder))

    def _move_points(self, image: Any, before: Any, warp: Warp) -> None:
        """Observed points go where their pixels went."""
        places = np.array([point.xy for point in image.points2D])
        rays = np.nan_to_num(before.cam_from_img(places))
        moved = warp.target.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
        for point, place in zip(image.points2D, moved, strict=True):
            point.xy = place

    def _require_numbers(self, view: str) -> None:
        image = self._images[view]
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        quaternion, translation = np.asarray(pose.rotation.quat), np.asarray(pose.translation)
        camera = self._model.cameras[image.camera_id]
        finite = np.isfinite([*quaternion, *translation, *camera.params]).all()
        if not finite or abs(float(np.linalg.norm(quaternion)) - 1) > 1e-3 or camera.mean_focal_length() <= 0:
            raise PolarguideError(
                f"{self.folder} (image {image.name})",
                expected="a finite pose and positive focal lengths",
                found=f"quaternion {quaternion}, translation {translation}, camera {camera.params}",
                remedy="Export the model again, or leave the image out.",
            )


def _fitted(camera: Any, geometry: Geometry, where: str) -> Any:
    """A COLMAP camera in the pixels of the developed picture."""
    width, height = geometry.size
    size = (camera.width, camera.height)
    if size == geometry.size:
        crop, step = (0.0, 0.0), 1.0
    elif size == geometry.stored:
        crop, step = (float(geometry.crop[0]), float(geometry.crop[1])), float(geometry.step)
    elif size[0] * height == size[1] * width:
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


def _warp(camera: Any) -> Warp:
    straight = camera.model_name in PINHOLES and all(
        camera.params[i] == 0 for i in camera.extra_params_idxs()
    )
    if not straight:
        return Warp(camera, pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera), True)
    inner = [camera.focal_length_x, camera.focal_length_y, camera.principal_point_x, camera.principal_point_y]
    target = pycolmap.Camera(
        model="PINHOLE", width=camera.width, height=camera.height, params=inner, camera_id=camera.camera_id
    )
    return Warp(camera, target, False)
