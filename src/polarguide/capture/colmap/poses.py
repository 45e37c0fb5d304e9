"""Match the poses of a COLMAP model with the views of a capture, and undistort the pictures."""

from __future__ import annotations

import copy
import functools
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from polarguide.capture.colmap.model import (
    MODEL_FILES,
    PosedCamera,
    find_model,
    is_pinhole,
    load_model,
    posed_images,
    posed_model,
    require_sound,
    second_model,
)
from polarguide.capture.develop import remapped_mask
from polarguide.core.errors import PolarguideError, PolarguideWarning, require
from polarguide.core.text import listed


@dataclass(frozen=True)
class Geometry:
    """Crop and scale between a stored picture and the developed picture.

    Coordinates in pixels from the top-left corner are related by ``developed = (stored - crop) / step``.

    Attributes:
        stored: width and height of the stored picture.
        crop: number of columns and rows that are cropped at the left and top.
        step: stored pixels per developed pixel.
        size: width and height of the developed picture.
    """

    stored: tuple[int, int]
    crop: tuple[int, int]
    step: int
    size: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Undistortion:
    """Resampling of a distorted picture to the pixels of a pinhole camera.

    Attributes:
        source: camera of the developed picture with its distortion, as pycolmap's type.
        target: pinhole camera of the resampled picture.
        moves: True if the resampling changes the picture, False without distortion.
    """

    source: Any
    target: Any
    moves: bool

    def record(self) -> dict[str, Any] | None:
        """Return the distorted camera model as an entry of ``scene.json``. Return None if there is no distortion."""
        if not self.moves:
            return None
        return {"model": self.source.model_name, "parameters": [float(value) for value in self.source.params]}

    def apply_mask(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Resample a foreground mask [H, W]. Pixels outside the picture are background."""
        if not self.moves:
            return mask
        x, y = self._map
        return np.asarray(cv2.remap(mask.astype(np.float32), x, y, cv2.INTER_LINEAR) >= 0.5)

    def apply(
        self, intensities: NDArray[np.float32], invalid: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Resample intensities [4, H, W, 3] and the mask of invalid pixels [H, W].

        A resampled pixel is invalid if it depends on an invalid pixel or on a place outside the picture.
        """
        if not self.moves:
            return intensities, invalid
        x, y = self._map
        moved = [cv2.remap(p, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for p in intensities]
        return np.stack(moved), remapped_mask(invalid, x, y)

    @functools.cached_property
    def _map(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Coordinates x and y in the source picture for each target pixel, in OpenCV's convention."""
        rows, columns = np.mgrid[: self.target.height, : self.target.width]
        places = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=1)  # COLMAP's pixel centers
        rays = self.target.cam_from_img(places)
        pixels = self.source.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
        pixels = np.nan_to_num(pixels, nan=-10.0).reshape(*rows.shape, 2).astype(np.float32) - np.float32(0.5)
        return np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])


def camera_for_picture(camera: Any, geometry: Geometry, where: str) -> Any:
    """Convert a COLMAP camera to the pixels of the developed picture.

    Raises:
        PolarguideError: the size of the camera matches neither the stored nor the developed picture. It is also not
            that of a resized copy.
    """
    width, height = geometry.size
    size = (camera.width, camera.height)
    if size == geometry.size:
        crop = (0.0, 0.0)
        steps = (1.0, 1.0)
    elif size == geometry.stored:
        crop = (float(geometry.crop[0]), float(geometry.crop[1]))
        steps = (float(geometry.step),) * 2
    elif _is_resized(size, geometry.size):
        crop = (0.0, 0.0)
        steps = (size[0] / width, size[1] / height)
    else:
        apart = geometry.stored != geometry.size
        files = f", or of the files, {geometry.stored[0]}x{geometry.stored[1]}" if apart else ""
        raise PolarguideError(
            where,
            expected=f"the size of the pictures, {width}x{height}{files}",
            found=f"{size[0]}x{size[1]}",
            remedy="Use a model that was made from these pictures without a crop.",
        )
    fitted = copy.copy(camera)
    params = np.array(camera.params, dtype=np.float64)
    for index, step in zip(camera.focal_length_idxs(), steps, strict=False):  # one or two focal lengths
        params[index] /= step
    for index, cut, step in zip(camera.principal_point_idxs(), crop, steps, strict=True):
        params[index] = (params[index] - cut) / step
    fitted.params = params
    fitted.width = width
    fitted.height = height
    return fitted


