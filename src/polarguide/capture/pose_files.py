"""Cameras from files of other programs: nerfstudio's ``transforms.json``, Metashape's ``cameras.xml``, IDR's .npz."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from polarguide.capture.colmap.files import PosedCamera
from polarguide.capture.datasets.dataset import checked_pose, pinhole_camera, read_projections
from polarguide.capture.formats.arrays import finite_numbers, wrong_camera
from polarguide.core.errors import PolarguideError
from polarguide.core.files import read_file
from polarguide.core.records import read_record
from polarguide.core.text import number_or_nan

SUFFIXES = (".json", ".xml", ".npz")
_SQUARE = ((3, 4), (4, 4))
# nerfstudio's cameras look along -z with y up.
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_LARGEST_XML = 1 << 24
MOST_FRAMES = 20_000


def read_pose_file(path: Path, views: Sequence[str], size: tuple[int, int]) -> dict[str, PosedCamera]:
    """Cameras by view name.

    Args:
        path: ``.json`` of nerfstudio, ``.xml`` of Metashape, or ``.npz`` with ``world_mat_<i>`` and ``scale_mat_<i>``
            (IDR), whose cameras belong to the views in the order of their names.
        views: names of the views, sorted. size: width and height that an ``.npz`` file was made for.

    Raises:
        PolarguideError: the file cannot be read, or describes no camera of these views.
    """
    if path.suffix.lower() == ".npz":
        return _idr(path, views, size)
    read: Callable[[Path], dict[str, PosedCamera]] = (
        _metashape if path.suffix.lower() == ".xml" else _nerfstudio
    )
    found = read(path)
    if not found:
        raise PolarguideError(
            path,
            expected="cameras with a pose",
            found="none",
            remedy="Align the pictures and export the cameras again.",
        )
    return found


class _Lens(msgspec.Struct):
    """Intrinsics of ``transforms.json``, for all frames or for one."""

    camera_model: str | None = None
    fl_x: float | None = None
    fl_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    w: float | None = None
    h: float | None = None
    camera_angle_x: float | None = None
    k1: float | None = None
    k2: float | None = None
    k3: float | None = None
    k4: float | None = None
    p1: float | None = None
    p2: float | None = None


class _Frame(_Lens):
    file_path: str = ""
    transform_matrix: list[list[float]] = []


class _Transforms(_Lens):
    frames: Annotated[list[_Frame], Meta(max_length=MOST_FRAMES)] = []


def _nerfstudio(path: Path) -> dict[str, PosedCamera]:
    record = read_record(path, _Transforms, remedy="Export transforms.json again.")
    found: dict[str, PosedCamera] = {}
    for number, frame in enumerate(record.frames):
        where = f"{path} (frame {number}, {frame.file_path})"
        stem = Path(frame.file_path.replace("\\", "/")).stem
        if stem in found:
            raise wrong_camera(where, f"one frame called {stem}", "two")
        matrix = finite_numbers(where, frame.transform_matrix, _SQUARE)
        lens = {name: _either(frame, record, name) for name in _Lens.__struct_fields__}
        found[stem] = _perspective(where, lens, matrix)
    return found


def _either(frame: _Lens, record: _Lens, name: str) -> Any:
    own = getattr(frame, name)
    return getattr(record, name) if own is None else own


def _perspective(where: str, lens: Mapping[str, Any], matrix: Any) -> PosedCamera:
    """A frame of ``transforms.json``."""
    model = lens["camera_model"] or "OPENCV"
    if model not in _PERSPECTIVE or lens["k4"]:
        found = model if not lens["k4"] else "a fourth radial coefficient"
        raise wrong_camera(where, "a perspective camera with at most three radial coefficients", found)
    if not lens["w"] or not lens["h"] or not 0 < lens["w"] < 1e5 or not 0 < lens["h"] < 1e5:
        raise wrong_camera(where, "width and height, w and h", f"{lens['w']} and {lens['h']}")
    size = round(lens["w"]), round(lens["h"])
    focal = lens["fl_x"]
    if focal is None and lens["camera_angle_x"]:
        focal = size[0] / 2 / np.tan(lens["camera_angle_x"] / 2)
    if not focal or not focal > 0:
        raise wrong_camera(where, "a focal length, fl_x or camera_angle_x", str(focal))
    if lens["fl_y"] is not None and not lens["fl_y"] > 0:
        raise wrong_camera(where, "a positive focal length fl_y", str(lens["fl_y"]))
    center = [size[k] / 2 if lens[name] is None else lens[name] for k, name in enumerate(("cx", "cy"))]
    inner = (float(focal), float(lens["fl_y"] or focal), *map(float, center))
    radial = [float(lens[name] or 0.0) for name in ("k1", "k2", "p1", "p2", "k3")]
    return _camera(where, size, inner, radial, np.vstack([matrix[:3], [0, 0, 0, 1]]) @ _OPENGL)


def _camera(
    where: str, size: tuple[int, int], inner: Sequence[float], coefficients: Sequence[float], to_world: Any
) -> PosedCamera:
    """A camera with OpenCV's k1, k2, p1, p2 and k3 from its pose in the world, axes right, down, forward."""
    scale = abs(np.linalg.det(to_world[:3, :3])) ** (1 / 3)
    if not 1e-6 < scale < 1e6:
        raise wrong_camera(where, "a rotation and a translation", "a singular matrix")
    axes, center = checked_pose(where, np.column_stack([to_world[:3, :3] / scale, to_world[:3, 3]]))
    rotation = axes.T
    pose = (rotation, -rotation @ center)
    if not any(coefficients):
        return PosedCamera(*size, "PINHOLE", tuple(inner), *pose)
    return PosedCamera(*size, "FULL_OPENCV", (*inner, *coefficients, 0.0, 0.0, 0.0), *pose)


