"""The sense in which a dataset's angles count, told by the outlines of its object masks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.calibration import Sense

# Pixels by which a mask is blurred to take the direction of its outline from its gradient.
_BLUR = 2.0
# Width of the band inside of the outline, as a share of the side of a square with the mask's area.
_BAND = 0.06
# Fewer pixels of a band tell nothing of a view.
_LEAST = 50
# Agreements differ by up to 1, where every pixel agrees in one sense and the outline has all directions. Noise, and
# outlines that the body does not curve away at, agree with neither.
_CLEAR = 0.2
# Share of the views that have to tell the same.
_MOST = 0.75


@dataclass(frozen=True)
class RimAgreement:
    """How well the angles at the outline of one view's mask agree with the outline, if they count either way.

    Attributes:
        ccw, cw: means of cos 4(angle - direction), weighted by the degree of polarization: 1 where the light is
            polarized across or along the outline everywhere, 0 without a relation.
    """

    ccw: float
    cw: float


def rim_agreement(
    stokes: NDArray[np.float32], mask: NDArray[np.bool_], zero: float = 0.0
) -> RimAgreement | None:
    """Compare polarization and outline of a view; None where the mask has too little of an outline.

    At the outline of a body that curves away, the surface normal lies in the picture, across the outline. Light from
    inside the body is polarized along this normal, and light that is mirrored across it. Both agree with the outline if
    the angles are counted as the outline is; mirrored ones agree with it only where it runs along the axes or the
    diagonals.

    Args:
        stokes: [3, H, W, C], in the dataset's own sense.
        mask: of the object, [H, W].
        zero: where the angles begin, in radians counter-clockwise from the picture's horizontal.
    """
    area = int(mask.sum())
    if area < _LEAST or mask.all():
        return None
    soft = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), _BLUR)
    across = cv2.Sobel(soft, cv2.CV_32F, 1, 0), cv2.Sobel(soft, cv2.CV_32F, 0, 1)
    depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    width = max(2.0 * _BLUR, _BAND * math.sqrt(area))
    # Beside the border of the picture, the outline is that of the picture.
    edge = math.ceil(2 * _BLUR)
    inner = np.zeros_like(mask)
    inner[edge:-edge, edge:-edge] = True
    size = np.hypot(*across)
    band = mask & inner & (depth <= width) & (size > 1e-3) & np.isfinite(stokes).all(axis=(0, 3))
    if int(band.sum()) < _LEAST:
        return None
    outline: Any = np.arctan2(-across[1], across[0])[band]  # y down in the picture, angles up
    s0, s1, s2 = stokes.mean(axis=3)[:, band].astype(np.float64)
    weight = np.minimum(np.hypot(s1, s2) / np.maximum(s0, 1e-12), 1.0) * (s0 > 0)
    total = float(weight.sum())
    if not total > 0:
        return None
    angle = np.arctan2(s2, s1) / 2
    ccw, cw = (
        float((weight * np.cos(4 * (sign * angle + zero - outline))).sum()) / total for sign in (1, -1)
    )
    return RimAgreement(ccw, cw)


def sense_of_rims(found: Sequence[RimAgreement]) -> Sense | None:
    """The sense that the outlines of most views agree with clearly; None where they do not tell."""
    if not found:
        return None
    gains = np.array([view.ccw - view.cw for view in found])
    mean = float(gains.mean())
    agreeing = float((np.sign(gains) == np.sign(mean)).mean())
    if abs(mean) < _CLEAR or agreeing < _MOST:
        return None
    return "ccw" if mean > 0 else "cw"
