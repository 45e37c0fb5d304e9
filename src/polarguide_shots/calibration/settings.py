"""Settings of ``calibrate``. This module does not import torch, OpenCV or SciPy."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from polarguide.capture.calibration import Sense
from polarguide.capture.sensor.pattern import (
    MosaicOptions,
    Positive,
    SensorName,
    require_sensor,
    sensor_pattern,
)
from polarguide.core.errors import PolarguideError, require
from polarguide.core.records import check_options
from polarguide.core.text import decimals

NAMES = "names"
"""Value of the setting ``angles`` if the names of the files contain the angles."""
_NUMBER = re.compile(r"(?:^|.*[_ ])(\d+(?:\.\d+)?)(?:deg)?")
_SIGNED = re.compile(r".*[-+\u2212]\d+(?:\.\d+)?(?:deg)?")
_IN_DEGREES = re.compile(r"\d ?deg(?![a-z])")


@dataclass(frozen=True)
class CalibrateSettings(MosaicOptions):
    """Settings of a calibration, and of its shots of a polarizer.

    Attributes:
        sensor: Sensor of the mosaics (IMX250, IMX253 or IMX264 with MYR for color, MZR for monochrome), or the model of
            the camera.
        lens: Name of the lens, which is stored in the file. The calibration includes the polarization by the lens.
        angles: Angles of the polarizer in degrees, in the order of the files' names, such as 0,15,30. Use names if the
            files' names end in the angles, after _ or a space. Default: the angles are estimated.
        sense: Direction in which given angles increase, as the picture is displayed.
        reference: Zero of the angles. angles is the zero of the given angles. mean is the zero at which the sensor's
            positions have no mean deviation from their nominal angles. Default: angles if given, else mean.
        polarizer_extinction: Extinction ratio of the polarizer. Default: an ideal polarizer.
        flat: Picture of the same light without the polarizer, or a folder of such pictures. The light must be
            unpolarized.
        dark_frame: Picture with the lens covered, or a folder of such pictures. It is subtracted in place of the black
            level.
        saturation: Smallest stored value of a saturated sample. Default: full scale.
        bits: Number of used bits in 16-bit files. Default: 12 if no value exceeds 4095, else 16.
        block: Width in pixels of the blocks that share analyzer vectors. 1 gives each pixel its own vector. Default:
            blocks of 32, or single pixels if their differences exceed the noise.
    """

    sensor: SensorName = field()
    lens: Annotated[str, Meta(max_length=200)] = ""
    angles: str | None = None
    sense: Sense = "ccw"
    reference: Literal["angles", "mean"] | None = None
    polarizer_extinction: Annotated[float, Meta(ge=10)] | None = None
    flat: Path | None = None
    dark_frame: Path | None = None
    saturation: Positive | None = None
    bits: Annotated[int, Meta(ge=8, le=16)] | None = None
    block: Annotated[int, Meta(ge=1, le=4096)] | None = None

    def checked(self) -> CalibrateSettings:
        """Validate the settings, and return them.

        Raises:
            PolarguideError: a value is out of range, or does not fit another value.
        """
        require_sensor(self.sensor)
        check_options(self)
        require(
            self.lens.isprintable(),
            "--lens",
            expected="one line of text",
            found=repr(self.lens),
            remedy="Remove control characters.",
        )
        period = sensor_pattern(self.sensor).period
        require(
            self.block is None or self.block == 1 or self.block % period == 0,
            "--block",
            expected=f"1, or a multiple of {period} pixels, the period of the pattern of {self.sensor}",
            found=str(self.block),
            remedy=f"Give for example --block {period}.",
        )
        require(
            self.reference != "angles" or self.angles is not None,
            "--reference",
            expected="mean, because the angles of the polarizer are unknown",
            found="angles",
            remedy="Specify --angles, or remove --reference.",
        )
        return self

    @property
    def offset(self) -> tuple[int, int]:
        """Column and row of the first sample of the region."""
        return self.offset_x, self.offset_y

    def known_angles(self, files: Sequence[Path]) -> list[float] | None:
        """Return the angle of the polarizer in each file, or None if the angles are to be estimated.

        Angles are in radians, counter-clockwise as displayed.

        Raises:
            PolarguideError: an angle is not a number, there are too few or too many, or a name does not end in an
                angle.
        """
        if self.angles is None:
            return None
        if self.angles == NAMES:
            degrees = [_angle_of(path) for path in files]
        else:
            degrees = list(decimals(self.angles))
            require(
                degrees and all(map(math.isfinite, degrees)),
                "--angles",
                expected="angles in degrees such as 0,15,30, or names",
                found=repr(self.angles),
                remedy="Give the angle of each file, or names if file names end in angles.",
            )
            require(
                len(degrees) == len(files),
                "--angles",
                expected=f"an angle for each of the {len(files)} shots",
                found=f"{len(degrees)} angles",
                remedy="List the angles in the order of the files' names. Keep dark frame and flat field elsewhere.",
            )
        sign = -1.0 if self.sense == "cw" else 1.0
        return [sign * math.radians(angle) for angle in degrees]


def _angle_of(path: Path) -> float:
    """Return the angle in degrees at the end of a file name.

    Raises:
        PolarguideError: the name does not end in exactly one angle.
    """
    number = _NUMBER.fullmatch(path.stem)
    reason = ""
    if _SIGNED.fullmatch(path.stem):
        reason = ", a sign or a hyphen before the number"
    elif number is not None and _IN_DEGREES.search(path.stem[: number.start(1)]):
        reason = ", an angle in degrees before the last number"
    if number is None or reason:
        raise PolarguideError(
            path,
            expected="a name that ends in the angle of the polarizer, 0 or more, after _ or a space, such as "
            "shot_022.5.png",
            found=f"{path.stem!r}{reason}",
            remedy="Rename it (150 for -30), or list the angles: --angles 150,0,30,...",
        )
    return float(number[1])
