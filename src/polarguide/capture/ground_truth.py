"""The ground truth of views, ``gt/<view>.npz``, and the objects that it tells apart, in ``scene.json``."""

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
from polarguide.capture.formats.arrays import decode_arrays
from polarguide.core.errors import PolarguideError, require
from polarguide.core.records import decode

ROUGH = 0.15
"""GGX roughness above which a surface is called rough: its lobe is wider than some nine degrees to each side."""
LARGEST_ID = 65535
MaterialClass = Literal["metal", "rough metal", "dielectric", "rough dielectric", "matte"]
METAL_CLASSES: tuple[MaterialClass, ...] = ("metal", "rough metal")
METALS = ("metal", "conductor", "roughconductor")
DIELECTRICS = ("plastic", "pplastic", "roughplastic", "dielectric", "roughdielectric", "principled")
MATTE = ("matte", "diffuse")
_REMEDY = "Correct it, or remove objid from the ground truth: then errors are not told apart by object."


class Material(msgspec.Struct, frozen=True):
    """A surface as ``scene.json`` names it; what else it says is passed over.

    Attributes:
        type: such as "plastic" or "roughconductor". alpha: GGX roughness. ior: refractive index. k: extinction.
    """

    type: str = ""
    alpha: Annotated[float, msgspec.Meta(ge=0)] | None = None
    ior: Any = None
    k: Any = None

    @property
    def kind(self) -> MaterialClass | None:
        """The class that errors are told apart by; None where the table does not say enough.

        A metal has an extinction ``k`` or the type of one, a dielectric an index ``ior`` or the type of one. Either is
        rough if its ``alpha`` exceeds ``ROUGH``. Matte is what has no reflection of its own at all.
        """
        rough = self.alpha is not None and self.alpha > ROUGH
        if self.type in METALS or self.k is not None:
            return "rough metal" if rough else "metal"
        if self.type in DIELECTRICS or self.ior is not None:
            return "rough dielectric" if rough else "dielectric"
        return "matte" if self.type in MATTE else None


class SceneObject(msgspec.Struct, frozen=True):
    """An object of the scene.

    Attributes:
        id: its number in ``objid`` of the ground truth, from 1 up; 0 is no object.
        name: unique. foreground: whether it belongs to the mask. material: its surface.
    """

    id: Annotated[int, msgspec.Meta(ge=1, le=LARGEST_ID)]
    name: Annotated[str, msgspec.Meta(min_length=1)]
    foreground: bool = True
    material: Material = Material()


class _Scene(msgspec.Struct):
    """The fields of ``scene.json`` that are read."""

    objects: list[SceneObject] | None = None


def objects_of(path: Path, data: bytes) -> tuple[SceneObject, ...]:
    """The table of objects in ``scene.json``; empty if there is none.

    Args:
        path: ``scene.json``, for messages. data: its content.

    Raises:
        PolarguideError: an object has no number or name, or shares it with another.
    """
    objects = decode(data, _Scene, path, remedy=_REMEDY).objects or []
    for field in ("id", "name"):
        counts = Counter(getattr(item, field) for item in objects)
        twice, times = next(iter(counts.most_common(1)), (None, 0))
        require(
            times <= 1,
            f"{path} (objects)",
            expected=f"objects of which each has its own {field}",
            found=f"two with the {field} {twice}",
            remedy=_REMEDY,
        )
    return tuple(objects)


_CHANNELS = {"normal": 3, "depth": 0, "mask": 0, "specular": 3, "diffuse": 3, "objid": 0}

_NOT_NEGATIVE = ("depth", "specular", "diffuse")
_ROUNDING = 1e-3  # of differences of what was rendered
_LARGEST_NUMBER = 16  # bytes
_LARGEST_HEADERS = 1 << 18  # bytes
_LARGEST = 1e18  # its square still is a number in single precision


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """Ground truth of a view. Any field may be None.

    Attributes:
        normal: unit surface normals in the world, zero where there is no surface, [H, W, 3] float32.
        depth: camera z in world units, 0 where there is no surface or it is not known, [H, W] float32.
        mask: foreground, [H, W] bool.
        specular, diffuse: first-surface lobes as linear S0, in the exposure of the pictures, [H, W, 3]
            float32. Pictures are S0 / 2, so compare rendered layers with half of these.
        object_ids: which object each pixel shows, as ``SceneObject.id``; 0 for none, or several, [H, W] int32.
    """

    normal: Tensor | None = None
    depth: Tensor | None = None
    mask: Tensor | None = None
    specular: Tensor | None = None
    diffuse: Tensor | None = None
    object_ids: Tensor | None = None


def read_ground_truth(path: Path, data: bytes, *, size: tuple[int, int], factor: int) -> GroundTruth:
    """Read one ground-truth file.

    Args:
        path: path of the file, for messages.
        data: the whole file, NumPy's .npz with any of the arrays ``normal``, ``depth``, ``mask``,
            ``specular``, ``diffuse`` and ``objid``; others are ignored.
        size: height and width of the pictures as stored.
        factor: side of the boxes to average. Normals are averaged and brought back to unit length; a pixel is
            foreground only where its whole box is, has a depth only where its whole box has, and shows an object only
            where its whole box does.

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
        _check(path, name, array, size)
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


def _check(path: Path, name: str, array: NDArray[Any], size: tuple[int, int]) -> None:
    shape = (*size, _CHANNELS[name]) if _CHANNELS[name] else size
    if array.shape != shape or array.dtype.kind not in "biuf":
        raise PolarguideError(
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
            expected=f"whole numbers from 0 to {LARGEST_ID}, those of scene.json's objects",
            found=f"{array.dtype} from {array.min()} to {array.max()}",
            remedy="Write the numbers of the objects, and 0 where there is none.",
        )
    if array.dtype.kind not in "if":
        return
    if name in _NOT_NEGATIVE and bool((array < -_ROUNDING).any()):
        raise PolarguideError(
            f"{path} ({name})",
            expected="numbers of 0 or more",
            found=f"down to {array.min():g}",
            remedy="Depth counts along the camera's z axis, away from it; light is never negative.",
        )
    if array.dtype.kind != "f":
        return
    most = min(_LARGEST, float(np.finfo(array.dtype).max))
    broken = array.size - int(np.count_nonzero(np.abs(array) <= most))  # NaN is not
    if broken:
        raise PolarguideError(
            f"{path} ({name})",
            expected=f"finite numbers up to {_LARGEST:g}",
            found=f"{broken} of {array.size} values that are NaN, infinite or larger",
            remedy="Write 0 where the value is unknown or too large, and set those pixels of the mask to 0.",
        )
