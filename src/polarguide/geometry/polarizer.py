"""Linear polarizers: the four standard angles and Malus's law, for NumPy arrays and PyTorch tensors.

Angles are measured from the image's horizontal, counter-clockwise in the displayed picture.
"""

from __future__ import annotations

from typing import Any

import numpy as np

ANGLES = (0, 45, 90, 135)
"""Polarizer angles in degrees, in the order of every stack of four intensities."""


def malus(stokes: Any, angle: Any) -> Any:
    """Return the intensity behind an ideal polarizer by Malus's law, ``(S0 + S1 cos 2a + S2 sin 2a) / 2``.

    Args:
        stokes: S0, S1 and S2, each [...]: an array or tensor [3, ...], or a sequence.
        angle: angle of the polarizer in radians: a number, or an array or tensor that broadcasts against [...].

    Returns:
        Intensity [...], of the same type as ``stokes``.
    """
    s0, s1, s2 = stokes
    twice = 2 * angle
    if isinstance(twice, (int, float, np.ndarray, np.generic)):
        cosine = np.cos(twice)
        sine = np.sin(twice)
    else:
        cosine = twice.cos()
        sine = twice.sin()
    return (s0 + s1 * cosine + s2 * sine) / 2


def stokes_of_four(intensities: Any) -> tuple[Any, Any, Any]:
    """Solve Malus's law for S0, S1 and S2 by least squares, from the intensities at ``ANGLES``.

    ``S0 = (I0 + I45 + I90 + I135) / 2``, ``S1 = I0 - I90``, ``S2 = I45 - I135``.

    Args:
        intensities: four intensities, each [...]: an array or tensor [4, ...], or a sequence.

    Returns:
        S0, S1 and S2, each [...].
    """
    i0, i45, i90, i135 = intensities
    return (i0 + i45 + i90 + i135) / 2, i0 - i90, i45 - i135


def four_intensities(stokes: Any) -> tuple[Any, Any, Any, Any]:
    """Return the intensities at ``ANGLES`` by Malus's law: the inverse of ``stokes_of_four``.

    Args:
        stokes: S0, S1 and S2, each [...].

    Returns:
        Four intensities, each [...].
    """
    s0, s1, s2 = stokes
    return (s0 + s1) / 2, (s0 + s2) / 2, (s0 - s1) / 2, (s0 - s2) / 2
