"""Malus's law for numbers, arrays and tensors, and at the four angles."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from polarguide import optics
from polarguide.capture import view
from polarguide.geometry.polarizer import ANGLES, four_intensities, malus, stokes_of_four

LIGHT = np.random.default_rng(0).uniform(0.1, 1.0, (3, 4, 5))


@pytest.mark.parametrize("angle", [0.0, 0.3, math.pi / 2, -1.1])
def test_arrays_and_tensors_give_the_same(angle: float) -> None:
    s0, s1, s2 = LIGHT
    expected = s0 / 2 + np.hypot(s1, s2) / 2 * np.cos(np.arctan2(s2, s1) - 2 * angle)
    assert np.allclose(malus(LIGHT, angle), expected, rtol=0, atol=1e-15)
    tensor = malus(torch.from_numpy(LIGHT), torch.tensor(angle, dtype=torch.float64))
    assert np.allclose(tensor.numpy(), expected, rtol=0, atol=1e-15)


def test_an_angle_for_each_pixel() -> None:
    angles = np.radians(np.resize(ANGLES, (4, 5)))
    found = malus(LIGHT, angles)
    assert found[1, 2] == pytest.approx(malus(LIGHT[:, 1, 2], angles[1, 2]))


def test_the_angle_has_a_gradient() -> None:
    angle = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
    malus(torch.tensor([1.0, 0.3, 0.2], dtype=torch.float64), angle).backward()
    assert angle.grad is not None
    assert float(angle.grad) == pytest.approx(-0.3 * math.sin(0.8) + 0.2 * math.cos(0.8))


def test_the_four_angles_are_the_law_and_invert() -> None:
    four = np.stack(four_intensities(LIGHT))
    assert np.allclose(four, [malus(LIGHT, math.radians(angle)) for angle in ANGLES], rtol=0, atol=1e-15)
    assert np.allclose(np.stack(stokes_of_four(four)), LIGHT, rtol=0, atol=1e-15)


def test_the_angles_are_one_object() -> None:
    assert optics.ANGLES is ANGLES
    assert view.ANGLES is ANGLES
