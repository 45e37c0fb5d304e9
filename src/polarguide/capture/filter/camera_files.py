"""Files of cameras: developed camera raw, and what files state beside their pixels (EXIF, the color profile).

Camera raw becomes linear pictures with the same processing for every shot. LibRaw (package rawpy) runs without any step
that depends on the picture: no automatic brightness, white level or white balance, no gamma, no color matrix. The
remaining steps are the same for every shot: black level, fixed gains, a linear scale and demosaicing.
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

from polarguide.capture.calibration import Calibration
from polarguide.capture.formats.headers import (
    LARGEST_PIXELS,
    ORIENTATION,
    heif_head,
    heif_tags,
    opened_picture,
    picture_kind,
    png_chunk,
)
from polarguide.capture.formats.pictures import array_kind, read_picture
from polarguide.core.errors import PolarguideError, optional_import
from polarguide.core.files import read_file
from polarguide.core.text import listed

CAMERA_RAW = (".dng", ".nef", ".nrw", ".cr2", ".cr3", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")
"""Suffixes that are read as camera raw."""
_FULL = 65535
_EXIF_OF_FLIP = {0: 1, 3: 3, 5: 8, 6: 6}


def is_camera_raw(path: Path) -> bool:
    """Whether a file is a camera raw file, by its suffix."""
    return path.suffix.lower() in CAMERA_RAW


def read_camera_raw(
    path: Path, gains: tuple[float, float, float], *, opener: Callable[[io.BytesIO], Any] | None = None
) -> tuple[NDArray[np.uint16], int]:
    """Develop a camera raw file.

    Args:
        path: the file.
        gains: of R, G and B; the smallest becomes 1, so that full scale of the sensor is full scale of the picture.
        opener: takes the file's bytes and returns what ``rawpy.imread`` would; rawpy itself if None.

    Returns:
        [H, W, 3] linear RGB in the camera's own colors, not turned; and the EXIF orientation, 1 to 8.

    Raises:
        PolarguideError: rawpy is missing, or the file cannot be read or is damaged.
    """
    with _opened(path, opener) as raw:
        if raw.sizes.raw_width * raw.sizes.raw_height > LARGEST_PIXELS:
            raise ValueError(f"{raw.sizes.raw_width}x{raw.sizes.raw_height} pixels")
        flip = int(raw.sizes.flip)  # before user_flip takes its place
        pixels = np.asarray(raw.postprocess(**libraw_parameters(gains)))
        reached = float(_FULL)
        if raw.raw_type.name == "Stack":
            # In a file that is not a mosaic (linear DNG, such as ProRAW of a telephone), LibRaw subtracts the black
            # levels of three channels from the samples. From the white level it subtracts that of a fourth one, 0.
            black = raw.black_level_per_channel
            reached = float((raw.white_level - max(black[:3])) / (raw.white_level - min(black)) * _FULL)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.uint16:
        raise PolarguideError(
            path,
            expected="a camera raw file with three colors",
            found=array_kind(pixels),
            remedy="Develop it to 16-bit linear TIFF.",
        )
    # The white level becomes 65535, as saturation in the camera has to be known. LibRaw rounds down.
    if reached < _FULL:
        pixels = np.minimum(np.rint(pixels * np.float32(_FULL / reached)), _FULL).astype(np.uint16)
    pixels = np.where(pixels >= _FULL - 1, np.uint16(_FULL), pixels)
    return pixels, _EXIF_OF_FLIP.get(flip, 1)


def stored_frame(path: Path) -> tuple[tuple[int, int], int]:
    """Width and height of the pixels of a camera raw file as stored, and its EXIF orientation; nothing is developed.

    Raises:
        PolarguideError: rawpy is missing, or the file cannot be read.
    """
    with _opened(path) as raw:
        return (int(raw.sizes.width), int(raw.sizes.height)), _EXIF_OF_FLIP.get(int(raw.sizes.flip), 1)


@contextlib.contextmanager
def _opened(path: Path, opener: Callable[[io.BytesIO], Any] | None = None) -> Iterator[Any]:
    """A camera raw file as rawpy opens it; whatever goes wrong with it, then and inside, is the file's fault.

    Raises:
        PolarguideError: rawpy is missing, or something did.
    """
    opened = opener or optional_import("rawpy", str(path)).imread
    data = read_file(path)
    try:
        with opened(io.BytesIO(data)) as raw:
            yield raw
    except Exception as error:  # LibRaw's errors have a class each; damaged files raise others, too
        raise PolarguideError(
            path,
            expected="a complete camera raw file",
            found="an empty file" if not data else f"one that cannot be developed ({_words(error)})",
            remedy="Copy the file again, or develop it to 16-bit linear TIFF.",
        ) from error


def _words(error: Exception) -> str:
    """LibRaw's error message, which may be bytes, as one line."""
    reason = error.args[0] if error.args else ""
    text = reason.decode(errors="replace") if isinstance(reason, bytes) else str(reason)
    return (text.strip().splitlines() or [type(error).__name__])[0]


