"""Settings of ``calibrate``. Nothing here imports torch, OpenCV or SciPy."""

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
from polarguide.core.errors import PolarguideError
from polarguide.core.records import check_options
from polarguide.core.text import decimals

NAMES = "names"
_NUMBER = re.compile(r"(?:^|.*[_ ])(\d+(?:\.\d+)?)(?:deg)?")
_SIGNED = re.compile(r".*[-+\u2212]\d+(?:\.\d+)?(?:deg)?")
_IN_DEGREES = re.compile(r"\d ?deg(?![a-z])")


@dataclass(frozen=True)
class CalibrateSettings(MosaicOptions):
    """How the shots of a polarizer were taken, and what is estimated from them.

    Attributes:
        sensor: Sensor of the mosaics (IMX250, IMX253 or IMX264 with MYR for color, MZR for monochrome), or the model of
            the camera.
        lens: Name of the lens, for the file; its own polarization is part of what is calibrated.
        angles: Angles of the polarizer in degrees, in the order of the files' names, such as 0,15,30; names if the
            files' names end in them, after _ or a space; without it they are estimated.
        sense: How given angles count, as the picture is displayed.
        reference: What the zero of the angles is: angles, that of the angles given; or mean, the mean deviation of the
            sensor's positions from their names is zero. Without it angles where they are given, else mean.
        polarizer_extinction: Extinction ratio of the polarizer; without it it is taken as ideal.
        flat: Picture of the same light without the polarizer (or a folder of some), which has to be unpolarized.
        dark_frame: Picture with the lens covered (or a folder of some), subtracted in place of the black level.
        saturation: Stored value from which the sensor saturates; without it full scale.
        bits: Bits of a sensor value in 16-bit files; without it 12 if no value exceeds 4095, else 16.
        block: Side in pixels of the blocks that share analyzer vectors; 1 gives each pixel its own; without it blocks
            of 32, or single pixels where these differ by more than their noise.
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
        """The settings.

        Raises:
            PolarguideError: a value is out of range, or does not fit another.
        """
        require_sensor(self.sensor)
        check_options(self)
        if not self.lens.isprintable():
            raise PolarguideError(
                "--lens",
                expected="one line of text",
                found=repr(self.lens),
                remedy="Leave control characters out.",
            )
        period = sensor_pattern(self.sensor).period
        if self.block is not None and self.block != 1 and self.block % period:
            raise PolarguideError(
                "--block",
                expected=f"1, or a multiple of {period} pixels, the period of the pattern of {self.sensor}",
                found=str(self.block),
                remedy=f"Give for example --block {period}.",
            )
        if self.reference == "angles" and self.angles is None:
            raise PolarguideError(
                "--reference",
                expected="mean where the angles of the polarizer are not known",
                found="angles",
                remedy="Give the --angles, or leave it out.",
            )
        return self

    @property
    def offset(self) -> tuple[int, int]:
        """Column and row at which the region starts."""
        return self.offset_x, self.offset_y

    def known_angles(self, files: Sequence[Path]) -> list[float] | None:
        """The angle of the polarizer in each file in radians, counter-clockwise as displayed; None if not given.

        Raises:
            PolarguideError: the angles are no numbers, too few or too many, or a name ends in none.
        """
        if self.angles is None:
            return None
        if self.angles == NAMES:
            degrees = [_angle_of(path) for path in files]
        else:
            degrees = _numbers(self.angles)
            if len(degrees) != len(files):
                raise PolarguideError(
                    "--angles",
                    expected=f"an angle for each of the {len(files)} shots",
                    found=f"{len(degrees)} angles",
                    remedy="List them in the order of the files' names; keep dark frame and flat field elsewhere.",
                )
        sign = -1.0 if self.sense == "cw" else 1.0
        return [sign * math.radians(angle) for angle in degrees]


def _angle_of(path: Path) -> float:
    name = path.stem
    number = _NUMBER.fullmatch(path.stem)
    why = ""
    if _SIGNED.fullmatch(name):
        why = ", a sign or a hyphen before the number"
    elif number is not None and _IN_DEGREES.search(name[: number.start(1)]):
        why = ", an angle in degrees before the last number"
    if number is None or why:
        raise PolarguideError(
            path,
            expected="a name that ends in the angle of the polarizer from 0 on, after _ or a space, such as "
            "shot_022.5.png",
            found=f"{name!r}{why}",
            remedy="Rename it (150 for -30), or list the angles: --angles 150,0,30,...",
        )
    return float(number[1])


def _numbers(text: str) -> list[float]:
    numbers = list(decimals(text))
    if not numbers or not all(map(math.isfinite, numbers)):
        raise PolarguideError(
            "--angles",
            expected="angles in degrees such as 0,15,30, or names",
            found=repr(text),
            remedy="Give the angle of each file, or names if file names end in angles.",
        )
    return numbers
