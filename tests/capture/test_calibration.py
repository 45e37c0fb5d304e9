"""Two calibrations, one after the other, are one."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from polarguide.capture.calibration import Calibration, combined, oriented
from polarguide.polarizer import ANGLES, malus


def taken(calibration: Calibration) -> np.ndarray:
    """What an instrument of this calibration stores under 0, 45, 90 and 135 of one pixel's light, [4, 1]."""
    sign = -1 if calibration.sense == "cw" else 1
    stokes = (1.0, 0.3, 0.25)
    true = [np.radians(sign * angle + calibration.zero) for angle in calibration.order]
    return np.array([[malus(stokes, angle)] for angle in true], np.float32)


SOME = [
    Calibration(),
    Calibration(sense="cw"),
    Calibration(zero=90),
    Calibration(sense="cw", zero=45),
    Calibration(order=(90, 45, 0, 135)),
    Calibration(order=(45, 0, 90, 135)),
    Calibration(zero=12.0),
    Calibration(sense="cw", zero=-10.0),
]


@pytest.mark.parametrize(("first", "second"), list(itertools.product(SOME, SOME)))
def test_one_calibration_in_place_of_two(first: Calibration, second: Calibration) -> None:
    whole = combined(first, second)
    if whole is None:
        assert not first.permutes  # a pairing found after a turn was no fault of names
        assert sorted(second.order) == sorted(ANGLES) != list(second.order)
        return
    # The stored values are those of an instrument that counts as ``whole`` says: all three ways read the same light.
    stored = taken(whole)
    np.testing.assert_allclose(oriented(stored, whole), taken(Calibration()), atol=1e-6)
    np.testing.assert_allclose(oriented(oriented(stored, first), second), taken(Calibration()), atol=1e-6)
