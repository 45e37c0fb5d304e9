"""Find groups of consecutive pictures that show one place, and extract the frames of videos."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.filter.camera_files import is_camera_raw, read_camera_raw
from polarguide.capture.formats.pictures import decode_picture
from polarguide.capture.formats.stored import read_picture
from polarguide.capture.write import write_png_file
from polarguide.core.errors import require
from polarguide.core.files import make_folder, write_text
from polarguide.core.progress import Advance, Reporter

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
MOST_SHOTS = 12
"""Largest number of shots of one place. It is sufficient for one shot every 15 degrees over 180 degrees."""
_SAMPLED = 24
_SIDE = 96
_BLUR = 4.0
_APART = 2.0
"""Smallest ratio of the differences between pictures of different groups to those within a group."""


def shots_of_one_place(paths: Sequence[Path]) -> int | None:
    """Return the number of consecutive pictures that show one place. Return None if there are no such groups.

    A rotating filter changes reflections but moves no edge. Consecutive pictures are therefore compared without low
    frequencies. Differences within groups must be much smaller than between groups. Only the first pictures are read.

    Raises:
        PolarguideError: a picture cannot be read.
    """
    count = len(paths)
    sizes = [size for size in range(2, MOST_SHOTS + 1) if count % size == 0 and count // size >= 3]
    if not sizes:
        return None
    pictures = [_edges(path) for path in paths[: max(_SAMPLED, 3 * max(sizes))]]
    # One minus the correlation.
    steps = np.array([1.0 - float((a * b).mean()) for a, b in itertools.pairwise(pictures)])
    places = np.arange(1, len(steps) + 1)
    for size in sizes:
        between = places % size == 0
        if np.percentile(steps[between], 10) > _APART * np.percentile(steps[~between], 90):
            return size
    return None


def _edges(path: Path) -> NDArray[np.float32]:
    """Return a small gray picture without low frequencies, with a standard deviation of 1."""
    raw = is_camera_raw(path)
    pixels = read_camera_raw(path)[0] if raw else decode_picture(path, read_picture(path))
    small = cv2.resize(
        np.sqrt(pixels.mean(axis=2, dtype=np.float32)), (_SIDE, _SIDE), interpolation=cv2.INTER_AREA
    )
    fine = small - cv2.GaussianBlur(small, (0, 0), _BLUR)
    return np.asarray(fine / max(float(fine.std()), 1e-6), np.float32)


FRAMES_A_SECOND = 2.0
"""Number of frames per second of a video that are used.

If the camera moves around a subject in a minute, it turns by 3 degrees between two of these frames.
"""
LEAST_FRAMES = 24
MOST_FRAMES = 120
_RECORD = "video.txt"


def find_videos(root: Path) -> list[Path]:
    """Return the videos in a folder. If ``root`` is a video file, return it."""
    files = [root] if root.is_file() else sorted(root.iterdir()) if root.is_dir() else []
    return [path for path in files if path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES]


def extract_frames(video: Path, folder: Path, reporter: Reporter) -> int:
    """Write the sharpest frame of each time interval of a video as a PNG file, and return the number of frames.

    Frames are rotated for display. The files of an earlier call for the same video are reused.

    Raises:
        PolarguideError: OpenCV cannot read the video, or it has too few frames.
    """
    status = video.stat()
    record = f"{video.resolve()} {status.st_size} {status.st_mtime_ns}\n"
    done = folder / _RECORD
    if done.is_file() and done.read_text() == record:
        return len(list(folder.glob("frame_*.png")))
    require(
        not folder.exists() or not any(folder.iterdir()) or done.is_file(),
        folder,
        expected="a new folder for the frames of the video",
        found="other files",
        remedy="Choose another --out: the folder of the frames is next to it.",
    )
    reader = cv2.VideoCapture(str(video))
    total = int(reader.get(cv2.CAP_PROP_FRAME_COUNT))
    rate = reader.get(cv2.CAP_PROP_FPS) or 25.0
    wanted = int(np.clip(FRAMES_A_SECOND * total / rate, LEAST_FRAMES, MOST_FRAMES))
    require(
        total >= 3,
        video,
        expected="a video that OpenCV reads",
        found=f"{max(total, 0)} frames",
        remedy="Convert it to H.264 in .mp4, or save its frames as pictures.",
    )
    make_folder(folder)
    write_text(done, "unfinished\n")
    for old in folder.glob("frame_*.png"):
        old.unlink()
    written = 0
    with reporter.track("reading frames", total) as advance:
        frames = enumerate(_frames(reader, total, advance))
        for _, interval in itertools.groupby(frames, key=lambda frame: frame[0] * wanted // total):
            _, sharpest = max(interval, key=lambda frame: _sharpness(frame[1]))
            write_png_file(folder / f"frame_{written:04d}.png", np.ascontiguousarray(sharpest[..., ::-1]))
            written += 1
    reader.release()
    write_text(done, record)
    return written


def _frames(reader: cv2.VideoCapture, total: int, advance: Advance) -> Iterator[NDArray[np.uint8]]:
    """Yield up to ``total`` frames of a video, BGR."""
    for number in range(total):
        is_read, picture = reader.read()
        if not is_read:
            return
        advance(number + 1)
        yield np.asarray(picture, np.uint8)


def _sharpness(picture: NDArray[np.uint8]) -> float:
    return float(cv2.Laplacian(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), cv2.CV_32F).var())


_MANY = 100
"""Largest number of pictures whose pairs are all compared, even if their names are numbered. They form 4950 pairs."""
_NUMBERED = re.compile(r"(?P<name>.*?)(?P<number>\d+)")
_NEIGHBORS = 20
"""Approximate number of pictures that COLMAP compares with each picture in sequential matching."""


def chosen_matching(views: Sequence[str], matching: str, reporter: Reporter) -> str:
    """Choose the matching of pictures, "exhaustive" or "sequential".

    A message informs the user about the choice for ``auto``, or about a faster alternative.

    Args:
        views: names of the views in their order.
        matching: matching that the user requested.
        reporter: reporter of the message.
    """
    if matching != "auto":
        return matching
    names = [_NUMBERED.fullmatch(view) for view in views]
    numbers = [int(name["number"]) for name in names if name is not None]
    running = len(numbers) == len(views) and len({name["name"] for name in names if name is not None}) == 1
    running = running and numbers[-1] - numbers[0] < 2 * len(numbers)
    frames = running and views[0].lower().startswith("frame")
    pairs = len(views) * (len(views) - 1) // 2
    few = _NEIGHBORS * len(views)
    if pairs > few and (frames or (running and len(views) > _MANY)):
        kind = "frames of a video" if frames else "running numbers"
        reporter.say(
            f"Matching: about {few} pairs of neighbors ({kind}); --matching exhaustive compares all {pairs}."
        )
        return "sequential"
    if pairs > 2 * few or (running and pairs > few):
        option = "If consecutive pictures by name overlap, --matching sequential compares about"
        reporter.say(f"Matching: all {pairs} pairs. {option} {few}.")
    return "exhaustive"
