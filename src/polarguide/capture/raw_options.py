"""Options of camera files, which captures and single shots have in common. Nothing here imports torch or OpenCV."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from msgspec import Meta

from polarguide.capture.calibration import Calibration, checked
from polarguide.capture.sensor.pattern import MosaicOptions, Positive, require_sensor
from polarguide.core.records import check_options

OWNERS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(
        (
            "sensor", "packing", "width", "height", "offset_x", "offset_y", "black_level", "dark_frame", "gamma",
            "flip", "demosaic", "interpolation", "register", "analyzers",
        ),
        ("mosaic", "pisr"),
    ),
    **dict.fromkeys(
        ("bits", "saturation", "white_balance", "precision"), ("mosaic", "pisr", "filter", "singles", "set")
    ),
    "transfer": ("filter", "singles", "set", "gnerp", "scene"),
    "align": ("filter", "singles"),
    "angles": ("singles",),
    "shots_per_view": ("singles",),
}  # fmt: skip
"""Options that mean something for some kinds of sources only, and these kinds."""


@dataclass(frozen=True)
class RawOptions(MosaicOptions):
    """How raw mosaics and shots through a filter become intensities.

    Attributes:
        bits: Bits of a sensor value in 16-bit files.
        gamma: Gamma that the camera applied to mosaics: stored = light ^ gamma.
        flip: Which way the mosaics were mirrored (Reverse X, Reverse Y), or the degrees by which they were turned
            counter-clockwise: undone before anything else.
        dark_frame: Picture with the lens covered, subtracted in place of the black level.
        saturation: Stored value from which the sensor saturates.
        demosaic: Resolution, in parts of the sensor's.
        interpolation: How half and full fill in colors and angles.
        transfer: Encoding of filter shots; auto by the curvature of the response.
        align: Estimate and correct small shifts between the four shots of a filter.
        gains: auto corrects what the light tells of the gains of the angles.
        calibration: gains, order, sense and zero of the angles.
        analyzers: calibration of the sensor that polarguide calibrate wrote; takes the place of gains.
    """

    bits: Annotated[int, Meta(ge=8, le=16)] | None = None
    gamma: Annotated[float, Meta(ge=0.1, le=4.0)] = 1.0
    flip: Literal["none", "x", "y", "xy", "90", "270"] = "none"
    dark_frame: Path | None = None
    saturation: Positive | None = None
    demosaic: Literal["half", "quarter", "full"] = "half"
    interpolation: Literal["bilinear", "guided"] = "bilinear"
    transfer: Literal["auto", "linear", "srgb"] = "auto"
    align: bool = True
    gains: Literal["auto", "none"] = "auto"
    calibration: Annotated[Calibration, tyro.conf.Suppress] = field(default_factory=Calibration)
    analyzers: Annotated[Path | None, tyro.conf.Suppress] = None

    def require_valid(self) -> None:
        """Check each value alone.

        Raises:
            PolarguideError: one is out of range.
        """
        require_sensor(self.sensor)
        check_options(self)
        checked(self.calibration, "calibration")


def changed(options: Any) -> list[str]:
    """Names of the fields of a dataclass that are not as they are by default."""
    default = type(options)()
    return [f.name for f in fields(options) if getattr(options, f.name) != getattr(default, f.name)]


def misplaced(
    options: RawOptions, kind: str, words: Mapping[str, str], owners: Mapping[str, tuple[str, ...]] = OWNERS
) -> Iterator[tuple[str, list[str]]]:
    """The options that are set and mean nothing for a kind of source, each with the kinds that it is for, in words.

    Args:
        options: the options. kind: kind of the source.
        words: of the kinds that there are here. owners: the kinds that each option is for; it is for all if not listed.
    """
    for option in changed(options):
        if kind not in owners.get(option, (kind,)):
            yield option, [words[owner] for owner in owners[option] if owner in words]
