"""Settings of ``prepare``. Nothing here imports torch, OpenCV or pycolmap."""

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
from polarguide.core.errors import PolarguideError
from polarguide.core.records import option_name
from polarguide.core.text import decimals
from polarguide.geometry.polarizer import ANGLES

Dataset = Literal["pandora", "pisr", "nersp", "neisf", "gnerp", "phygap"]
ORIGINS = ("auto", "dataset", "sfm", "none")
"""Values of ``poses`` besides a path."""


@dataclass(frozen=True)
class PictureSettings(SampledOptions):
    """Settings of sources that are developed.

    Attributes:
        white_balance: none, gray (the mean color becomes gray), or gains of R, G and B such as 1.9,1,1.6.
        precision: source rounds the intensities to less than a fifth of a step of the camera's values, full to 16 bits,
            in larger files.
    """

    white_balance: str = "none"
    precision: Literal["source", "full"] = "source"


@dataclass(frozen=True)
class MosaicSettings(RawMosaicOptions, PictureSettings):
    """Settings of raw mosaics.

    Attributes:
        register: Bring the four angles of half size, which lie half a pixel apart, to one place.
    """

    register: bool = True


@dataclass(frozen=True)
class FilterSettings(FilterOptions, PictureSettings):
    """Settings of views of four shots through a filter."""


@dataclass(frozen=True)
class SinglesSettings(FilterSettings):
    """Settings of photographs through a filter at any angles.

    Attributes:
        angles: Polarizer angles of singles: unknown or none for all, numbers in the order of the files that repeat
            (such as 0,60,120), or the path of a table (.csv); without it angles.csv, folders or names say them.
        shots_per_view: Consecutive photographs, by name, that are one view; --angles has as many angles, or a word.
            Without it, groups that show one place are found.
    """

    angles: str | None = None
    shots_per_view: Annotated[int, Meta(ge=1, le=72)] | None = None


@dataclass(frozen=True)
class EncodedStokesSettings(EncodedOptions, GainOptions):
    """Settings of Stokes vectors made of encoded pictures."""


_KINDS: dict[str, type[GainOptions]] = {
    "raw mosaics": MosaicSettings,
    "pisr": MosaicSettings,
    "rotating filters": FilterSettings,
    "single shots": SinglesSettings,
    "gnerp": EncodedStokesSettings,
}
"""Types of settings by the names of the sources in messages."""
_NAMES = {"mosaic": "raw mosaics", "filter": "rotating filters", "singles": "single shots"}
"""Names of formats in messages, where they differ from the formats."""


@dataclass(frozen=True)
class PrepareSettings(RawOptions, MosaicSettings, SinglesSettings):
    """Source of a scene folder, and how it is prepared.

    Attributes:
        format: What the source is; auto looks for datasets, the four shots of a filter, and singles (photographs
            through a filter at any angles, each with a pose of its own), else takes mosaics.
        bits: Bits of a sensor value in 16-bit files; without it those of the value at which samples pile up, else 12 if
            no value exceeds 4095, else 16.
        saturation: Stored value from which the sensor saturates; without it full scale.
        demosaic: half, quarter or full resolution of the sensor.
        transfer: Encoding of filter shots (auto: by the curvature of the response, as inspect judges it) and of GNeRP.
        gains: auto corrects the exposures that files state (EXIF) and what the light tells of the gains of the angles,
            and estimates the exposure of every single shot; exif corrects only what files state; none leaves all.
            Gains of a calibration go first.
        poses: sfm, dataset, none, or the path of a COLMAP model, transforms.json (nerfstudio), cameras.xml (Metashape)
            or cameras.npz (IDR); auto takes those of a dataset, else sfm.
        poses_of: Whether the poses of a path are of the pixels as stored, or of pictures as EXIF orientation displays
            them; auto decides by the sizes of the cameras, else stored.
        matching: Pairs that SfM compares: all, or neighbors in the order of their names; auto takes neighbors for
            frames of videos and for more than 100 pictures with running numbers.
        sfm_pictures: What SfM finds features in: the photograph, or the minimum over the angles, which has less glare.
        intrinsics: fx,fy,cx,cy (and k1,k2,p1,p2) of all pictures as developed, for SfM; without it they are estimated.
        refine_intrinsics: Let SfM change the focal lengths and distortion given.
        masks: Folder of object masks called like the views; SfM looks at their white parts alone.
        seed: Seed of SfM.
    """

    format: Literal["auto", "mosaic", "filter", "singles"] | Dataset = "auto"
    poses: str = "auto"
    poses_of: Literal["auto", "stored", "displayed"] = "auto"
    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    sfm_pictures: Literal["photograph", "minimum"] = "photograph"
    intrinsics: str | None = None
    refine_intrinsics: bool = False
    masks: Path | None = None
    seed: Annotated[int, Meta(ge=0, lt=2**31)] = 0

    def checked(self) -> PrepareSettings:
        """The settings with absolute paths.

        Raises:
            PolarguideError: a value is out of range.
        """
        self.require_valid()
        white_gains(self.white_balance)
        if self.analyzers is not None and self.calibration.gains is not None:
            raise PolarguideError(
                "calibration (gains)",
                expected="none beside the analyzers of polarguide calibrate, which hold the gains of every pixel",
                found=str(self.calibration.gains),
                remedy="Leave one of them out.",
            )
        if self.shots_per_view is not None and self.angles is None:
            raise PolarguideError(
                "--shots-per-view",
                expected="--angles beside it: those of the shots of a view in their order, or a word",
                found="none",
                remedy="Give both, such as --angles 0,45,90,135 --shots-per-view 4.",
            )
        if self.intrinsics is not None:
            known_intrinsics(self.intrinsics)
        elif self.refine_intrinsics:
            raise PolarguideError(
                "--refine-intrinsics",
                expected="intrinsics to begin with",
                found="no --intrinsics",
                remedy="Leave it out: unknown intrinsics are always estimated.",
            )
        return replace(
            self,
            white_balance="gray" if self.white_balance == "grey" else self.white_balance,
            dark_frame=_absolute(self.dark_frame),
            analyzers=_absolute(self.analyzers),
            angles=os.path.realpath(self.angles)
            if self.angles and self.angles.lower().endswith(".csv")
            else self.angles,
            poses=self.poses if self.poses in ORIGINS else os.path.realpath(self.poses),
            masks=_absolute(self.masks),
        )

    def record(self) -> dict[str, Any]:
        """All settings as plain JSON types."""
        plain: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(self), default=str))
        return plain


