"""The files of a COLMAP model: checked before they are read, and written for posed cameras without points."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from polarguide.core.errors import PolarguideError
from polarguide.core.files import read_file
from polarguide.core.text import decimal_comma
from polarguide.geometry.camera import quaternion

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
    params = list(camera.parameters)
    return pycolmap.Camera(model=camera.model, params=params, **size, **more)


def write_cameras(
    folder: Path, cameras: Mapping[str, PosedCamera], numbers: Mapping[str, tuple[int, int]] | None = None
) -> None:
    """Write a binary COLMAP model with one image ``<view>.png`` a view and no points.

    Views that share their intrinsics share a camera.

    Args:
        folder: exists.
        cameras: by view name; may not be empty.
        numbers: numbers of each view's image and camera; counted from 1 if None.
    """
    number_of: dict[tuple[object, ...], int] = {}
    used: dict[int, tuple[Any, ...]] = {}
    images = []
    for number, (view, camera) in enumerate(sorted(cameras.items()), 1):
        of_camera = number_of.setdefault(camera.intrinsics, len(number_of) + 1)
        if numbers is not None:
            number, of_camera = numbers[view]
        used[of_camera] = camera.intrinsics
        pose = (*quaternion(camera.rotation), *camera.translation)
        name = f"{view}.png".encode() + b"\0"
        images.append(struct.pack("<I7dI", number, *pose, of_camera) + name + struct.pack("<Q", 0))
    intrinsics = []
    for number, (model, width, height, *parameters) in used.items():
        head = struct.pack("<IiQQ", number, MODELS[str(model)][0], width, height)
        intrinsics.append(head + struct.pack(f"<{len(parameters)}d", *parameters))
    (folder / "cameras.bin").write_bytes(struct.pack("<Q", len(intrinsics)) + b"".join(intrinsics))
    (folder / "images.bin").write_bytes(struct.pack("<Q", len(images)) + b"".join(images))
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 0))


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
    """A line of ``points3D.txt`` with a color that pycolmap would take modulo 256; None where there is none.

    What is no number at all, pycolmap finds itself.
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


_POSE = 9  # number, quaternion, translation, camera: what stands before the name
_PLACE = 3  # x, y and the number of a point; pycolmap checks all of them, lines of images show in the first


@dataclass(frozen=True)
class TextImages:
    """A text model that pycolmap can read in place of an ``images.txt``.

    Attributes:
        data: the same file with names that have no blanks.
        names: number of an image -> its name.
    """

    data: bytes
    names: dict[int, str]


def read_text_images(data: bytes) -> TextImages:
    """Take the names out of an ``images.txt``.

    An image with one line, as some programs write it, would make pycolmap pass over every other image.

    Raises:
        ValueError: lines are not those of images and their observations in turn, or a name is not in UTF-8.
    """
    out: list[bytes] = []
    names: dict[int, str] = {}
    number: int | None = None  # of the image whose observations come next
    for count, line in enumerate(data.splitlines(), 1):
        cells = line.split()
        if number is not None:
            if len(cells) % _PLACE or not all(map(_is_number, cells[: _POSE + _PLACE])):
                raise ValueError(f"line {count} does not hold the observations of image {number}")
            number = None
            out.append(line)
        elif not cells or line.lstrip().startswith(b"#"):
            out.append(line)
        else:
            head = line.split(None, _POSE)
            if len(head) <= _POSE or not (head[0].isdigit() and all(map(_is_number, head[:_POSE]))):
                raise ValueError(f"line {count} does not hold an image")
            number = int(head[0])
            if number in names:
                raise ValueError(f"image {number} stands there twice")
            try:
                names[number] = head[_POSE].decode().strip()
            except UnicodeDecodeError:
                raise ValueError(f"line {count} has a name that is not in UTF-8") from None
            out.append(b" ".join([*head[:_POSE], b"%d" % number]))
    return TextImages(b"\n".join(out) + b"\n\n", names)


def _is_number(cell: bytes) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