def libraw_parameters(gains: tuple[float, float, float]) -> dict[str, Any]:
    """LibRaw's settings, by the names of ``rawpy.Params``."""
    red, green, blue = (gain / min(gains) for gain in gains)
    settings: dict[str, Any] = {
        "gamma": (1.0, 1.0),
        "output_bps": 16,
        "no_auto_bright": True,
        "bright": 1.0,
        # Otherwise the white level follows the brightest pixel of each shot.
        "adjust_maximum_thr": 0.0,
        "use_camera_wb": False,
        "use_auto_wb": False,
        "user_wb": [red, green, blue, green],
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


_MIRRORED = (2, 4, 5, 7)
QUARTER_TURNS = (5, 6, 7, 8)
"""Orientations that exchange width and height."""
INVERSE = {code: {6: 8, 8: 6}.get(code, code) for code in range(1, 9)}
"""The orientation that takes another one back."""
TURNS = {
    2: "mirrored left to right",
    3: "turned by 180 degrees",
    4: "mirrored top to bottom",
    5: "mirrored along the falling diagonal",
    6: "turned by 90 degrees clockwise",
    7: "mirrored along the rising diagonal",
    8: "turned by 90 degrees counter-clockwise",
}
"""What each orientation but 1 does to the stored picture for display."""


def orientation(data: bytes) -> int:
    """The orientation tag of a picture file, 1 to 8; 1 (as stored) where there is none that can be read.

    HEIC states its turn in the header; its tag is for information only.
    """
    if picture_kind(data) == "HEIF":
        head = heif_head(data)
        return 1 if head is None else head.orientation
    value = tags_of(data).get(ORIENTATION)
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def apply_orientation(pixels: NDArray[Any], code: int) -> NDArray[Any]:
    """Pixels [H, W, ...] rotated or mirrored for display, given the orientation tag."""
    if code in (5, 7):
        pixels = pixels.swapaxes(0, 1)
        return np.rot90(pixels, 2) if code == 7 else pixels
    if code in (2, 4):
        return np.flip(pixels, axis=1 if code == 2 else 0)
    return np.rot90(pixels, {1: 0, 3: 2, 6: -1, 8: 1}[code])


def orientation_calibration(code: int) -> Calibration:
    """The change of polarizer angles when the stored picture is rotated or mirrored for display."""
    return Calibration(
        sense="cw" if code in _MIRRORED else "ccw", zero=90.0 if code in QUARTER_TURNS else 0.0
    )


def tags_of(data: bytes) -> dict[int, Any]:
    """The EXIF tags of a picture file and of camera raw that is built like TIFF; none where they are damaged.

    Pillow reads tags only: of pictures with 16 bits a channel it would return 8.
    """
    exif = Image.Exif()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            exif.load(_block_of_tags(data))
            return {**exif, **exif.get_ifd(_DIRECTORY)}
    except Exception:  # Pillow raises a dozen kinds for tags that are damaged, and promises none
        return {}


def _block_of_tags(data: bytes) -> bytes:
    """The EXIF block of a picture file, which is built like a TIFF file; empty where it has none."""
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


_MAKER = 271
_MODEL = 272
_DIRECTORY = 34665
_TIME = 33434
_F_NUMBER = 33437
_ISO = 34855
_ISO_TOO_LARGE = 65535
"""Value of the tag ISO where its 16 bits are too few."""
_LARGER_ISO = (34866, 34865, 34867)
"""Tags with the ISO then: recommended exposure index, standard output sensitivity, ISO speed (EXIF 2.3)."""
_FOCAL_LENGTH = 37386
_FOCAL_LENGTH_OF_FILM = 41989
_SERIAL_NUMBER = 42033
_LENS = 42036
_DIGITAL_ZOOM = 41988


@dataclass(frozen=True)
class Lens:
    """The camera and the lens of a picture, as far as its file states them.

    Attributes:
        camera: in words. focal: focal length, in a unit that pictures of one ``camera`` share; None: not known.
    """

    camera: str
    focal: float | None = None


@dataclass(frozen=True)
class ExposureData:
    """How a photograph was taken, as its file says; None for what it does not say, or not plausibly.

    Attributes:
        camera: maker and model; empty where it does not say.
        lens: body and lens, with the focal length in mm of the 35 mm film, else as it is.
        seconds, iso, f_number: of the exposure.
    """

    camera: str = ""
    lens: Lens = Lens("")
    seconds: float | None = None
    iso: float | None = None
    f_number: float | None = None

    @property
    def light(self) -> float | None:
        """How much light was let in and how it was amplified: seconds * ISO / f-number^2; None without a time.

        Comparable among files that say the same of the three: ISO and f-number count as 100 and 1 where none does.
        """
        return (
            None if self.seconds is None else self.seconds * (self.iso or 100.0) / (self.f_number or 1.0) ** 2
        )


_NAMES = {"seconds": "ExposureTime", "iso": "ISO", "f_number": "FNumber"}


def missing_tags(taken: Mapping[Path, ExposureData]) -> str:
    """A sentence where some files do not say what others say of their exposure; "" where they are comparable."""
    for field, name in _NAMES.items():
        without = [path.name for path, data in taken.items() if getattr(data, field) is None]
        if 0 < len(without) < len(taken):
            return (
                f"{len(without)} of {len(taken)} files have no {name} in their EXIF tags ({listed(without)}), and the "
                "others have: EXIF corrects no exposure."
            )
    return ""


def read_exposure_data(path: Path) -> ExposureData:
    """Exposure data of a file: EXIF of pictures and of camera raw that is built like TIFF; else LibRaw.

    Raises:
        PolarguideError: the file cannot be read, or LibRaw is needed and missing.
    """
    raw = is_camera_raw(path)
    data = read_file(path) if raw else read_picture(path)
    exposure = exif_data(data)
    if not raw or exposure.seconds is not None or picture_kind(data) == "TIFF":
        return exposure
    libraw = optional_import("rawpy", str(path))
    # LibRaw's errors: whoever develops the file says what is wrong with it.
    with contextlib.suppress(Exception), libraw.imread(io.BytesIO(data)) as opened:
        other = opened.other  # which some versions of rawpy do not have
        return _plausible("", Lens(""), other.shutter, other.iso_speed, other.aperture)
    return exposure


def exif_data(data: bytes) -> ExposureData:
    """Exposure data in the EXIF tags of a picture file; damaged tags count as missing."""
    tags = tags_of(data)
    names = (str(tags.get(tag, "")).partition("\0")[0].strip() for tag in (_MAKER, _MODEL))
    camera = " ".join(filter(None, names))
    seconds, iso, f_number = (number_of(tags.get(tag)) for tag in (_TIME, _ISO, _F_NUMBER))
    if iso == _ISO_TOO_LARGE:
        iso = next(filter(None, (number_of(tags.get(tag)) for tag in _LARGER_ISO)), None)
    return _plausible(camera, _lens(camera, tags), seconds, iso, f_number)


def _lens(camera: str, tags: dict[int, Any]) -> Lens:
    """Bodies and lenses count as one where their focal lengths are stated: then these tell cameras apart.

    Digital zoom makes another camera: whether a stated focal length has it is each maker's choice.
    """
    zoom = number_of(tags.get(_DIGITAL_ZOOM))
    if zoom is not None and zoom > 0 and zoom != 1:  # 0: none was used
        camera = f"{camera} zoom {zoom:.3g}".lstrip()
    focal, of_film = (number_of(tags.get(tag)) for tag in (_FOCAL_LENGTH, _FOCAL_LENGTH_OF_FILM))
    stated = [(unit, value) for unit, value in (("film", of_film), ("lens", focal)) if value and value > 0]
    if stated:
        return Lens(f"{camera} ({stated[0][0]})", stated[0][1])
    more = (str(tags.get(tag, "")).partition("\0")[0].strip() for tag in (_SERIAL_NUMBER, _LENS))
    return Lens(" ".join(filter(None, (camera, *more))))


_FOCAL_AGREES = 0.01
"""Relative difference of focal lengths that are one: tags are rounded, and lenses breathe with focus."""


def camera_groups(paths: Mapping[str, Path]) -> dict[str, Lens]:
    """The lens of each view, by its first file; focal lengths that agree become one. Empty where all have one lens.

    Raises:
        PolarguideError: a file cannot be read.
    """
    lenses = {view: read_exposure_data(path).lens for view, path in paths.items()}
    alike: list[Lens] = []
    groups: dict[str, Lens] = {}
    for view in sorted(lenses, key=lambda view: (lenses[view].camera, lenses[view].focal or 0.0, view)):
        lens = lenses[view]
        last = alike[-1] if alike else None
        same = last is not None and lens.camera == last.camera
        if same and last is not None and lens.focal and last.focal:
            same = lens.focal < (1 + _FOCAL_AGREES) * last.focal
        if not same:
            alike.append(lens)
        groups[view] = alike[-1]
    return groups if len(alike) > 1 else {}


def _plausible(
    camera: str, lens: Lens, seconds: float | None, iso: float | None, f_number: float | None
) -> ExposureData:
    """Exposure data without numbers that no camera has, such as the 0 of a lens that states no aperture."""
    return ExposureData(
        camera,
        lens,
        seconds if seconds is not None and 0 < seconds < 1e5 else None,
        iso if iso is not None and 0 < iso < 1e8 else None,
        f_number if f_number is not None and 0.1 < f_number < 1000 else None,
    )


def number_of(value: Any) -> float | None:
    """A tag as a number, the first of several; None where it is missing or not finite."""
    try:
        number = float(value[0] if isinstance(value, tuple) else value)
    except (TypeError, ValueError, IndexError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None
