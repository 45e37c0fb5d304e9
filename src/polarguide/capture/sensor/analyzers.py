"""Analyzer vectors of a polarization sensor, and the correction of intensities with them.

A pixel behind a polarizer measures ``I = a . (S0, S1, S2)`` of the linear Stokes vector; ``a`` is its analyzer vector,
``(1, cos 2p, sin 2p) / 2`` for an ideal polarizer at the angle p. ``polarguide calibrate`` estimates the vectors.
``AnalyzerCalibration.apply`` computes the intensities of ideal polarizers (the superpixel calibration of Powell and
Gruev, Optics Express 21(18), 2013).
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from polarguide.capture.sensor.pattern import SENSORS, Pattern, sensor_pattern
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import in_utf8, require_file, write_whole
from polarguide.core.records import decode

Array = NDArray[np.float32]


def correction_matrices(analyzers: list[Array], nominal: NDArray[Any]) -> Array:
    """Compute the matrix C that converts the four samples of each polarizer cell to those of ideal polarizers.

    ``C = W pinv(A) + n m^T``. A [4, 3] has the analyzer vectors of the samples, and W [4, 3] those of ideal polarizers.
    The unit vectors n and m are perpendicular to the columns of W and A. As a result, C A = W. If A is equal to W, C is
    the identity.

    Args:
        analyzers: four arrays [..., 3] with the analyzer vectors of the four samples of each cell.
        nominal: nominal angles of the samples in degrees.

    Returns:
        [4, 4, ...] float32.
    """
    u, v, w = ([a[..., component].astype(np.float32) for a in analyzers] for component in range(3))

    def dot(x: list[Any], y: list[Any]) -> Any:
        return x[0] * y[0] + x[1] * y[1] + x[2] * y[2] + x[3] * y[3]

    gram = [[dot(x, y) for y in (u, v, w)] for x in (u, v, w)]
    # The adjugate inverts A^T A, because LAPACK's calls would take seconds for millions of 3x3 matrices.
    adjugate = [
        [gram[i - 2][j - 2] * gram[i - 1][j - 1] - gram[i - 2][j - 1] * gram[i - 1][j - 2] for j in range(3)]
        for i in range(3)
    ]
    scale = 1 / (gram[0][0] * adjugate[0][0] + gram[0][1] * adjugate[0][1] + gram[0][2] * adjugate[0][2])
    inverse = [
        [(row[0] * u[j] + row[1] * v[j] + row[2] * w[j]) * scale for j in range(4)] for row in adjugate
    ]
    left = []
    for j in range(4):
        i, k, m = (other for other in range(4) if other != j)
        minor = u[i] * (v[k] * w[m] - v[m] * w[k]) - v[i] * (u[k] * w[m] - u[m] * w[k])
        minor = minor + w[i] * (u[k] * v[m] - u[m] * v[k])
        left.append(minor if j % 2 == 0 else -minor)
    rest = [0.5 if int(angle) % 90 == 0 else -0.5 for angle in nominal]
    length = np.copysign(np.sqrt(dot(left, left)), dot(rest, left))
    left = [part / length for part in left]
    cosine = [{0: 1.0, 90: -1.0}.get(int(angle), 0.0) for angle in nominal]
    sine = [{45: 1.0, 135: -1.0}.get(int(angle), 0.0) for angle in nominal]
    rows = []
    for k in range(4):
        component = inverse[1] if cosine[k] else inverse[2]
        sign = cosine[k] + sine[k]
        rows.append([(inverse[0][j] + sign * component[j]) / 2 + rest[k] * left[j] for j in range(4)])
    return np.asarray(rows, np.float32)


CALIBRATED_IMBALANCE = 0.01
"""Largest relative difference of the pair sums of a calibrated sensor.

A larger difference is a sign that the calibration is that of another camera.
"""


def imbalance_notes(ratio: float | None) -> list[str]:
    """Return a note for the user if the ratio of the pair sums deviates from 1 after calibration."""
    notes = (
        []
        if ratio is None
        else [f"With the calibration, I0 + I90 differs from I45 + I135 by {ratio - 1:+.2%}."]
    )
    if ratio is not None and abs(ratio - 1) > CALIBRATED_IMBALANCE:
        notes.append(
            "This is too much for a calibration of this camera: check whether it is of another camera."
        )
    return notes


FARTHEST_ANGLE = np.radians(20.0)
"""Largest deviation of a pixel's polarizer from its nominal angle that is accepted, in radians."""
LEAST_DIATTENUATION = 0.3
"""Smallest diattenuation of a pixel's polarizer that is accepted. It corresponds to an extinction ratio of 1.9."""
# Number of rows of cells per batch of matrices, which must fit into the processor's cache.
_BATCH = 16

Reference = Literal["angles", "mean"]


