"""Read, check and write the files of a COLMAP model."""

from __future__ import annotations

import contextlib
import difflib
import math
import re
import shutil
import struct
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray
from torch import Tensor

from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import read_file
from polarguide.core.text import canonical, decimal_comma
from polarguide.geometry.camera import FARTHEST, LENS, Camera, can_be_lens, quaternion, seen_at

MODELS = {
    "SIMPLE_PINHOLE": (0, 3), "PINHOLE": (1, 4), "SIMPLE_RADIAL": (2, 4), "RADIAL": (3, 5), "OPENCV": (4, 8),
    "OPENCV_FISHEYE": (5, 8), "FULL_OPENCV": (6, 12), "FOV": (7, 5), "SIMPLE_RADIAL_FISHEYE": (8, 4),
    "RADIAL_FISHEYE": (9, 5), "THIN_PRISM_FISHEYE": (10, 12),
}  # fmt: skip
"""Id and number of parameters of each of COLMAP's camera models."""


@dataclass(frozen=True, eq=False)
class PosedCamera:
    """Intrinsics and pose of one picture in COLMAP's conventions.

    Attributes:
        width, height: picture size in pixels.
        model: camera model, a key of ``MODELS``.
        parameters: parameters of the camera model. The center of the first pixel is at (0.5, 0.5).
        rotation: rotation from world to camera, [3, 3].
        translation: translation from world to camera, [3].
    """

    width: int
    height: int
    model: str
    parameters: tuple[float, ...]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    @property
    def intrinsics(self) -> tuple[Any, ...]:
        """Model, width, height and parameters, which are equal for all pictures of a camera."""
        return (self.model, self.width, self.height, *self.parameters)

    @property
    def center(self) -> NDArray[np.float64]:
        """Camera center in world coordinates, [3]."""
        return np.asarray(-self.rotation.T @ self.translation)


def colmap_camera(camera: PosedCamera, **more: Any) -> pycolmap.Camera:
    """Convert the intrinsics of a camera to pycolmap's type."""
    size = {"width": camera.width, "height": camera.height}
    return pycolmap.Camera(model=camera.model, params=list(camera.parameters), **size, **more)


def posed_model(
    cameras: Mapping[str, PosedCamera], numbers: Mapping[str, tuple[int, int]] | None = None
) -> pycolmap.Reconstruction:
    """Create a COLMAP model without points, with an image ``<view>.png`` for each view.

    Views with equal intrinsics share a camera.

    Args:
        cameras: cameras by view name.
        numbers: ids of the image and the camera by view. By default, ids are 1, 2, ...
    """
    model = pycolmap.Reconstruction()
    ids: dict[tuple[object, ...], int] = {}
    for number, (view, camera) in enumerate(sorted(cameras.items()), 1):
        camera_id = ids.setdefault(camera.intrinsics, len(ids) + 1)
        if numbers is not None:
            number, camera_id = numbers[view]
        if not model.exists_camera(camera_id):
            model.add_camera_with_trivial_rig(colmap_camera(camera, camera_id=camera_id))
        w, *axis = quaternion(camera.rotation)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([*axis, w])), camera.translation)
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=f"{view}.png", camera_id=camera_id, image_id=number), pose
        )
    return model


_PARAMETERS = dict(MODELS.values())
_LONGEST_NAME = 4096


