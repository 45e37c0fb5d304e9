"""The eight orders: what they do to names, pictures and angles."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from polarguide import optics
from polarguide.capture.angle_evidence import IDENTITY, ORDERS, PAIRINGS, Order, OrderPosterior, swaps
from polarguide.capture.calibration import Calibration, oriented
from polarguide.capture.sensor.pattern import sensor_pattern
from polarguide.geometry.polarizer import ANGLES
from polarguide.inspection.angles import MOSAICS, AngleFindings


def test_three_pairings_of_eight_orders_are_all_permutations() -> None:
    found = {order.files(pairing) for pairing in PAIRINGS for order in ORDERS}
    assert len(found) == 24
    assert all(sorted(files) == [0, 45, 90, 135] for files in found)
    assert IDENTITY.files() == (0, 45, 90, 135)


def test_orders_of_the_first_pairing_keep_the_pairs() -> None:
    for order in ORDERS:
        i0, i45, i90, i135 = order.files()
        assert (i0 - i90) % 180 == 90
        assert (i45 - i135) % 180 == 90


@pytest.mark.parametrize("order", ORDERS)
def test_an_order_turns_the_aolp_as_its_sense_and_zero_say(order) -> None:
    rng = np.random.default_rng(0)
    values = rng.uniform(0.1, 0.9, (4, 5, 6, 3)).astype(np.float32)
    values[3] = values[0] + values[2] - values[1]  # an ideal capture
    right = oriented(values, Calibration(order=order.files()))
    before, after = (optics.aolp(optics.stokes(torch.from_numpy(v).double())) for v in (values, right))
    expected = order.sense * before + math.radians(order.zero)
    torch.testing.assert_close(torch.cos(2 * after), torch.cos(2 * expected), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.sin(2 * after), torch.sin(2 * expected), atol=1e-5, rtol=0)


CAUSES = [(key, place) for key, causes in MOSAICS.items() for place in range(causes.count("--flip") or 1)]


@pytest.mark.parametrize(("key", "place"), CAUSES)
def test_mirrored_turned_and_shifted_mosaics_are_named_by_the_options_that_read_them(key, place) -> None:
    """By the angles of a sensor whose mosaic is mirrored, turned or begins elsewhere, in the frame of that picture."""
    pattern = sensor_pattern("IMX250MZR").angles
    stored = np.tile(pattern, (2, 2))
    option, value = MOSAICS[key].replace(",", "").split(" or ")[place].split()[:2]
    if value in ("90", "270"):
        stored = (np.rot90(stored, int(value) // 90) + int(value)) % 180
    elif option == "--flip":
        stored = stored[:, ::-1] if "x" in value else stored
        stored = stored[::-1] if "y" in value else stored
        stored = -stored % 180 if len(value) == 1 else stored  # a mirror turns angles round
    else:
        stored = np.roll(stored, -int(value), axis=1 if option == "--offset-x" else 0)
    true = {int(pattern[place]): int(stored[place]) for place in np.ndindex(2, 2)}
    order = Order(*key)
    assert order.files() == tuple(true[angle] for angle in ANGLES)
    sure = OrderPosterior((0.0,) * 8, tuple(float(other == order) for other in ORDERS), 0.0, 1.0)
    found = AngleFindings(0, (), sure, Calibration(), mosaic=True)
    assert f"{option} {value}" in found.correction(0.0)
    assert option not in replace(found, mosaic=False).correction(0.0)


def test_swaps_in_words() -> None:
    assert swaps((0, 45, 90, 135)) == "nothing"
    assert swaps((90, 45, 0, 135)) == (
        "the picture named 0° was taken at 90°, the picture named 90° was taken at 0°"
    )