_LEAST_STEP = 1.5
"""Smallest ratio of two sizes at which one picture counts as a resized copy. Undistortion crops pictures by less."""


def _is_resized(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Return True if width and height of two pictures have the same ratio, apart from rounding."""
    if size[0] * other[1] == size[1] * other[0]:
        return size[0] > 0
    small, large = sorted((size, other))
    if min(small) < 2 or large[0] < _LEAST_STEP * small[0]:
        return False
    least = max(long / (short + 1) for long, short in zip(large, small, strict=True))
    return least < min(long / (short - 1) for long, short in zip(large, small, strict=True))


def undistortion(camera: Any) -> Undistortion:
    """Create the undistortion of the pictures of a COLMAP camera."""
    if not is_pinhole(camera):
        target = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
        return Undistortion(camera, target, True)
    inner = [camera.focal_length_x, camera.focal_length_y, camera.principal_point_x, camera.principal_point_y]
    target = pycolmap.Camera(
        model="PINHOLE", width=camera.width, height=camera.height, params=inner, camera_id=camera.camera_id
    )
    return Undistortion(camera, target, False)


class Poses:
    """Poses of a COLMAP model that were matched with the views of a capture.

    Attributes:
        views: names of the views with a pose.
        missing: names of the views without a pose.
        folder: folder of the model.
        files: files from which the model was read.
        assumed_sizes: views whose camera file states no size. Their cameras get the size of the pictures.
        held_out: held-out views that the pose files define.
        notes: notes for the user about the source of the poses.
    """

    assumed_sizes: frozenset[str] = frozenset()
    held_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def __init__(self, model: Any, where: Path, views: list[str], files: Sequence[Path] = ()) -> None:
        """Match the images of a model with views by stem.

        Args:
            model: pycolmap's ``Reconstruction``.
            where: source of the model for messages.
            views: names of the views of the capture.
            files: files from which the model was read.

        Raises:
            PolarguideError: no image belongs to a view, two images belong to one view, or a pose or camera is invalid.
        """
        self.folder = where
        self.files = tuple(files)
        self._model = model
        images = posed_images(self._model, frozenset(views))
        self.views = [view for view in views if view in images]
        self.missing = [view for view in views if view not in images]
        require(
            self.views,
            self.folder,
            expected=f"images named like the views ({listed(views, 3)}), with any suffix",
            found=listed(sorted(images), 3) or "no posed image",
            remedy="Rename the images in the model or the pictures; names are matched without folder and suffix.",
        )
        self._images = {view: images[view][0] for view in self.views}
        for view in self.views:
            require(
                len(images[view]) == 1,
                self.folder,
                expected=f"one image called {view}",
                found=", ".join(sorted(image.name for image in images[view])),
                remedy="Keep one of them.",
            )
            image = self._images[view]
            where_image = f"{self.folder} (image {image.name})"
            require_sound(where_image, image, model.cameras[image.camera_id], 1e-3)
        self._warps: dict[tuple[int, Geometry], Undistortion] = {}
        self._of_camera: dict[int, Undistortion] = {}

    @classmethod
    def read(cls, path: Path, views: list[str]) -> Poses:
        """Read a COLMAP model and match it with views. The model may have no points.

        The files of the model are in ``path``, or in its subfolder ``sparse/0`` or ``sparse``.

        Raises:
            PolarguideError: no model can be read, or it does not match the views.
        """
        folder, kind = find_model(path, points=False)
        for warning in second_model(folder, kind):
            warnings.warn(warning, PolarguideWarning, stacklevel=2)
        files = [folder / (name + kind) for name in MODEL_FILES]
        return cls(load_model(folder, kind), folder, views, [file for file in files if file.exists()])

    @classmethod
    def of_cameras(
        cls, cameras: Mapping[str, PosedCamera], where: Path, views: list[str], files: Sequence[Path] = ()
    ) -> Poses:
        """Create poses without points from cameras by view name. ``where`` names their source in messages."""
        return cls(posed_model(cameras), where, views, files)

    @property
    def others(self) -> list[Path]:
        """Folders of other models next to the folder of this model, such as ``sparse/1``."""
        numbered = self.folder.parent.glob("[0-9]*") if self.folder.name.isdigit() else ()
        models = (folder for folder in numbered if any(folder.glob("images.*")))
        return [folder for folder in sorted(models) if folder != self.folder]

    @property
    def points(self) -> int:
        """Number of 3D points of the model."""
        return len(self._model.points3D)

    def stated_size(self, view: str) -> tuple[int, int] | None:
        """Return the width and height of a view's camera. Return None if the camera file states no size."""
        camera = self._model.cameras[self._images[view].camera_id]
        size = int(camera.width), int(camera.height)
        middle = (camera.principal_point_x, camera.principal_point_y) == (size[0] / 2, size[1] / 2)
        return None if view in self.assumed_sizes and middle else size

    def developed(self, geometries: Mapping[str, Geometry]) -> dict[str, PosedCamera]:
        """Return the cameras of the developed pictures by view, including their distortion.

        Raises:
            PolarguideError: the size of a camera does not match the pictures, see ``warp``.
        """
        cameras = {}
        for view in self.views:
            image = self._images[view]
            camera = self.warp(view, geometries[view]).source
            pose = image.cam_from_world()
            cameras[view] = PosedCamera(
                camera.width,
                camera.height,
                camera.model_name,
                tuple(float(value) for value in camera.params),
                np.asarray(pose.rotation.matrix(), np.float64),
                np.asarray(pose.translation, np.float64),
            )
        return cameras

    def warp(self, view: str, geometry: Geometry) -> Undistortion:
        """Return the undistortion of a view's picture.

        Raises:
            PolarguideError: the size of the camera matches neither the stored nor the developed picture.
        """
        number = self._images[view].camera_id
        key = (number, geometry)
        where = f"{self.folder} (camera of view {view})"
        if key not in self._warps:
            self._warps[key] = undistortion(camera_for_picture(self._model.cameras[number], geometry, where))
        warp = self._warps[key]
        require(
            self._of_camera.setdefault(number, warp) is warp,
            where,
            expected="pictures of one size for one camera",
            found=f"{geometry.size[0]}x{geometry.size[1]} and another size",
            remedy="Use a separate camera in the model for each size.",
        )
        return warp

    def write(self, folder: Path) -> None:
        """Write the COLMAP model of the undistorted pictures as binary files.

        ``warp`` must have been called for every view.
        """
        model = copy.deepcopy(self._model)
        for image in model.images.values():
            if image.camera_id in self._of_camera and len(image.points2D):
                places = np.array([point.xy for point in image.points2D])
                rays = np.nan_to_num(model.cameras[image.camera_id].cam_from_img(places))
                moved = self._of_camera[image.camera_id].target.img_from_cam(
                    np.column_stack([rays, np.ones(len(rays))])
                )
                for point, place in zip(image.points2D, moved, strict=True):
                    point.xy = place
        for number, warp in self._of_camera.items():
            camera = model.cameras[number]
            for name in ("model", "width", "height", "params"):
                setattr(camera, name, getattr(warp.target, name))
        model.write_binary(str(folder))