def check_model_files(folder: Path, kind: str) -> None:
    """Check the files of a model before pycolmap reads them. Missing files are skipped.

    pycolmap checks text files itself, except for decimal commas and the range of colors.

    Args:
        folder: folder of the model.
        kind: suffix of the files, ".bin" or ".txt".

    Raises:
        PolarguideError: a file is truncated, damaged, or has trailing bytes.
    """
    walkers: dict[str, Callable[[bytes], int]] = {
        "cameras": _cameras,
        "images": lambda data: _lists(data, _image, "<Q", 24),
        "points3D": lambda data: _lists(data, lambda _, at: at + 43, "<Q", 8),
        "rigs": _rigs,
        "frames": lambda data: _lists(data, lambda _, at: at + 64, "<I", 16),
    }
    for name, walk in walkers.items():
        path = folder / (name + kind)
        if not path.exists():
            continue
        data = read_file(path)
        found = "an empty file" if not data and name != "points3D" else None
        if kind == ".bin":
            try:
                end = walk(data)
                if end != len(data):
                    found = f"{len(data)} bytes instead of the {end} that its counts require"
            except (struct.error, ValueError) as error:
                found = f"a damaged one ({error})" if data else "an empty file"
        elif comma := _decimal_comma(data):
            raise PolarguideError(
                path,
                expected="numbers with a decimal point",
                found=comma,
                remedy="Write the model again with a locale that uses decimal points (LC_NUMERIC=C).",
            )
        elif name == "points3D":
            found = _invalid_color(data)
        if found is not None:
            raise PolarguideError(
                path,
                expected=f"a complete COLMAP {name}{kind}",
                found=found,
                remedy="Copy or export the model again.",
            )


_HEAD = 1 << 16
"""Number of bytes at the start of a text file that are searched for a decimal comma."""


def _decimal_comma(data: bytes) -> str:
    """Describe the first decimal comma in the head of a text file, or return an empty text."""
    for number, line in enumerate(data[:_HEAD].decode("ascii", "replace").splitlines(), 1):
        comma = "" if line.startswith("#") else decimal_comma(line.split()[:_POSE])
        if comma:
            return f"a decimal comma, {comma} in line {number}"
    return ""


def _invalid_color(data: bytes) -> str | None:
    """Describe the first color in ``points3D.txt`` that is not in the range 0 to 255. Return None if all are valid.

    pycolmap reads such a color modulo 256 without an error.
    """
    for number, line in enumerate(data.splitlines(), 1):
        cells = line.split(None, 7)[4:7]
        if line[:1] != b"#" and any(
            cell.lstrip(b"-").isdigit() and not (len(cell) <= 3 and 0 <= int(cell) <= 255) for cell in cells
        ):
            color = ", ".join(cell.decode("ascii", "replace")[:20] for cell in cells)
            return f"a color of {color} in line {number}, outside of 0 to 255"
    return None


