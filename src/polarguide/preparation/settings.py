"""Settings of ``prepare``. This module does not import torch, OpenCV or pycolmap."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from polarguide.capture.calibration import Calibration, Sense, read_calibration
from polarguide.capture.raw_options import (
    EncodedOptions,
    FilterOptions,
    GainOptions,
    RawMosaicOptions,
    RawOptions,
    SampledOptions,
    misplaced,
)
from polarguide.capture.sensor.analyzers import is_analyzer_file
from polarguide.core.errors import PolarguideError, require
from polarguide.core.records import option_name
from polarguide.core.text import decimals, whole_number
from polarguide.geometry.polarizer import ANGLES
from polarguide.preparation.datasets import DatasetName

ORIGINS = ("auto", "dataset", "sfm", "none")
"""Allowed values of the setting ``poses``, apart from paths."""


@dataclass(frozen=True)
class PictureSettings(SampledOptions):
    """Settings of sources whose pictures are developed from camera files.

    Attributes:
        precision: source rounds the intensities to less than a fifth of a step of the camera's values. full keeps 16
            bits in larger files.
    """

    precision: Literal["source", "full"] = "source"


@dataclass(frozen=True)
class MosaicSettings(RawMosaicOptions, PictureSettings):
    """Settings of raw mosaics.

    Attributes:
        register: Align the four angles in mode half, which are half a pixel apart.
    """

    register: bool = True


@dataclass(frozen=True)
class FilterSettings(FilterOptions, PictureSettings):
    """Settings of captures that have four shots of each view through a filter."""


@dataclass(frozen=True)
class SinglesSettings(FilterSettings):
    """Settings of photographs through a filter at any angles.

    Attributes:
        angles: Polarizer angles of singles: unknown or none for all, repeating numbers in the order of the files (such
            as 0,60,120), or the path of a table (.csv). By default, angles.csv, folders or names state them.
        shots_per_view: Number of consecutive photographs, by name, that show one view. --angles lists the same number
            of angles, or is unknown or none. By default, groups that show one place are detected.
    """

    angles: str | None = None
    shots_per_view: Annotated[int, Meta(ge=1, le=72)] | None = None


@dataclass(frozen=True)
class EncodedStokesSettings(EncodedOptions, GainOptions):
    """Settings of datasets whose Stokes vectors are computed from encoded pictures."""


_KINDS: dict[str, type[GainOptions]] = {
    "raw mosaics": MosaicSettings,
    "pisr": MosaicSettings,
    "rotating filters": FilterSettings,
    "single shots": SinglesSettings,
    "gnerp": EncodedStokesSettings,
}
"""Types of settings by the names of the sources in messages."""
_NAMES = {"mosaic": "raw mosaics", "filter": "rotating filters", "singles": "single shots"}
"""Names of formats in messages, for formats whose names are not clear to users."""


@dataclass(frozen=True)
class PrepareSettings(RawOptions, MosaicSettings, SinglesSettings):
    """Source of a scene folder, and settings of its preparation.

    Attributes:
        format: Format of the source. auto detects datasets, four shots through a filter, and singles (photographs
            through a filter at any angles, each with its own pose), else assumes mosaics.
        bits: Bits of a sensor value in 16-bit files. By default, those of the value at which samples pile up, else 12
            if no value exceeds 4095, else 16.
        saturation: Stored value from which the sensor saturates. By default, full scale.
        demosaic: half, quarter or full resolution of the sensor.
        transfer: Encoding of filter shots and of GNeRP. auto measures the curvature of the response, like inspect.
        gains: auto corrects the exposures that files state (EXIF) and the gains of the angles by the light, and
            estimates the exposure of every single shot. exif corrects only stated exposures, none corrects nothing.
            Gains of a calibration take precedence.
        poses: sfm, dataset, none, or the path of a COLMAP model, transforms.json (nerfstudio), cameras.xml (Metashape)
            or cameras.npz (IDR). auto uses the poses of a dataset, else sfm.
        poses_of: Pixels that the poses of a path refer to, stored or displayed (rotated by EXIF orientation). auto
            decides by the sizes of the cameras, else stored.
        matching: Pairs that SfM compares, all or neighbors by name. auto uses neighbors for frames of videos and for
            more than 100 pictures with consecutive numbers.
        sfm_pictures: Pictures for SfM. The photograph, or the minimum over the angles, which has less glare.
        intrinsics: fx,fy,cx,cy (and k1,k2,p1,p2) of all developed pictures, for SfM. By default, they are estimated.
        masks: Folder of object masks named like the views. SfM uses only their white parts.
        seed: Seed of SfM.
    """

    format: Literal["auto", "mosaic", "filter", "singles"] | DatasetName = "auto"
    poses: str = "auto"
    poses_of: Literal["auto", "stored", "displayed"] = "auto"
    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    sfm_pictures: Literal["photograph", "minimum"] = "photograph"
    intrinsics: str | None = None
    masks: Path | None = None
    seed: Annotated[int, Meta(ge=0, lt=2**31)] = 0

    def checked(self) -> PrepareSettings:
        """Validate the settings and return them with absolute paths.

        Raises:
            PolarguideError: a value is out of range.
        """
        self.require_valid()
        require(
            self.analyzers is None or self.calibration.gains is None,
            "calibration (gains)",
            expected="no gains, because the analyzers of polarguide calibrate contain the gains of every pixel",
            found=str(self.calibration.gains),
            remedy="Remove one of the two.",
        )
        require(
            self.shots_per_view is None or self.angles is not None,
            "--shots-per-view",
            expected="the angles of the shots of each view in --angles, or --angles unknown or none",
            found="no --angles",
            remedy="Specify both, such as --angles 0,45,90,135 --shots-per-view 4.",
        )
        if self.intrinsics is not None:
            known_intrinsics(self.intrinsics)
        return replace(
            self,
            dark_frame=_absolute(self.dark_frame),
            analyzers=_absolute(self.analyzers),
            angles=os.path.realpath(self.angles)
            if self.angles and self.angles.lower().endswith(".csv")
            else self.angles,
            poses=self.poses if self.poses in ORIGINS else os.path.realpath(self.poses),
            masks=_absolute(self.masks),
        )

    def record(self) -> dict[str, Any]:
        """Return all settings as plain JSON types, for the record of the preparation."""
        plain: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(self), default=str))
        return plain


@dataclass(frozen=True)
class CalibrationOptions:
    """Calibration on the command line.

    Attributes:
        calibration: File of polarguide calibrate (.safetensors), or JSON file with gains, order, sense and zero. The
            options --order, --sense and --zero take precedence.
        order: Angles of the pictures named 0, 45, 90 and 135, such as 90,45,0,135.
        sense: Direction in which angles increase in the displayed picture. By default, ccw or the sense of the dataset.
        zero: Zero of the angles, in degrees counter-clockwise from the image's horizontal.
    """

    calibration: Path | None = None
    order: str | None = None
    sense: Sense | None = None
    zero: float | None = None

    def read(self) -> Calibration:
        """Read the calibration file, and apply the options that take precedence.

        Raises:
            PolarguideError: the file or the order is wrong.
        """
        calibration = Calibration()
        if self.calibration is not None and self.analyzers() is None:
            calibration = read_calibration(self.calibration)
        changes = {"order": self._order(), "sense": self.sense, "zero": self.zero}
        specified = {name: value for name, value in changes.items() if value is not None}
        return replace(calibration, **specified)  # type: ignore[arg-type]

    def _order(self) -> tuple[int, ...] | None:
        angles = [whole_number(part.strip()) for part in (self.order or "").split(",")]
        require(
            self.order is None or (None not in angles and len(angles) == len(ANGLES)),
            "--order",
            expected="four angles such as 90,45,0,135",
            found=repr(self.order),
            remedy="List the angles of the pictures named 0, 45, 90 and 135, in this order.",
        )
        return None if self.order is None else tuple(angle for angle in angles if angle is not None)

    def analyzers(self) -> Path | None:
        """Return the calibration file if polarguide calibrate wrote it, else None.

        The result is the value of ``PrepareSettings.analyzers``.
        """
        return (
            self.calibration if self.calibration is not None and is_analyzer_file(self.calibration) else None
        )


def settings_of_format(settings: PrepareSettings, kind: str) -> GainOptions:
    """Return the settings that apply to a format, as the settings type of that format.

    Raises:
        PolarguideError: a setting that does not apply differs from its default.
    """
    owner = _KINDS.get(_NAMES.get(kind, kind), GainOptions)
    for name, owners in sorted(misplaced(settings, owner, _KINDS)):
        *others, last = owners
        raise PolarguideError(
            option_name(name),
            expected=f"only options of the format {kind}",
            found=f"an option of {', '.join(others)} and {last}" if others else f"an option of {last}",
            remedy="Remove the option, or choose another --format.",
        )
    calibration = settings.calibration
    require(
        kind != "singles" or (calibration.gains is None and calibration.order == ANGLES),
        "calibration (gains, order)",
        expected="only sense and zero in the calibration of single shots",
        found=f"gains {calibration.gains}, order {calibration.order}",
        remedy="List the angle and gain of every shot in angles.csv.",
    )
    require(
        kind in ("mosaic", "filter", "pisr") or settings.calibration.gains is None,
        "calibration (gains)",
        expected=f"no gains for the format {kind}, whose four intensities are computed from Stokes vectors",
        found=str(settings.calibration.gains),
        remedy="Remove the gains; order, sense and zero apply.",
    )
    return owner(**{f.name: getattr(settings, f.name) for f in dataclasses.fields(owner)})


def known_intrinsics(text: str) -> tuple[str, tuple[float, ...]]:
    """Parse the camera intrinsics in ``--intrinsics``.

    Returns:
        The name of COLMAP's camera model; and its parameters. The model is PINHOLE for four numbers, and OPENCV for
        eight.

    Raises:
        PolarguideError: the text is invalid.
    """
    numbers = decimals(text)
    require(
        len(numbers) in (4, 8) and all(map(math.isfinite, numbers)) and min(numbers[:4]) > 0,
        "--intrinsics",
        expected="fx,fy,cx,cy or fx,fy,cx,cy,k1,k2,p1,p2 in pixels of the developed pictures",
        found=repr(text),
        remedy="Specify four or eight numbers; the center of the first pixel is at 0.5.",
    )
    return ("PINHOLE" if len(numbers) == 4 else "OPENCV"), numbers


def _absolute(path: Path | None) -> Path | None:
    return None if path is None else Path(os.path.realpath(path))
