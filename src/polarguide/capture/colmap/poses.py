"""The COLMAP model of the developed pictures: matched by name, scaled and undistorted."""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from polarguide.camera import FARTHEST, LENS
from polarguide.capture.colmap.model import (
    MODEL_FILES,
    find_model,
    is_lens,
    is_turn,
    load_model,
    posed_images,
)
from polarguide.capture.colmap.undistort import Geometry, Undistortion, camera_for_picture, undistortion
from polarguide.capture.colmap.write import PosedCamera, write_cameras
from polarguide.capture.view import listed
from polarguide.errors import PolarguideError

Key = tuple[int, Geometry]


class Poses:
    """A COLMAP model and the views of a capture that it has poses for."""

    def __init__(self, model: Any, where: Path, views: list[str], files: Sequence[Path] = ()) -> None:
        """Match the images of a model with views by stem.

        Args:
            model: pycolmap's ``Reconstruction``.
            where: origin of the model, for messages.
            views: view names of the capture.
            files: the files it was read from.

        Raises:
            PolarguideError: none of its images is a view, two images belong to one view, or a pose or camera
                is invalid.
        """
        self.folder = where
        self.files = tuple(files)
        self._model = model
        images = posed_images(self._model)
        self.views = [view for view in views if view in images]
        self.missing = [view for view in views if view not in images]
        if not self.views:
            raise PolarguideError(
                self.folder,
                expected=f"images named like the views ({listed(views, 3)}), with any suffix",
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
                    remedy="Keep one of them.",
                )
            self._require_numbers(view)
        self._warps: dict[Key, Undistortion] = {}
        self._of_camera: dict[int, Undistortion] = {}

    @classmethod
    def read(cls, path: Path, views: list[str]) -> Poses:
        """A model from a folder with its files, or with ``sparse/0`` or ``sparse``; it may lack points.

        Raises:
            PolarguideError: there is no readable model, or as for the model itself.
        """
        folder, kind = find_model(path, points=False)
        files = [folder / (name + kind) for name in MODEL_FILES]
        return cls(load_model(folder, kind), folder, views, [file for file in files if file.exists()])

    @classmethod
    def of_cameras(
        cls, cameras: Mapping[str, PosedCamera], where: Path, views: list[str], files: Sequence[Path] = ()
    ) -> Poses:
        """A model without points from cameras by view name; ``where`` names their origin in messages."""
        with tempfile.TemporaryDirectory() as made:
            write_cameras(Path(made), cameras)
            return cls(load_model(Path(made), ".bin"), where, views, files)

    @property
    def points(self) -> int:
        """Number of 3D points of the model."""
        return len(self._model.points3D)

    def developed(self, geometries: Mapping[str, Geometry]) -> dict[str, PosedCamera]:
        """Cameras of the developed pictures, including distortion, by view.

        Raises:
            PolarguideError: as in ``warp``.
        """
        found = {}
        for view in self.views:
            image = self._images[view]
            camera = self.warp(view, geometries[view]).source
            pose = image.cam_from_world()
            found[view] = PosedCamera(
                camera.width,
                camera.height,
                camera.model_name,
                tuple(float(value) for value in camera.params),
                np.asarray(pose.rotation.matrix(), np.float64),
                np.asarray(pose.translation, np.float64),
            )
        return found

    def warp(self, view: str, geometry: Geometry) -> Undistortion:
        """The undistortion of a view's picture.

        Raises:
            PolarguideError: the camera is neither of the stored nor the developed size, nor a resized one.
        """
        number = self._images[view].camera_id
        key, where = (number, geometry), f"{self.folder} (camera of view {view})"
        if key not in self._warps:
            self._warps[key] = undistortion(camera_for_picture(self._model.cameras[number], geometry, where))
        warp = self._warps[key]
        if self._of_camera.setdefault(number, warp) is not warp:
            raise PolarguideError(
                where,
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
            for name in ("model", "width", "height", "params"):
                setattr(camera, name, getattr(warp.target, name))
        model.write_binary(str(folder))

    def _move_points(self, image: Any, before: Any, warp: Undistortion) -> None:
        """Undistort the observations of an image."""
        places = np.array([point.xy for point in image.points2D])
        rays = np.nan_to_num(before.cam_from_img(places))
        moved = warp.target.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
        for point, place in zip(image.points2D, moved, strict=True):
            point.xy = place

    def _require_numbers(self, view: str) -> None:
        image = self._images[view]
        pose = image.cam_from_world()
        quaternion, translation = np.asarray(pose.rotation.quat), np.asarray(pose.translation)
        camera = self._model.cameras[image.camera_id]
        sound = bool((np.abs(translation) <= FARTHEST).all()) and is_lens(camera)  # false for NaN, too
        if not (sound and is_turn(quaternion, 1e-3)):
            raise PolarguideError(
                f"{self.folder} (image {image.name})",
                expected=f"a pose and a lens of numbers up to {FARTHEST:g}, {LENS}",
                found=f"quaternion {quaternion}, translation {translation}, camera {camera.params}",
                remedy="Export the model again, or leave the image out.",
            )