def _cameras(data: bytes) -> int:
    """Return the end of the cameras in ``cameras.bin``."""
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    for _ in range(_checked_count(count, len(data) // 48)):
        _, model, width, height = struct.unpack_from("<IiQQ", data, at)
        if not (0 < width < 1 << 20 and 0 < height < 1 << 20):
            raise ValueError(f"a camera of {width}x{height} pixels")
        if model not in _PARAMETERS:  # a newer model of unknown length
            return len(data)
        at += 24 + 8 * _PARAMETERS[model]
    return at


def _lists(data: bytes, head: Callable[[bytes, int], int], counter: str, entry: int) -> int:
    """Return the end of the records in a file. A record consists of a head, a number of entries, and the entries.

    Args:
        data: the whole file.
        head: function that returns the end of the head that starts at an offset.
        counter: type of the number of entries as a format of ``struct``.
        entry: size of an entry in bytes.
    """
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    for _ in range(_checked_count(count, len(data) // 8)):
        at = head(data, at)
        (entries,) = struct.unpack_from(counter, data, at)
        at += struct.calcsize(counter)
        at += entry * _checked_count(entries, (len(data) - at) // entry)
    return at


def _image(data: bytes, at: int) -> int:
    """Return the end of an image's pose and name in ``images.bin``. They start at the offset ``at``."""
    if not all(map(math.isfinite, struct.unpack_from("<7d", data, at + 4))):
        raise ValueError("an image whose pose is not finite")
    name = data.find(b"\0", at + 64, at + 64 + _LONGEST_NAME)
    if name < 0:
        raise ValueError("an image whose name does not end")
    return name + 1


def _rigs(data: bytes) -> int:
    """Return the end of the rigs in ``rigs.bin``."""
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    for _ in range(_checked_count(count, len(data) // 8)):
        _, sensors = struct.unpack_from("<II", data, at)
        at += 8
        for sensor in range(_checked_count(sensors, (len(data) - at) // 8)):
            at += 8
            if sensor:  # the first sensor is the origin of the rig and has no pose
                (has_pose,) = struct.unpack_from("<B", data, at)
                at += 1 + 56 * bool(has_pose)
        if at > len(data):
            raise ValueError("a rig that does not end")
    return at


def _checked_count(count: int, most: int) -> int:
    """Return the number of entries of a record. Raise ValueError if the file is too short for it."""
    if count > most:
        raise ValueError(f"a count of {count}, too many for the length of the file")
    return count


_NUMBER = re.compile(rb"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|nan|inf)", re.IGNORECASE)
_POSE = 9
"""Number of values before the name in a line of ``images.txt``. They are id, quaternion, translation and camera."""
_PLACE = 3
"""Number of values of an observation in ``images.txt``. They are x, y and the id of a point."""


def read_text_images(data: bytes) -> tuple[bytes, dict[int, str]]:
    """Replace the image names in ``images.txt`` by numbers, because pycolmap cuts names at blanks.

    Lines of images and lines of observations must alternate. Otherwise pycolmap would skip every second image.

    Returns:
        The content of the file with numbers as names; and the original names by image id.

    Raises:
        ValueError: images and observations do not alternate, or a name is not UTF-8.
    """
    out: list[bytes] = []
    names: dict[int, str] = {}
    number: int | None = None  # id of the image whose observations are in the next line
    for count, line in enumerate(data.splitlines(), 1):
        cells = line.split()
        if number is not None:
            if len(cells) % _PLACE or not all(map(_NUMBER.fullmatch, cells[: _POSE + _PLACE])):
                raise ValueError(f"line {count} has no observations of image {number}")
            number = None
            out.append(line)
        elif not cells or line.lstrip().startswith(b"#"):
            out.append(line)
        else:
            head = line.split(None, _POSE)
            if len(head) <= _POSE or not (head[0].isdigit() and all(map(_NUMBER.fullmatch, head[:_POSE]))):
                raise ValueError(f"line {count} has no image")
            number = int(head[0])
            if number in names:
                raise ValueError(f"image {number} occurs twice")
            try:
                names[number] = head[_POSE].decode().strip()
            except UnicodeDecodeError:
                raise ValueError(f"line {count} has a name that is not in UTF-8") from None
            out.append(b" ".join([*head[:_POSE], b"%d" % number]))
    return b"\n".join(out) + b"\n\n", names


MODEL_FILES = ("cameras", "images", "points3D", "rigs", "frames")
PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Camera models that describe a pinhole camera if all of their distortion parameters are zero."""


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """COLMAP model that was read from files: poses, intrinsics and points.

    Attributes:
        folder: folder of the files.
        files: files that were read.
        points: 3D points in the order of their ids, [M, 3] float32.
        point_colors: colors of the points, [M, 3] uint8.
        warnings: warnings for the user.
    """

    folder: Path
    files: tuple[Path, ...]
    points: Tensor
    point_colors: Tensor
    warnings: tuple[str, ...]
    _images: dict[str, list[Any]] = field(repr=False)
    _cameras: dict[int, Any] = field(repr=False)
    _tracks: tuple[tuple[int, ...], ...] = field(repr=False, default=())
    _rows: dict[int, int] = field(repr=False, default_factory=dict)

    @property
    def names(self) -> list[str]:
        """Names (stems) of the posed images, sorted."""
        return sorted(self._images)

    def camera(self, view: str) -> Camera:
        """Return the camera of a view at the picture size in the model.

        Raises:
            PolarguideError: the model has no image of this view, or several. Or the camera is distorted or invalid.
        """
        images = self._images.get(view, [])
        if len(images) != 1:
            near = difflib.get_close_matches(view, self.names, n=3, cutoff=0.4) or self.names[:3]
            raise PolarguideError(
                self.folder,
                expected=f"one posed image called {view} (any suffix)",
                found=", ".join(sorted(image.name for image in images))
                or f"none; the nearest are {', '.join(near)}",
                remedy="Register the view in COLMAP under this name, or remove its pictures.",
            )
        return _camera_of(self.folder, images[0], self._cameras[images[0].camera_id])

    def correspondences(self, view: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the points that a view observes.

        Returns:
            The observed positions in pixels at the picture size in the model, [N, 2]; and the 3D points, [N, 3].
        """
        pairs = [
            (point.xy, self._rows[point.point3D_id])
            for image in self._images.get(view, [])[:1]
            for point in image.points2D
            if point.has_point3D() and point.point3D_id in self._rows
        ]
        pixels = np.array([place for place, _ in pairs], np.float64).reshape(-1, 2)
        return pixels, self.points.double().numpy()[[row for _, row in pairs]]

    def observations(self, views: Sequence[str]) -> Tensor:
        """Return a mask of the views that observe each point, [M, V].

        It is False everywhere if the model does not store the observations.
        """
        columns = {
            image.image_id: column
            for column, view in enumerate(views)
            for image in self._images.get(view, [])
        }
        observed = torch.zeros(len(self._tracks), len(views), dtype=torch.bool)
        for row, track in enumerate(self._tracks):
            observed[row, [columns[number] for number in track if number in columns]] = True
        return observed


def read_model(root: Path) -> ColmapModel:
    """Read the COLMAP model in ``root/sparse/0`` or ``root/sparse``. Binary files take precedence over text.

    Raises:
        PolarguideError: there is no model, it cannot be read, or it has no points.
    """
    folder, kind = find_model(root, itself=False)
    files = tuple(path for path in (folder / (name + kind) for name in MODEL_FILES) if path.exists())
    model = load_model(folder, kind)
    images = posed_images(model)
    points, colors, tracks, numbers = _points_of(model)
    dropped = len(model.points3D) - len(points)
    require(
        len(points),
        folder / ("points3D" + kind),
        expected="3D points to start from",
        found="none",
        remedy="Triangulate points with the known poses (colmap point_triangulator).",
    )
    beyond = f"not finite, or farther than {FARTHEST:g}, and were ignored."
    warnings = (
        *second_model(folder, kind),
        *([f"{dropped} of {dropped + len(points)} 3D points are {beyond}"] if dropped else []),
    )
    rows = {number: row for row, number in enumerate(numbers)}
    return ColmapModel(folder, files, points, colors, warnings, images, dict(model.cameras), tracks, rows)


def fit_camera(camera: Camera, width: int, height: int, *, folder: Path, view: str) -> Camera:
    """Scale a camera to the size of the pictures.

    Raises:
        PolarguideError: the aspect ratios of the two sizes differ.
    """
    if (camera.width, camera.height) == (width, height):
        return camera
    require(
        camera.width and camera.width * height == camera.height * width,
        f"{folder} (camera of view {view})",
        expected=f"the size of the pictures, {width}x{height}",
        found=f"{camera.width}x{camera.height}",
        remedy="Use intrinsics of these pictures, or pictures of the size that COLMAP used (without a crop).",
    )
    return camera.scaled(width / camera.width, width, height)


def _model_files(root: Path, itself: bool = True) -> list[tuple[Path, str]]:
    """List the folders and suffixes of the models in a folder, in order of precedence."""
    folders = (root / "sparse" / "0", root / "sparse", *([root / "0", root] if itself else []))
    return [
        (folder, kind)
        for folder in folders
        for kind in (".bin", ".txt")
        if (folder / f"cameras{kind}").exists()
    ]


def find_model(root: Path, *, itself: bool = True, points: bool = True) -> tuple[Path, str]:
    """Find the folder and the suffix of a model in ``sparse/0``, ``sparse``, ``0`` or ``root`` itself.

    Args:
        root: folder to search.
        itself: if True, the files may be in ``root`` or ``root/0``.
        points: if True, the file of points is required.

    Raises:
        PolarguideError: there is no model, or one of its files is missing.
    """
    for folder, kind in _model_files(root, itself):
        for name in ("images", "points3D") if points else ("images",):
            require(
                (folder / (name + kind)).exists(),
                folder / (name + kind),
                expected="this file of the COLMAP model",
                found="nothing",
                remedy=f"A model consists of cameras{kind}, images{kind} and points3D{kind}: copy all of them.",
            )
        return folder, kind
    raise PolarguideError(
        root if itself else root / "sparse" / "0",
        expected="a COLMAP model (cameras, images and points3D as .bin or .txt)",
        found="no model in it or in sparse/",
        remedy="Copy the model there, or run structure from motion with polarguide prepare FOLDER --out SCENE.",
    )


def holds_model(root: Path) -> bool:
    """Return True if a folder has a COLMAP model or a part of one."""
    return bool(_model_files(root))


def load_model(folder: Path, kind: str) -> Any:
    """Read the model in a folder as pycolmap's ``Reconstruction``. The file of points may be missing.

    Raises:
        PolarguideError: pycolmap cannot read the model.
    """
    model = pycolmap.Reconstruction()
    check_model_files(folder, kind)
    try:
        if kind == ".bin":
            with _complete_files(folder, kind) as complete:
                model.read_binary(str(complete))
        else:
            images, names = read_text_images(read_file(folder / "images.txt"))
            with _complete_files(folder, kind, images) as complete:
                model.read_text(str(complete))
            for number, image in model.images.items():
                image.name = names[number]
    except PolarguideError:
        raise
    except Exception as error:  # pycolmap raises several kinds of C++ errors
        raise PolarguideError(
            folder,
            expected="a readable COLMAP model",
            found=f"a model that pycolmap cannot read ({str(error).strip().splitlines()[0]})",
            remedy="Export the model again; text files need two lines per image.",
        ) from error
    return model


def second_model(folder: Path, kind: str) -> tuple[str, ...]:
    """Return a warning if a folder has a text model next to the binary model that is used."""
    if kind != ".bin" or not (folder / "images.txt").exists():
        return ()
    return (f"{folder} has two models. images.bin is used, and images.txt is ignored.",)


@contextlib.contextmanager
def _complete_files(folder: Path, kind: str, images: bytes | None = None) -> Iterator[Path]:
    """Yield a folder in which pycolmap can read the model.

    It is ``folder`` if all files exist and need no change. Otherwise it is a temporary copy, to which an empty file of
    points is added if necessary. The content ``images`` replaces the file of images.
    """
    if images is None and (folder / ("points3D" + kind)).exists():
        yield folder
        return
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name)
        (copy / f"points3D{kind}").write_bytes(bytes(8) if kind == ".bin" else b"")
        for path in (folder / (name + kind) for name in MODEL_FILES):
            if path.exists():
                shutil.copyfile(path, copy / path.name)
        if images is not None:
            (copy / f"images{kind}").write_bytes(images)
        yield copy


def posed_images(model: Any, views: Collection[str] = ()) -> dict[str, list[Any]]:
    """Return the images with a pose in pycolmap's ``Reconstruction``, grouped by view."""
    images: dict[str, list[Any]] = {}
    for number, image in model.images.items():
        if image.has_pose:
            try:
                name = image.name
            except UnicodeDecodeError:
                raise PolarguideError(
                    f"the COLMAP model (image {number})",
                    expected="a name in UTF-8",
                    found="another encoding",
                    remedy="Rename the picture, and export the model again.",
                ) from None
            images.setdefault(view_of_name(name, views), []).append(image)
    return images


def view_of_name(name: str, views: Collection[str] = ()) -> str:
    """Return the view of a picture's name in a pose file. It is the name without folders and suffix.

    A suffix contains a letter, so the name ``./train/r_0.5`` has no suffix. If the whole name is in ``views``, it is
    returned unchanged, because labels of Metashape have no suffix.
    """
    path = PurePosixPath(canonical(name).replace("\\", "/"))
    if path.name in views:
        return path.name
    return path.stem if any(sign.isalpha() for sign in path.suffix) else path.name


def is_pinhole(camera: Any) -> bool:
    """Return True if a camera of pycolmap is a pinhole camera without distortion."""
    extra = camera.extra_params_idxs()
    return camera.model_name in PINHOLES and all(camera.params[index] == 0 for index in extra)


def require_sound(where: object, image: Any, camera: Any, tolerance: float) -> None:
    """Check the pose of an image and the parameters of its camera, both of pycolmap.

    Numbers must be finite and at most ``FARTHEST``, also in single precision. The length of the quaternion may differ
    from 1 by at most ``tolerance``.

    Raises:
        PolarguideError: a number is invalid.
    """
    pose = image.cam_from_world()
    quaternion = np.asarray(pose.rotation.quat, np.float64)
    length = math.hypot(*quaternion)  # does not overflow
    require(
        not tolerance < abs(length - 1) < FARTHEST,
        where,
        expected="a quaternion of length 1",
        found=f"one of length {length:g}",
        remedy="Normalize the quaternion, or export the model again.",
    )
    unit = (np.abs(quaternion) <= 2).all() and abs(length - 1) <= tolerance
    bounded = (np.abs(pose.translation) <= FARTHEST).all() and (np.abs(camera.params) <= FARTHEST).all()
    focal = list(camera.focal_length_idxs())  # empty for a panorama
    inner = (camera.params[k] for k in (focal, list(camera.principal_point_idxs())))
    require(
        unit and bounded and focal and can_be_lens((camera.width, camera.height), *inner),
        where,
        expected=f"a pose and a lens of numbers up to {FARTHEST:g}, {LENS}",
        found=f"quaternion {pose.rotation.quat}, translation {pose.translation}, camera {camera.params}",
        remedy="Export the model again, or remove the image from it.",
    )


def _camera_of(folder: Path, image: Any, camera: Any) -> Camera:
    where = f"{folder} (camera {camera.camera_id}, image {image.name})"
    require(
        is_pinhole(camera),
        where,
        expected="an undistorted camera (PINHOLE or SIMPLE_PINHOLE)",
        found=f"{camera.model_name} with parameters {', '.join(f'{value:g}' for value in camera.params)}",
        remedy="Undistort the four intensities of each view, and the model with them.",
    )
    require_sound(where, image, camera, 1e-6)
    pose = image.cam_from_world()
    rotation, translation = (
        torch.from_numpy(np.array(part, np.float64)) for part in (pose.rotation.matrix(), pose.translation)
    )
    return Camera(
        width=int(camera.width),
        height=int(camera.height),
        fx=float(camera.focal_length_x),
        fy=float(camera.focal_length_y),
        cx=float(camera.principal_point_x),
        cy=float(camera.principal_point_y),
        rotation=rotation,
        translation=translation,
    )


def _points_of(model: Any) -> tuple[Tensor, Tensor, tuple[tuple[int, ...], ...], list[int]]:
    """Return the points of a model whose coordinates are finite.

    Returns:
        The positions [M, 3]; the colors [M, 3]; the ids of the images that observe each point; and the ids of the
        points.
    """
    numbered = sorted(model.points3D.items())
    points = [point for _, point in numbered]
    with np.errstate(over="ignore"):
        places = np.array([point.xyz for point in points]).reshape(-1, 3).astype(np.float32)
    colors = np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3)
    finite = (np.abs(places) <= FARTHEST).all(axis=1)
    observers = {number: {element.image_id for element in point.track.elements} for number, point in numbered}
    for number, image in model.images.items():  # some models store tracks only in their images
        for observation in image.points2D:
            if observation.has_point3D() and observation.point3D_id in observers:
                observers[observation.point3D_id].add(number)
    ids = [numbered[place][0] for place in np.flatnonzero(finite)]
    return (
        torch.from_numpy(places[finite]),
        torch.from_numpy(colors[finite]),
        tuple(tuple(sorted(observers[number])) for number in ids),
        ids,
    )


_SAMPLES = 2000
"""Largest number of points that are tested for visibility."""


def unseen_points(points: Tensor, cameras: Sequence[Camera]) -> list[str]:
    """Return a list with a warning if none of the points [M, 3] is visible in any camera. Large clouds are sampled."""
    if not cameras or not len(points):
        return []
    places = points[:: max(1, len(points) // _SAMPLES)].to(torch.float64)
    if any(bool(seen_at(places - camera.center, camera)[2].any()) for camera in cameras):
        return []
    return [
        f"None of the {len(points)} points of the COLMAP model is in the field of view of one of the {len(cameras)} "
        "cameras: points and poses are of different models, or one of them is rotated."
    ]
