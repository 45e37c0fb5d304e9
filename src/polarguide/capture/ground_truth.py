"""Read ground-truth files, ``gt/<view>.npz``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from polarguide.capture import box_filter as boxes
from polarguide.capture.formats.arrays import BROKEN, unpacked
from polarguide.capture.objects import LARGEST_ID
from polarguide.capture.view import GroundTruth
from polarguide.errors import PolarguideError

_CHANNELS = {"normal": 3, "depth": 0, "mask": 0, "specular": 3, "diffuse": 3, "objid": 0}

_NOT_NEGATIVE = ("depth", "specular", "diffuse")
_ROUNDING = 1e-3  # of differences of what was rendered
_LARGEST_NUMBER = 16  # bytes
_LARGEST = 1e18  # its square still is a number in single precision


def read_ground_truth(path: Path, data: bytes, *, size: tuple[int, int], factor: int) -> GroundTruth:
    """Read one ground-truth file.

    Args:
        path: of the file, for messages.
        data: the whole file, NumPy's .npz with any of the arrays ``normal``, ``depth``, ``mask``,
            ``specular``, ``diffuse`` and ``objid``; others are ignored.
        size: height and width of the pictures as stored.
        factor: side of the boxes to average. Normals are averaged and brought back to unit length; a pixel is
            foreground only where its whole box is, has a depth only where its whole box has, and shows an object only
            where its whole box does.

    Raises:
        PolarguideError: the file cannot be read, an array has another size, or values are not finite.
    """
    arrays = _read_arrays(path, data, size)
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


def _read_arrays(path: Path, data: bytes, size: tuple[int, int]) -> dict[str, NDArray[Any]]:
    try:
        return unpacked(data, _CHANNELS, _LARGEST_NUMBER * max(3, *_CHANNELS.values()) * size[0] * size[1])
    except BROKEN as error:
        raise PolarguideError(
            path,
            expected="a NumPy .npz file with normal, depth, mask, specular, diffuse or objid",
            found="a damaged, truncated or other file",
            remedy="Write it again with numpy.savez_compressed, or remove it.",
        ) from error


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
            remedy="Write zeros where the value is unknown and exclude those pixels from the mask.",
        )
