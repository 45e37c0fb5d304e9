"""Angles of the polarizer that the names of shots say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from faults import Fault

from polarguide_shots.calibration.settings import CalibrateSettings


@pytest.mark.parametrize(
    ("name", "degrees"),
    [("shot_022.5", 22.5), ("shot_005_75", 75.0), ("30deg", 30.0), ("pol 120deg", 120.0), ("0", 0.0)],
)  # fmt: skip
def test_angles_of_names(name: str, degrees: float) -> None:
    settings = CalibrateSettings("IMX250MZR", angles="names")
    assert settings.known_angles([Path(f"{name}.png")]) == [pytest.approx(np.radians(degrees))]


@pytest.mark.parametrize(
    ("name", "why"),
    [("pol_-30", "a sign or a hyphen"), ("pol-30", "a sign or a hyphen"), ("pol_+30deg", "a sign or a hyphen"),
     ("shot_1e2", "'shot_1e2'"), ("shot_1e-2", "a sign or a hyphen"),
     ("shot_30deg_2", "an angle in degrees before"),
     ("pol30", "'pol30'"), ("shot_1,5", "'shot_1,5'"), ("a.30", "'a.30'")],
)  # fmt: skip
def test_names_that_may_mean_another_angle_are_refused(name: str, why: str) -> None:
    settings = CalibrateSettings("IMX250MZR", angles="names")
    error = Fault(expected="a name that ends in the angle").raised_by(
        settings.known_angles, [Path(f"{name}.png")]
    )
    assert why in error.found
