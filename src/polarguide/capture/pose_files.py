"""Read cameras from pose files of other programs.

The files are ``transforms.json`` (nerfstudio, instant-ngp, Blender), XML files of Metashape, and ``.npz`` files of IDR.
docs/reference/formats.md describes their fields. A field that would change the meaning of other fields and is not
supported causes an error. An unknown field causes a warning.
"""

from __future__ import annotations

import functools
import math
import warnings
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from polarguide.capture.camera_matrices import (
    POSE_SHAPES,
    checked_intrinsics,
    checked_pose,
    pinhole_camera,
    read_projections,
    require_known_names,
)
from polarguide.capture.colmap.model import PosedCamera, view_of_name
from polarguide.capture.formats.pictures import finite_numbers, require_camera, wrong_camera
from polarguide.capture.layout import numbered_views
from polarguide.core.errors import PolarguideError, PolarguideWarning, require
from polarguide.core.files import read_file
from polarguide.core.records import LARGEST_RECORD, decode, parse
from polarguide.core.text import listed, number_or_nan

Size = tuple[int, int]
Sizes = Callable[[str], tuple[Size, ...]]
"""Function that returns the possible sizes (width, height) of a view's camera. The most likely size is first."""
_OFF_CENTER = 0.125
"""Largest distance of a principal point from the center of the picture, as a share of the picture's side.

The principal point of a lens is off by a few percent. If it refers to pictures of half the size, it is off by a
quarter.
"""


def is_centered(size: Size, center: tuple[float | None, float | None]) -> bool:
    """Return True if a principal point is near the center of the picture. Coordinates that are ``None`` are ignored."""
    return all(
        place is None or abs(place - side / 2) <= _OFF_CENTER * side
        for place, side in zip(center, size, strict=True)
    )


def settled_size(
    where: object, sizes: Sequence[Size], center: tuple[float | None, float | None], *, in_pixels: bool
) -> Size:
    """Choose the picture size of a camera whose file does not state it.

    The principal point must be near the center of the picture.

    Args:
        where: file and camera that an error message names.
        sizes: possible sizes. The most likely size is first.
        center: principal point. A coordinate is ``None`` if it is unknown.
        in_pixels: if True, other numbers of the camera are in pixels, so they depend on the size.

    Raises:
        PolarguideError: there is no possible size, or the principal point fits no size or several sizes.
    """
    expected = "width and height of the pictures that the camera was made for, w and h"
    require_camera(sizes, where, expected, "none")
    fitting = [size for size in sizes if is_centered(size, center)]
    text = " or ".join(f"{width}x{height}" for width, height in sizes)
    require_camera(
        fitting, where, f"a principal point near the middle of {text}", f"{center[0]}, {center[1]}"
    )
    areas = {width * height for width, height in fitting}
    require_camera(len(areas) == 1 or not in_pixels, where, expected, f"none, for pictures of {text}")
    return fitting[0]


_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Matrix that converts a pose with OpenGL's camera axes (y up, view along -z) to axes right, down, forward."""
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_FISHEYE = "OPENCV_FISHEYE"
MOST_FRAMES = 20_000
"""Largest number of frames in a file that is accepted."""
_SAME_FOCAL = 0.01
"""Largest relative difference of two focal lengths that count as equal.

Rounding causes smaller differences, resized pictures much larger differences.
"""


_NUMBERS = (
    "fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov", "k1", "k2", "k3",
    "k4", "p1", "p2", "k5", "k6", "rolling_shutter_time", "ftheta_p0", "fisheye_crop_radius",
)  # fmt: skip
_LENS: dict[str, Any] = {
    **dict.fromkeys(_NUMBERS, float | None),
    **dict.fromkeys(("distortion_params", "rolling_shutter"), list[float] | None),
    **dict.fromkeys(("latlong", "equirectangular"), Any),
    "camera_model": str | None,
    "is_fisheye": bool | None,
    "intrinsic_matrix": list[list[float]] | None,
}
"""Type of each field of a lens. The fields may apply to the whole file or to one frame."""
_Lens: Any = msgspec.defstruct("_Lens", [(name, kind, None) for name, kind in _LENS.items()])


