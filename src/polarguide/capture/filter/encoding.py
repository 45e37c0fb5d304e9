"""How the pictures of a capture are encoded: as the light tells, as their files state, or as their kind usually is."""

from __future__ import annotations

import contextlib
import io
import itertools
import logging
import math
import re
import struct
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image

from polarguide.capture import checks
from polarguide.capture.exposures import Angle
from polarguide.capture.filter.camera_files import is_camera_raw, number_of, tags_of
from polarguide.capture.filter.shots import Shots
from polarguide.capture.formats.headers import (
    HIGH_RANGE,
    TIFFS,
    heif_colors,
    picture_kind,
    png_chunk,
)
from polarguide.capture.formats.pictures import is_lossy, linear_codes, read_picture
from polarguide.core.errors import PolarguideError, optional_import

SRGB_EXPONENT = 2.22
"""Exponent of sRGB at half scale."""
_CHARACTERISTICS = {
    **dict.fromkeys((1, 6, 7, 13, 14, 15), SRGB_EXPONENT),
    4: 2.2,
    5: 2.8,
    8: 1.0,
}
"""Exponents of transfer characteristics (ITU-T H.273). Those of television are shown as sRGB is."""
_UNSPECIFIED = 2
_TIFF_PROFILE = 34675
_TRANSFER_FUNCTION = 301
_COLOR_SPACE = 40961
_GAMMA = 42240
_CURVES = (b"rTRC", b"kTRC")
_PARAMETERS = {0: 1, 1: 3, 2: 4, 3: 5, 4: 7}
_MIDDLE = 0.5


@dataclass(frozen=True)
class Encoding:
    """How a picture file says that it is encoded.

    Attributes:
        exponent: light = value ^ exponent at half scale: 1 is linear, 2.2 sRGB and Adobe RGB, 1.8 ProPhoto RGB; None
            where it is no such curve.
        words: what says so.
    """

    exponent: float | None
    words: str


def stated_encoding(data: bytes) -> Encoding | None:
    """The encoding that a picture file states; None where it states none that can be read.

    By transfer characteristics (cICP of PNG, nclx of HEIC), else an ICC profile, else sRGB and gAMA of PNG or
    TransferFunction of TIFF, else gamma and color space of EXIF: a more specific statement goes first, as in the
    standard of PNG.
    """
    characteristics = None
    profile = None
    rest = None
    # A statement that cannot be read states nothing: Pillow, tifffile and pillow-heif raise what they please.
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
    gamma = number_of(tags.get(_GAMMA))
    if gamma is not None and gamma > 0:
        return Encoding(gamma, f"EXIF gamma {gamma:.3g}")
    return Encoding(SRGB_EXPONENT, "EXIF color space sRGB") if tags.get(_COLOR_SPACE) == 1 else None


def _of_tiff(data: bytes) -> tuple[bytes | None, Encoding | None]:
    """The ICC profile of a TIFF file, and what its transfer function says."""
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        tags = file.pages.first.tags
        profile = tags.valueof(_TIFF_PROFILE)
        function = tags.valueof(_TRANSFER_FUNCTION)
        count = 1 << int(file.pages.first.bitspersample)
    curve = np.ravel([] if function is None else function)  # of all colors, or of one after the other
    place = round(_MIDDLE * (count - 1))
    middle = float(curve[place]) / 65535 if len(curve) >= count else 0.0
    exponent = math.log(middle) / math.log(place / (count - 1)) if 0 < middle < 1 else None
    return profile, None if exponent is None else Encoding(exponent, "a TransferFunction")


def profile_exponent(profile: bytes) -> float | None:
    """The exponent of an ICC profile as in ``Encoding``; None where it has no such curve, or is damaged."""
    try:
        decoded = _decoded_middle(profile)
    except (struct.error, OverflowError, ValueError, IndexError):
        return None
    if decoded is None or not 0 < decoded < 1:
        return None
    return math.log(decoded) / math.log(_MIDDLE)


def _decoded_middle(profile: bytes) -> float | None:
    """Value of a profile's red or gray curve at half scale (ICC.1, curveType and parametricCurveType)."""
    (count,) = struct.unpack_from(">I", profile, 128)
    entries = [struct.unpack_from(">4sII", profile, 132 + 12 * number) for number in range(min(count, 100))]
    at = next((at for name, at, _ in entries if name in _CURVES), None)
    if at is None:
        return None
    kind = profile[at : at + 4]
    if kind == b"curv":
        (count,) = struct.unpack_from(">I", profile, at + 8)
        if count == 0:
            return _MIDDLE
        if count == 1:
            return float(_MIDDLE ** (struct.unpack_from(">H", profile, at + 12)[0] / 256))
        return float(struct.unpack_from(">H", profile, at + 12 + 2 * round(_MIDDLE * (count - 1)))[0]) / 65535
    if kind != b"para":
        return None
    (form,) = struct.unpack_from(">H", profile, at + 8)
    if form not in _PARAMETERS:
        return None
    numbers = [n / 65536 for n in struct.unpack_from(f">{_PARAMETERS[form]}i", profile, at + 12)]
    factor, shift = numbers[1:3] if form else (1.0, 0.0)
    # Half scale lies above the linear part of every curve in use.
    raised = numbers[{2: 3, 4: 5}[form]] if form in (2, 4) else 0.0
    return float(max(0.0, factor * _MIDDLE + shift) ** max(numbers[0], 0.1) + raised)


