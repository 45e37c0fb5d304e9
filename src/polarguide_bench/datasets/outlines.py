"""Evidence of the outlines of masks on the sense of the angles of a dataset of Stokes vectors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.angle_evidence import SENSES, AngleLimits
from polarguide.capture.calibration import Sense

# Pixels of the blur before the gradient of a mask.
_BLUR = 2.0
# Width of the band inside the outline, as a share of the side of a square with the area of the mask.
_BAND = 0.06
# Smallest number of pixels in the band.
_LEAST = 50


class OutlineAgreement(NamedTuple):
    """Agreement of the AoLP with the outline of one view's mask, for both senses of the angles.

    An agreement is the mean of cos 4(angle - direction of the outline), weighted by the DoLP. It is 1 if the light is
    polarized along or across the outline at every pixel, and 0 if the two directions are unrelated.

    Attributes:
        ccw: agreement if the angles increase counter-clockwise.
        cw: agreement if the angles increase clockwise.
    """

    ccw: float
    cw: float


def outline_agreement(
    stokes: NDArray[np.float32], mask: NDArray[np.bool_], zero: float = 0.0
) -> OutlineAgreement | None:
    """Compare the polarization of a view with the outline of its mask. Return None if the outline is too short.

    At the outline of a curved body, the surface normal lies in the picture, across the outline. Diffuse light is
    polarized along this normal, and specular light across it. Both agree with the outline if the sense of the angles is
    right. With a wrong sense, they agree only at outlines along the axes or diagonals.

    Args:
        stokes: Stokes vectors [3, H, W, C] in the stated sense.
        mask: mask of the object, [H, W].
        zero: zero of the angles, in radians counter-clockwise from the picture's horizontal.
    """
    area = int(mask.sum())
    if area < _LEAST or mask.all():
        return None
    soft = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), _BLUR)
    across = cv2.Sobel(soft, cv2.CV_32F, 1, 0), cv2.Sobel(soft, cv2.CV_32F, 0, 1)
    depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    # At the border of the picture, the outline is the border.
    edge = math.ceil(2 * _BLUR)
    inner = np.zeros_like(mask)
    inner[edge:-edge, edge:-edge] = True
    band = mask & inner & (depth <= max(2.0 * _BLUR, _BAND * math.sqrt(area))) & (np.hypot(*across) > 1e-3)
    band &= np.isfinite(stokes).all(axis=(0, 3))
    if int(band.sum()) < _LEAST:
        return None
    outline: Any = np.arctan2(-across[1], across[0])[band]  # y points down, angles count upwards
    s0, s1, s2 = stokes.mean(axis=3)[:, band].astype(np.float64)
    weight = np.minimum(np.hypot(s1, s2) / np.maximum(s0, 1e-12), 1.0) * (s0 > 0)
    total = float(weight.sum())
    if not total > 0:
        return None
    angle = np.arctan2(s2, s1) / 2
    return OutlineAgreement(
        *(float((weight * np.cos(4 * (sense * angle + zero - outline))).sum()) / total for sense in SENSES)
    )


def sense_of_outlines(views: Sequence[OutlineAgreement]) -> Sense | None:
    """Return the sense that the outlines of most views clearly support. Return None if they do not decide.

    The threshold is a share of the views and not a number of standard errors. If a body is not curved at its outline,
    the error is systematic, so it does not average out.
    """
    if not views:
        return None
    gains = np.array([view.ccw - view.cw for view in views])
    mean = float(gains.mean())
    agreeing = float((np.sign(gains) == np.sign(mean)).mean())
    if abs(mean) < AngleLimits.outline_gain or agreeing < AngleLimits.outline_share:
        return None
    return "ccw" if mean > 0 else "cw"
