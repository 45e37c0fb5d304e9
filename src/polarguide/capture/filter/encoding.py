"""Decide whether the pictures of a capture are linear or sRGB.

The encoding is measured from the light, or read from the files, or assumed according to the format of the files.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import logging
import math
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image, ImageCms
from PIL.ExifTags import Base

from polarguide.capture import checks
from polarguide.capture.exposures import Angle
from polarguide.capture.filter.camera_files import is_camera_raw, number_of, tags_of
from polarguide.capture.filter.shots import Shots
from polarguide.capture.formats.pictures import linear_codes
from polarguide.capture.formats.stored import (
    HIGH_RANGE,
    TIFFS,
    heif_colors,
    is_lossy,
    picture_kind,
    png_chunk,
    read_picture,
)
from polarguide.core.errors import PolarguideError, optional_import

SRGB_EXPONENT = 2.22
"""Exponent of the power function that approximates sRGB at half of full scale."""
_CHARACTERISTICS = {
    **dict.fromkeys((1, 6, 7, 13, 14, 15), SRGB_EXPONENT),
    4: 2.2,
    5: 2.8,
    8: 1.0,
}
"""Exponent of each transfer characteristic of ITU-T H.273. Those for television are treated like sRGB."""
_UNSPECIFIED = 2
_MIDDLE = 0.5
_GRAY = 128
"""8-bit value near half of full scale, whose light a profile gives."""


@dataclass(frozen=True)
class Encoding:
    """Encoding that a picture file states.

    Attributes:
        exponent: exponent of ``light = value ^ exponent`` at half of full scale. It is 1 for linear files, 2.2 for sRGB
            and Adobe RGB, 1.8 for ProPhoto RGB, and None for a curve that is no power function.
        source: field of the file that states the encoding.
    """

    exponent: float | None
    source: str


def stated_encoding(data: bytes) -> Encoding | None:
    """Return the encoding that a picture file states. Return None if the file states no readable encoding.

    If a file has several statements, the first in this order applies, as in the standard of PNG: transfer
    characteristics (cICP of PNG, nclx of HEIC); ICC profile; sRGB and gAMA of PNG, or TransferFunction of TIFF; gamma
    and color space of EXIF.
    """
    characteristics = None
    profile = None
    rest = None
    # Damaged statements count as missing. Pillow, tifffile and pillow-heif raise many classes of errors.
    with contextlib.suppress(Exception), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        kind = picture_kind(data)
        if kind in TIFFS:
            profile, rest = _of_tiff(data)
        elif kind == "HEIF":
            characteristics, profile = heif_colors(data)
        else:
            with Image.open(io.BytesIO(data)) as image:
                profile = image.info.get("icc_profile")
                gamma = image.info.get("gamma")
                if "srgb" in image.info:
                    rest = Encoding(SRGB_EXPONENT, "an sRGB chunk")
                elif gamma:
                    rest = Encoding(1 / gamma, f"a gAMA chunk of {gamma:.5g}")
            stated = png_chunk(data, b"cICP") if kind == "PNG" else None
            if stated and not stated[3]:
                return Encoding(None, "its cICP chunk (values of narrow range, from 16 to 235 of 255)")
            characteristics = stated[1] if stated else None
    if characteristics is not None and characteristics != _UNSPECIFIED:
        name = HIGH_RANGE.get(characteristics, f"number {characteristics} of H.273")
        return Encoding(_CHARACTERISTICS.get(characteristics), f"its transfer characteristics ({name})")
    exponent = None if profile is None else profile_exponent(profile)
    if exponent is not None:
        return Encoding(exponent, "a color profile (ICC)")
    if rest is not None:
        return rest
    tags = tags_of(data)
    gamma = number_of(tags.get(Base.Gamma))
    if gamma is not None and gamma > 0:
        return Encoding(gamma, f"EXIF gamma {gamma:.3g}")
    return Encoding(SRGB_EXPONENT, "EXIF color space sRGB") if tags.get(Base.ColorSpace) == 1 else None


def _of_tiff(data: bytes) -> tuple[bytes | None, Encoding | None]:
    """Return the ICC profile of a TIFF file, and the encoding that its transfer function states, or None for each."""
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        tags = file.pages.first.tags
        profile = tags.valueof(int(Base.InterColorProfile))
        function = tags.valueof(int(Base.TransferFunction))
        count = 1 << int(file.pages.first.bitspersample)
    curve = np.ravel([] if function is None else function)  # one curve for all colors, or one after the other
    place = round(_MIDDLE * (count - 1))
    middle = float(curve[place]) / 65535 if len(curve) >= count else 0.0
    exponent = math.log(middle) / math.log(place / (count - 1)) if 0 < middle < 1 else None
    return profile, None if exponent is None else Encoding(exponent, "a TransferFunction")


def profile_exponent(profile: bytes) -> float | None:
    """Return the exponent of an ICC profile, see ``Encoding``. Return None for a damaged profile.

    The profile converts grays to CIE L*, which is ``116 Y^(1/3) - 16`` for the luminance Y. L* has 256 levels, so the
    exponent is a mean over grays near the middle.
    """
    with contextlib.suppress(Exception):  # littlecms raises several kinds of errors
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        mode = "L" if source.profile.xcolor_space == "GRAY" else "RGB"
        target = ImageCms.createProfile("LAB")
        to_lab = ImageCms.buildTransform(source, target, mode, "LAB", ImageCms.Intent.RELATIVE_COLORIMETRIC)
        grays = np.arange(_GRAY - 16, _GRAY + 17, dtype=np.uint8)
        picture = Image.merge(mode, [Image.fromarray(grays[None])] * len(mode))
        lightness = np.asarray(ImageCms.applyTransform(picture, to_lab))[0, :, 0] * 100.0 / 255
        luminance = ((lightness + 16) / 116) ** 3
        if luminance.min() > 0 and luminance.max() < 1:
            return float((np.log(luminance) / np.log(grays / 255.0)).mean())
    return None


LOSSY = "JPEG, WebP or HEIC"
PLAIN = "PNG, TIFF or BMP"
CAMERA_RAW = "camera raw"
VIDEO = "video"
"""Name of the kind of pictures that are frames of a video. They are sRGB unless the file states another encoding."""
ARRAY = "array"
"""Name of the kind of pictures that are arrays. They are linear."""


def kind_of_file(path: Path) -> str:
    """Return the kind of a photograph according to its suffix. Each kind has a usual encoding."""
    return CAMERA_RAW if is_camera_raw(path) else LOSSY if is_lossy(path) else PLAIN


Stated = tuple[str, str]
"""Tuple of an encoding, linear or srgb, and the field of the file that states it."""
_NEAR = 0.1
"""Largest relative deviation of an exponent from those of linear files and sRGB. It is also the relative error of
DoLP."""


def transfer_of(path: Path, encoding: Encoding) -> Stated:
    """Return the transfer function of an encoding that a file states.

    Raises:
        PolarguideError: the encoding is not linear or similar to sRGB.
    """
    exponent = encoding.exponent
    for transfer, usual in (("linear", 1.0), ("srgb", SRGB_EXPONENT)):
        if exponent is not None and abs(exponent / usual - 1) <= _NEAR:
            return transfer, encoding.source
    raise PolarguideError(
        path,
        expected="a linear picture, or one encoded as sRGB (gamma 2.2)",
        found=f"another encoding by {encoding.source}"
        + ("" if exponent is None else f", gamma {exponent:.2f}"),
        remedy="Export with a linear profile or sRGB, and film in standard range, for a right DoLP. If the statement "
        "is wrong, use --transfer linear or srgb.",
    )


def stated_transfer(paths: Sequence[Path]) -> Stated | None:
    """Return the encoding that pictures of one kind state. Return None if no picture states an encoding.

    Raises:
        PolarguideError: a picture states an encoding that is neither linear nor sRGB, or pictures state different
            encodings.
    """
    first: dict[str, tuple[Path, str]] = {}
    without: Path | None = None
    for path in paths:
        encoding = None if is_camera_raw(path) else stated_encoding(read_picture(path))
        if encoding is not None:
            transfer, source = transfer_of(path, encoding)
            first.setdefault(transfer, (path, source))
        elif is_lossy(path):
            first.setdefault("srgb", (path, ""))  # by convention
        else:
            without = without or path
    kinds = [(path, f"{transfer} by {source or 'convention'}") for transfer, (path, source) in first.items()]
    if kinds and without is not None:
        kinds.append((without, "a file without a stated encoding"))
    if len(kinds) > 1:
        raise PolarguideError(
            kinds[1][0],
            expected=f"the encoding of {kinds[0][0].name}, {kinds[0][1]}",
            found=kinds[1][1],
            remedy="Export all pictures with the same settings, or specify --transfer.",
        )
    return next(((transfer, source) for transfer, (_, source) in first.items() if source), None)


_VIDEO_EXPONENTS = {
    **dict.fromkeys(("unknown", "reserved"), None),
    "linear": 1.0,
    **dict.fromkeys(
        (
            "bt709",
            "smpte170m",
            "smpte240m",
            "iec61966-2-1",
            "iec61966-2-4",
            "bt1361e",
            "bt2020-10",
            "bt2020-12",
        ),
        SRGB_EXPONENT,
    ),
    "bt470m": 2.2,
    "bt470bg": 2.8,
}
"""Exponent of each transfer function by the name that ffmpeg uses. Those for television are treated like sRGB."""
_HIGH_RANGE = {"smpte2084": "PQ", "arib-std-b67": "HLG"}
_COLORS = re.compile(r"[\w-]+/[\w-]+/([\w-]+)")
"""Pattern that finds the transfer function in ffmpeg's description of a video.

