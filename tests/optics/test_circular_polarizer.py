"""A circular polarizer (CPL) by Mueller calculus: mounted the ordinary way it analyzes, reversed it does not."""

from __future__ import annotations

import numpy as np
import pytest

from polarguide.polarizer import ANGLES, malus


def rotated(mueller: np.ndarray, angle: float) -> np.ndarray:
    """An element turned counter-clockwise by ``angle`` radians."""
    c, s = np.cos(2 * angle), np.sin(2 * angle)
    turn = np.array([[1, 0, 0, 0], [0, c, s, 0], [0, -s, c, 0], [0, 0, 0, 1]])
    return turn.T @ mueller @ turn


def polarizer(angle: float) -> np.ndarray:
    """An ideal linear polarizer whose axis lies at ``angle`` radians."""
    along = np.zeros((4, 4))
    along[:2, :2] = 0.5
    return rotated(along, angle)


def quarter_wave(angle: float, retardance: float = np.pi / 2) -> np.ndarray:
    """A retarder whose fast axis lies at ``angle`` radians."""
    c, s = np.cos(retardance), np.sin(retardance)
    return rotated(np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, c, s], [0, 0, -s, c]]), angle)


def circular(angle: float, *, reversed_: bool, retardance: float = np.pi / 2) -> np.ndarray:
    """A CPL turned to ``angle``: light meets the polarizer first, then the plate at 45 degrees; or from behind."""
    parts = [polarizer(angle), quarter_wave(angle + np.pi / 4, retardance)]
    first, second = reversed(parts) if reversed_ else parts
    return np.asarray(second @ first)


def seen(stokes: np.ndarray, **how: object) -> np.ndarray:
    """Brightness at the four angles of the filter."""
    return np.array([(circular(np.radians(angle), **how) @ stokes)[0] for angle in ANGLES])  # type: ignore[arg-type]


@pytest.mark.parametrize("aolp", np.radians([0.0, 20.0, 67.0, 110.0, 155.0]))
@pytest.mark.parametrize("dolp", [0.1, 0.6, 1.0])
def test_mounted_the_ordinary_way_it_follows_malus(aolp: float, dolp: float) -> None:
    stokes = np.array([0.8, 0.8 * dolp * np.cos(2 * aolp), 0.8 * dolp * np.sin(2 * aolp), 0.0])
    expected = [malus(stokes[:3], np.radians(angle)) for angle in ANGLES]
    np.testing.assert_allclose(seen(stokes, reversed_=False), expected, atol=1e-12)
    # The plate behind the polarizer cannot change the brightness, whatever its color or quality.
    np.testing.assert_allclose(seen(stokes, reversed_=False, retardance=1.1), expected, atol=1e-12)


@pytest.mark.parametrize("aolp", np.radians([0.0, 20.0, 67.0, 110.0, 155.0]))
def test_reversed_it_gives_no_modulation(aolp: float) -> None:
    stokes = np.array([0.8, 0.8 * np.cos(2 * aolp), 0.8 * np.sin(2 * aolp), 0.0])
    np.testing.assert_allclose(seen(stokes, reversed_=True), 0.4, atol=1e-12)


def test_before_a_screen_only_the_analyzing_side_goes_dark() -> None:
    screen = np.array([1.0, 0.0, 1.0, 0.0])  # linear at 45 degrees, as most are
    turns = np.radians(np.arange(180))
    for reversed_, darkest in ((False, 0.0), (True, 0.5)):
        least = min((circular(turn, reversed_=reversed_) @ screen)[0] for turn in turns)
        assert least == pytest.approx(darkest, abs=1e-12)