class _Frame(_Lens):
    file_path: str = ""
    transform_matrix: list[list[float]] | None = None
    transform_matrix_start: list[list[float]] | None = None
    transform_matrix_end: list[list[float]] | None = None


class _Transforms(_Lens):
    frames: Annotated[tuple[_Frame, ...], Meta(max_length=MOST_FRAMES)] = ()
    test_frames: Annotated[tuple[_Frame, ...], Meta(max_length=MOST_FRAMES)] = ()
    camera: Any = None
    normal_mts_args: Any = None
    from_na: bool | None = None


# Known fields that do not affect cameras: placement of the scene, training, depth, masks and points.
_IRRELEVANT = {
    "aabb", "aabb_scale", "render_aabb", "scale", "offset", "up", "applied_transform", "applied_scale",
    "orientation_override", "auto_scale_poses_override", "centered", "ply_file_path", "n_frames",
    "n_extra_learnable_dims", "importance_sampling", "sharpen", "envmap", "white_transparent",
    "black_transparent", "mask_color", "fix_premult", "enable_ray_loading", "enable_depth_loading",
    "integer_depth_scale", "depth_unit_scale_factor", "sharpness_discard_threshold", "train_filenames",
    "val_filenames", "test_filenames", "ftheta_p1", "ftheta_p2", "ftheta_p3", "ftheta_p4", "rotation",
    "sharpness", "time", "mask_path", "depth_file_path", "depth_path", "normal_file_path", "semantics_path",
    "segmentation_path", "colmap_im_id", "camera_id", "driver_parameters", "bg_color", "has_mask", "is_bad",
    "camera_linear_velocity", "camera_angular_velocity", "exposure_time", "motion_blur_score",
}  # fmt: skip


def read_transforms(path: Path, views: Collection[str], sizes: Sizes) -> dict[str, PosedCamera]:
    """Read the cameras of a file ``transforms.json``. The file name of a frame determines its view.

    Args:
        path: path of the file.
        views: names of the capture's views.
        sizes: possible sizes of a view's camera for files without a size.

    Raises:
        PolarguideError: the file cannot be read, or has a camera of an unsupported kind.
    """
    remedy = "Export transforms.json again."
    content = parse(read_file(path, largest=LARGEST_RECORD, remedy=remedy), path, remedy=remedy)
    record = decode(content, _Transforms, path, remedy=remedy)
    listed_frames = [frame for key in ("frames", "test_frames") for frame in content.get(key, ())]
    names = set(content).union(*listed_frames)
    for name in ("camera", "normal_mts_args"):
        require_camera(
            getattr(record, name) is None,
            path,
            "cameras that look along -z with y up (OpenGL)",
            f"{name}, of other axes",
        )
    cameras: dict[str, PosedCamera] = {}
    for number, frame in enumerate((*record.frames, *record.test_frames)):
        where = f"{path} (frame {number}, {frame.file_path})"
        require_camera(
            frame.file_path,
            where,
            "file_path and transform_matrix, as nerfstudio writes them",
            listed(sorted(listed_frames[number])),
        )
        view = view_of_name(frame.file_path, views)
        require_camera(view not in cameras, where, f"one frame called {view}", "two")
        lens = _lens_of(where, frame, record)
        # ``from_na`` of NeuS2 means axes right, down, forward.
        to_world = _pose_of(where, frame) @ (np.eye(4) if record.from_na else _OPENGL)
        cameras[view] = _camera_of(where, lens, to_world, functools.partial(sizes, view))
    require_known_names(
        path, names - {*_Transforms.__struct_fields__, *_Frame.__struct_fields__, *_IRRELEVANT}
    )
    return cameras