An example is yuv420p(tv, bt2020nc/bt2020/arib-std-b67), with matrix, primaries and transfer function.
"""


def stated_video_transfer(path: Path) -> Stated | None:
    """Return the encoding that a video file states according to ffmpeg. Return None if the file states no encoding.

    Raises:
        PolarguideError: the encoding is not linear or similar to sRGB.
    """
    decoder = optional_import("imageio_ffmpeg", str(path))
    logging.getLogger("imageio_ffmpeg").setLevel(logging.ERROR)  # it warns about sizes of rotated films
    # Films with a logarithmic encoding cannot be converted. The option changes the label of the frames, and does not
    # change the description of the file.
    frames = decoder.read_frames(str(path), output_params=["-vf", "setparams=color_trc=bt709"])
    try:
        described = str(next(frames).get("pix_fmt", ""))
    except (OSError, RuntimeError, StopIteration):  # the reader of the frames reports it
        return None
    finally:
        frames.close()
    colors = _COLORS.search(described)
    # Three equal names are described by one, as in yuv420p(tv, bt709).
    names = (name for name in re.findall(r"[\w-]+", described) if name in _VIDEO_EXPONENTS)
    name = colors[1] if colors else next(names, "unknown")
    if name in _VIDEO_EXPONENTS and _VIDEO_EXPONENTS[name] is None:
        return None
    label = f"transfer {name}" + (
        f" ({_HIGH_RANGE[name]}, high dynamic range)" if name in _HIGH_RANGE else ""
    )
    return transfer_of(path, Encoding(_VIDEO_EXPONENTS.get(name), label))


@dataclass(frozen=True)
class TransferDecision:
    """Decision on a transfer function, a note for the user about its reason, and a warning, which may be empty."""

    transfer: str
    note: str
    doubt: str = ""


Slope = Callable[[str], checks.Curvature | None]
"""Function that measures the curvature of the response if the files are decoded with a transfer function.

