"""How the pictures of a capture are encoded: as the light tells, as their files state, or as their kind usually is."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from polarguide.capture import checks
from polarguide.capture.exposures import Angle
from polarguide.capture.filter.camera_files import SRGB_EXPONENT, is_camera_raw, stated_encoding
from polarguide.capture.filter.shots import Shots
from polarguide.capture.formats.pictures import is_lossy, linear_codes, read_picture
from polarguide.core.errors import PolarguideError, optional_import

LOSSY, PLAIN, CAMERA_RAW = "JPEG, WebP or HEIC", "PNG, TIFF or BMP", "camera raw"
VIDEO, ARRAY = "video", "array"
"""Kinds of pictures by their usual encoding."""


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
    "unknown": None,
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


def stated_video_transfer(path: Path) -> Stated | None:
    """The encoding that a video states, as ffmpeg names it; None where it states none.

    Raises:
        PolarguideError: it is neither linear nor like sRGB.
    """
    decoder = optional_import("imageio_ffmpeg", str(path))
    frames = decoder.read_frames(str(path))
    try:
        described = str(next(frames).get("pix_fmt", ""))
    except (OSError, RuntimeError, StopIteration):  # whoever reads the frames says what is wrong
        return None
    finally:
        frames.close()
    # As in yuv420p(tv, bt2020nc/bt2020/arib-std-b67): matrix, primaries and transfer, or one name where all agree.
    words = [word.strip().split("/")[-1] for word in described.partition("(")[2].rstrip(")").split(",")]
    name = next((word for word in words if word in _OF_VIDEO or word in _HIGH_RANGE), "unknown")
    if name in _OF_VIDEO and _OF_VIDEO[name] is None:
        return None
    said = f"transfer {name}" + (f" ({_HIGH_RANGE[name]}, high dynamic range)" if name in _HIGH_RANGE else "")
    return transfer_of(path, _OF_VIDEO.get(name), said)


@dataclass(frozen=True)
class TransferDecision:
    """The chosen transfer function, a sentence that says why, and what to warn of: "" or a sentence."""

    transfer: str
    note: str
    doubt: str = ""


def given_transfer(kind: str, transfer: str) -> TransferDecision | None:
    """The transfer that needs no decision: of camera raw, or as specified; None for auto."""
    if kind == CAMERA_RAW:
        note = "Transfer linear: camera raw, developed without tone curve, alike for all shots."
        return TransferDecision("linear", note)
    return None if transfer == "auto" else TransferDecision(transfer, f"Transfer {transfer}, as given.")


Slope = Callable[[str], float | None]
"""The curvature of the response (``checks.Measures``) that a transfer leaves; None where the light does not tell."""


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
    if encoding is not None and slope is not None:
        note = f"the curvature of the response is {measured:+.2f}; linear files have 0, sRGB about -0.6"
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
        untold = ": too few pixels are polarized for pair sums to tell"
    if measured is not None:
        untold = f": the curvature of the response is {measured:+.2f}, between those of linear files and sRGB"
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
    """The curvature of the response over some views.

    Args:
        shots: of each view, aligned well enough (as from a tripod). angles: of each view's pictures.
    """
    pairs = [checks.right_pairs(mine) for mine in angles]
    samples = [checks.sampled(view.pictures) for view in shots]
    usable = [checks.sampled(~(view.clipped.any(axis=0) | view.dark)[None])[0] for view in shots]

    def slope(transfer: str) -> float | None:
        views = zip(samples, usable, pairs, strict=True)
        each = (checks.pair_slopes(linear_codes(view, transfer), *rest) for view, *rest in views)
        return checks.slope(list(itertools.chain.from_iterable(each)))

    return slope


def transfer_of_set(
    paths: Sequence[Path], transfer: str, shots: Shots, angles: Sequence[Angle], *, video: Path | None = None
) -> TransferDecision:
    """The transfer of the pictures of one set.

    Args:
        paths: their files; none of pictures in memory. transfer: as given, or auto. shots, angles: the pictures.
        video: the file, if they are its frames.

    Raises:
        PolarguideError: the files state an encoding that is not read, or several.
    """
    kind = VIDEO if video else kind_of_file(paths[0]) if paths else ARRAY
    given = given_transfer(kind, transfer)
    if given is not None:
        return given
    stated = stated_video_transfer(video) if video else stated_transfer(paths) if paths else None
    eight = shots.pictures.dtype == np.uint8
    return decide_transfer(kind, stated, eight=eight, slope=slope_of_shots([shots], [angles]))


def _doubt(slope: Slope | None, transfer: str) -> str:
    """The warning where the chosen transfer leaves the response curved, as a camera's own tone curve does."""
    left = None if slope is None else slope(transfer)
    if left is None or checks.ENCODED[0] <= left <= checks.DECODED[0]:
        return ""
    return (
        f"Read as {transfer}, the response still has a curvature of {left:+.2f} (0 if it is linear): the files have "
        "another tone curve, and DoLP is wrong. Export 16-bit TIFF without a tone curve, or take camera raw."
    )
