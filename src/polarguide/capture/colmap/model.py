"""The files of a COLMAP model: checked before they are read, and written for posed cameras without points."""

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
from polarguide.core.text import canonical, decimal_comma, listed
from polarguide.geometry.camera import FARTHEST, LENS, Camera, can_be_lens, quaternion

MODELS = {
    "SIMPLE_PINHOLE": (0, 3), "PINHOLE": (1, 4), "SIMPLE_RADIAL": (2, 4), "RADIAL": (3, 5), "OPENCV": (4, 8),
    "OPENCV_FISHEYE": (5, 8), "FULL_OPENCV": (6, 12), "FOV": (7, 5), "SIMPLE_RADIAL_FISHEYE": (8, 4),
    "RADIAL_FISHEYE": (9, 5), "THIN_PRISM_FISHEYE": (10, 12),
}  # fmt: skip
"""COLMAP's camera models: number and count of parameters."""


@dataclass(frozen=True, eq=False)
class PosedCamera:
    """Intrinsics and pose of one picture, in COLMAP's conventions.

    Attributes:
        width, height: picture size in pixels.
        model: a key of ``MODELS``.
        parameters: in COLMAP's order; pixel centers at 0.5.
        rotation: world to camera, [3, 3].
        translation: world to camera, [3].
    """

    width: int
    height: int
    model: str
    parameters: tuple[float, ...]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    @property
    def intrinsics(self) -> tuple[Any, ...]:
        """Model, size and parameters: equal for pictures of one camera."""
        return (self.model, self.width, self.height, *self.parameters)

    @property
    def center(self) -> NDArray[np.float64]:
        """Camera center in the world, [3]."""
        return np.asarray(-self.rotation.T @ self.translation)


def colmap_camera(camera: PosedCamera, **more: Any) -> pycolmap.Camera:
    """The intrinsics of a camera as pycolmap's type."""
    size = {"width": camera.width, "height": camera.height}
    return pycolmap.Camera(model=camera.model, params=list(camera.parameters), **size, **more)


def posed_model(
    cameras: Mapping[str, PosedCamera], numbers: Mapping[str, tuple[int, int]] | None = None
) -> pycolmap.Reconstruction:
    """A COLMAP model with one image ``<view>.png`` a view and no points.

    Views that share their intrinsics share a camera.

    Args:
        cameras: by view name.
        numbers: numbers of each view's image and camera; counted from 1 if None.
    """
    model = pycolmap.Reconstruction()
    number_of: dict[tuple[object, ...], int] = {}
    for number, (view, camera) in enumerate(sorted(cameras.items()), 1):
        of_camera = number_of.setdefault(camera.intrinsics, len(number_of) + 1)
        if numbers is not None:
            number, of_camera = numbers[view]
        if not model.exists_camera(of_camera):
            model.add_camera_with_trivial_rig(colmap_camera(camera, camera_id=of_camera))
        w, *axis = quaternion(camera.rotation)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([*axis, w])), camera.translation)
        image = pycolmap.Image(name=f"{view}.png", camera_id=of_camera, image_id=number)
        model.add_image_with_trivial_frame(image, pose)
    return model


_PARAMETERS = dict(MODELS.values())
_LONGEST_NAME = 4096