def _metashape(path: Path) -> dict[str, PosedCamera]:
    """Metashape's XML: poses in the frame of the chunk, ``sensor/calibration`` counted from the picture's center."""
    root = _parsed(path)
    sensors = {sensor.get("id"): sensor for sensor in root.iter("sensor")}
    found: dict[str, PosedCamera] = {}
    for camera in root.iter("camera"):
        text = camera.findtext("transform")
        if text is None:  # not aligned
            continue
        label = camera.get("label") or ""
        where = f"{path} (camera {label})"
        sensor = sensors.get(camera.get("sensor_id"))
        if sensor is None:
            raise wrong_camera(where, "the sensor it names", "none")
        stem = (
            Path(label).stem
            if Path(label).suffix.lower() in (".jpg", ".jpeg", ".png", ".tif", ".tiff")
            else label
        )
        if stem in found:
            raise wrong_camera(where, f"one camera called {stem}", "two")
        numbers = finite_numbers(where, [number_or_nan(part) for part in text.split()], ((16,),)).reshape(
            4, 4
        )
        found[stem] = _camera(where, *_lens_of(where, sensor), numbers)
    return found


def _lens_of(where: str, sensor: Any) -> tuple[tuple[int, int], tuple[float, ...], list[float]]:
    """Size, intrinsics and OpenCV's coefficients of a Metashape sensor; the adjusted calibration goes first."""
    if sensor.get("type", "frame") != "frame":
        raise wrong_camera(where, "a frame camera", f"a {sensor.get('type')} camera")
    calibrations = sensor.findall("calibration")
    best = next(
        (c for c in calibrations if c.get("class") == "adjusted"), calibrations[0] if calibrations else None
    )
    resolution = None if best is None else best.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if best is None or resolution is None or best.findtext("f") is None:
        raise wrong_camera(where, "a calibrated sensor with a resolution and a focal length f", "none")
    names = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")
    value = dict(
        zip(
            names,
            finite_numbers(where, [number_or_nan(best.findtext(n, "0")) for n in names], ((11,),)),
            strict=True,
        )
    )
    width, height = (number_or_nan(resolution.get(side, "0")) for side in ("width", "height"))
    if not (1 <= width < 1e5 and 1 <= height < 1e5 and value["f"] > 0):
        raise wrong_camera(
            where, "a size and a positive focal length", f"{width:g}x{height:g}, f = {value['f']:g}"
        )
    if value["k4"] or abs(value["b2"]) > 1e-3 * value["f"]:
        raise wrong_camera(
            where, "no skew (b2) and at most k3", f"b2 = {value['b2']:g}, k4 = {value['k4']:g}"
        )
    inner = (value["f"] + value["b1"], value["f"], width / 2 + value["cx"], height / 2 + value["cy"])
    # Metashape's p1 bends along x, OpenCV's p2 does.
    radial = [value[name] for name in ("k1", "k2", "p2", "p1", "k3")]
    return (
        (int(width), int(height)),
        tuple(float(number) for number in inner),
        [float(number) for number in radial],
    )


def _parsed(path: Path) -> ElementTree.Element:
    data = read_file(path, largest=_LARGEST_XML)
    found = "something else"
    # In UTF-16, entities would hide from this search.
    if b"\0" not in data and b"<!ENTITY" not in data and b"<!DOCTYPE" not in data:
        try:
            return ElementTree.fromstring(data)
        except (ElementTree.ParseError, ValueError, LookupError) as error:
            found = f"one that cannot be parsed ({error})"
    raise PolarguideError(
        path,
        expected="cameras exported by Metashape as XML",
        found=found,
        remedy="Export them again: File, Export, Export Cameras, Agisoft XML.",
    )


def _idr(path: Path, views: Sequence[str], size: tuple[int, int]) -> dict[str, PosedCamera]:
    """Cameras by number: of the views called so, or of the views in their order where there are as many."""
    cameras = {number: pinhole_camera(size, *camera) for number, camera in read_projections(path).items()}
    numbered = {view: int(view) for view in views if view.isascii() and view.isdigit() and len(view) < 7}
    found = {view: cameras[number] for view, number in numbered.items() if number in cameras}
    if len(found) == len(views):
        return found
    if len(cameras) != len(views):
        raise PolarguideError(
            path,
            expected=f"as many cameras as views, {len(views)}",
            found=str(len(cameras)),
            remedy="Number the views as the cameras are: view 7 has world_mat_7.",
        )
    return dict(zip(sorted(views), (cameras[number] for number in sorted(cameras)), strict=True))
