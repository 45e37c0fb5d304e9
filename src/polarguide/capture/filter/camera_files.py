"""Read files of ordinary cameras: camera raw files, and the exposure data in EXIF tags.

LibRaw (package rawpy) develops camera raw to linear pictures. All steps that depend on the picture are disabled:
automatic brightness, white level and white balance, gamma, and color matrix. The other steps are equal for every shot:
black level, fixed gains, a linear scale and demosaicing.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.ExifTags import IFD, Base

from polarguide.capture.formats.pictures import array_kind
from polarguide.capture.formats.stored import (
    LARGEST_PIXELS,
    ORIENTATION,
    heif_orientation,
    heif_tags,
    opened_picture,
    picture_kind,
    png_chunk,
    read_picture,
)
from polarguide.core.errors import PolarguideError, optional_import, require
from polarguide.core.files import read_file
from polarguide.core.text import listed

CAMERA_RAW = (".dng", ".nef", ".nrw", ".cr2", ".cr3", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")
"""Suffixes of camera raw files in lower case."""
_FULL = 65535
_EXIF_OF_FLIP = {0: 1, 3: 3, 5: 8, 6: 6}


def is_camera_raw(path: Path) -> bool:
    """Return True if the suffix of a file is that of camera raw."""
    return path.suffix.lower() in CAMERA_RAW


def read_camera_raw(
    path: Path, *, opener: Callable[[io.BytesIO], Any] | None = None
) -> tuple[NDArray[np.uint16], int]:
    """Develop a camera raw file.

    Args:
        path: the file.
        opener: function that opens the content of a file instead of ``rawpy.imread``, or None.

    Returns:
        The linear picture [H, W, 3] in the camera's own RGB colors, not rotated for display; and the EXIF orientation,
        1 to 8.

    Raises:
        PolarguideError: rawpy is missing, or the file cannot be read or is damaged.
    """
    with _opened(path, opener) as raw:
        if raw.sizes.raw_width * raw.sizes.raw_height > LARGEST_PIXELS:
            raise ValueError(f"{raw.sizes.raw_width}x{raw.sizes.raw_height} pixels")
        flip = int(raw.sizes.flip)  # user_flip overwrites it
        pixels = np.asarray(raw.postprocess(**libraw_parameters()))
        reached = float(_FULL)
        if raw.raw_type.name == "Stack":
            # In files without a mosaic (linear DNG, such as ProRAW), LibRaw subtracts the black levels of three
            # channels from the samples, but the black level of a fourth channel, 0, from the white level.
            black = raw.black_level_per_channel
            reached = float((raw.white_level - max(black[:3])) / (raw.white_level - min(black)) * _FULL)
    require(
        pixels.ndim == 3 and pixels.shape[2] == 3 and pixels.dtype == np.uint16,
        path,
        expected="a camera raw file with three colors",
        found=array_kind(pixels),
        remedy="Develop it to 16-bit linear TIFF.",
    )
    # The white level becomes 65535, which marks saturation. LibRaw rounds down.
    if reached < _FULL:
        pixels = np.minimum(np.rint(pixels * np.float32(_FULL / reached)), _FULL).astype(np.uint16)
    pixels = np.where(pixels >= _FULL - 1, np.uint16(_FULL), pixels)
    return pixels, _EXIF_OF_FLIP.get(flip, 1)


def stored_frame(path: Path) -> tuple[tuple[int, int], int]:
    """Return the size and the EXIF orientation of a camera raw file without developing it.

    Returns:
        The width and height of the stored pixels; and the orientation.

    Raises:
        PolarguideError: rawpy is missing, or the file cannot be read.
    """
    with _opened(path) as raw:
        return (int(raw.sizes.width), int(raw.sizes.height)), _EXIF_OF_FLIP.get(int(raw.sizes.flip), 1)


@contextlib.contextmanager
def _opened(path: Path, opener: Callable[[io.BytesIO], Any] | None = None) -> Iterator[Any]:
    """Open a camera raw file with rawpy as a context. Any error inside the context is reported as a fault of the file.

    Raises:
        PolarguideError: rawpy is missing, or the file cannot be read or developed.
    """
    opened = opener or optional_import("rawpy", str(path)).imread
    data = read_file(path)
    try:
        with opened(io.BytesIO(data)) as raw:
            yield raw
    except Exception as error:  # LibRaw has many classes of errors, and damaged files raise others
        raise PolarguideError(
            path,
            expected="a complete camera raw file",
            found="an empty file" if not data else f"a file that cannot be developed ({_message(error)})",
            remedy="Copy the file again, or develop it to 16-bit linear TIFF.",
        ) from error


def _message(error: Exception) -> str:
    """Return the message of an error of LibRaw as one line of text."""
    reason = error.args[0] if error.args else ""
    text = reason.decode(errors="replace") if isinstance(reason, bytes) else str(reason)
    return (text.strip().splitlines() or [type(error).__name__])[0]


def libraw_parameters() -> dict[str, Any]:
    """Return the settings for LibRaw. The keys are the names of the arguments of ``rawpy.Params``."""
    settings: dict[str, Any] = {
        "gamma": (1.0, 1.0),
        "output_bps": 16,
        "no_auto_bright": True,
        "bright": 1.0,
        # Other values adapt the white level to the brightest pixel of each shot.
        "adjust_maximum_thr": 0.0,
        "use_camera_wb": False,
        "use_auto_wb": False,
        "user_wb": [1.0, 1.0, 1.0, 1.0],
        "user_flip": 0,
        "median_filter_passes": 0,
    }
    with contextlib.suppress(ImportError):
        rawpy = importlib.import_module("rawpy")
        settings |= {
            "output_color": rawpy.ColorSpace.raw,
            "demosaic_algorithm": rawpy.DemosaicAlgorithm.LINEAR,
            "highlight_mode": rawpy.HighlightMode.Clip,
            "fbdd_noise_reduction": rawpy.FBDDNoiseReductionMode.Off,
        }
    return settings


def orientation(data: bytes) -> int:
    """Return the EXIF orientation of a picture file, 1 to 8. Without a valid tag it is 1, which means no rotation.

    The rotation of a HEIC file is read from its header, because its tag is informative only.
    """
    if picture_kind(data) == "HEIF":
        return heif_orientation(data)
    value = tags_of(data).get(ORIENTATION)
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def tags_of(data: bytes) -> dict[int, Any]:
    """Return the EXIF tags of a picture file or of a camera raw file based on TIFF.

    The result is empty if the tags are missing or damaged.
    """
    exif = Image.Exif()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            exif.load(_block_of_tags(data))
            return {**exif, **exif.get_ifd(IFD.Exif)}
    except Exception:  # Pillow raises many undocumented classes for damaged tags
        return {}


def _block_of_tags(data: bytes) -> bytes:
    """Return the EXIF block of a picture file. It has the format of TIFF, and is empty if the file has no EXIF tags."""
    block = data
    kind = picture_kind(data)
    if kind in ("JPEG", "WebP"):
        block = opened_picture(data).info.get("exif", b"")
    elif kind == "PNG":
        block = png_chunk(data, b"eXIf") or b""
    elif kind == "HEIF":
        block = heif_tags(data)
    block = block.removeprefix(b"Exif\0\0")
    return block if picture_kind(block) == "TIFF" else b""


_ISO_TOO_LARGE = 65535
"""Value of the tag ISO that means a larger value, which does not fit into 16 bits."""
_LARGER_ISO = (Base.RecommendedExposureIndex, Base.StandardOutputSensitivity, Base.ISOSpeed)
"""Tags of EXIF 2.3 that state the ISO value if it does not fit into the tag ISO."""

_FOCAL_AGREES = 0.01
"""Largest relative difference of focal lengths that count as equal. Tags are rounded, and focusing changes the value.
"""


@dataclass(frozen=True)
class Lens:
    """Camera and lens that the file of a picture states.

    Pictures with the same lens can share intrinsics.

    Attributes:
        camera: text that identifies the camera.
        focal: focal length, or None if it is unknown. Its unit is the same for all pictures of a ``camera``.
    """

    camera: str
    focal: float | None = None

    def agrees(self, other: Lens) -> bool:
        """Return True if the cameras are equal and this focal length is at most slightly larger than the other.

        If one of the focal lengths is unknown, only the cameras are compared.
        """
        close = not self.focal or not other.focal or self.focal < (1 + _FOCAL_AGREES) * other.focal
        return self.camera == other.camera and close


@dataclass(frozen=True)
class ExposureData:
    """Exposure data of a photograph that its file states.

    Attributes:
        camera: maker and model of the camera. It is empty if the file does not state them.
        lens: camera and lens. The focal length is that for 35 mm film if the file states it, otherwise the actual one,
            in mm.
        seconds: exposure time in seconds; None if it is missing or implausible.
        iso: sensitivity; None if it is missing or implausible.
        f_number: aperture; None if it is missing or implausible.
    """

    camera: str = ""
    lens: Lens = Lens("")
    seconds: float | None = None
    iso: float | None = None
    f_number: float | None = None

    @property
    def light(self) -> float | None:
        """Exposure ``seconds * iso / f_number^2``, or None if the exposure time is unknown.

        A missing ISO value is replaced by 100, and a missing f-number by 1. Exposures are therefore comparable only
        between files with the same tags.
        """
        return (
            None if self.seconds is None else self.seconds * (self.iso or 100.0) / (self.f_number or 1.0) ** 2
        )


_NAMES = {"seconds": "ExposureTime", "iso": "ISO", "f_number": "FNumber"}


def missing_tags(exposures: Mapping[Path, ExposureData]) -> str:
    """Return a warning if some files lack an exposure tag that other files have.

    Return "" if all files have the same tags.
    """
    for field, name in _NAMES.items():
        without = [path.name for path, data in exposures.items() if getattr(data, field) is None]
        if 0 < len(without) < len(exposures):
            return (
                f"{len(without)} of {len(exposures)} files have no {name} in their EXIF tags ({listed(without)}). "
                "Exposures are not corrected by EXIF."
            )
    return ""


def read_exposure_data(path: Path) -> ExposureData:
    """Read the exposure data of a picture file or a camera raw file.

    EXIF tags are read if possible. For other camera raw files, LibRaw (package rawpy) reads the data.

    Raises:
        PolarguideError: the file cannot be read, or rawpy is required and not installed.
    """
    raw = is_camera_raw(path)
    data = read_file(path) if raw else read_picture(path)
    exposure = exif_data(data)
    if not raw or exposure.seconds is not None or picture_kind(data) == "TIFF":
        return exposure
    libraw = optional_import("rawpy", str(path))
    # ``read_camera_raw`` reports LibRaw's errors.
    with contextlib.suppress(Exception), libraw.imread(io.BytesIO(data)) as opened:
        other = opened.other  # missing in some versions of rawpy
        return _plausible("", Lens(""), other.shutter, other.iso_speed, other.aperture)
    return exposure


def exif_data(data: bytes) -> ExposureData:
    """Return the exposure data in the EXIF tags of a picture file. A damaged tag is treated as missing."""
    tags = tags_of(data)
    camera = _joined_texts(tags, Base.Make, Base.Model)
    exposure = (Base.ExposureTime, Base.ISOSpeedRatings, Base.FNumber)
    seconds, iso, f_number = (number_of(tags.get(tag)) for tag in exposure)
    if iso == _ISO_TOO_LARGE:
        iso = next(filter(None, (number_of(tags.get(tag)) for tag in _LARGER_ISO)), None)
    return _plausible(camera, _lens(camera, tags), seconds, iso, f_number)


def _lens(camera: str, tags: dict[int, Any]) -> Lens:
    """Determine the camera and lens from EXIF tags.

    Lenses are distinguished by their focal length. If it is unknown, they are distinguished by serial number and name.
    Pictures with digital zoom count as pictures of another camera, because only some makers include the zoom in the
    focal length.
    """
    zoom = number_of(tags.get(Base.DigitalZoomRatio))
    if zoom is not None and zoom > 0 and zoom != 1:  # 0 means no zoom
        camera = f"{camera} zoom {zoom:.3g}".lstrip()
    for unit, tag in (("film", Base.FocalLengthIn35mmFilm), ("lens", Base.FocalLength)):
        focal = number_of(tags.get(tag))
        if focal and focal > 0:
            return Lens(f"{camera} ({unit})", focal)
    return Lens(f"{camera} {_joined_texts(tags, Base.BodySerialNumber, Base.LensModel)}".strip())


def _joined_texts(tags: dict[int, Any], *names: int) -> str:
    """Return the texts of some tags, separated by blanks."""
    return " ".join(filter(None, (str(tags.get(name, "")).partition("\0")[0].strip() for name in names)))


def camera_groups(paths: Mapping[str, Path]) -> dict[str, Lens]:
    """Return the lens of each view according to its first file. Return an empty result if all views have one lens.

    Focal lengths that agree get the same value.

    Raises:
        PolarguideError: a file cannot be read.
    """
    lenses = {view: read_exposure_data(path).lens for view, path in paths.items()}
    groups: dict[str, Lens] = {}
    last = None
    for view in sorted(lenses, key=lambda view: (lenses[view].camera, lenses[view].focal or 0.0, view)):
        if last is None or not lenses[view].agrees(last):
            last = lenses[view]
        groups[view] = last
    return groups if len(set(groups.values())) > 1 else {}


def _plausible(
    camera: str, lens: Lens, seconds: float | None, iso: float | None, f_number: float | None
) -> ExposureData:
    """Return exposure data without implausible numbers, such as 0 for a missing aperture."""
    return ExposureData(
        camera,
        lens,
        seconds if seconds is not None and 0 < seconds < 1e5 else None,
        iso if iso is not None and 0 < iso < 1e8 else None,
        f_number if f_number is not None and 0.1 < f_number < 1000 else None,
    )


def number_of(value: Any) -> float | None:
    """Return the value of a tag as a number. If the tag has several values, return the first one.

    Return None if the tag is missing or its value is not finite.
    """
    try:
        number = float(value[0] if isinstance(value, tuple) else value)
    except (TypeError, ValueError, IndexError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None
