"""The file of the analyzer vectors that ``polarguide calibrate`` writes: safetensors with a checksum over all of it."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from polarguide.capture.sensor.analyzers import (
    FARTHEST_ANGLE,
    LEAST_DIATTENUATION,
    AnalyzerCalibration,
    Reference,
    grid_shape,
)
from polarguide.capture.sensor.pattern import SENSORS
from polarguide.core.errors import PolarguideError
from polarguide.core.files import in_utf8, require_file, write_whole
from polarguide.core.records import decode

FORMAT = "polarguide-analyzers"
VERSION = 1
SUFFIX = ".safetensors"
MOST_THROUGHPUT = 1e3
_LONGEST_HEADER = 100_000_000  # bytes, by safetensors' format; text in their place is a larger number
_ENTRY = "polarguide"
_TENSOR = "vectors"
_REMEDY = "Calibrate again (polarguide calibrate), or copy the file again."

_Positive = Annotated[int, msgspec.Meta(ge=1, le=1 << 20)]
_NotNegative = Annotated[int, msgspec.Meta(ge=0, le=1 << 20)]


class _Metadata(msgspec.Struct, forbid_unknown_fields=True):
    """The one entry of metadata of the file."""

    format: str
    version: int
    sensor: str
    lens: str
    width: _Positive
    height: _Positive
    offset_x: _NotNegative
    offset_y: _NotNegative
    block: _Positive
    reference: Reference
    polarizer_extinction: float | None
    units: str
    sha256: str


UNITS = "intensity per Stokes component, (S0, S1, S2); an ideal polarizer has (1, cos 2p, sin 2p) / 2"


def is_analyzer_file(path: Path) -> bool:
    """Whether a file looks like one of analyzers rather than like JSON; False where it cannot be read."""
    try:
        if not path.is_file():  # opening a pipe would wait for somebody who writes to it
            return False
        with path.open("rb") as file:
            start = file.read(64)
    except OSError:
        return False
    return path.suffix.lower() == SUFFIX or (
        start[8:9] == b"{" and int.from_bytes(start[:8], "little") <= _LONGEST_HEADER
    )


def write_analyzers(path: Path, calibration: AnalyzerCalibration) -> str:
    """Write the file of a calibration, which is the same bytes for the same content; returns the checksum.

    Raises:
        PolarguideError: the file cannot be written.
    """
    vectors = np.ascontiguousarray(calibration.vectors, np.float32)
    metadata = _Metadata(
        FORMAT, VERSION, calibration.sensor, calibration.lens, *calibration.size, *calibration.offset,
        calibration.block, calibration.reference, calibration.polarizer_extinction, UNITS, "",
    )  # fmt: skip
    metadata.sha256 = _checksum(metadata, vectors)
    # One entry: safetensors writes several in any order.
    text = json.dumps(msgspec.to_builtins(metadata), ensure_ascii=False)
    write_whole(path, save({_TENSOR: vectors}, metadata={_ENTRY: text}))
    return metadata.sha256


def read_analyzers(path: Path) -> AnalyzerCalibration:
    """Read the file that ``polarguide calibrate`` wrote.

    Raises:
        PolarguideError: the file cannot be read, is cut short, damaged, or of another kind or version.
    """
    require_file(path, expected="a calibration of polarguide calibrate", remedy=_REMEDY)
    try:
        with in_utf8(path) as name, safe_open(name, framework="numpy") as file:
            entries = file.metadata() or {}
            names = list(file.keys())
            vectors = file.get_tensor(_TENSOR) if names == [_TENSOR] else None
    except (SafetensorError, ValueError, OSError, RuntimeError, TypeError) as error:
        raise _damaged(path, f"damaged or foreign data ({str(error)[:200]})") from None
    if _ENTRY not in entries or vectors is None:
        raise _damaged(path, "another safetensors file")
    metadata = decode(entries[_ENTRY].encode(), _Metadata, path, remedy=_REMEDY)
    if metadata.format != FORMAT or metadata.version != VERSION:
        raise _damaged(path, f"{metadata.format}, version {metadata.version}")
    if _checksum(metadata, vectors) != metadata.sha256:
        raise PolarguideError(
            path,
            expected=f"content with the checksum {metadata.sha256[:16]}...",
            found="other content: the file is damaged, or was changed",
            remedy=_REMEDY,
        )
    calibration = AnalyzerCalibration(
        metadata.sensor, metadata.lens, (metadata.offset_x, metadata.offset_y), (metadata.width, metadata.height),
        metadata.block, vectors, metadata.reference, metadata.polarizer_extinction, metadata.sha256,
    )  # fmt: skip
    _require_sound(path, calibration)
    return calibration


def _require_sound(path: Path, calibration: AnalyzerCalibration) -> None:
    """Refuse content that fits its checksum and still makes no sense.

    Raises:
        PolarguideError: an unknown sensor, vectors of another shape, or that no polarizer has.
    """
    if calibration.sensor not in SENSORS:
        raise _damaged(path, f"one of the sensor {calibration.sensor!r}, which is unknown")
    period = calibration.pattern.period
    shape = (*grid_shape(calibration.offset, calibration.size, calibration.block), period, period, 3)
    if (
        calibration.block % period
        or calibration.vectors.shape != shape
        or calibration.vectors.dtype != np.float32
    ):
        raise _damaged(
            path,
            f"vectors {list(calibration.vectors.shape)} of {calibration.vectors.dtype} instead of {list(shape)}",
        )
    gain = calibration.vectors[..., 0]
    if not (np.isfinite(calibration.vectors).all() and (gain > 0).all()):
        raise _damaged(path, "vectors that are not finite, or have no throughput")
    if gain.min() < 1 / MOST_THROUGHPUT or gain.max() > MOST_THROUGHPUT:
        throughputs = f"throughputs of {gain.min():g} to {gain.max():g}, whose mean is 1/2 in such a file"
        raise _damaged(path, throughputs)
    if (
        np.hypot(calibration.vectors[..., 1], calibration.vectors[..., 2]) < LEAST_DIATTENUATION * gain
    ).any():
        raise _damaged(path, "vectors of pixels that hardly polarize")
    nominal = 2 * np.radians(calibration.pattern.angles)
    angles = np.arctan2(calibration.vectors[..., 2], calibration.vectors[..., 1])
    # Four that are alike could not be solved for light.
    if (np.cos(angles - nominal) < np.cos(2 * FARTHEST_ANGLE)).any():
        raise _damaged(path, "vectors of polarizers far from the sensor's angles")


def _damaged(path: Path, found: str) -> PolarguideError:
    return PolarguideError(
        path,
        expected=f"a file that polarguide calibrate wrote (version {VERSION})",
        found=found,
        remedy=_REMEDY,
    )


def _checksum(metadata: _Metadata, vectors: NDArray[Any]) -> str:
    fields = {key: value for key, value in msgspec.to_builtins(metadata).items() if key != "sha256"}
    digest = hashlib.sha256(json.dumps(fields, ensure_ascii=False, sort_keys=True).encode())
    digest.update(f"{vectors.dtype.str} {vectors.shape}".encode())
    digest.update(np.ascontiguousarray(vectors).tobytes())
    return digest.hexdigest()