def check_model_files(folder: Path, kind: str) -> None:
    """Check the files of a model, of suffix ``kind``; missing files are skipped.

    pycolmap checks text files itself. Only decimal commas and the colors of points are searched for there.

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
                    found = f"{len(data)} bytes where its counts require {end}"
            except (struct.error, ValueError) as error:
                found = f"a damaged one ({error})" if data else "an empty file"
        elif comma := _decimal_comma(data):
            raise PolarguideError(
                path,
                expected="numbers with a decimal point",
                found=comma,
                remedy="Write the model again in a program or a locale (LC_NUMERIC=C) that writes points.",
            )
        elif name == "points3D":
            found = _strange_color(data)
        if found is not None:
            raise PolarguideError(
                path,
                expected=f"a complete COLMAP {name}{kind}",
                found=found,
                remedy="Copy or export the model again.",
            )


_HEAD = 1 << 16  # bytes; a program writes all lines alike


def _decimal_comma(data: bytes) -> str:
    """Where the first lines of a text file have a decimal comma; empty where they have none."""
    for number, line in enumerate(data[:_HEAD].decode("ascii", "replace").splitlines(), 1):
        comma = "" if line.startswith("#") else decimal_comma(line.split()[:_POSE])
        if comma:
            return f"a decimal comma, {comma} in line {number}"
    return ""


def _strange_color(data: bytes) -> str | None:
    """Return a line of ``points3D.txt`` with a color that pycolmap would take modulo 256, or None.

    Colors that are not numbers are left to pycolmap, which refuses them.
    """
    for number, line in enumerate(data.splitlines(), 1):
        cells = line.split(None, 7)[4:7]
        if line[:1] != b"#" and any(
            cell.lstrip(b"-").isdigit() and not (len(cell) <= 3 and 0 <= int(cell) <= 255) for cell in cells
        ):
            color = ", ".join(cell.decode("ascii", "replace")[:20] for cell in cells)
            return f"a color of {color} in line {number}, whose parts go from 0 to 255"
    return None


def _cameras(data: bytes) -> int:
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    for _ in range(_at_most(count, len(data) // 48)):
        _, model, width, height = struct.unpack_from("<IiQQ", data, at)
        if not (0 < width < 1 << 20 and 0 < height < 1 << 20):
            raise ValueError(f"a camera of {width}x{height} pixels")
        if model not in _PARAMETERS:  # a newer model: its length is not known here
            return len(data)
        at += 24 + 8 * _PARAMETERS[model]
    return at


def _lists(data: bytes, head: Callable[[bytes, int], int], counter: str, entry: int) -> int:
    """The end of records that each have a head, a count, and as many entries of ``entry`` bytes.

    ``head`` returns the end of the head at a place; ``counter`` is the type of the count, for ``struct``.
    """
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    for _ in range(_at_most(count, len(data) // 8)):
        at = head(data, at)
        (entries,) = struct.unpack_from(counter, data, at)
        at += struct.calcsize(counter)
        at += entry * _at_most(entries, (len(data) - at) // entry)
    return at


def _image(data: bytes, at: int) -> int:
    if not all(map(math.isfinite, struct.unpack_from("<7d", data, at + 4))):
        raise ValueError("an image whose pose is not finite")
    name = data.find(b"\0", at + 64, at + 64 + _LONGEST_NAME)
    if name < 0:
        raise ValueError("an image without the end of its name")
    return name + 1


def _rigs(data: bytes) -> int:
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    for _ in range(_at_most(count, len(data) // 8)):
        _, sensors = struct.unpack_from("<II", data, at)
        at += 8
        for sensor in range(_at_most(sensors, (len(data) - at) // 8)):
            at += 8
            if sensor:  # the first is the rig's own place
                (has_pose,) = struct.unpack_from("<B", data, at)
                at += 1 + 56 * bool(has_pose)
        if at > len(data):
            raise ValueError("a rig without its end")
    return at


def _at_most(count: int, most: int) -> int:
    """The count, if the file is long enough for it."""
    if count > most:
        raise ValueError(f"a count of {count} that the file is too short for")
    return count


_NUMBER = re.compile(rb"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|nan|inf)", re.IGNORECASE)
_POSE = 9  # number, quaternion, translation, camera: what stands before the name
_PLACE = 3  # x, y and the number of a point; pycolmap checks all of them, lines of images show in the first


def read_text_images(data: bytes) -> tuple[bytes, dict[int, str]]:
    """Take the names out of an ``images.txt``, for pycolmap, which cuts them at blanks.

    An image with one line, as some programs write it, would make pycolmap pass over every other image.

    Returns:
        The same file with numbers for names, and the name of each image by its number.

    Raises:
        ValueError: lines are not those of images and their observations in turn, or a name is not in UTF-8.
    """
    out: list[bytes] = []
    names: dict[int, str] = {}
    number: int | None = None  # of the image whose observations come next
    for count, line in enumerate(data.splitlines(), 1):
        cells = line.split()
        if number is not None:
            if len(cells) % _PLACE or not all(map(_NUMBER.fullmatch, cells[: _POSE + _PLACE])):
                raise ValueError(f"line {count} does not hold the observations of image {number}")
            number = None
            out.append(line)
        elif not cells or line.lstrip().startswith(b"#"):
            out.append(line)
        else:
            head = line.split(None, _POSE)
            if len(head) <= _POSE or not (head[0].isdigit() and all(map(_NUMBER.fullmatch, head[:_POSE]))):
                raise ValueError(f"line {count} does not hold an image")
            number = int(head[0])
            if number in names:
                raise ValueError(f"image {number} stands there twice")
            try:
                names[number] = head[_POSE].decode().strip()
            except UnicodeDecodeError:
                raise ValueError(f"line {count} has a name that is not in UTF-8") from None
            out.append(b" ".join([*head[:_POSE], b"%d" % number]))
    return b"\n".join(out) + b"\n\n", names


MODEL_FILES = ("cameras", "images", "points3D", "rigs", "frames")
# Perspective models that are a plain pinhole when all of their distortion parameters are zero.
PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """Poses, intrinsics and points of a COLMAP model.

    Attributes:
        folder: the folder with its files.
        files: the files that were read.
        points: [M, 3] float32, in the order of their COLMAP ids.
        point_colors: [M, 3] uint8.
        warnings: plain sentences.
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
        """Camera of the image whose name without folder and suffix is ``view``, at the size the model states.

        Raises:
            PolarguideError: there is no such image or more than one, it is distorted, or has broken numbers.
        """
        images = self._images.get(view, [])
        if len(images) != 1:
            near = difflib.get_close_matches(view, self.names, n=3, cutoff=0.4) or self.names[:3]
            raise PolarguideError(
                self.folder,
                expected=f"one posed image called {view} (any suffix)",
                found=", ".join(sorted(image.name for image in images))
                or f"none; the nearest are {', '.join(near)}",
                remedy="Register the view in COLMAP under this name, or leave out its pictures.",
            )
        return _camera_of(self.folder, images[0], self._cameras[images[0].camera_id])

    def correspondences(self, view: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where a view observes points, in pixels at the size the model states [N, 2], and the points [N, 3]."""
        seen = [
            (point.xy, self._rows[point.point3D_id])
            for image in self._images.get(view, [])[:1]
            for point in image.points2D
            if point.has_point3D() and point.point3D_id in self._rows
        ]
        pixels = np.array([place for place, _ in seen], np.float64).reshape(-1, 2)
        return pixels, self.points.double().numpy()[[row for _, row in seen]]

    def observations(self, views: Sequence[str]) -> Tensor:
        """Which of the views observe each point, [M, V] bool; all False where no tracks are stored."""
        columns = {view: column for column, view in enumerate(views)}
        by_id = {
            image.image_id: columns[view]
            for view, images in self._images.items()
            if view in columns
            for image in images
        }
        observed = torch.zeros(len(self._tracks), len(views), dtype=torch.bool)
        for row, track in enumerate(self._tracks):
            observed[row, [by_id[number] for number in track if number in by_id]] = True
        return observed


def read_model(root: Path) -> ColmapModel:
    """Read the COLMAP model in ``root/sparse/0`` or ``root/sparse``: binary, else text.

    Raises:
        PolarguideError: there is no model, it cannot be read, or it has no points.
    """
    folder, kind = find_model(root, itself=False)
    files = tuple(path for path in (folder / (name + kind) for name in MODEL_FILES) if path.exists())
    model = load_model(folder, kind)
    stale = other_text_model(folder, kind, model)
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
    beyond = f"not finite, or farther than {FARTHEST:g}, and were left out."
    warning = f"{dropped} of {dropped + len(points)} 3D points are {beyond}"
    warnings = (*stale, *([warning] if dropped else []))
    rows = {number: row for row, number in enumerate(numbers)}
    return ColmapModel(folder, files, points, colors, warnings, images, dict(model.cameras), tracks, rows)


def fit_camera(camera: Camera, width: int, height: int, *, folder: Path, view: str) -> Camera:
    """The camera at the size of the pictures, rescaled where the model was made at another resolution.

    Raises:
        PolarguideError: the two sizes differ by more than one common factor.
    """
    if (camera.width, camera.height) == (width, height):
        return camera
    require(
        camera.width and camera.width * height == camera.height * width,
        f"{folder} (camera of view {view})",
        expected=f"the size of the pictures, {width}x{height}",
        found=f"{camera.width}x{camera.height}",
        remedy="Give intrinsics for these pictures, or pictures of the size COLMAP saw (no crop).",
    )
    return camera.scaled(width / camera.width, width, height)


def unused_poses(model: ColmapModel, names: list[str]) -> list[str]:
    """A warning about posed images without a view in the capture, if there are any."""
    unused = sorted(set(model.names) - set(names))
    if not unused:
        return []
    return [f"The COLMAP model has poses for {len(unused)} images without pictures ({listed(unused)})."]


def find_model(root: Path, *, itself: bool = True, points: bool = True) -> tuple[Path, str]:
    """The folder of a model and the suffix of its files: in ``sparse/0`` or ``sparse``, else ``0`` or ``root`` itself.

    Args:
        root: where to look.
        itself: whether the files may be in ``root`` or ``root/0``.
        points: whether the file of points is required.

    Raises:
        PolarguideError: there is none, or a file of it is missing.
    """
    needed = ("images", "points3D") if points else ("images",)
    for folder in (root / "sparse" / "0", root / "sparse", *([root / "0", root] if itself else [])):
        for kind in (".bin", ".txt"):
            if (folder / ("cameras" + kind)).exists():
                missing = [n for n in needed if not (folder / (n + kind)).exists()]
                if missing:
                    raise PolarguideError(
                        folder / (missing[0] + kind),
                        expected="this file of the COLMAP model",
                        found="nothing",
                        remedy=f"A model is cameras{kind}, images{kind} and points3D{kind} together.",
                    )
                return folder, kind
    raise PolarguideError(
        root if itself else root / "sparse" / "0",
        expected="a COLMAP model (cameras, images and points3D as .bin or .txt)",
        found="neither there nor in sparse/",
        remedy="Copy the model there; or let polarguide prepare FOLDER --out SCENE run structure from motion.",
    )


def holds_model(root: Path) -> bool:
    """Whether ``find_model`` finds a model, or a part of one, in a folder."""
    places = (root / "sparse" / "0", root / "sparse", root / "0", root)
    return any((folder / f"cameras{kind}").exists() for folder in places for kind in (".bin", ".txt"))


def load_model(folder: Path, kind: str) -> Any:
    """The model in a folder, as pycolmap's ``Reconstruction``; without points if it has no file of them.

    Raises:
        PolarguideError: pycolmap cannot read the model.
    """
    model = pycolmap.Reconstruction()
    check_model_files(folder, kind)
    try:
        if kind == ".bin":
            with _whole(folder, kind) as whole:
                model.read_binary(str(whole))
        else:
            images, names = read_text_images(read_file(folder / "images.txt"))
            with _whole(folder, kind, images) as whole:
                model.read_text(str(whole))
            for number, image in model.images.items():
                image.name = names[number]
    except PolarguideError:
        raise
    except Exception as error:  # pycolmap raises whatever C++ threw: ValueError, IndexError, MemoryError, ...
        raise PolarguideError(
            folder,
            expected="a readable COLMAP model",
            found=f"a model that pycolmap cannot read ({str(error).strip().splitlines()[0]})",
            remedy="Export the model again; text files need two lines per image.",
        ) from error
    return model


# Share by which numbers of two models may differ: programs write as few as six digits as text.
_DIGITS = 1e-5


def other_text_model(folder: Path, kind: str, model: Any) -> list[str]:
    """The warning that text files beside a binary model say something else, if they do.

    Args:
        folder: of the model. kind: suffix of the files that were read. model: what they hold.
    """
    if kind != ".bin" or not all((folder / f"{name}.txt").exists() for name in ("cameras", "images")):
        return []
    try:
        differ = _differing(model, load_model(folder, ".txt"))
    except PolarguideError as error:
        return [f"The text model beside {folder / 'images.bin'} is not used, and cannot be read: {error}"]
    if not differ:
        return []
    return [
        f"{folder} holds two models: images.txt has other poses or cameras than images.bin ({listed(differ)}). "
        "The binary files are used; remove them if the text is right."
    ]


def _differing(model: Any, other: Any) -> list[str]:
    """Names of the images that only one of two models has, or whose poses or cameras are others."""
    placed, again = (
        {
            image.name: (image.cam_from_world(), m.cameras[image.camera_id])
            for image in m.images.values()
            if image.has_pose
        }
        for m in (model, other)
    )
    reach = max((float(np.abs(pose.translation).max()) for pose, _ in placed.values()), default=0.0)

    def alike(name: str) -> bool:
        pose, camera = placed[name]
        pose_again, camera_again = again[name]
        return (
            camera.model_name == camera_again.model_name
            and np.allclose(camera.params, camera_again.params, rtol=_DIGITS)
            and np.allclose(pose.rotation.matrix(), pose_again.rotation.matrix(), rtol=0, atol=_DIGITS)
            and np.allclose(pose.translation, pose_again.translation, rtol=0, atol=_DIGITS * reach)
        )

    both = placed.keys() & again.keys()
    return sorted((placed.keys() ^ again.keys()) | {name for name in both if not alike(name)})


@contextlib.contextmanager
def _whole(folder: Path, kind: str, images: bytes | None = None) -> Iterator[Path]:
    """The folder, or a copy: with an empty file of points where it has none, and with another file of images."""
    if images is None and (folder / ("points3D" + kind)).exists():
        yield folder
        return
    with tempfile.TemporaryDirectory() as made:
        for name in MODEL_FILES:
            if (folder / (name + kind)).exists():
                shutil.copyfile(folder / (name + kind), Path(made) / (name + kind))
        if images is not None:
            (Path(made) / ("images" + kind)).write_bytes(images)
        if not (folder / ("points3D" + kind)).exists():
            (Path(made) / ("points3D" + kind)).write_bytes(bytes(8) if kind == ".bin" else b"")
        yield Path(made)


def posed_images(model: Any, views: Collection[str] = ()) -> dict[str, list[Any]]:
    """The images with a pose of pycolmap's ``Reconstruction``, by the view that their name means."""
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
    """The view that a picture's name in a file of poses means: without folders, and without a suffix with a letter.

    Suffixes without one are no kinds of files: ``./train/r_0.5`` is called so. Nor is what follows a point in the name
    of one of ``views``: Metashape's labels have no suffix.
    """
    path = PurePosixPath(canonical(name).replace("\\", "/"))
    if path.name in views:
        return path.name
    return path.stem if any(sign.isalpha() for sign in path.suffix) else path.name


def is_pinhole(camera: Any) -> bool:
    """Whether a camera of pycolmap's is a pinhole without distortion."""
    extra = camera.extra_params_idxs()
    return camera.model_name in PINHOLES and all(camera.params[index] == 0 for index in extra)


def is_sound(image: Any, camera: Any, tolerance: float) -> bool:
    """Whether pose and lens of pycolmap's image and camera have numbers that they can have, in single precision, too.

    The quaternion needs length 1 to a tolerance; NaN is refused, and so are numbers beyond ``FARTHEST``.
    """
    pose = image.cam_from_world()
    quaternion = np.asarray(pose.rotation.quat, np.float64)
    translation = np.asarray(pose.translation)
    turns = (np.abs(quaternion) <= 2).all() and abs(float(np.linalg.norm(quaternion)) - 1) <= tolerance
    bounded = (np.abs(translation) <= FARTHEST).all() and (np.abs(camera.params) <= FARTHEST).all()
    if not len(camera.focal_length_idxs()):  # a panorama
        return False
    inner = (camera.params[list(k)] for k in (camera.focal_length_idxs(), camera.principal_point_idxs()))
    return bool(turns and bounded) and can_be_lens((camera.width, camera.height), *inner)


def _camera_of(folder: Path, image: Any, camera: Any) -> Camera:
    where = f"{folder} (camera {camera.camera_id}, image {image.name})"
    if not is_pinhole(camera):
        raise PolarguideError(
            where,
            expected="an undistorted camera (PINHOLE or SIMPLE_PINHOLE)",
            found=f"{camera.model_name} with parameters {', '.join(f'{value:g}' for value in camera.params)}",
            remedy="Undistort the four intensities of each view, and the model with them.",
        )
    placed = image.cam_from_world()
    inner = (camera.focal_length_x, camera.focal_length_y, camera.principal_point_x, camera.principal_point_y)
    if not is_sound(image, camera, 1e-6):
        raise PolarguideError(
            where,
            expected=f"a unit quaternion, a translation up to {FARTHEST:g} and {LENS}",
            found=f"quaternion {placed.rotation.quat}, translation {placed.translation}, intrinsics {inner}",
            remedy="Export the model again.",
        )
    rotation, translation = (
        torch.from_numpy(np.array(part, np.float64))
        for part in (placed.rotation.matrix(), placed.translation)
    )
    fx, fy, cx, cy = map(float, inner)
    return Camera(int(camera.width), int(camera.height), fx, fy, cx, cy, rotation, translation)


def _points_of(model: Any) -> tuple[Tensor, Tensor, tuple[tuple[int, ...], ...], list[int]]:
    """Finite points, their colors, the numbers of the images that see them, and their own numbers."""
    numbered = sorted(model.points3D.items())
    points = [point for _, point in numbered]
    with np.errstate(over="ignore"):
        places = np.array([point.xyz for point in points]).reshape(-1, 3).astype(np.float32)
    colors = np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3)
    finite = (np.abs(places) <= FARTHEST).all(axis=1)
    seen = {number: {element.image_id for element in point.track.elements} for number, point in numbered}
    for number, image in model.images.items():  # exported models may have tracks there alone
        for observed in image.points2D:
            if observed.has_point3D() and observed.point3D_id in seen:
                seen[observed.point3D_id].add(number)
    kept = [numbered[place][0] for place in np.flatnonzero(finite)]
    tracks = tuple(tuple(sorted(seen[number])) for number in kept)
    return torch.from_numpy(places[finite]), torch.from_numpy(colors[finite]), tracks, kept


_SAMPLES = 2000
# Of a picture's sides, by which a point may miss it: pictures of few points need not show one.
_MARGIN = 1.0


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
    across = _MARGIN * camera.width
    down = _MARGIN * camera.height
    inside = (x >= -across) & (x <= camera.width + across) & (y >= -down) & (y <= camera.height + down)
    return bool(inside.any())
