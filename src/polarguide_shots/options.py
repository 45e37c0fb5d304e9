"""Options for reading shots, for measuring them, and for watching a folder.

This module does not import torch or OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from msgspec import Meta

from polarguide.capture.raw_options import (
    CameraOptions,
    EncodedOptions,
    FilterOptions,
    RawMosaicOptions,
    RawOptions,
    SetOptions,
    changed,
    misplaced,
)
from polarguide.core.errors import PolarguideError, require
from polarguide.core.options import check_finite
from polarguide.core.records import option_name

Kind = Literal["mosaic", "filter", "set", "scene"]
"""Kind of a shot.

A "mosaic" is one raw file. A "filter" shot has four files at 0, 45, 90 and 135 degrees. A "set" has pictures at any
angles. A "scene" shot is a view of a scene.
"""
_KINDS: dict[Kind, tuple[str, str, type[CameraOptions]]] = {
    "mosaic": ("a raw mosaic", "raw mosaics", RawMosaicOptions),
    "filter": ("a shot through a filter", "shots through a filter", FilterOptions),
    "set": ("a set at other angles", "sets at other angles", SetOptions),
    "scene": ("a view of a scene", "views of a scene", EncodedOptions),
}
"""Description of each kind of shot in the singular and plural, and the type of its options."""
_OPTION_OF = {"analyzers": "--calibration (of polarguide calibrate)", "align": "--no-align"}


@dataclass(frozen=True)
class ShotOptions(RawOptions):
    """Options for reading shots.

    Attributes:
        sensor: Sensor of raw mosaics (IMX250, IMX253 or IMX264 with MYR for color, MZR for monochrome), or the model of
            the camera. Without it, files are shots through a filter.
        bits: Number of used bits in 16-bit files. Default for shots through a filter: 16. Default for mosaics: 12 if no
            value exceeds 4095, else 16.
        saturation: Smallest stored value of a saturated sample. Default: the value that very many samples have, or full
            scale.
        demosaic: full, half or quarter resolution of the sensor.
        align: Estimate and correct small shifts between the four shots of a filter. Sets at other angles are not moved.
        gains: exif corrects different exposures that the files state. auto also corrects unequal brightness of the
            angles, which it estimates from each shot. none corrects nothing.
        full_well: Electrons of a sample at full scale, from which its noise is computed. Default: the noise is
            estimated from each shot.
        read_noise: Standard deviation of the noise without light, in electrons. It requires the full well.
        snr: Smallest ratio of the DoLP to its standard deviation at a pixel with a valid angle.
    """

    demosaic: Literal["half", "quarter", "full"] = "full"
    gains: Literal["auto", "exif", "none"] = "exif"
    full_well: Annotated[float, Meta(ge=10, le=1e9)] | None = None
    read_noise: Annotated[float, Meta(ge=0, le=1e6)] = 0.0
    snr: Annotated[float, Meta(ge=0, le=1000)] = 3.0

    def checked(self) -> ShotOptions:
        """Validate the options, and return them.

        Raises:
            PolarguideError: a value is out of range, or does not fit another value.
        """
        self.require_valid()
        require(
            not self.read_noise or self.full_well is not None,
            "--read-noise",
            expected="--full-well together with --read-noise",
            found=f"{self.read_noise:g} without --full-well",
            remedy="Specify --full-well as well, or remove --read-noise: the noise is then estimated from each shot.",
        )
        return self

    def label(self, name: str) -> str:
        """Return the text for an option in messages. For the calibration, it lists the contents."""
        if name == "calibration":
            return f"calibration ({', '.join(changed(self.calibration))})"
        return _OPTION_OF.get(name, option_name(name))

    def require_kind(self, kind: Kind, name: str) -> None:
        """Check that all options apply to a kind of shot.

        Args:
            kind: kind of the shot.
            name: name of the shot.

        Raises:
            PolarguideError: an option does not apply.
        """
        singular, _, owner = _KINDS[kind]
        for option, owners in misplaced(self, owner, {plural: of for _, plural, of in _KINDS.values()}):
            hint = " Raw mosaics need --sensor." if owners == ["raw mosaics"] and self.sensor is None else ""
            raise PolarguideError(
                self.label(option),
                expected=f"{' and '.join(owners)}, to which the option applies",
                found=f"{name}, {singular}",
                remedy=f"Remove the option, because it would have no effect.{hint}",
            )
        require(
            kind != "scene" or self.calibration.gains is None,
            "calibration (gains)",
            expected="raw mosaics and shots through a filter, to which gains apply",
            found=f"{name}, {singular}",
            remedy="Remove the gains; order, sense and zero apply. prepare --calibration corrects gains.",
        )


@dataclass(frozen=True)
class MeasureOptions:
    """Quantities to measure, and their limits.

    Attributes:
        roi: Region x,y,width,height in pixels of the maps, or the corners of a polygon, x,y;x,y;x,y (in quotes),
            optionally with name=... before it. Repeat the option for several regions. Default: the whole picture.
        limits: JSON file with a bound per field. Shots beyond a limit are drawn, and the exit status is 3.
        reference: Shot of a reference part from the same camera and position, with which all shots are compared.
        threshold: DoLP above which pixels count in dolp_share.
        overwrite: Replace a table that was measured with other options.
    """

    roi: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    limits: Path | None = None
    reference: Path | None = None
    threshold: float = 0.05
    overwrite: bool = False

    def __post_init__(self) -> None:
        check_finite("threshold", self.threshold, 0.0, 1.0)


@dataclass(frozen=True)
class WatchOptions:
    """Options for watching a folder.

    Attributes:
        watch: Folder whose shots are measured as they arrive, until Ctrl-C. Each shot is measured once, even after a
            restart with the same --out.
        settle: Seconds without a change after which a file is read.
        patience: Seconds without a change after which an incomplete file counts as unread.
        idle: Seconds without a new file after which the command ends. 0 waits forever.
    """

    watch: Path | None = None
    settle: float = 1.0
    patience: float = 60.0
    idle: float = 0.0

    def __post_init__(self) -> None:
        check_finite("settle", self.settle, 0.0, 3600.0)
        check_finite("patience", self.patience, 0.0, 1e6)
        check_finite("idle", self.idle, 0.0, 1e9)
