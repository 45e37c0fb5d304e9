"""Options of camera files, one type for each kind of file. This module does not import torch or OpenCV.

The options of a command are one flat class that inherits the types of all kinds that the command reads.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from msgspec import Meta

from polarguide.capture.calibration import Calibration, checked
from polarguide.capture.sensor.pattern import MosaicOptions, Positive, require_sensor
from polarguide.core.records import check_options


@dataclass(frozen=True)
class CameraOptions:
    """Options of all sources.

    Attributes:
        calibration: gains, order, sense and zero of the angles.
    """

    calibration: Annotated[Calibration, tyro.conf.Suppress] = field(default_factory=Calibration)


@dataclass(frozen=True)
class EncodedOptions(CameraOptions):
    """Options of pictures with a transfer function.

    Attributes:
        transfer: Encoding of filter shots; auto by the curvature of the response.
    """

    transfer: Literal["auto", "linear", "srgb"] = "auto"


@dataclass(frozen=True)
class SampledOptions(CameraOptions):
    """Options of files that hold the values of a sensor.

    Attributes:
        bits: Bits of a sensor value in 16-bit files.
        saturation: Stored value from which the sensor saturates.
    """

    bits: Annotated[int, Meta(ge=8, le=16)] | None = None
    saturation: Positive | None = None


@dataclass(frozen=True)
class GainOptions(CameraOptions):
    """Options of pictures whose gains are estimated.

    Attributes:
        gains: auto divides by the exposures that files state (EXIF) and by the gains that the light implies; exif
            divides by the former only; none by neither.
    """

    gains: Literal["auto", "exif", "none"] = "auto"


@dataclass(frozen=True)
class SetOptions(EncodedOptions, SampledOptions):
    """Options of photographs through a filter at any angles."""


@dataclass(frozen=True)
class FilterOptions(SetOptions, GainOptions):
    """Options of four shots through a filter.

    Attributes:
        align: Estimate and correct small shifts between the four shots of a filter.
    """

    align: bool = True


@dataclass(frozen=True)
class RawMosaicOptions(MosaicOptions, SampledOptions, GainOptions):
    """Options of raw mosaics.

    Attributes:
        dark_frame: Picture with the lens covered. It is subtracted instead of the black level.
        gamma: Gamma that the camera applied to mosaics, stored = light ^ gamma.
        flip: Mirroring (Reverse X, Reverse Y) or counter-clockwise rotation of the mosaics in degrees. It is undone
            first.
        demosaic: Resolution as a fraction of the sensor's.
        analyzers: calibration of the sensor from polarguide calibrate, which replaces gains.
    """

    dark_frame: Path | None = None
    gamma: Annotated[float, Meta(ge=0.1, le=4.0)] = 1.0
    flip: Literal["none", "x", "y", "xy", "90", "270"] = "none"
    demosaic: Literal["half", "quarter", "full"] = "half"
    analyzers: Annotated[Path | None, tyro.conf.Suppress] = None


@dataclass(frozen=True)
class RawOptions(RawMosaicOptions, FilterOptions):
    """Options of all kinds of camera files."""

    def require_valid(self) -> None:
        """Check each value alone.

        Raises:
            PolarguideError: a value is out of range.
        """
        require_sensor(self.sensor)
        check_options(self)
        checked(self.calibration, "calibration")


def changed(options: Any) -> list[str]:
    """Return the names of the fields of a dataclass that differ from their defaults."""
    default = type(options)()
    return [f.name for f in fields(options) if getattr(options, f.name) != getattr(default, f.name)]


def misplaced(options: RawOptions, kind: type, kinds: Mapping[str, type]) -> list[tuple[str, list[str]]]:
    """Return the changed options without effect on a kind of source, each with the kinds that have it.

    Args:
        options: options of a command. kind: type of the options of the source.
        kinds: types of the options of all kinds of sources, by their names in messages.
    """
    names = {f.name for f in fields(kind)}
    owners = {
        option: [name for name, other in kinds.items() if option in {f.name for f in fields(other)}]
        for option in changed(options)
        if option not in names
    }
    return [(option, kinds_of_option) for option, kinds_of_option in owners.items() if kinds_of_option]
