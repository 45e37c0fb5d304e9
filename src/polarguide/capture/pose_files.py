"""Cameras from files of other programs: nerfstudio's ``transforms.json``, Metashape's ``cameras.xml``, IDR's .npz.

Metashape's poses are in the frame of a chunk, its calibrations count from the middle of the picture; elements and their
meaning: docs/reference/formats.md has each.
"""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from polarguide.capture.colmap.model import PosedCamera, view_of_name
from polarguide.capture.datasets.dataset import pinhole_camera, read_projections, require_known_names
from polarguide.capture.formats.arrays import finite_numbers, wrong_camera
from polarguide.capture.transforms_file import (
    Sizes,
    brown_camera,
    camera_to_world,
    read_transforms,
    settled_size,
)
from polarguide.capture.view import listed
from polarguide.core.errors import PolarguideError, PolarguideWarning
from polarguide.core.files import read_file
from polarguide.core.text import number_or_nan

SUFFIXES = (".json", ".xml", ".npz")


TEST = "test"


def parts_of_poses(folder: Path) -> dict[str, Path]:
    """The pose files of a folder as NeRF's synthetic scenes have them: ``transforms_train.json`` and those of other
    parts by part, or ``transforms.json`` as the only one.
    """
    whole = folder / "transforms.json"
    if whole.is_file():
        return {"all": whole}
    parts = {part: folder / f"transforms_{part}.json" for part in ("train", "val", TEST)}
    return {part: path for part, path in parts.items() if path.is_file()}


def read_parts(
    parts: Mapping[str, Path], views: Sequence[str], sizes: Sizes
) -> tuple[dict[str, PosedCamera], tuple[str, ...]]:
    """Cameras by view name from several files, and the views of the test part.

    Raises:
        PolarguideError: as ``read_pose_file``, or two files have a camera of one view.
    """
    cameras: dict[str, PosedCamera] = {}
    tests: tuple[str, ...] = ()
    for part, path in parts.items():
        of_part = read_pose_file(path, views, sizes)
        twice = sorted(cameras.keys() & of_part.keys())
        if twice:
            raise PolarguideError(
                path,
                expected="frames that no other part has, as names of views are compared without folders",
                found=f"{listed(twice)} again",
                remedy="Give the pictures of each part names of their own, in the files of poses, too.",
            )
        cameras |= of_part
        tests = tuple(sorted(of_part)) if part == TEST else tests
    return cameras, tests


def read_pose_file(path: Path, views: Sequence[str], sizes: Sizes) -> dict[str, PosedCamera]:
    """Cameras by view name.

    Args:
        path: ``.json`` of nerfstudio, instant-ngp or Blender, ``.xml`` of Metashape, or ``.npz`` with ``world_mat_<i>``
            and ``scale_mat_<i>`` (IDR).
        views: names of the views, sorted.
        sizes: what a view's camera may have been made for, where the file does not say.

    Raises:
        PolarguideError: the file cannot be read, or describes no camera of these views.
    """
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return _idr(path, views, sizes)
    names = frozenset(views)
    cameras = read_metashape(path, names) if suffix == ".xml" else read_transforms(path, names, sizes)
    if not cameras:
        raise PolarguideError(
            path,
            expected="cameras with a pose",
            found="none",
            remedy="Align the pictures and export the cameras again.",
        )
    return cameras


