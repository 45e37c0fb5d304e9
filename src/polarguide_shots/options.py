"""How shots are read, what is measured of them, and how a folder is watched. Nothing here imports torch or OpenCV."""

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
from polarguide.core.errors import PolarguideError
from polarguide.core.options import check_finite
from polarguide.core.records import option_name

Kind = Literal["mosaic", "filter", "set", "scene"]
"""Kinds of shots: one file, one each at 0, 45, 90 and 135 degrees, others at any angles, a view of a scene."""
_KINDS: dict[str, type[CameraOptions]] = {
    "raw mosaics": RawMosaicOptions,
    "shots through a filter": FilterOptions,
    "sets at other angles": SetOptions,
    "views of a scene": EncodedOptions,
}
"""Types of options by the names of the kinds of shots in messages."""
_ONE: dict[Kind, tuple[str, type[CameraOptions]]] = {
    "mosaic": ("a raw mosaic", RawMosaicOptions),
    "filter": ("a shot through a filter", FilterOptions),
    "set": ("a set at other angles", SetOptions),
    "scene": ("a view of a scene", EncodedOptions),
}
_OPTION_OF = {"analyzers": "--calibration (of polarguide calibrate)", "align": "--no-align"}


@dataclass(frozen=True)
class ShotOptions(RawOptions):
    """How the files of a shot become intensities, and from when on a pixel counts.

    Attributes:
        sensor: Sensor of raw mosaics (IMX250, IMX253 or IMX264 with MYR for color, MZR for monochrome), or the model of
            the camera. Without it files are shots through a filter.
        bits: Bits of a value in 16-bit files; without it 16 for shots through a filter, for mosaics 12 if no value
            exceeds 4095, else 16.
        saturation: Stored value from which the sensor saturates; without it that at which samples pile up, or full
            scale.
        demosaic: full, half or quarter resolution of the sensor.
        align: Estimate and correct small shifts between the four shots of a filter; sets at other angles are not moved.
        gains: exif corrects only exposures that the files state, auto also what the light of each shot tells of the
            gains of the angles; none leaves both.
        full_well: Electrons of a sample at full scale, for its noise; without it the noise is estimated from each shot.
        read_noise: Electrons of noise without light; goes with the full well.
        snr: DoLP in units of its standard deviation from which on an angle counts.
    """

    demosaic: Literal["half", "quarter", "full"] = "full"
    gains: Literal["auto", "exif", "none"] = "exif"
    full_well: Annotated[float, Meta(ge=10, le=1e9)] | None = None
    read_noise: Annotated[float, Meta(ge=0, le=1e6)] = 0.0
    snr: Annotated[float, Meta(ge=0, le=1000)] = 3.0

    def checked(self) -> ShotOptions:
        """The options themselves.

        Raises:
            PolarguideError: a value is out of range, or means nothing beside the others.
        """
        self.require_valid()
        if self.read_noise and self.full_well is None:
            raise PolarguideError(
                "--read-noise",
                expected="--full-well with it: without, noise is estimated from each shot",
                found=f"{self.read_noise:g} without --full-well",
                remedy="Give --full-well, or leave it out.",
            )
        return self

    def called(self, name: str) -> str:
        """Name of an option in messages; of the calibration, its contents."""
        if name == "calibration":
            return f"calibration ({', '.join(changed(self.calibration))})"
        return _OPTION_OF.get(name, option_name(name))

    def require_kind(self, kind: Kind, name: str) -> None:
        """Refuse options that mean nothing for a kind of shot.

        Args:
            kind: kind of the shot. name: name of the shot.

        Raises:
            PolarguideError: one is set.
        """
        words, owner = _ONE[kind]
        here = f"{name}, {words}"
        for option, owners in misplaced(self, owner, _KINDS):
            alone = owners == ["raw mosaics"] and self.sensor is None
            more = " Raw mosaics need --sensor." if alone else ""
            raise PolarguideError(
                self.called(option),
                expected=f"{' and '.join(owners)}: the option is for these",
                found=here,
                remedy=f"Leave it out; it changes nothing there.{more}",
            )
        if kind == "scene" and self.calibration.gains is not None:
            raise PolarguideError(
                "calibration (gains)",
                expected="raw mosaics and shots through a filter, which gains are for",
                found=here,
                remedy="Leave the gains out; order, sense and zero apply. prepare --calibration corrects a scene.",
            )


@dataclass(frozen=True)
class MeasureOptions:
    """Quantities to measure, and their limits.

    Attributes:
        roi: Region x,y,width,height in pixels of the maps, or the corners of a polygon, x,y;x,y;x,y (in quotes), each
            also as name=...; repeat it for several. Without any, the whole picture is one.
        limits: JSON file with a bound per field; shots beyond make the exit status 3 and are drawn.
        reference: A golden part from the same camera at the same place: difference maps and their figures.
        threshold: DoLP over which pixels count in dolp_share.
        overwrite: Begin a new table where the folder has one that was measured with other options.
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
    """How a folder is watched.

    Attributes:
        watch: Folder to work on as files come, until Ctrl-C; each once, also after a restart with the same --out.
        settle: Seconds for which a file must not have changed.
        patience: Seconds without a change after which a file that is still not complete counts as unread.
        idle: Stop after so many seconds in which nothing came; 0 waits for ever.
    """

    watch: Path | None = None
    settle: float = 1.0
    patience: float = 60.0
    idle: float = 0.0

    def __post_init__(self) -> None:
        check_finite("settle", self.settle, 0.0, 3600.0)
        check_finite("patience", self.patience, 0.0, 1e6)
        check_finite("idle", self.idle, 0.0, 1e9)