@dataclass(frozen=True)
class CalibrationOptions:
    """A calibration as the command line states it.

    Attributes:
        calibration: File of polarguide calibrate (.safetensors), or JSON file with gains, order, sense and zero; the
            three options below go first.
        order: Angle of the pictures called 0, 45, 90 and 135, such as 90,45,0,135.
        sense: How the angles count as the picture is displayed; without it ccw, or as the dataset says.
        zero: Where their zero lies, in degrees counter-clockwise from the image's horizontal.
    """

    calibration: Path | None = None
    order: str | None = None
    sense: Sense | None = None
    zero: float | None = None

    def read(self) -> Calibration:
        """The calibration of the file, with what is given beside it.

        Raises:
            PolarguideError: the file or the order is wrong.
        """
        if self.calibration is None or self.analyzers() is not None:
            calibration = Calibration()
        else:
            calibration = read_calibration(self.calibration)
        if self.order is not None:
            try:
                first, second, third, fourth = (int(angle) for angle in self.order.split(","))
            except ValueError:
                raise PolarguideError(
                    "--order",
                    expected="four angles such as 90,45,0,135",
                    found=repr(self.order),
                    remedy="Name the angle of the pictures called 0, 45, 90 and 135, in this order.",
                ) from None
            calibration = replace(calibration, order=(first, second, third, fourth))
        if self.sense is not None:
            calibration = replace(calibration, sense=self.sense)
        return calibration if self.zero is None else replace(calibration, zero=self.zero)

    def analyzers(self) -> Path | None:
        """The file, if it is one of polarguide calibrate, which ``PrepareSettings.analyzers`` takes; else None."""
        return (
            self.calibration if self.calibration is not None and is_analyzer_file(self.calibration) else None
        )


def settings_of_format(settings: PrepareSettings, kind: str) -> GainOptions:
    """Return the settings that apply to a format, as the type of that format.

    Raises:
        PolarguideError: another setting differs from its default.
    """
    owner = _KINDS.get(_NAMES.get(kind, kind), GainOptions)
    for name, owners in sorted(misplaced(settings, owner, _KINDS)):
        *others, last = owners
        raise PolarguideError(
            option_name(name),
            expected=f"only flags that apply to the format {kind}",
            found=f"one for {', '.join(others)} and {last}" if others else f"one for {last}",
            remedy="Leave it out, or choose another --format.",
        )
    calibration = settings.calibration
    if kind == "singles" and (calibration.gains is not None or calibration.order != ANGLES):
        raise PolarguideError(
            "calibration (gains, order)",
            expected="only sense and zero for single shots",
            found=f"gains {calibration.gains}, order {calibration.order}",
            remedy="Say the angle and gain of every shot in angles.csv.",
        )
    if kind not in ("mosaic", "filter", "pisr") and settings.calibration.gains is not None:
        raise PolarguideError(
            "calibration (gains)",
            expected=f"none for the format {kind}, whose four intensities are made from Stokes vectors",
            found=str(settings.calibration.gains),
            remedy="Leave the gains out; order, sense and zero apply.",
        )
    return owner(**{f.name: getattr(settings, f.name) for f in dataclasses.fields(owner)})


def white_gains(text: str) -> tuple[float, float, float] | None:
    """Gains of R, G and B from a ``--white-balance``; None for "gray", which needs the pictures.

    Raises:
        PolarguideError: the text has another form.
    """
    if text in ("none", "gray", "grey"):
        return (1.0, 1.0, 1.0) if text == "none" else None
    gains = decimals(text)
    if len(gains) != 3 or not all(0.05 <= gain <= 20 for gain in gains):
        raise PolarguideError(
            "--white-balance",
            expected="none, gray, or three gains from 0.05 to 20 such as 1.9,1,1.6",
            found=repr(text),
            remedy="Take the gains from a picture of a gray card.",
        )
    return gains[0], gains[1], gains[2]


def known_intrinsics(text: str) -> tuple[str, tuple[float, ...]]:
    """COLMAP's camera model and parameters from ``--intrinsics``: PINHOLE of four numbers, OPENCV of eight.

    Raises:
        PolarguideError: the text is neither.
    """
    numbers = decimals(text)
    if len(numbers) not in (4, 8) or not all(map(math.isfinite, numbers)) or min(numbers[:4]) <= 0:
        raise PolarguideError(
            "--intrinsics",
            expected="fx,fy,cx,cy or fx,fy,cx,cy,k1,k2,p1,p2 in pixels of the developed pictures",
            found=repr(text),
            remedy="Give four or eight numbers; the center of the first pixel is at 0.5.",
        )
    return ("PINHOLE" if len(numbers) == 4 else "OPENCV"), numbers


def _absolute(path: Path | None) -> Path | None:
    return None if path is None else Path(os.path.realpath(path))
