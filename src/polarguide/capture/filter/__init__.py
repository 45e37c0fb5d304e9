"""A rotating polarizing filter in front of an ordinary camera: four shots per view."""

from polarguide.capture.filter.align import Shift, align_shots, estimate_shifts
from polarguide.capture.filter.camera_raw import is_camera_raw
from polarguide.capture.filter.exif import orientation
from polarguide.capture.filter.shots import Shots, find_shots, read_shots
from polarguide.capture.filter.transfer import TransferDecision, decide_transfer, linear_intensities

__all__ = [
    "Shift",
    "Shots",
    "TransferDecision",
    "align_shots",
    "decide_transfer",
    "estimate_shifts",
    "find_shots",
    "is_camera_raw",
    "linear_intensities",
    "orientation",
    "read_shots",
]
