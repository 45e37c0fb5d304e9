"""A filter turned before an ordinary camera: four shots per view -> intensities behind four polarizer angles."""

from polarguide.capture.filter.align import Shift, aligned, find_shifts
from polarguide.capture.filter.camera_raw import is_camera_raw
from polarguide.capture.filter.exif import orientation
from polarguide.capture.filter.shots import Shots, find_shots, read_shots
from polarguide.capture.filter.transfer import Decision, decide_transfer, decoded

__all__ = [
    "Decision",
    "Shift",
    "Shots",
    "aligned",
    "decide_transfer",
    "decoded",
    "find_shifts",
    "find_shots",
    "is_camera_raw",
    "orientation",
    "read_shots",
]
