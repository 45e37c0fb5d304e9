"""Read ground-truth files, ``gt/<view>.npz``."""

from __future__ import annotations

import io
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from polarguide.capture import box_filter as boxes
from polarguide.capture.view import GroundTruth
from polarguide.errors import PolarguideError

_CHANNELS = {"normal": 3, "depth": 0, "mask": 0, "specular": 3, "diffuse": 3}


def read_ground_truth(path: Path, data: bytes, *, size: tuple[int, int], factor: int) -> GroundTruth:
    """Read one ground-truth file.

    Args:
        path: of the file, for messages.
        data: the whole file, NumPy's .npz with any of the arrays ``normal``, ``depth``, ``mask``,
            ``specular`` and ``diffuse``; others are ignored.
        size: height and width of the pictures as stored.
        factor: side of the boxes to average. Normals are averaged and brought back to unit length; a pixel is
            foreground only where its whole box is.

    Raises:
        PolarguideError: the file cannot be read, an array has another size, or values are not finite.
    """
    arrays = _read_arrays(path, data)
    for name, array in arrays.items():
        _check(path, name, array, size)
    fields: dict[str, NDArray[Any]] = {}
    for name, array in arrays.items():
        if name == "mask":
            fields[name] = boxes.every(array.astype(bool), factor)
        elif name == "normal":
            fields[name] = boxes.unit_mean(boxes.unit_mean(array.astype(np.float32), 1), factor)
        else:
            fields[name] = boxes.mean(array.astype(np.float32), factor)
    return GroundTruth(
        **{name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in fields.items()}
    )


def _read_arrays(path: Path, data: bytes) -> dict[str, NDArray[Any]]:
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            return {name: archive[name] for name in _CHANNELS if name in archive.files}
    except (ValueError, TypeError, OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise PolarguideError(
            path,
            expected="a NumPy .npz file with normal, depth, mask, specular or diffuse",
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
    broken = int(np.count_nonzero(~np.isfinite(array)))
    if broken:
        raise PolarguideError(
            f"{path} ({name})",
            expected="finite numbers",
            found=f"{broken} of {array.size} values that are NaN or infinite",
            remedy="Write zeros where the value is unknown and exclude those pixels from the mask.",
        )