LOSSY = "JPEG, WebP or HEIC"
PLAIN = "PNG, TIFF or BMP"
CAMERA_RAW = "camera raw"
VIDEO = "video"
"""Frames of a video: sRGB unless the file states another encoding."""
ARRAY = "array"
"""Arrays: linear."""


def kind_of_file(path: Path) -> str:
    """The kind of a photograph by its suffix."""
    return CAMERA_RAW if is_camera_raw(path) else LOSSY if is_lossy(path) else PLAIN


Stated = tuple[str, str]
"""An encoding, linear or srgb, and what states it."""
_NEAR = 0.1
"""Share by which an exponent may differ from that of linear files or sRGB. DoLP is off by as much as the exponent."""


def transfer_of(path: Path, exponent: float | None, words: str) -> Stated:
    """The transfer of an exponent that a file states.

    Raises:
        PolarguideError: it is neither linear nor like sRGB.
    """
    known = {"linear": 1.0, "srgb": SRGB_EXPONENT}
    for transfer, its in known.items():
        if exponent is not None and abs(exponent / its - 1) <= _NEAR:
            return transfer, words
    raise PolarguideError(
        path,
        expected="a linear picture, or one encoded as sRGB (gamma 2.2)",
        found=f"another encoding by {words}" + ("" if exponent is None else f", gamma {exponent:.2f}"),
        remedy="Export with a linear profile or sRGB, film in standard range: DoLP would be wrong. If the statement is "
        "wrong, give --transfer linear or srgb.",
    )


def stated_transfer(paths: Sequence[Path]) -> Stated | None:
    """The encoding that pictures of one kind state; None where none states any.

    Raises:
        PolarguideError: one states another encoding than linear or sRGB, or two of them differ.
    """
    first: dict[str, tuple[Path, str]] = {}
    silent: Path | None = None
    for path in paths:
        encoding = None if is_camera_raw(path) else stated_encoding(read_picture(path))
        if encoding is not None:
            transfer, words = transfer_of(path, encoding.exponent, encoding.words)
            first.setdefault(transfer, (path, words))
        elif is_lossy(path):
            first.setdefault("srgb", (path, ""))  # by custom
        else:
            silent = silent or path
    found = [(path, f"{transfer} by {words or 'custom'}") for transfer, (path, words) in first.items()]
    if found and silent is not None:
        found.append((silent, "a file that states none"))
    if len(found) > 1:
        raise PolarguideError(
            found[1][0],
            expected=f"the encoding of {found[0][0].name}, {found[0][1]}",
            found=found[1][1],
            remedy="Export all pictures with the same settings, or give --transfer.",
        )
    transfer, (_, words) = next(iter(first.items()), ("", (None, "")))
    return (transfer, words) if words else None


