"""Parse the optional files of a scene: ``split.json``, ``scene.json``, and ground truth in ``gt/<view>.npz``."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polarguide.capture import box_filter as boxes
from polarguide.capture.calibration import Calibration, Sense
from polarguide.capture.formats.pictures import MOST_MATERIAL, decode_arrays
from polarguide.core.errors import PolarguideError, require, unknown_view
from polarguide.core.records import decode
from polarguide.core.text import canonical
from polarguide.geometry.polarizer import ANGLES
from polarguide.optics import Mount

LEAST_INDEX = 1.0
LARGEST_INDEX = 4.0
# Smallest label in materials/ that stands for a dielectric whose refractive index is in scene.json.
FIRST_LISTED = 3
Index = Annotated[float, msgspec.Meta(gt=LEAST_INDEX, lt=LARGEST_INDEX)]


class _Split(msgspec.Struct):
    """Fields of ``split.json``. Unknown fields are ignored."""

    test: list[str]


class _Material(msgspec.Struct):
    ior: float | None = None


class _Object(msgspec.Struct):
    material: _Material | str | None = None


class _Dielectric(msgspec.Struct):
    """Entry of ``scene.json`` for a dielectric that has a number in ``materials/``."""

    refractive_index: Index


class _Materials(msgspec.Struct):
    """Table of materials in ``scene.json``."""

    materials: dict[str, _Dielectric] = {}


class _Scene(msgspec.Struct):
    """Fields of ``scene.json``. Unknown fields are ignored."""

    refractive_index: Index | None = None
    objects: list[_Object] = []
    prepare: Any = None
    sensor: Any = None
    pair_sums: Any = None
    corrections: Any = None


class _Polarizer(msgspec.Struct):
    """Field of ``scene.json`` for the place of the polarizer."""

    polarizer: Mount = "sensor"


class _Angles(msgspec.Struct, frozen=True):
    """Fields of ``scene.json`` for the calibration of the polarizer angles."""

    order: tuple[int, int, int, int] = ANGLES
    sense: Sense = "ccw"
    zero_degrees: float = 0.0


class _Prepared(msgspec.Struct):
    """Field of ``scene.json`` for the changes of the polarizer angles by ``prepare``."""

    calibration: _Angles = _Angles()


def held_out(path: Path, data: bytes, names: list[str]) -> tuple[str, ...]:
    """Read the names of the held-out views from ``split.json``, sorted.

    Args:
        path: path of ``split.json`` for messages.
        data: its content.
        names: all view names of the capture, sorted.

    Raises:
        PolarguideError: the split is invalid, has an unknown view, or leaves no training view.
    """
    remedy = 'List the names of the test views, {"test": ["<view>", ...]}, or remove the file.'
    test = [canonical(name) for name in decode(data, _Split, path, remedy=remedy).test]
    for name in test:
        if name not in names:
            raise unknown_view(f"{path} (test)", name, names)
    require(
        len(set(test)) < len(names),
        path,
        expected="at least one training view",
        found=f"all {len(names)} views in the test set",
        remedy="Remove test views from split.json, or add views.",
    )
    return tuple(sorted(set(test)))


def refractive_index_of(path: Path, data: bytes) -> float | None:
    """Return the refractive index in ``scene.json``, or None if the file does not state it.

    It is the field ``refractive_index``. Without this field, it is the field ``ior`` of the objects, if all of them
    have the same value.

    Args:
        path: path of ``scene.json`` for messages.
        data: its content.

    Raises:
        PolarguideError: ``refractive_index`` is not a number between 1 and 4.
    """
    scene = decode(data, _Scene, path, remedy="Correct it, or remove it to use the default.")
    if scene.refractive_index is not None:
        return scene.refractive_index
    materials = [item.material for item in scene.objects]
    indices = {item.ior for item in materials if isinstance(item, _Material) and item.ior is not None}
    index = indices.pop() if len(indices) == 1 else None
    return index if index is not None and LEAST_INDEX < index < LARGEST_INDEX else None


def indices_of(path: Path, data: bytes) -> dict[int, float]:
    """Return the refractive index of each dielectric that has a number in ``materials/``.

    The numbers start at 3. The indices are in the field ``materials`` of ``scene.json``, for example
    ``{"3": {"refractive_index": 1.33}}``.

    Args:
        path: path of ``scene.json`` for messages.
        data: its content.

    Raises:
        PolarguideError: a number or an index is out of range.
    """
    remedy = 'Write {"materials": {"3": {"refractive_index": 1.33}}}, or remove materials.'
    table = decode(data, _Materials, path, remedy=remedy).materials
    numbers = {str(number) for number in range(FIRST_LISTED, MOST_MATERIAL + 1)}
    for key in table:
        require(
            key in numbers,
            f"{path} (materials)",
            expected=f"numbers from {FIRST_LISTED} to {MOST_MATERIAL}",
            found=repr(key),
            remedy=remedy,
        )
    return {int(key): item.refractive_index for key, item in table.items()}


def mount_of(path: Path, data: bytes) -> Mount:
    """Return the place of the polarizer. It is the field ``polarizer`` of ``scene.json``, by default "sensor".

    Args:
        path: path of ``scene.json`` for messages.
        data: its content.

    Raises:
        PolarguideError: ``polarizer`` is not "sensor" or "filter".
    """
    return decode(
        data,
        _Polarizer,
        path,
        remedy='Write "sensor" for polarizers on the sensor, "filter" for a sheet in front of the lens.',
    ).polarizer


def keeps_gains(path: Path, data: bytes) -> bool:
    """Return True if the scene was prepared with ``--gains none``, so exposures must not be corrected.

    Args:
        path: path of ``scene.json`` for messages.
        data: its content.
    """
    prepared = decode(data, _Scene, path, remedy="Prepare the scene again.").prepare
    request = prepared.get("request") if isinstance(prepared, dict) else None
    settings = request.get("settings") if isinstance(request, dict) else None
    return isinstance(settings, dict) and settings.get("gains") == "none"


def merges_exposures(path: Path, data: bytes) -> bool:
    """Return True if the scene was prepared from exposure brackets, so most pixels may be above full scale.

    Args:
        path: path of ``scene.json`` for messages.
        data: its content.
    """
    prepared = decode(data, _Scene, path, remedy="Prepare the scene again.").prepare
    measured = prepared.get("measured") if isinstance(prepared, dict) else None
    return isinstance(measured, dict) and measured.get("bracketed") is True


def applied_calibration(path: Path, data: bytes) -> Calibration | None:
    """Return the order, sense and zero that ``prepare`` applied to the pictures of a scene.

    Args:
        path: path of ``scene.json`` for messages.
        data: its content.

    Returns:
        The calibration. It is ``None`` if the scene was not written by ``prepare``, or if its pictures were corrected
        later.

    Raises:
        PolarguideError: the calibration is invalid.
    """
    scene = decode(data, _Scene, path, remedy="Prepare the scene again.")
    if scene.prepare is None or scene.corrections:
        return None
    applied = decode(data, _Prepared, path, remedy="Prepare the scene again.").calibration
    return Calibration(order=applied.order, sense=applied.sense, zero=applied.zero_degrees)


Origin = Literal["mosaics", "stokes", "other"]


def origin_of(path: Path, data: bytes) -> Origin:
    """Return the kind of files from which a scene was prepared, such as mosaics or Stokes vectors of a dataset.

    Args:
        path: path of ``scene.json`` for messages.
        data: its content.
    """
    scene = decode(data, _Scene, path, remedy="Prepare the scene again.")
    if scene.prepare is None:
        return "other"
    if scene.pair_sums is not None:  # written with computed intensities
        return "stokes"
    return "mosaics" if isinstance(scene.sensor, str) else "other"


ROUGH = 0.15
"""GGX roughness above which a surface counts as rough. Its reflection is then wider than nine degrees to each side."""
LARGEST_ID = 65535
MaterialClass = Literal["metal", "rough metal", "dielectric", "rough dielectric", "matte"]
METAL_CLASSES: tuple[MaterialClass, ...] = ("metal", "rough metal")
METALS = ("metal", "conductor", "roughconductor")
DIELECTRICS = ("plastic", "pplastic", "roughplastic", "dielectric", "roughdielectric", "principled")
MATTE = ("matte", "diffuse")
_OBJECTS_REMEDY = "Correct it, or remove objid from the ground truth to score all objects together."


class Material(msgspec.Struct, frozen=True):
    """Material of an object in ``scene.json``. Unknown fields are ignored.

    Attributes:
        type: name of the material, such as "plastic" or "roughconductor".
        alpha: GGX roughness.
        ior: refractive index.
        k: extinction coefficient.
    """

    type: str = ""
    alpha: Annotated[float, msgspec.Meta(ge=0)] | None = None
    ior: Any = None
    k: Any = None

    @property
    def kind(self) -> MaterialClass | None:
        """Class of the material, by which scores are grouped. It is ``None`` if the fields do not determine it.

        A material is a metal if it has an extinction coefficient ``k``, or the type of a metal. It is a dielectric if
        it has a refractive index ``ior``, or the type of a dielectric. Both are rough if ``alpha`` exceeds ``ROUGH``. A
        matte material has no specular reflection.
        """
        rough = self.alpha is not None and self.alpha > ROUGH
        if self.type in METALS or self.k is not None:
            return "rough metal" if rough else "metal"
        if self.type in DIELECTRICS or self.ior is not None:
            return "rough dielectric" if rough else "dielectric"
        return "matte" if self.type in MATTE else None


class SceneObject(msgspec.Struct, frozen=True):
    """Object of a scene according to ``scene.json``.

    Attributes:
        id: number of the object in the array ``objid`` of the ground truth. It is at least 1; 0 means no object.
        name: name of the object, unique in the scene.
        foreground: True if the foreground mask includes the object.
        material: material of the surface.
    """

    id: Annotated[int, msgspec.Meta(ge=1, le=LARGEST_ID)]
    name: Annotated[str, msgspec.Meta(min_length=1)]
    foreground: bool = True
    material: Material = Material()


class _ObjectTable(msgspec.Struct):
    """Field of ``scene.json`` with the list of objects."""

    objects: list[SceneObject] | None = None


def objects_of(path: Path, data: bytes) -> tuple[SceneObject, ...]:
    """Return the objects that ``scene.json`` lists. The result may be empty.

    Args:
        path: path of ``scene.json`` for messages.
        data: its content.

    Raises:
        PolarguideError: an object has no number or name, or two objects have the same number or name.
    """
    objects = decode(data, _ObjectTable, path, remedy=_OBJECTS_REMEDY).objects or []
    for field in ("id", "name"):
        counts = Counter(getattr(item, field) for item in objects)
        value, times = next(iter(counts.most_common(1)), (None, 0))
        require(
            times <= 1,
            f"{path} (objects)",
            expected=f"a unique {field} of each object",
            found=f"{times} with the {field} {value}",
            remedy=_OBJECTS_REMEDY,
        )
    return tuple(objects)


_CHANNELS = {"normal": 3, "depth": 0, "mask": 0, "specular": 3, "diffuse": 3, "objid": 0}

_NOT_NEGATIVE = ("depth", "specular", "diffuse")
_ROUNDING = 1e-3  # rounding error of differences of rendered values
_LARGEST_NUMBER = 16  # bytes
_LARGEST_HEADERS = 1 << 18  # bytes
_LARGEST_TRUTH = 1e18  # its square is finite in single precision


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """Ground truth of a view, with which a trained scene is compared. Any field may be None.

    Attributes:
        normal: unit surface normals in the world, [H, W, 3] float32; zero at pixels without a surface.
        depth: camera z in world units, [H, W] float32; 0 at pixels without a surface or with unknown depth.
        mask: foreground mask, [H, W] bool.
        specular: specular reflection of the first surface as linear S0, [H, W, 3] float32. The scale is that of the
            pictures, which show ``S0 / 2``. A rendered layer is therefore compared with half of this value.
        diffuse: diffuse reflection of the first surface, in the same form as ``specular``.
        object_ids: ``SceneObject.id`` at each pixel, [H, W] int32; 0 at pixels with no object or several objects.
    """

    normal: Tensor | None = None
    depth: Tensor | None = None
    mask: Tensor | None = None
    specular: Tensor | None = None
    diffuse: Tensor | None = None
    object_ids: Tensor | None = None


def read_ground_truth(path: Path, data: bytes, *, size: tuple[int, int], factor: int) -> GroundTruth:
    """Parse a ground-truth file, and average its arrays over pixel boxes.

    Args:
        path: path of the file for messages.
        data: content of the ``.npz`` file. It may have the arrays ``normal``, ``depth``, ``mask``, ``specular``,
            ``diffuse`` and ``objid``. Other arrays are ignored.
        size: height and width of the stored pictures.
        factor: side of the boxes. Normals are averaged and normalized. A pixel of the result is foreground only if all
            pixels of its box are foreground. The same rule applies to its depth and its object.

    Raises:
        PolarguideError: the file cannot be read, an array has another size, or values are not finite.
    """
    arrays = decode_arrays(
        path,
        data,
        _CHANNELS,
        _LARGEST_NUMBER * sum(max(1, count) for count in _CHANNELS.values()) * size[0] * size[1]
        + _LARGEST_HEADERS,
        kinds="biufcSU",
        expected="a NumPy .npz file with normal, depth, mask, specular, diffuse or objid",
        remedy="Write it again with numpy.savez_compressed, or remove it.",
    )
    for name, array in arrays.items():
        _check_truth(path, name, array, size)
    fields: dict[str, NDArray[Any]] = {}
    for name, array in arrays.items():
        if name == "mask":
            fields[name] = boxes.every(array.astype(bool), factor)
        elif name == "normal":
            fields[name] = boxes.unit_mean(boxes.unit_mean(array.astype(np.float32), 1), factor)
        elif name == "depth":
            depth = array.astype(np.float32)
            fields[name] = np.where(boxes.every(depth > 0, factor), boxes.mean(depth, factor), np.float32(0))
        elif name == "objid":
            fields["object_ids"] = boxes.agreed(array.astype(np.int32), factor)
        else:
            fields[name] = boxes.mean(array.astype(np.float32), factor)
    return GroundTruth(
        **{name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in fields.items()}
    )


def _check_truth(path: Path, name: str, array: NDArray[Any], size: tuple[int, int]) -> None:
    """Check the size, the type and the values of an array of the ground truth."""
    shape = (*size, _CHANNELS[name]) if _CHANNELS[name] else size
    require(
        array.shape == shape and array.dtype.kind in "biuf",
        f"{path} ({name})",
        expected=f"an array of shape {list(shape)} like the pictures",
        found=f"{array.dtype} of shape {list(array.shape)}",
        remedy="Write the ground truth at the size of the pictures.",
    )
    if name == "objid" and (
        array.dtype.kind not in "iu" or not 0 <= array.min() <= array.max() <= LARGEST_ID
    ):
        raise PolarguideError(
            f"{path} (objid)",
            expected=f"whole numbers from 0 to {LARGEST_ID}, the ids of objects in scene.json",
            found=f"{array.dtype} from {array.min()} to {array.max()}",
            remedy="Write the ids of the objects, and 0 for pixels without an object.",
        )
    if array.dtype.kind not in "if":
        return
    if name in _NOT_NEGATIVE and bool((array < -_ROUNDING).any()):
        raise PolarguideError(
            f"{path} ({name})",
            expected="numbers of 0 or more",
            found=f"down to {array.min():g}",
            remedy="Depth is the distance along the camera's z axis; light is never negative.",
        )
    if array.dtype.kind != "f":
        return
    most = min(_LARGEST_TRUTH, float(np.finfo(array.dtype).max))
    broken = array.size - int(np.count_nonzero(np.abs(array) <= most))  # NaN compares False
    require(
        not broken,
        f"{path} ({name})",
        expected=f"finite numbers up to {_LARGEST_TRUTH:g}",
        found=f"{broken} of {array.size} values that are NaN, infinite or larger",
        remedy="Write 0 for unknown or too large values, and set these pixels of the mask to 0.",
    )
