"""From stored shots to aligned linear intensities: small shifts between the shots, and their transfer function."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.geometry.polarizer import ANGLES

SMALLEST = 0.2
"""Shifts below this many pixels are not corrected: resampling would blur more, and polarization causes errors of the
estimate of this size."""
LARGEST_SHARE = 0.05
"""Shifts above this share of the picture's width are reported but not corrected."""

_BETTER = 0.95
_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-5)


@dataclass(frozen=True)
class Shift:
    """How a shot lies relative to the first.

    Attributes:
        x, y: shift in pixels, right and down; with a ``warp``, that of the picture's center.
        trusted: whether the estimate is reliable.
        warp: affine matrix [2, 3], row by row, that maps pixels of the first shot to this one; None: the camera did not
            turn between them. In it, unlike elsewhere, the center of the first pixel is (0, 0).
    """

    x: float
    y: float
    trusted: bool
    warp: tuple[float, ...] | None = None

    @property
    def corrected(self) -> bool:
        """Whether the shift is corrected: reliable and large enough."""
        return self.trusted and (self.warp is not None or max(abs(self.x), abs(self.y)) >= SMALLEST)


AGREEING = 0.05
"""Mean |I0 + I90 - I45 - I135| / S0 up to which shots lie on one another; ``inspect`` calls more inconsistent."""


def estimate_shifts(linear: NDArray[np.float32]) -> list[Shift]:
    """Estimate the shifts of the four shots relative to the first.

    Phase correlation of the logarithms' fine detail finds a start (brightness and polarization change slowly
    across a surface, edges stay); maximizing the enhanced correlation coefficient refines it to a fraction of
    a pixel. Edges of polarization can mislead both, so the shifts are trusted only if with them
    I0 + I90 = I45 + I135 holds better than without. If the camera was turned, pair sums agree still better with a
    rotation beside the shift. A homography agrees with them better still, but less with the truth.

    Args:
        linear: [4, H, W, 3] linear intensities.
    """
    detail = [_detail(shot) for shot in linear]
    shifts = [Shift(0.0, 0.0, True), *(_shift(detail[0], other) for other in detail[1:])]
    least = _disagreement(linear, np.zeros(linear.shape[1:3], bool))
    if any(shift.corrected for shift in shifts):
        after = _aligned_disagreement(linear, shifts)
        if after < _BETTER * least:
            least = after
        else:
            shifts = [shifts[0], *(replace(shift, trusted=False) for shift in shifts[1:])]
    turned = [shifts[0], *(_turn(detail[0], detail[k], shifts[k]) for k in (1, 2, 3))]
    if turned != shifts and _aligned_disagreement(linear, turned) < _BETTER * least:
        return turned
    if least < AGREEING:  # nothing moved, whatever the details say
        return [shift if shift.trusted else Shift(0.0, 0.0, True) for shift in shifts]
    return shifts


def _aligned_disagreement(linear: NDArray[np.float32], shifts: Sequence[Shift]) -> float:
    moved, _, outside = align_shots(linear, (), shifts)
    return _disagreement(moved, outside)


def _disagreement(linear: NDArray[np.float32], bad: NDArray[np.bool_]) -> float:
    """Mean |I0 + I90 - I45 - I135| relative to S0, after removing a common gain."""
    i0, i45, i90, i135 = linear.mean(axis=3)[:, ~bad]
    first = i0 + i90
    second = i45 + i135
    if not second.sum() > 0:
        return 0.0
    return float(np.abs(first - second * (first.sum() / second.sum())).sum() / first.sum())


