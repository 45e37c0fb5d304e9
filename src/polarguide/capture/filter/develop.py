"""Estimate and correct small shifts and rotations between the shots of a view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.geometry.polarizer import ANGLES

SMALLEST = 0.2
"""Smallest shift in pixels that is corrected. The estimate has errors of this size, and a correction blurs a shot."""
LARGEST_SHARE = 0.05
"""Largest shift that is corrected, as a share of the picture's width."""

_BETTER = 0.95
_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-5)


@dataclass(frozen=True)
class Shift:
    """Displacement of a shot relative to the first.

    Attributes:
        x: shift to the right in pixels. If there is a ``warp``, it is the shift of the picture's center.
        y: shift down in pixels, as ``x``.
        trusted: True if the estimate is reliable.
        warp: affine matrix [2, 3] from pixels of the first shot to pixels of this shot, row by row. It is ``None`` if
            the shot is not rotated. The center of the first pixel is at (0, 0).
    """

    x: float
    y: float
    trusted: bool
    warp: tuple[float, ...] | None = None

    @property
    def corrected(self) -> bool:
        """True if the shift is reliable and large enough for a correction."""
        return self.trusted and (self.warp is not None or max(abs(self.x), abs(self.y)) >= SMALLEST)


AGREEING = 0.05
"""Largest mean of |I0 + I90 - I45 - I135| / S0 at which four shots count as aligned."""


def estimate_shifts(linear: NDArray[np.float32]) -> list[Shift]:
    """Estimate the shifts of the four shots relative to the first.

    Phase correlation of fine detail in the logarithms gives initial values: brightness and polarization vary slowly
    across a surface, and edges stay. Maximization of the enhanced correlation coefficient refines them to a fraction of
    a pixel. Edges of polarization can mislead both. Shifts are therefore trusted only if they improve I0 + I90 = I45 +
    I135. A rotation is added if it improves the pair sums further. A homography would improve them more, but deviates
    more from the truth.

    Args:
        linear: linear intensities [4, H, W, 3].
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
    if least < AGREEING:  # pair sums agree, so shots did not move
        return [shift if shift.trusted else Shift(0.0, 0.0, True) for shift in shifts]
    return shifts


def _aligned_disagreement(linear: NDArray[np.float32], shifts: Sequence[Shift]) -> float:
    moved, _, outside = align_shots(linear, (), shifts)
    return _disagreement(moved, outside)


def _disagreement(linear: NDArray[np.float32], bad: NDArray[np.bool_]) -> float:
    """Return the mean of |I0 + I90 - I45 - I135| / S0, after the two pair sums were scaled to the same brightness."""
    i0, i45, i90, i135 = linear.mean(axis=3)[:, ~bad]
    first = i0 + i90
    second = i45 + i135
    if not second.sum() > 0:
        return 0.0
    return float(np.abs(first - second * (first.sum() / second.sum())).sum() / first.sum())


def align_shots(
    linear: NDArray[np.float32], masks: Sequence[NDArray[np.bool_]], shifts: Sequence[Shift]
) -> tuple[NDArray[np.float32], list[NDArray[np.bool_]], NDArray[np.bool_]]:
    """Resample shots so that all of them are aligned with the first shot.

    Args:
        linear: linear intensities [K, H, W, 3].
        masks: masks for each shot, [K, H, W], or for all shots, [H, W].
        shifts: shift of each shot.

    Returns:
        The aligned intensities; for each of ``masks`` a mask [H, W] of the pixels that depend on a marked pixel of some
        shot; and a mask [H, W] of the pixels that depend on a place outside a shot.
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
    """Resample a mask [H, W] at the coordinates ``x`` and ``y`` by bilinear interpolation.

    A pixel of the result is True if its interpolation uses a marked pixel or a place outside the mask.
    """
    weight = cv2.remap(
        mask.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1.0
    )
    return np.asarray(weight > 0)


def moved_shots(shifts: Sequence[Shift]) -> list[str]:
    """Describe each shot whose shift was corrected, as text."""
    return [
        f"{angle} by ({-shift.x:+.2f}, {-shift.y:+.2f}){'' if shift.warp is None else ' and turned'}"
        for angle, shift in zip(ANGLES, shifts, strict=True)
        if shift.corrected
    ]


def shift_notes(view: str, shifts: Sequence[Shift]) -> list[str]:
    """Return notes for the user about shots with a corrected shift, and about shots with an unreliable shift."""
    moved = moved_shots(shifts)
    doubtful = [str(angle) for angle, shift in zip(ANGLES, shifts, strict=True) if not shift.trusted]
    notes = [f"{view}: shots were shifted back, in pixels: {', '.join(moved)}."] if moved else []
    if doubtful:
        notes.append(
            f"{view}: I0 + I90 and I45 + I135 differ, and no shift of the shots at {', '.join(doubtful)} explains it. "
            "These shots are not shifted."
        )
    return notes


def _detail(shot: NDArray[np.float32]) -> NDArray[np.float32]:
    gray = np.log(shot.mean(axis=2) + np.float32(0.01))
    return np.asarray(cv2.GaussianBlur(gray, (0, 0), 0.8) - cv2.GaussianBlur(gray, (0, 0), 5.0), np.float32)


def _shift(reference: NDArray[np.float32], other: NDArray[np.float32]) -> Shift:
    height, width = reference.shape
    if min(height, width) < 2:  # the window needs two pixels
        return Shift(0.0, 0.0, False)
    window = cv2.createHanningWindow((width, height), cv2.CV_32F)
    # The window reduces the weight of borders, where new content has no match. phaseCorrelate would apply it in place,
    # and only for some sizes.
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
    except cv2.error:  # no convergence without detail
        return Shift(0.0, 0.0, False)
    x, y = (float(value) for value in np.asarray(moved)[:, 2])
    return Shift(
        round(x, 3),
        round(y, 3),
        score > 0.3 and max(abs(x), abs(y)) <= limit and bool(np.isfinite([x, y]).all()),
    )


_TURN_SIDE = 1024
"""Longer side in pixels at which rotations are estimated."""


def _turn(reference: NDArray[np.float32], other: NDArray[np.float32], shift: Shift) -> Shift:
    """Estimate the rotation of a shot in addition to its shift.

    The shift is returned unchanged if the estimate does not converge, or if the rotation is negligible.
    """
    height, width = reference.shape
    if min(height, width) < 2:
        return shift
    factor = max(1, -(-max(height, width) // _TURN_SIDE))
    small = [
        cv2.resize(d, (width // factor, height // factor), interpolation=cv2.INTER_AREA)
        for d in (reference, other)
    ]
    half = (
        factor - 1
    ) / 2  # distance between the centers of the first pixels of the small and the large picture
    large = np.array([[factor, 0, half], [0, factor, half], [0, 0, 1]], np.float64)
    start = np.eye(3)
    start[:2, 2] = (shift.x, shift.y) if shift.trusted else (0.0, 0.0)
    start = (np.linalg.inv(large) @ start @ large).astype(np.float32)
    everywhere = np.ones(small[0].shape, np.uint8)
    try:
        score, start[:2] = cv2.findTransformECC(
            small[0], small[1], start[:2].copy(), cv2.MOTION_EUCLIDEAN, _CRITERIA, everywhere, 5
        )
    except cv2.error:  # no convergence without detail
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
