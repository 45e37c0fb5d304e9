"""What ``prepare`` was asked for."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass, field
from typing import Any

from polarguide.capture.calibration import Calibration, checked
from polarguide.capture.datasets import DATASETS
from polarguide.capture.sensor import DEMOSAIC_MODES, INTERPOLATIONS, PACKINGS, sensor_pattern
from polarguide.errors import PolarguideError

FORMATS = ("auto", "mosaic", "filter", *DATASETS)
_MOSAIC_ONLY = (
    "sensor", "packing", "width", "height", "bits", "offset_x", "offset_y", "black_level", "dark_frame",
    "saturation", "white_balance", "demosaic", "interpolation", "register",
)  # fmt: skip
ORIGINS = ("auto", "dataset", "sfm", "none")
"""What poses can be instead of a path."""
_FLAGS = {
    "mosaic": _MOSAIC_ONLY,
    "pisr": _MOSAIC_ONLY,
    "filter": ("transfer", "align", "white_balance"),
    "gnerp": ("transfer",),
}
"""Flags that mean something for some formats only."""


@dataclass(frozen=True)
class PrepareSettings:
    """Settings of a preparation; see the flags of ``polarguide prepare`` for what each means.

    Attributes:
        white_balance: "none", "gray" or three gains separated by commas.
        register: whether half size brings the four angles of a cell to one place.
        gains: "auto" or "none"; a calibration with gains goes first.
        poses: "auto" (those of a published dataset, else "sfm"), "dataset", "sfm", "none" or the path of a
            COLMAP model.
        sfm_pictures: what features are found in: "photograph" (S0/2) or "minimum" (the least of the four angles).
        intrinsics: of structure from motion, see ``known_intrinsics``; None: estimated.
        refine_intrinsics: whether it may change them.
        masks: folder of object masks.
    """

    format: str = "auto"
    sensor: str | None = None
    packing: str | None = None
    width: int | None = None
    height: int | None = None
    bits: int | None = None
    offset_x: int = 0
    offset_y: int = 0
    black_level: float = 0.0
    dark_frame: str | None = None
    saturation: int | None = None
    white_balance: str = "none"
    demosaic: str = "half"
    interpolation: str = "bilinear"
    register: bool = True
    transfer: str = "auto"
    align: bool = True
    gains: str = "auto"
    calibration: Calibration = field(default_factory=Calibration)
    poses: str = "auto"
    matching: str = "exhaustive"
    sfm_pictures: str = "photograph"
    intrinsics: str | None = None
    refine_intrinsics: bool = False
    masks: str | None = None
    seed: int = 0

    def record(self) -> dict[str, Any]:
        """All settings as plain JSON types."""
        plain: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(self)))
        return plain


def check_settings(settings: PrepareSettings) -> None:
    """Check values that need no file.

    Raises:
        PolarguideError: one is out of range.
    """
    choices = {
        "format": FORMATS,
        "demosaic": tuple(DEMOSAIC_MODES),
        "interpolation": INTERPOLATIONS,
        "transfer": ("auto", "linear", "srgb"),
        "gains": ("auto", "none"),
        "matching": ("exhaustive", "sequential"),
        "sfm_pictures": ("photograph", "minimum"),
        "packing": (None, *PACKINGS),
    }
    for name, allowed in choices.items():
        _require(
            name, getattr(settings, name) in allowed, ", ".join(map(str, filter(None, allowed))), settings
        )
    for name, least in (("offset_x", 0), ("offset_y", 0), ("width", 1), ("height", 1), ("saturation", 1)):
        value = getattr(settings, name)
        _require(name, value is None or value >= least, f"{least} or more", settings)
    _require("bits", settings.bits is None or 8 <= settings.bits <= 16, "8 to 16", settings)
    _require("seed", 0 <= settings.seed < 2**31, "a whole number from 0 to 2147483647", settings)
    level = settings.black_level
    _require("black_level", math.isfinite(level) and level >= 0, "0 or more", settings)
    checked(settings.calibration, "calibration")
    if settings.intrinsics is not None:
        known_intrinsics(settings.intrinsics)
    elif settings.refine_intrinsics:
        raise PolarguideError(
            "--refine-intrinsics",
            expected="intrinsics to begin with",
            found="no --intrinsics",
            remedy="Leave it out: unknown intrinsics are always estimated.",
        )
    if settings.sensor is not None:
        sensor_pattern(settings.sensor)


def check_format(settings: PrepareSettings, kind: str) -> None:
    """Refuse settings that mean nothing for a format.

    Raises:
        PolarguideError: one is set.
    """
    default = PrepareSettings()
    mine = _FLAGS.get(kind, ())
    for name in sorted({name for names in _FLAGS.values() for name in names} - set(mine)):
        if getattr(settings, name) != getattr(default, name):
            raise PolarguideError(
                flag(name),
                expected=f"only flags that apply to the format {kind}",
                found=f"one for {_owners(name)}",
                remedy="Leave it out, or choose another --format.",
            )
    if kind in DATASETS and kind != "pisr" and settings.calibration.gains is not None:
        raise PolarguideError(
            "calibration (gains)",
            expected=f"none for the format {kind}, whose four intensities are made from Stokes vectors",
            found=str(settings.calibration.gains),
            remedy="Leave the gains out; order, sense and zero apply.",
        )


def _owners(name: str) -> str:
    """The formats that a flag is for, in words."""
    words = {"mosaic": "raw mosaics", "filter": "rotating filters"}
    return " and ".join(words.get(kind, kind) for kind, names in _FLAGS.items() if name in names)


def white_gains(text: str) -> tuple[float, float, float] | None:
    """Gains of R, G and B from a ``--white-balance``; None for "gray", which needs the pictures.

    Raises:
        PolarguideError: it is none of the forms.
    """
    if text in ("none", "gray"):
        return (1.0, 1.0, 1.0) if text == "none" else None
    try:
        red, green, blue = (float(part) for part in text.split(","))
        if not all(math.isfinite(gain) and 0.05 <= gain <= 20 for gain in (red, green, blue)):
            raise ValueError
    except ValueError:
        raise PolarguideError(
            "--white-balance",
            expected="none, gray, or three gains from 0.05 to 20 such as 1.9,1,1.6",
            found=repr(text),
            remedy="Take the gains from a picture of a gray card.",
        ) from None
    return red, green, blue


def known_intrinsics(text: str) -> tuple[str, tuple[float, ...]]:
    """COLMAP's camera model and parameters from ``--intrinsics``: PINHOLE of four numbers, OPENCV of eight.

    Raises:
        PolarguideError: it is neither.
    """
    try:
        numbers = tuple(float(part) for part in text.split(","))
        right = len(numbers) in (4, 8) and all(map(math.isfinite, numbers)) and min(numbers[:4]) > 0
    except ValueError:
        right = False
    if not right:
        raise PolarguideError(
            "--intrinsics",
            expected="fx,fy,cx,cy or fx,fy,cx,cy,k1,k2,p1,p2 in pixels of the developed pictures",
            found=repr(text),
            remedy="Correct the value; the center of the first pixel is at 0.5.",
        )
    return ("PINHOLE" if len(numbers) == 4 else "OPENCV"), numbers


def flag(name: str) -> str:
    """The flag that sets a field."""
    return "--" + name.replace("_", "-")


def _require(name: str, right: bool, expected: str, settings: PrepareSettings) -> None:
    if not right:
        raise PolarguideError(
            flag(name), expected=expected, found=str(getattr(settings, name)), remedy="Correct the value."
        )
