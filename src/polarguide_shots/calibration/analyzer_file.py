"""Writing the file of a calibrated camera."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np
from safetensors.numpy import save

from polarguide.capture.sensor.analyzer_file import (
    _ENTRY,
    _TENSOR,
    FORMAT,
    UNITS,
    VERSION,
    _checksum,
    _Metadata,
)
from polarguide.capture.sensor.analyzers import AnalyzerCalibration
from polarguide.core.files import write_whole


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