def align_shots(
    linear: NDArray[np.float32], masks: Sequence[NDArray[np.bool_]], shifts: Sequence[Shift]
) -> tuple[NDArray[np.float32], list[NDArray[np.bool_]], NDArray[np.bool_]]:
    """Shift the shots back.

    Args:
        linear: [K, H, W, 3] linear intensities.
        masks: pixels of each shot, [K, H, W], or of all shots, [H, W].
        shifts: shifts of the shots.

    Returns:
        The moved intensities; for each mask the pixels that depend on a marked one of any shot, [H, W]; and the pixels
        that depend on one outside of a shot, [H, W].
    """
    height, width = linear.shape[1:3]
    moved = linear.copy()
    each = [np.broadcast_to(mask, linear.shape[:3]).copy() for mask in masks]
    outside = np.zeros((height, width), bool)
    for index, shift in enumerate(shifts):
        if not shift.corrected:
            continue
        y, x = np.mgrid[:height, :width].astype(np.float32)
        if shift.warp is None:
            x = x + np.float32(shift.x)
            y = y + np.float32(shift.y)
        else:
            places = np.stack([x.ravel(), y.ravel()], axis=-1)[:, None]
            matrix = np.array(shift.warp, np.float64).reshape(2, 3)
            x, y = cv2.transform(places, matrix)[:, 0].T.reshape(2, height, width)
        moved[index] = cv2.remap(linear[index], x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        beyond = remapped_mask(np.zeros((height, width), bool), x, y)
        for mask in each:
            mask[index] = remapped_mask(mask[index], x, y) & ~beyond
        outside |= beyond
    return moved, [np.asarray(mask.any(axis=0)) for mask in each], outside


def remapped_mask(mask: NDArray[np.bool_], x: Any, y: Any) -> NDArray[np.bool_]:
    """A mask [H, W] looked up at places ``x`` and ``y``: True where a pixel of it or one outside has weight."""
    weight = cv2.remap(
        mask.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1.0
    )
    return np.asarray(weight > 0)


def moved_shots(shifts: Sequence[Shift]) -> list[str]:
    """The shots that were shifted back, and by how much, in words."""
    return [
        f"{angle} by ({-shift.x:+.2f}, {-shift.y:+.2f}){'' if shift.warp is None else ' and turned'}"
        for angle, shift in zip(ANGLES, shifts, strict=True)
        if shift.corrected
    ]


def shift_notes(view: str, shifts: Sequence[Shift]) -> list[str]:
    """Notes about shots that were moved back, and about shots that seem to have moved without a reliable estimate."""
    moved = moved_shots(shifts)
    doubtful = [str(angle) for angle, shift in zip(ANGLES, shifts, strict=True) if not shift.trusted]
    notes = [f"{view}: shots moved, in pixels: {', '.join(moved)}."] if moved else []
    if doubtful:
        notes.append(
            f"{view}: I0 + I90 and I45 + I135 differ, and no shift of the shots at {', '.join(doubtful)} explains it; "
            "they are used as they are."
        )
    return notes


def _detail(shot: NDArray[np.float32]) -> NDArray[np.float32]:
    gray = np.log(shot.mean(axis=2) + np.float32(0.01))
    return np.asarray(cv2.GaussianBlur(gray, (0, 0), 0.8) - cv2.GaussianBlur(gray, (0, 0), 5.0), np.float32)


def _shift(reference: NDArray[np.float32], other: NDArray[np.float32]) -> Shift:
    height, width = reference.shape
    if min(height, width) < 2:  # a window that fades out on both sides has no middle there
        return Shift(0.0, 0.0, False)
    window = cv2.createHanningWindow((width, height), cv2.CV_32F)
    # Borders count less: what enters the picture there has no match. Done here, as phaseCorrelate does it in place, and
    # only to pictures of some sizes.
    reference = reference * window
    other = other * window
    (x, y), _ = cv2.phaseCorrelate(reference, other)
    limit = LARGEST_SHARE * width
    if max(abs(x), abs(y)) > limit:
        x = y = 0.0
    warp = np.array([[1, 0, x], [0, 1, y]], np.float32)
    try:
        score, moved = cv2.findTransformECC(
            reference, other, warp, cv2.MOTION_TRANSLATION, _CRITERIA, np.ones(reference.shape, np.uint8), 5
        )
    except cv2.error:  # it does not converge where there is no detail to compare
        return Shift(0.0, 0.0, False)
    x, y = (float(value) for value in np.asarray(moved)[:, 2])
    return Shift(
        round(x, 3),
        round(y, 3),
        score > 0.3 and max(abs(x), abs(y)) <= limit and bool(np.isfinite([x, y]).all()),
    )


_TURN_SIDE = 1024
"""Pixels of the longer side at which turns are estimated, to a fraction of a pixel."""


def _turn(reference: NDArray[np.float32], other: NDArray[np.float32], shift: Shift) -> Shift:
    """The shift and rotation of a shot whose camera was turned, beginning with its shift; the shift itself where none
    converges, or where no corner moves otherwise.
    """
    height, width = reference.shape
    if min(height, width) < 2:
        return shift
    factor = max(1, -(-max(height, width) // _TURN_SIDE))
    small = [
        cv2.resize(d, (width // factor, height // factor), interpolation=cv2.INTER_AREA)
        for d in (reference, other)
    ]
    half = (factor - 1) / 2  # of the middle of a small picture's first pixel from that of the large one's
    large = np.array([[factor, 0, half], [0, factor, half], [0, 0, 1]], np.float64)
    start = np.eye(3)
    start[:2, 2] = (shift.x, shift.y) if shift.trusted else (0.0, 0.0)
    start = (np.linalg.inv(large) @ start @ large).astype(np.float32)
    everywhere = np.ones(small[0].shape, np.uint8)
    try:
        score, start[:2] = cv2.findTransformECC(
            small[0], small[1], start[:2].copy(), cv2.MOTION_EUCLIDEAN, _CRITERIA, everywhere, 5
        )
    except cv2.error:  # it does not converge where there is no detail to compare
        return shift
    warp = large @ start.astype(np.float64) @ np.linalg.inv(large)
    corners = np.array([[x, y] for x in (0, width - 1) for y in (0, height - 1)], np.float64)
    moved = cv2.transform(corners[:, None], warp[:2])[:, 0] - corners
    middle = moved.mean(axis=0)
    limit = LARGEST_SHARE * width
    if not (np.isfinite(moved).all() and score > 0.3 and np.abs(moved).max() <= limit):
        return shift
    if np.abs(moved - middle).max() < SMALLEST:
        return shift
    x, y = (round(float(value), 3) for value in middle)
    return Shift(x, y, True, tuple(float(f"{value:.9g}") for value in warp[:2].ravel()))
