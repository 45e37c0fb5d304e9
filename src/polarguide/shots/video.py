"""Frames of a video of a turning polarizer, at the angles that a table beside it lists."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.exposures import LARGEST, Angle, parse_angle
from polarguide.core.errors import PolarguideError
from polarguide.core.files import read_file, require_file
from polarguide.core.records import shortened

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
_COLUMNS = ["frame", "angle"]
_LARGEST_TABLE = 1 << 24
_REMEDY = "Write a line for each frame to use: its number, counted from 0, and its angle in degrees."


def frame_table(video: Path) -> Path:
    """The table of a video: of its name, with the suffix .csv."""
    return video.with_suffix(".csv")


def read_frame_table(path: Path, video: Path) -> list[tuple[int, Angle]]:
    """The lines of a table ``frame,angle``: frames counted from 0, and their angles.

    Raises:
        PolarguideError: there is no such table, a cell is wrong, or a frame is listed twice.
    """
    if not path.is_file():
        raise PolarguideError(
            path, expected=f"a table frame,angle of {video.name}", found="no such file", remedy=_REMEDY
        )
    try:
        text = read_file(path, largest=_LARGEST_TABLE, remedy=_REMEDY).decode("utf-8-sig")
        rows = [
            [cell.strip() for cell in row] for row in csv.reader(io.StringIO(text, newline=""), strict=True)
        ]
    except (UnicodeDecodeError, csv.Error) as error:
        raise PolarguideError(
            path, expected="CSV text in UTF-8", found=f"something else ({error})", remedy=_REMEDY
        ) from None
    header = [cell.lower() for cell in rows[0]] if rows else []
    if header != _COLUMNS:
        found = shortened(",".join(header)) or "an empty file"
        raise PolarguideError(
            f"{path} (line 1)", expected="the header frame,angle", found=found, remedy=_REMEDY
        )
    frames: dict[int, Angle] = {}
    for number, row in enumerate(rows[1:], 2):
        if not any(row):
            continue
        angle = parse_angle(row[1]) if len(row) == len(_COLUMNS) else None
        if angle is None or not row[0].isdecimal() or int(row[0]) in frames:
            raise PolarguideError(
                f"{path} (line {number})",
                expected=f"a frame that no other line has, and its angle up to {LARGEST:g} degrees",
                found=shortened(",".join(row)),
                remedy=_REMEDY,
            )
        frames[int(row[0])] = angle
    return sorted(frames.items())


def read_frames(path: Path, frames: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
    """The frames of a video [H, W, 3] uint8 RGB, one after the other.

    Args:
        path: of the video, whose frames stay as they are stored: angles count from their horizontal. frames: numbers,
            counted from 0 and rising.

    Raises:
        PolarguideError: OpenCV cannot read the video, or it ends before the last of them.
    """
    require_file(path, expected="a video", remedy="Copy the file there.")
    video = cv2.VideoCapture(str(path))
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    try:
        place = -1
        for frame in frames:
            # One by one: many formats seek to the nearest key frame only.
            while place < frame and video.grab():
                place += 1
            picture: Any = None
            if place == frame:
                _, picture = video.retrieve()
            if picture is None or np.ndim(picture) != 3:
                found = f"a video of {place + 1}" if place >= 0 else "a file that OpenCV cannot read"
                raise PolarguideError(
                    path,
                    expected=f"a video with frame {frame}, counted from 0",
                    found=found,
                    remedy="Correct the table, or save the frames as pictures.",
                )
            yield np.ascontiguousarray(picture[..., ::-1])
    finally:
        video.release()