_MATRIX = ("fl_x", "fl_y", "cx", "cy")
_FOCAL = ("fl_x", "fl_y", "intrinsic_matrix", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov")
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")


def _lens_of(where: str, frame: Any, record: Any) -> dict[str, Any]:
    """Collect the fields of a frame's lens. Fields of the whole file are defaults.

    If a frame has a field for the focal length, all fields of the file for the focal length are ignored. The same rule
    applies to distortion coefficients. ``intrinsic_matrix`` is converted to focal lengths and principal point.

    Raises:
        PolarguideError: ``intrinsic_matrix`` is invalid, or other fields specify the intrinsics again.
    """
    lens = {name: getattr(frame, name) for name in _LENS}
    groups = (_FOCAL, (*_COEFFICIENTS, "distortion_params"))
    stated = {name for names in groups if any(lens[n] is not None for n in names) for name in names}
    used = {
        name: getattr(record, name) if own is None and name not in stated else own
        for name, own in lens.items()
    }
    if used["intrinsic_matrix"] is None:
        return used
    others = [name for name in (*_FOCAL, *_MATRIX) if name != "intrinsic_matrix" and used[name] is not None]
    require_camera(not others, where, "intrinsic_matrix alone", f"also {', '.join(others)}")
    inner = checked_intrinsics(where, used["intrinsic_matrix"])
    numbers = (inner[0, 0], inner[1, 1], inner[0, 2], inner[1, 2])
    return used | dict(zip(_MATRIX, map(float, numbers), strict=True))


def _pose_of(where: str, frame: _Frame) -> Any:
    """Return the matrix from camera to world, [4, 4], with the axes of the file."""
    matrices = [
        matrix
        for matrix in (frame.transform_matrix, frame.transform_matrix_start, frame.transform_matrix_end)
        if matrix is not None
    ]
    numbers = [finite_numbers(where, matrix, POSE_SHAPES)[:3] for matrix in matrices or [[]]]
    require_camera(
        all(np.allclose(numbers[0], other) for other in numbers[1:]),
        where,
        "a camera that does not move",
        "transform_matrix_start and transform_matrix_end that differ",
    )
    return np.vstack([numbers[0], [0, 0, 0, 1]])


def _camera_of(
    where: str, lens: Mapping[str, Any], to_world: Any, sizes: Callable[[], Sequence[Size]]
) -> PosedCamera:
    fisheye = _is_fisheye(where, lens)
    coefficients = _distortion(where, lens, fisheye)
    center = (lens["cx"], lens["cy"])
    size = _stated_size(where, lens)
    if size is None:
        in_pixels = lens["fl_x"] is not None or lens["fl_y"] is not None
        size = settled_size(where, sizes(), center, in_pixels=in_pixels)
    focal = _focal_lengths(where, lens, size, fisheye)
    middle = [size[k] / 2 if center[k] is None else float(center[k]) for k in range(2)]
    inner = (*focal, *middle)
    return camera_to_world(
        where,
        size,
        (_FISHEYE, (*inner, *coefficients)) if fisheye else brown_camera(inner, coefficients),
        to_world,
    )


def _is_fisheye(where: str, lens: Mapping[str, Any]) -> bool:
    """Return True if the lens is a fisheye lens of OpenCV, and False if it is a perspective lens.

    Raises:
        PolarguideError: the lens is of another kind, such as a panorama, or two fields contradict each other.
    """
    model = lens["camera_model"]
    expected = f"a camera of {', '.join(_PERSPECTIVE)} or {_FISHEYE}"
    for name in ("latlong", "equirectangular", "ftheta_p0", "fisheye_crop_radius", "k5", "k6"):
        require_camera(not lens[name], where, expected, f"{name} {lens[name]}")
    require_camera(
        not (any(lens["rolling_shutter"] or ()) or lens["rolling_shutter_time"]),
        where,
        "a shutter that opens for all rows at once",
        "rolling_shutter",
    )
    require_camera(model is None or model in (*_PERSPECTIVE, _FISHEYE), where, expected, model)
    require_camera(
        lens["is_fisheye"] is None or model is None or lens["is_fisheye"] == (model == _FISHEYE),
        where,
        "camera_model and is_fisheye that agree",
        f"{model} with is_fisheye {str(lens['is_fisheye']).lower()}",
    )
    return bool(lens["is_fisheye"]) or model == _FISHEYE


def _distortion(where: str, lens: Mapping[str, Any], fisheye: bool) -> list[float]:
    """Return the distortion coefficients: k1, k2, p1, p2 and k3 of a perspective camera, or k1 to k4 of a fisheye.

    Raises:
        PolarguideError: the lens has other coefficients, or two fields for a coefficient differ.
    """
    coefficients = [lens[name] for name in _COEFFICIENTS]
    value = [float(number or 0.0) for number in coefficients]
    params = lens["distortion_params"]
    if params is not None:
        require_camera(
            len(params) == len(_COEFFICIENTS),
            where,
            "six distortion_params: k1, k2, k3, k4, p1, p2",
            f"{len(params)} numbers",
        )
        require_camera(
            all(own is None or own == other for own, other in zip(coefficients, params, strict=True)),
            where,
            "distortion_params that agree with k1 to p2",
            f"{params} and {dict(zip(_COEFFICIENTS, coefficients, strict=True))}",
        )
        value = [float(number) for number in params]
    k1, k2, k3, k4, p1, p2 = value
    if fisheye:
        require_camera(not (p1 or p2), where, "a fisheye with k1 to k4 alone", f"p1 = {p1:g}, p2 = {p2:g}")
        return [k1, k2, k3, k4]
    require_camera(
        not k4, where, "a perspective camera with at most three radial coefficients", f"k4 = {k4:g}"
    )
    return [k1, k2, p1, p2, k3]


def _stated_size(where: str, lens: Mapping[str, Any]) -> tuple[int, int] | None:
    """Return the width and height that a file states. Return None if it states no size.

    Raises:
        PolarguideError: the file states only width or only height, or the size is invalid.
    """
    width = lens["w"]
    height = lens["h"]
    if width is None and height is None:
        return None
    require_camera(
        width and height and 0 < width < 1e5 and 0 < height < 1e5,
        where,
        "width and height, w and h",
        f"{width} and {height}",
    )
    return round(width), round(height)


def _focal_lengths(
    where: str, lens: Mapping[str, Any], size: tuple[int, int], fisheye: bool
) -> tuple[float, float]:
    """Return the focal lengths in x and y in pixels.

    The file may state focal lengths in pixels, or angles of view in radians or degrees.

    Raises:
        PolarguideError: a value is not positive, all values are missing, or two values contradict each other.
    """
    lengths: list[float | None] = []
    for axis, side in zip("xy", size, strict=True):
        length = lens[f"fl_{axis}"]
        angle = lens[f"camera_angle_{axis}"]
        degrees = lens[f"{axis}_fov"]
        angles = [*([angle] if angle else []), *([math.radians(degrees)] if degrees else [])]
        by_angle = [side / 2 / math.tan(view / 2) for view in angles if 0 < view < math.pi]
        require_camera(
            len(by_angle) == len(angles) and (length is None or length > 0),
            where,
            f"a positive focal length fl_{axis}, or an angle below 180 degrees",
            str(length),
        )
        stated = [*([float(length)] if length is not None else []), *([] if fisheye else by_angle)]
        if stated and max(stated) > (1 + _SAME_FOCAL) * min(stated):
            others = " and ".join(f"{one:.6g}" for one in stated)
            raise wrong_camera(
                where,
                f"fl_{axis} that agrees with camera_angle_{axis} and the width or height of {side}",
                f"focal lengths of {others} pixels",
            )
        lengths.append(stated[0] if stated else None)
    x, y = lengths
    require_camera(x is not None or y is not None, where, "a focal length, fl_x or camera_angle_x", "none")
    return float(x or y or 0.0), float(y or x or 0.0)


def brown_camera(inner: Sequence[float], coefficients: Sequence[float]) -> tuple[str, tuple[float, ...]]:
    """Return the name and the parameters of COLMAP's camera model for a perspective camera.

    Args:
        inner: focal lengths and principal point.
        coefficients: OpenCV's k1, k2, p1, p2 and k3.
    """
    if not any(coefficients):
        return "PINHOLE", tuple(inner)
    return "FULL_OPENCV", (*inner, *coefficients, 0.0, 0.0, 0.0)


def camera_to_world(
    where: str, size: tuple[int, int], lens: tuple[str, tuple[float, ...]], to_world: Any
) -> PosedCamera:
    """Create a camera from its pose in the world.

    Args:
        where: file and camera that an error message names.
        size: width and height.
        lens: name of COLMAP's camera model, and its parameters. The center of the first pixel is at (0.5, 0.5).
        to_world: matrix from the camera to the world for camera axes right, down, forward, [4, 4]. Its scale is
            removed.

    Raises:
        PolarguideError: the matrix is not a pose.
    """
    scale = abs(np.linalg.det(to_world[:3, :3])) ** (1 / 3)
    require_camera(1e-6 < scale < 1e6, where, "a rotation and a translation", "a singular matrix")
    axes, center = checked_pose(where, np.column_stack([to_world[:3, :3] / scale, to_world[:3, 3]]))
    rotation = axes.T
    return PosedCamera(*size, *lens, rotation, -rotation @ center)


SUFFIXES = (".json", ".xml", ".npz")
"""Suffixes of pose files."""
TEST = "test"
"""Name of the part of a dataset that is held out."""


def parts_of_poses(folder: Path) -> dict[str, Path]:
    """Find the pose files of a folder, and return them by part of the dataset.

    A folder has one file ``transforms.json``, or a file for each part, as in the synthetic scenes of NeRF:
    ``transforms_train.json``, ``transforms_val.json`` and ``transforms_test.json``.
    """
    single = folder / "transforms.json"
    if single.is_file():
        return {"all": single}
    parts = {part: folder / f"transforms_{part}.json" for part in ("train", "val", TEST)}
    return {part: path for part, path in parts.items() if path.is_file()}


def read_parts(
    parts: Mapping[str, Path], views: Sequence[str], sizes: Sizes
) -> tuple[dict[str, PosedCamera], tuple[str, ...]]:
    """Read the cameras of several pose files.

    Returns:
        The cameras by view name, and the names of the views in the part "test".

    Raises:
        PolarguideError: a file is invalid (see ``read_pose_file``), or two files have a camera for the same view.
    """
    cameras: dict[str, PosedCamera] = {}
    tests: tuple[str, ...] = ()
    for part, path in parts.items():
        part_cameras = read_pose_file(path, views, sizes)
        duplicates = sorted(cameras.keys() & part_cameras.keys())
        require(
            not duplicates,
            path,
            expected="frames that no other part has (names of views are compared without folders)",
            found=f"{listed(duplicates)} again",
            remedy="Rename the pictures of each part, also in the pose files.",
        )
        cameras |= part_cameras
        tests = tuple(sorted(part_cameras)) if part == TEST else tests
    return cameras, tests


def read_pose_file(path: Path, views: Sequence[str], sizes: Sizes) -> dict[str, PosedCamera]:
    """Read the cameras of a pose file by view name.

    Args:
        path: ``.json`` of nerfstudio, instant-ngp or Blender, ``.xml`` of Metashape, or ``.npz`` with ``world_mat_<i>``
            and ``scale_mat_<i>`` (IDR).
        views: names of the views, sorted.
        sizes: possible sizes of a view's camera for files without a size.

    Raises:
        PolarguideError: the file cannot be read, or has no camera for any of the views.
    """
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return _idr(path, views, sizes)
    names = frozenset(views)
    cameras = read_metashape(path, names) if suffix == ".xml" else read_transforms(path, names, sizes)
    require(
        cameras,
        path,
        expected="cameras with a pose",
        found="none",
        remedy="Align the pictures and export the cameras again.",
    )
    return cameras


def _idr(path: Path, views: Sequence[str], sizes: Sizes) -> dict[str, PosedCamera]:
    """Read the cameras of a file of IDR, and match them with views.

    If there are as many cameras as views, they are matched in their order. Otherwise, they are matched by number.

    Raises:
        PolarguideError: the match is ambiguous.
    """
    cameras = read_projections(path).cameras
    numbered = numbered_views(set(views))
    named = len(numbered) == len(views)
    order = sorted(views, key=lambda view: numbered[view]) if named else sorted(views)
    in_order = dict(zip(order, sorted(cameras), strict=False))
    # With equal counts the order decides, and numbers may begin with 0 or 1.
    offsets = {number - in_order[view] for view, number in numbered.items() if view in in_order}
    if len(cameras) == len(views) and len(offsets) <= 1:
        chosen = in_order
    elif named and min(cameras) == min(numbered.values()) and set(numbered.values()) <= set(cameras):
        chosen = numbered
    else:
        raise PolarguideError(
            path,
            expected=f"as many cameras as views, {len(views)}, or a camera with the number of each view",
            found=f"{len(cameras)} cameras, world_mat_{min(cameras)} to world_mat_{max(cameras)}",
            remedy="Number the views like the cameras (view 7 has world_mat_7), or remove cameras without a view.",
        )
    posed = {}
    for view, number in chosen.items():
        inner, *pose = cameras[number]
        center = (float(inner[0, 2]), float(inner[1, 2]))
        size = settled_size(f"{path} (world_mat_{number})", sizes(view), center, in_pixels=True)
        posed[view] = pinhole_camera(size, inner, *pose)
    return posed


_LARGEST_XML = 1 << 24
_METASHAPE_LENS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
_LARGEST_SKEW = 0.25
"""Largest shift in pixels at the edge of a picture that an ignored skew may cause.

The conventions for pixel centers differ by half a pixel, which is more.
"""
_EQUIDISTANT = ("fisheye", "equidistant_fisheye")
"""Names of an equidistant fisheye lens in Metashape before version 2.3, and since this version."""
_OFF = ("", "0", "false", "none", "disabled")
_METASHAPE_FIELDS = {
    "sensor": {"resolution", "calibration", "rolling_shutter"},
    "calibration": {"resolution", *_METASHAPE_LENS},
    "camera": {"transform", "rolling_shutter"},
}
# Known elements that do not affect cameras: bands, exposures, accuracies, GPS, and the placement of the chunk.
# ``orientation`` is for display only; pose and calibration refer to the stored pixels.
_METASHAPE_IRRELEVANT = {
    "sensor": {
        "property", "bands", "data_type", "covariance", "meta", "fixed", "fixed_params", "fixed_calibration",
        "black_level", "sensitivity", "normalize_sensitivity", "normalize_to_float", "vignetting",
        "user_calib", "photogrammetry_params", "location", "rotation", "location_covariance",
        "rotation_covariance", "reference", "planes",
    },
    "calibration": {"date"},
    "camera": {
        "orientation", "reference", "rotation_covariance", "location_covariance", "meta", "photo", "image",
        "layer_index", "label",
    },
}  # fmt: skip


def read_metashape(path: Path, views: Collection[str]) -> dict[str, PosedCamera]:
    """Read the cameras of an XML file of Metashape. The label of a camera determines its view.

    Args:
        path: path of the file.
        views: names of the capture's views.

    Raises:
        PolarguideError: the file cannot be read, its cameras have several coordinate frames, or a lens is unsupported.
    """
    chunk = _chunk(path, _parsed(path))
    cameras = list(chunk.iter("camera"))
    enabled = [camera for camera in cameras if camera.get("enabled", "true") not in _OFF]
    # Cameras without a label have no picture.
    posed = [camera for camera in enabled if camera.get("label") and camera.findtext("transform") is not None]
    _require_one_component(path, chunk, posed)
    if len(enabled) < len(cameras):
        _warn(path, f"{len(cameras) - len(enabled)} disabled cameras, which are ignored")
    slaves = [camera for camera in enabled if camera.get("master_id") and camera not in posed]
    if slaves:
        labels = listed([camera.get("label") or "" for camera in slaves])
        _warn(path, f"{len(slaves)} cameras of a rig without a pose, which are ignored ({labels})")
    sensors = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
    world_cameras: dict[str, PosedCamera] = {}
    for camera in posed:
        label = camera.get("label") or ""
        where = f"{path} (camera {label})"
        view = view_of_name(label, views)
        sensor = sensors.get(camera.get("sensor_id"))
        if sensor is None:
            raise wrong_camera(where, "the sensor of its sensor_id", "none")
        require_camera(view not in world_cameras, where, f"one camera called {view}", "two")
        _require_known(path, camera, sensor)
        text = camera.findtext("transform") or ""
        numbers = finite_numbers(where, [number_or_nan(part) for part in text.split()], ((16,),))
        size, lens = _metashape_lens(where, sensor)
        world_cameras[view] = camera_to_world(where, size, lens, numbers.reshape(4, 4))
    return world_cameras


def _warn(path: Path, text: str) -> None:
    warnings.warn(f"{path.name} has {text}.", PolarguideWarning, stacklevel=3)


def _chunk(path: Path, root: ElementTree.Element) -> ElementTree.Element:
    """Return the chunk whose cameras have poses. There must be one only, because each chunk has its own world axes.

    Raises:
        PolarguideError: several chunks have poses.
    """
    chunks = [
        chunk
        for chunk in root.iter("chunk")
        if any(camera.findtext("transform") is not None for camera in chunk.iter("camera"))
    ]
    if len(chunks) > 1:
        labels = listed([chunk.get("label") or "" for chunk in chunks])
        raise PolarguideError(
            path,
            expected="cameras of one chunk, which are in one frame",
            found=f"{len(chunks)} chunks ({labels})",
            remedy="Export only the chunk of these pictures, or align and merge the chunks first.",
        )
    return chunks[0] if chunks else root


def _require_one_component(
    path: Path, chunk: ElementTree.Element, posed: Sequence[ElementTree.Element]
) -> None:
    """Refuse cameras of several components, whose relative poses are unknown.

    Raises:
        PolarguideError: the cameras have several components.
    """
    counts = Counter(camera.get("component_id") or "none" for camera in posed)
    if len(counts) > 1:
        labels = {component.get("id"): component.get("label") for component in chunk.iter("component")}
        raise PolarguideError(
            path,
            expected="cameras of one component, which are in one frame",
            found=listed(
                [f"{labels.get(number) or number} with {count}" for number, count in counts.items()]
            ),
            remedy="Align the components with one another in Metashape, or reset the others.",
        )


def _require_known(path: Path, camera: ElementTree.Element, sensor: ElementTree.Element) -> None:
    """Refuse a rolling shutter, and warn about unknown elements.

    Raises:
        PolarguideError: the camera has a rolling shutter.
    """
    for element in (camera, sensor):
        for shutter in element.iter("rolling_shutter"):
            require_camera(
                (shutter.text or "").strip().lower() in _OFF and not len(shutter),
                f"{path} ({element.tag} {element.get('label')})",
                "a shutter that opens for all rows at once",
                "rolling_shutter",
            )
    for kind, elements in (
        ("camera", [camera]),
        ("sensor", [sensor]),
        ("calibration", sensor.findall("calibration")),
    ):
        names = {child.tag for element in elements for child in element}
        require_known_names(path, names - _METASHAPE_FIELDS[kind] - _METASHAPE_IRRELEVANT[kind])


def _metashape_lens(where: str, sensor: Any) -> tuple[tuple[int, int], tuple[str, tuple[float, ...]]]:
    """Convert a sensor of Metashape to a camera model of COLMAP. An adjusted calibration takes precedence.

    The coefficients p1 and p2 of Metashape are p2 and p1 of OpenCV and COLMAP. The polynomial of a frame camera is a
    function of the tangent of the angle from the axis. That of a fisheye is a function of the angle itself.

    Returns:
        The width and height; and the name and the parameters of COLMAP's camera model.

    Raises:
        PolarguideError: the type of the lens is unsupported, or COLMAP's model lacks one of its terms.
    """
    calibrations = sensor.findall("calibration")
    best = next(iter([c for c in calibrations if c.get("class") == "adjusted"] or calibrations), None)
    kinds = {sensor.get("type", "frame"), *([] if best is None else [best.get("type", "frame")])}
    fisheye = kinds <= set(_EQUIDISTANT)
    require_camera(
        kinds == {"frame"} or fisheye,
        where,
        f"a camera of the type frame, {' or '.join(_EQUIDISTANT)}",
        f"a {' and '.join(sorted(kinds - {'frame'}))} camera",
    )
    resolution = None if best is None else best.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if best is None or resolution is None or best.findtext("f") is None:
        raise wrong_camera(where, "a calibrated sensor with a resolution and a focal length f", "none")
    numbers = finite_numbers(
        where, [number_or_nan(best.findtext(n, "0")) for n in _METASHAPE_LENS], ((len(_METASHAPE_LENS),),)
    )
    value = {name: float(number) for name, number in zip(_METASHAPE_LENS, numbers, strict=True)}
    width, height = (number_or_nan(resolution.get(side, "0")) for side in ("width", "height"))
    require_camera(
        1 <= width < 1e5 and 1 <= height < 1e5 and value["f"] > 0,
        where,
        "a size and a positive focal length",
        f"{width:g}x{height:g}, f = {value['f']:g}",
    )
    _require_terms(where, value, height, ("p3", "p4") if fisheye else ("k4", "p3", "p4"))
    inner = (value["f"] + value["b1"], value["f"], width / 2 + value["cx"], height / 2 + value["cy"])
    size = (int(width), int(height))
    terms = [value[name] for name in ("k1", "k2", "p2", "p1", "k3")]
    if fisheye:
        return size, ("THIN_PRISM_FISHEYE", (*inner, *terms, value["k4"], 0.0, 0.0))
    return size, brown_camera(inner, terms)


def _require_terms(where: str, value: Mapping[str, float], height: float, others: Sequence[str]) -> None:
    """Refuse a lens with a term that COLMAP's model lacks, such as a coefficient in ``others`` or a large skew.

    Raises:
        PolarguideError: the lens has such a term.
    """
    skew = abs(value["b2"]) * height / 2 / value["f"]
    present = [name for name in others if value[name]] + ["b2"] * (skew > _LARGEST_SKEW)
    if present:
        terms = [name for name in _METASHAPE_LENS if name not in (*others, "b2")]
        raise PolarguideError(
            where,
            expected=f"a lens with {listed(terms, len(terms))}",
            found=", ".join(f"{name} = {value[name]:g}" for name in present),
            remedy="Optimize the cameras in Metashape without these terms, and export them again.",
        )


def _parsed(path: Path) -> ElementTree.Element:
    """Parse Metashape's XML. Entities are refused."""
    data = read_file(path, largest=_LARGEST_XML)
    found = "something else"
    # Encodings with zero bytes, such as UTF-16, could hide entities.
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