It returns None if the light does not determine the curvature.
"""


def decide_transfer(
    kind: str, stated: Stated | None, *, eight: bool, slope: Slope | None
) -> TransferDecision:
    """Decide the encoding of pictures.

    If the measured curvature of the response decides, it is used. Otherwise the encoding that the files state is used,
    and otherwise the usual encoding of their kind.

    Args:
        kind: kind of the pictures, see ``kind_of_file``.
        stated: encoding that the files state, or None.
        eight: True for pictures with 8 bits per channel.
        slope: function that measures the curvature; None if every view has only one picture.
    """
    measured = None if slope is None else slope("linear")
    encoding = checks.encoding(measured)
    if encoding is not None and measured is not None and slope is not None:
        note = f"the curvature of the response is {measured.value:+.2f}; linear files have 0, sRGB about -0.6"
        doubt = _doubt(slope, encoding)
        if stated is not None and stated[0] != encoding:
            doubt = (
                f"The files state {stated[0]} ({stated[1]}), but their pair sums are {encoding}, which is used "
                f"(--transfer {stated[0]} overrides this)."
            )
        return TransferDecision(encoding, f"Transfer {encoding}: {note}.", doubt)
    if stated is not None:
        note = f"Transfer {stated[0]}, as the files state ({stated[1]})."
        return TransferDecision(stated[0], note, _doubt(slope, stated[0]))
    undecided = ""
    if slope is not None:
        undecided = (
            ": there are no two pairs at right angles, or too few polarized pixels to decide by their sums"
        )
    if measured is not None:
        undecided = (
            f": the curvature of the response is {measured.value:+.2f} +- {measured.error:.2f}; linear files have 0, "
            "sRGB about -0.6"
        )
    if kind == PLAIN and eight and slope is not None:
        doubt = (
            "The 8-bit files state no encoding, and their pair sums do not decide it. They are read as linear. If they "
            "are sRGB, like most photographs, DoLP is wrong. Specify --transfer linear or srgb."
        )
        return TransferDecision("linear", f"Transfer linear{undecided} (--transfer sets it).", doubt)
    usual = "srgb" if kind in (LOSSY, VIDEO) or (kind == PLAIN and eight) else "linear"
    bits = f"{8 if eight else 16}-bit " if kind == PLAIN else ""
    if kind == ARRAY:
        return TransferDecision(usual, f"Transfer {usual}, the convention of arrays.", _doubt(slope, usual))
    note = f"Transfer {usual}, as {bits}{kind} files usually are{undecided} (--transfer sets it)."
    return TransferDecision(usual, note, _doubt(slope, usual))


def slope_of_shots(shots: Sequence[Shots], angles: Sequence[Sequence[Angle]]) -> Slope:
    """Return a function that measures the curvature of the response for a transfer function, from several views.

    Exposures of the pictures may differ.

    Args:
        shots: shots of each view. Large shifts between shots disturb the measurement.
        angles: angles of the pictures of each view.
    """
    pairs = [checks.right_pairs(view) for view in angles]
    samples = [checks.sampled(view.pictures) for view in shots]
    usable = [checks.sampled(~(view.clipped.any(axis=0) | view.dark)[None])[0] for view in shots]

    def slope(transfer: str) -> checks.Curvature | None:
        views = zip(samples, usable, pairs, strict=True)
        each = (checks.pair_slopes(linear_codes(view, transfer), valid, at) for view, valid, at in views)
        return checks.curvature_of(list(itertools.chain.from_iterable(each)))

    return slope


def transfer_of_pictures(
    paths: Sequence[Path],
    transfer: str,
    judged: Callable[[], Sequence[tuple[Shots, Sequence[Angle]]]],
    *,
    video: Path | None = None,
) -> TransferDecision:
    """Decide the transfer function of the pictures of a capture or of one view.

    Args:
        paths: files of the pictures; empty for pictures in memory.
        transfer: transfer function that the user specified, or auto.
        judged: function that reads the shots of some views. It returns the shots, and the angles of each view.
        video: file of the video if the pictures are its frames, otherwise None.

    Raises:
        PolarguideError: the files state an unsupported encoding, or different encodings.
    """
    kind = VIDEO if video else kind_of_file(paths[0]) if paths else ARRAY
    if kind == CAMERA_RAW:
        note = "Transfer linear: camera raw, developed without a tone curve and equally for all shots."
        return TransferDecision("linear", note)
    if transfer != "auto":
        return TransferDecision(transfer, f"Transfer {transfer}, as specified.")
    stated = stated_video_transfer(video) if video else stated_transfer(paths) if paths else None
    shots, angles = zip(*judged(), strict=True)
    return decide_transfer(
        kind,
        stated,
        eight=shots[0].pictures.dtype == np.uint8,
        slope=slope_of_shots(shots, angles) if len(angles[0]) > 1 else None,
    )


def _doubt(slope: Slope | None, transfer: str) -> str:
    """Return a warning if the response is curved significantly after decoding. Otherwise return "".

    A possible cause is a tone curve that the camera applied.
    """
    curvature = None if slope is None else slope(transfer)
    if curvature is None or not (curvature.surely_below(-checks.BENT) or curvature.surely_above(checks.BENT)):
        return ""
    return (
        f"Read as {transfer}, the response still has a curvature of {curvature.value:+.2f} (0 if it is linear). The "
        "files have another tone curve, and DoLP is wrong. Export 16-bit TIFF without a tone curve, or use camera raw."
    )