def _idr(path: Path, views: Sequence[str], sizes: Sizes) -> dict[str, PosedCamera]:
    """Cameras by number: of the views called so, or of the views in their order where there are as many.

    Raises:
        PolarguideError: the file does not say which camera is whose.
    """
    cameras = read_projections(path).cameras
    numbered = {view: int(view) for view in views if view.isascii() and view.isdigit() and len(view) < 7}
    named = len(numbered) == len(views)
    order = sorted(views, key=lambda view: numbered[view]) if named else sorted(views)
    in_order = dict(zip(order, sorted(cameras), strict=False))
    # As many of both: the order holds, whether numbers begin with 0 or 1.
    offsets = {number - in_order[view] for view, number in numbered.items() if view in in_order}
    if len(cameras) == len(views) and len(offsets) <= 1:
        chosen = in_order
    elif named and min(cameras) == min(numbered.values()) and set(numbered.values()) <= set(cameras):
        chosen = numbered
    else:
        raise PolarguideError(
            path,
            expected=f"as many cameras as views, {len(views)}, or one of the number of every view",
            found=f"{len(cameras)} cameras, world_mat_{min(cameras)} to world_mat_{max(cameras)}",
            remedy="Number the views as the cameras are: view 7 has world_mat_7. Or leave out cameras without a view.",
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
# Pixels by which skew may move those at the edge of the picture: less than what two ways to count pixels differ by.
_LARGEST_SKEW = 0.25
# Fisheyes are equidistant, under their name since version 2.3.
_EQUIDISTANT = ("fisheye", "equidistant_fisheye")
_OFF = ("", "0", "false", "none", "disabled")
_METASHAPE_FIELDS = {
    "sensor": {"resolution", "calibration", "rolling_shutter"},
    "calibration": {"resolution", *_METASHAPE_LENS},
    "camera": {"transform", "rolling_shutter"},
}
# What these say changes no camera that is read: bands, exposures, accuracies, GPS, and what the chunk's frame is to the
# world. ``orientation`` is how Metashape displays a picture; pose and calibration are of the stored pixels.
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
    """Cameras by the views that their labels mean.

    Args:
        path: the file.
        views: names of the capture's views.

    Raises:
        PolarguideError: the file cannot be read, or its cameras are not all in one frame, or have another lens.
    """
    chunk = _chunk(path, _parsed(path))
    cameras = list(chunk.iter("camera"))
    enabled = [camera for camera in cameras if camera.get("enabled", "true") not in _OFF]
    # Cameras without a label are of no picture.
    posed = [camera for camera in enabled if camera.get("label") and camera.findtext("transform") is not None]
    _require_one_component(path, chunk, posed)
    if len(enabled) < len(cameras):
        _warn(path, f"{len(cameras) - len(enabled)} cameras that are not enabled, which are left out")
    slaves = [camera for camera in enabled if camera.get("master_id") and camera not in posed]
    if slaves:
        labels = listed([camera.get("label") or "" for camera in slaves])
        _warn(
            path, f"{len(slaves)} cameras of a rig without a pose of their own, which are left out ({labels})"
        )
    sensors = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
    world_cameras: dict[str, PosedCamera] = {}
    for camera in posed:
        label = camera.get("label") or ""
        where = f"{path} (camera {label})"
        view = view_of_name(label, views)
        sensor = sensors.get(camera.get("sensor_id"))
        if sensor is None:
            raise wrong_camera(where, "the sensor it names", "none")
        if view in world_cameras:
            raise wrong_camera(where, f"one camera called {view}", "two")
        _require_known(path, camera, sensor)
        text = camera.findtext("transform") or ""
        numbers = finite_numbers(where, [number_or_nan(part) for part in text.split()], ((16,),))
        size, lens = _metashape_lens(where, sensor)
        world_cameras[view] = camera_to_world(where, size, lens, numbers.reshape(4, 4))
    return world_cameras


def _warn(path: Path, text: str) -> None:
    warnings.warn(f"{path.name} has {text}.", PolarguideWarning, stacklevel=3)


def _chunk(path: Path, root: ElementTree.Element) -> ElementTree.Element:
    """The chunk whose cameras have poses; each has a frame of its own.

    Raises:
        PolarguideError: several have.
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
            remedy="Export the chunk of these pictures alone, or align and merge the chunks first.",
        )
    return chunks[0] if chunks else root


def _require_one_component(
    path: Path, chunk: ElementTree.Element, posed: Sequence[ElementTree.Element]
) -> None:
    """Refuse cameras that were aligned apart: how their components lie to one another is not known.

    Raises:
        PolarguideError: there are.
    """
    counts: dict[str, int] = {}
    for camera in posed:
        number = camera.get("component_id") or "none"
        counts[number] = counts.get(number, 0) + 1
    if len(counts) > 1:
        labels = {component.get("id"): component.get("label") for component in chunk.iter("component")}
        raise PolarguideError(
            path,
            expected="cameras of one component, which are in one frame",
            found=listed(
                [f"{labels.get(number) or number} with {count}" for number, count in counts.items()]
            ),
            remedy="Align the components with one another in Metashape, or reset those that are not wanted.",
        )


def _require_known(path: Path, camera: ElementTree.Element, sensor: ElementTree.Element) -> None:
    """Refuse a rolling shutter, and warn of elements that are not known.

    Raises:
        PolarguideError: the shutter is one.
    """
    for element in (camera, sensor):
        for shutter in element.iter("rolling_shutter"):
            if (shutter.text or "").strip().lower() not in _OFF or len(shutter):
                raise wrong_camera(
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
    """Size of a sensor, and COLMAP's model of its lens with parameters; the adjusted calibration goes first.

    Metashape's p1 bends along x, and so does p2 of OpenCV and COLMAP. Its fisheye distorts the angle from the axis by
    the same terms as a frame camera its tangent.

    Raises:
        PolarguideError: the lens is a panorama or another that is not read, or has terms that COLMAP's has not.
    """
    calibrations = sensor.findall("calibration")
    adjusted = [c for c in calibrations if c.get("class") == "adjusted"]
    best = next(iter(adjusted or calibrations), None)
    kinds = {sensor.get("type", "frame"), *([] if best is None else [best.get("type", "frame")])}
    fisheye = kinds <= set(_EQUIDISTANT)
    if kinds != {"frame"} and not fisheye:
        found = f"a {' and '.join(sorted(kinds - {'frame'}))} camera"
        raise wrong_camera(where, f"a camera of the type frame, {' or '.join(_EQUIDISTANT)}", found)
    resolution = None if best is None else best.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if best is None or resolution is None or best.findtext("f") is None:
        raise wrong_camera(where, "a calibrated sensor with a resolution and a focal length f", "none")
    numbers = finite_numbers(where, [number_or_nan(best.findtext(n, "0")) for n in _METASHAPE_LENS], ((len(_METASHAPE_LENS),),))
    value = {name: float(number) for name, number in zip(_METASHAPE_LENS, numbers, strict=True)}
    width, height = (number_or_nan(resolution.get(side, "0")) for side in ("width", "height"))
    if not (1 <= width < 1e5 and 1 <= height < 1e5 and value["f"] > 0):
        found = f"{width:g}x{height:g}, f = {value['f']:g}"
        raise wrong_camera(where, "a size and a positive focal length", found)
    _require_terms(where, value, height, ("p3", "p4") if fisheye else ("k4", "p3", "p4"))
    inner = (value["f"] + value["b1"], value["f"], width / 2 + value["cx"], height / 2 + value["cy"])
    names = ("k1", "k2", "p2", "p1", "k3")
    terms = [value[name] for name in names]
    if fisheye:
        return (int(width), int(height)), ("THIN_PRISM_FISHEYE", (*inner, *terms, value["k4"], 0.0, 0.0))
    return (int(width), int(height)), brown_camera(inner, terms)


def _require_terms(where: str, value: Mapping[str, float], height: float, others: Sequence[str]) -> None:
    """Refuse a lens with terms that its model does not have: ``others``, and a skew that moves pixels.

    Raises:
        PolarguideError: the lens has such a term.
    """
    skew = abs(value["b2"]) * height / 2 / value["f"]
    named = [name for name in others if value[name]] + ["b2"] * (skew > _LARGEST_SKEW)
    if named:
        terms = [name for name in _METASHAPE_LENS if name not in (*others, "b2")]
        raise PolarguideError(
            where,
            expected=f"a lens with {listed(terms, len(terms))}",
            found=", ".join(f"{name} = {value[name]:g}" for name in named),
            remedy="Optimize the cameras in Metashape without these terms, and export them again.",
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