@dataclass(frozen=True, eq=False)
class AnalyzerCalibration:
    """Calibration of a polarization sensor: the analyzer vectors of its pixels.

    Attributes:
        sensor: name of the sensor, a key of ``SENSORS``.
        lens: name of the lens that the user specified, or "".
        offset: column and row of the sensor at which the calibrated region starts.
        size: width and height of the calibrated region.
        block: side of the blocks whose pixels share vectors, in pixels. If it is the period of the pattern, each pixel
            has a vector of its own.
        vectors: [rows, columns, P, P, 3] float32 for a pattern with the period P. The vector of the pixel in column x
            and row y of the sensor is ``vectors[y // block - offset_y // block, x // block - offset_x // block,
            y % P, x % P]``. Vectors are scaled: the mean first component of the pixels of a color in a neighborhood
            is 1/2.
        reference: meaning of angle zero. "angles" means that the angles of the polarizer during the calibration were
            known. "mean" means that the pixels have their nominal angles on average.
        polarizer_extinction: extinction ratio of the polarizer in front of the light; None for an ideal polarizer.
        sha256: checksum of all other attributes.
    """

    sensor: str
    lens: str
    offset: tuple[int, int]
    size: tuple[int, int]
    block: int
    vectors: Array
    reference: Reference
    polarizer_extinction: float | None = None
    sha256: str = ""
    _matrices: dict[Any, tuple[Array, NDArray[np.intp], NDArray[np.intp]]] = field(
        default_factory=dict, init=False, repr=False
    )

    @property
    def pattern(self) -> Pattern:
        """Pattern of the whole sensor."""
        return sensor_pattern(self.sensor)

    def require_sensor(self, sensor: str | None, where: object) -> None:
        """Refuse a calibration of another sensor.

        Args:
            sensor: sensor of the pictures, or None if it is unknown.
            where: file that an error message names.

        Raises:
            PolarguideError: the calibration belongs to another sensor.
        """
        require(
            sensor is None or sensor == self.sensor,
            where,
            expected=f"a calibration of the sensor {sensor}",
            found=f"the calibration of {self.sensor}",
            remedy="Use the calibration of this camera, or the --sensor of the calibration.",
        )

    def require_region(self, offset: tuple[int, int], size: tuple[int, int], where: object) -> None:
        """Refuse a region outside the calibrated one.

        Args:
            offset: column and row of the sensor at which the region starts.
            size: width and height of the region.
            where: file that an error message names.

        Raises:
            PolarguideError: the region is not inside the calibrated one.
        """
        inside = all(
            low <= start and start + length <= low + side
            for low, side, start, length in zip(self.offset, self.size, offset, size, strict=True)
        )
        require(
            inside,
            where,
            expected=f"a calibration that covers {_region(offset, size)}",
            found=f"the calibration of {_region(self.offset, self.size)}",
            remedy="Calibrate with the region of these files; --offset-x and --offset-y specify its start.",
        )

    def record(self) -> dict[str, str]:
        """Return the entry of ``scene.json`` that identifies the calibration."""
        return {"sensor": self.sensor, "lens": self.lens, "sha256": self.sha256}

    def apply(self, mosaic: Array, *, offset: tuple[int, int] | None = None) -> Array:
        """Compute the mosaic that ideal polarizers would measure.

        The Stokes vector of a cell is ``pinv(A) I``, with the four samples I and their analyzer vectors A [4, 3]. The
        result has the intensities of this Stokes vector behind ideal polarizers. The component of I that no Stokes
        vector explains does not change; for an ideal sensor it is I0 - I45 + I90 - I135. The samples of an ideal
        sensor therefore do not change, and noise remains measurable.

        Args:
            mosaic: linear values without black level, on any scale, [H, W].
            offset: column and row of the sensor at which the mosaic starts. By default, it starts like the calibrated
                region.

        Returns:
            [H, W] float32. Rows and columns of incomplete cells do not change.

        Raises:
            PolarguideError: the mosaic is not inside the calibrated region.
        """
        mosaic = np.asarray(mosaic, np.float32)
        start = self.offset if offset is None else offset
        height, width = mosaic.shape
        self.require_region(start, (width, height), "calibration")
        left, top = self.pattern.shifted(*start).cell_corner()
        height = (height - top) // 2 * 2
        width = (width - left) // 2 * 2
        matrices, rows, columns = self._coarse((start[0] + left, start[1] + top), (width, height))
        inside = (slice(top, top + height), slice(left, left + width))
        cells = mosaic[inside]
        samples = [np.ascontiguousarray(cells[row::2, column::2]) for row, column in np.ndindex(2, 2)]
        out = mosaic.copy()
        part = np.empty_like(samples[0])
        product = np.empty_like(samples[0])
        for index, (row, column) in enumerate(np.ndindex(2, 2)):
            part[:] = 0
            for other, sample in enumerate(samples):
                plane = matrices[index, other]
                if plane.shape != sample.shape:  # cells share matrices
                    plane = plane[:, columns][rows]
                part += np.multiply(plane, sample, out=product)
            out[inside][row::2, column::2] = part
        return out

    def correction(self, offset: tuple[int, int], size: tuple[int, int]) -> Array:
        """Return the matrix that corrects the samples of each cell of a region.

        Args:
            offset: column and row of the sensor at which the region starts. A cell must start there.
            size: width and height of the region in pixels; both are even.

        Returns:
            [4, 4, height / 2, width / 2]. A matrix converts the four samples of a cell, in the order of rows, to the
            corrected samples.
        """
        matrices, rows, columns = self._coarse(offset, size)
        return np.ascontiguousarray(matrices[:, :, rows[:, None], columns])

    def peak(self, offset: tuple[int, int], size: tuple[int, int]) -> float:
        """Return the largest intensity that the correction can give in a region if all samples are at most 1."""
        matrices, _, _ = self._coarse(offset, size)
        return float(np.maximum(matrices, 0).sum(axis=1).max())

    def _coarse(
        self, offset: tuple[int, int], size: tuple[int, int]
    ) -> tuple[Array, NDArray[np.intp], NDArray[np.intp]]:
        """Compute the matrices of a region without duplicates.

        Returns:
            The matrices [4, 4, R, C]; and the index into R for each row of cells, and into C for each column.
        """
        key = (offset, size)
        grid = self._matrices.get(key)
        if grid is None:
            (y, row_index), (x, column_index) = (
                self._places(axis, offset[1 - axis], size[1 - axis]) for axis in (0, 1)
            )
            nominal = self.pattern.shifted(*offset).angles[:2, :2].ravel()
            matrices = np.empty((4, 4, y.shape[1], x.shape[1]), np.float32)
            for first in range(0, y.shape[1], _BATCH):
                part = y[:, first : first + _BATCH, None]
                analyzers = [
                    self.vectors[part[2 * r], x[2 * c], part[2 * r + 1], x[2 * c + 1]]
                    for r, c in np.ndindex(2, 2)
                ]
                matrices[:, :, first : first + _BATCH] = correction_matrices(analyzers, nominal)
            grid = matrices, row_index, column_index
            self._matrices.clear()
            self._matrices[key] = grid
        return grid

    def _places(self, axis: int, start: int, length: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Find the rows (axis 0) or columns (axis 1) of cells that have different matrices.

        Returns:
            [4, R] for R different rows: block and place in the pattern for the first and for the second pixel row of
            the cell; and the index into R for each row of cells, [length / 2].
        """
        period = self.pattern.period
        last = self.vectors.shape[axis] - 1
        first = start + 2 * np.arange(length // 2)
        described = []
        for place in (first, first + 1):
            # A cell beyond the edge, which completes a superpixel, has the vectors of the last block.
            block = place // self.block - self.offset[1 - axis] // self.block
            described += [np.minimum(block, last), place % period]
        unique, inverse = np.unique(np.stack(described), axis=1, return_inverse=True)
        return unique, inverse.reshape(-1)


def spread_to_cells(bad: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Extend a mask of unusable samples of a mosaic, [H, W], to whole cells.

    The correction by a calibration mixes the samples of a cell.
    """
    height, width = bad.shape
    cells = bad.reshape(height // 2, 2, width // 2, 2).any(axis=(1, 3))
    return np.repeat(np.repeat(cells, 2, axis=0), 2, axis=1)


def grid_shape(offset: tuple[int, int], size: tuple[int, int], block: int) -> tuple[int, int]:
    """Return the numbers of rows and columns of blocks that a region touches. Blocks start at the sensor's corner."""
    rows, columns = (
        (start + length - 1) // block - start // block + 1
        for start, length in zip(offset[::-1], size[::-1], strict=True)
    )
    return rows, columns


def _region(offset: tuple[int, int], size: tuple[int, int]) -> str:
    place = f" from column {offset[0]}, row {offset[1]}" if any(offset) else ""
    return f"{size[0]}x{size[1]} pixels{place}"


FORMAT = "polarguide-analyzers"
VERSION = 1
SUFFIX = ".safetensors"
MOST_THROUGHPUT = 1e3
"""Largest ratio of a throughput to 1, and of 1 to a throughput, that is accepted."""
_LONGEST_HEADER = 100_000_000  # limit of safetensors in bytes; text gives a larger number
_ENTRY = "polarguide"
_TENSOR = "vectors"
_REMEDY = "Calibrate again (polarguide calibrate), or copy the file again."

_Positive = Annotated[int, msgspec.Meta(ge=1, le=1 << 20)]
_NotNegative = Annotated[int, msgspec.Meta(ge=0, le=1 << 20)]


class _Metadata(msgspec.Struct, forbid_unknown_fields=True):
    """Metadata of a calibration file. They are stored as a single entry of the file."""

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
    """Return True if a file looks like a calibration of analyzer vectors. A JSON or unreadable file gives False."""
    try:
        if not path.is_file():  # opening a pipe would block
            return False
        with path.open("rb") as file:
            start = file.read(64)
    except OSError:
        return False
    return path.suffix.lower() == SUFFIX or (
        start[8:9] == b"{" and int.from_bytes(start[:8], "little") <= _LONGEST_HEADER
    )


def write_analyzers(path: Path, calibration: AnalyzerCalibration) -> str:
    """Write a calibration to a file, and return its checksum. The same calibration always gives the same bytes.

    Raises:
        PolarguideError: the file cannot be written.
    """
    vectors = np.ascontiguousarray(calibration.vectors, np.float32)
    metadata = _Metadata(
        FORMAT, VERSION, calibration.sensor, calibration.lens, *calibration.size, *calibration.offset,
        calibration.block, calibration.reference, calibration.polarizer_extinction, UNITS, "",
    )  # fmt: skip
    metadata.sha256 = _checksum(metadata, vectors)
    # A single entry, because safetensors writes several entries in any order.
    write_whole(
        path,
        save(
            {_TENSOR: vectors},
            metadata={_ENTRY: json.dumps(msgspec.to_builtins(metadata), ensure_ascii=False)},
        ),
    )
    return metadata.sha256


def read_analyzers(path: Path) -> AnalyzerCalibration:
    """Read a calibration from a file that ``polarguide calibrate`` wrote.

    Raises:
        PolarguideError: the file cannot be read, is truncated, damaged, or of another kind or version.
    """
    require_file(path, expected="a calibration of polarguide calibrate", remedy=_REMEDY)
    try:
        with in_utf8(path) as name, safe_open(name, framework="numpy") as file:
            entries = file.metadata() or {}
            vectors = file.get_tensor(_TENSOR) if list(file.keys()) == [_TENSOR] else None
    except (SafetensorError, ValueError, OSError, RuntimeError, TypeError) as error:
        raise _damaged(path, f"damaged or foreign data ({str(error)[:200]})") from None
    if _ENTRY not in entries or vectors is None:
        raise _damaged(path, "another safetensors file")
    metadata = decode(entries[_ENTRY].encode(), _Metadata, path, remedy=_REMEDY)
    if (metadata.format, metadata.version) != (FORMAT, VERSION):
        raise _damaged(path, f"{metadata.format}, version {metadata.version}")
    require(
        _checksum(metadata, vectors) == metadata.sha256,
        path,
        expected=f"content with the checksum {metadata.sha256[:16]}...",
        found="other content: the file is damaged or was changed",
        remedy=_REMEDY,
    )
    calibration = AnalyzerCalibration(
        metadata.sensor, metadata.lens, (metadata.offset_x, metadata.offset_y), (metadata.width, metadata.height),
        metadata.block, vectors, metadata.reference, metadata.polarizer_extinction, metadata.sha256,
    )  # fmt: skip
    fault = _fault(calibration)
    if fault:
        raise _damaged(path, fault)
    return calibration


def _fault(calibration: AnalyzerCalibration) -> str:
    """Return the fault of a calibration whose checksum is valid; empty without a fault."""
    vectors = calibration.vectors
    if calibration.sensor not in SENSORS:
        return f"the unknown sensor {calibration.sensor!r}"
    period = calibration.pattern.period
    shape = (*grid_shape(calibration.offset, calibration.size, calibration.block), period, period, 3)
    if calibration.block % period or vectors.shape != shape or vectors.dtype != np.float32:
        return f"vectors {list(vectors.shape)} of {vectors.dtype} instead of {list(shape)}"
    gain = vectors[..., 0]
    if not (
        np.isfinite(vectors).all() and gain.min() >= 1 / MOST_THROUGHPUT and gain.max() <= MOST_THROUGHPUT
    ):
        return f"throughputs of {gain.min():g} to {gain.max():g} instead of a mean of 1/2"
    if (np.hypot(vectors[..., 1], vectors[..., 2]) < LEAST_DIATTENUATION * gain).any():
        return "vectors of pixels that hardly polarize"
    angles = np.arctan2(vectors[..., 2], vectors[..., 1])
    apart = np.cos(angles - 2 * np.radians(calibration.pattern.angles))
    # Equal angles would not determine the light.
    return (
        "vectors of polarizers far from the sensor's angles"
        if apart.min() < np.cos(2 * FARTHEST_ANGLE)
        else ""
    )


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