_OF_VIDEO = {
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
"""Exponents of transfers by ffmpeg's names; those of television are shown as sRGB is."""
_HIGH_RANGE = {"smpte2084": "PQ", "arib-std-b67": "HLG"}
_COLORS = re.compile(r"[\w-]+/[\w-]+/([\w-]+)")
"""Matrix, primaries and transfer as ffmpeg describes them, as in yuv420p(tv, bt2020nc/bt2020/arib-std-b67)."""


def stated_video_transfer(path: Path) -> Stated | None:
    """The encoding that a video states, as ffmpeg names it; None where it states none.

    Raises:
        PolarguideError: it is neither linear nor like sRGB.
    """
    decoder = optional_import("imageio_ffmpeg", str(path))
    logging.getLogger("imageio_ffmpeg").setLevel(logging.ERROR)  # of turned films it says that sizes differ
    # Logarithmic films are not converted: the frames are taken for others, and the description is that of the file.
    frames = decoder.read_frames(str(path), output_params=["-vf", "setparams=color_trc=bt709"])
    try:
        described = str(next(frames).get("pix_fmt", ""))
    except (OSError, RuntimeError, StopIteration):  # whoever reads the frames says what is wrong
        return None
    finally:
        frames.close()
    colors = _COLORS.search(described)
    # One name stands for all three where they agree, as in yuv420p(tv, bt709).
    words = (
        [colors[1]] if colors else [word for word in re.findall(r"[\w-]+", described) if word in _OF_VIDEO]
    )
    name = words[0] if words else "unknown"
    if name in _OF_VIDEO and _OF_VIDEO[name] is None:
        return None
    return transfer_of(
        path,
        _OF_VIDEO.get(name),
        f"transfer {name}" + (f" ({_HIGH_RANGE[name]}, high dynamic range)" if name in _HIGH_RANGE else ""),
    )


@dataclass(frozen=True)
class TransferDecision:
    """The chosen transfer function, a sentence that says why, and what to warn of: "" or a sentence."""

    transfer: str
    note: str
    doubt: str = ""


Slope = Callable[[str], checks.Curvature | None]
"""The curvature of the response that a transfer leaves; None where the light does not tell."""


def decide_transfer(
    kind: str, stated: Stated | None, *, eight: bool, slope: Slope | None
) -> TransferDecision:
    """How pictures are encoded: as the light tells, else as they state, else as their kind usually is.

    Args:
        kind: their kind. stated: what they state. eight: whether they have 8 bits a channel.
        slope: of views at several angles; None where every view is one picture.
    """
    measured = None if slope is None else slope("linear")
    encoding = checks.encoding(measured)
    if encoding is not None and measured is not None and slope is not None:
        note = f"the curvature of the response is {measured.value:+.2f}; linear files have 0, sRGB about -0.6"
        doubt = _doubt(slope, encoding)
        if stated is not None and stated[0] != encoding:
            doubt = (
                f"The files state {stated[0]} ({stated[1]}), and their pair sums say {encoding}, which is believed "
                f"(--transfer {stated[0]} overrides)."
            )
        return TransferDecision(encoding, f"Transfer {encoding}: {note}.", doubt)
    if stated is not None:
        note = f"Transfer {stated[0]}, as the files state ({stated[1]})."
        return TransferDecision(stated[0], note, _doubt(slope, stated[0]))
    untold = ""
    if slope is not None:
        untold = ": no two pairs at right angles, or too few pixels are polarized for their sums to tell"
    if measured is not None:
        untold = (
            f": the curvature of the response is {measured.value:+.2f} +- {measured.error:.2f}; linear files have 0, "
            "sRGB about -0.6"
        )
    if kind == PLAIN and eight and slope is not None:
        doubt = (
            "The 8-bit files state no encoding, and their pair sums do not tell it: they are taken as linear. If they "
            "are sRGB, as photographs usually are, DoLP is wrong; --transfer linear or srgb says it."
        )
        return TransferDecision("linear", f"Transfer linear{untold} (--transfer sets it).", doubt)
    usual = "srgb" if kind in (LOSSY, VIDEO) or (kind == PLAIN and eight) else "linear"
    bits = f"{8 if eight else 16}-bit " if kind == PLAIN else ""
    if kind == ARRAY:
        return TransferDecision(usual, f"Transfer {usual}, as arrays are.", _doubt(slope, usual))
    note = f"Transfer {usual}, as {bits}{kind} files usually are{untold} (--transfer sets it)."
    return TransferDecision(usual, note, _doubt(slope, usual))


def slope_of_shots(shots: Sequence[Shots], angles: Sequence[Sequence[Angle]]) -> Slope:
    """The curvature of the response over some views, whatever the exposures of their pictures.

    Args:
        shots: of each view, aligned well enough (as from a tripod). angles: of each view's pictures.
    """
    pairs = [checks.right_pairs(mine) for mine in angles]
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
    """The transfer of the pictures of a capture or of one set.

    Args:
        paths: their files; none of pictures in memory. transfer: as given, or auto.
        judged: reads the shots of some views and the angles of each; all views have several pictures, or it is one.
        video: the file, if they are its frames.

    Raises:
        PolarguideError: the files state an encoding that is not read, or several.
    """
    kind = VIDEO if video else kind_of_file(paths[0]) if paths else ARRAY
    if kind == CAMERA_RAW:
        note = "Transfer linear: camera raw, developed without tone curve, alike for all shots."
        return TransferDecision("linear", note)
    if transfer != "auto":
        return TransferDecision(transfer, f"Transfer {transfer}, as given.")
    stated = stated_video_transfer(video) if video else stated_transfer(paths) if paths else None
    shots, angles = zip(*judged(), strict=True)
    return decide_transfer(
        kind,
        stated,
        eight=shots[0].pictures.dtype == np.uint8,
        slope=slope_of_shots(shots, angles) if len(angles[0]) > 1 else None,
    )


def _doubt(slope: Slope | None, transfer: str) -> str:
    """The warning where the chosen transfer surely leaves the response curved, as a camera's own tone curve does."""
    left = None if slope is None else slope(transfer)
    if left is None or not (left.surely_below(-checks.BENT) or left.surely_above(checks.BENT)):
        return ""
    return (
        f"Read as {transfer}, the response still has a curvature of {left.value:+.2f} (0 if it is linear): the files "
        "have another tone curve, and DoLP is wrong. Export 16-bit TIFF without a tone curve, or take camera raw."
    )
