"""Raw mosaics: packings, bit depths, patterns and levels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from camera_files import COLOR, MONO, pack, write_mosaic

from polarguide.capture.sensor.pattern import estimate_levels, sensor_pattern, unusable_samples
from polarguide.capture.sensor.raw_file import PACKINGS, RawFormat, packed_size, read_mosaic, unpack
from polarguide.errors import PolarguideError


@pytest.mark.parametrize("packing", PACKINGS)
@pytest.mark.parametrize(("width", "height"), [(8, 4), (7, 3), (5, 1)])
def test_packings_round_trip(packing: str, width: int, height: int) -> None:
    bits = PACKINGS[packing][2]
    values = np.random.default_rng(0).integers(0, 2**bits, (height, width))
    data = pack(values, packing)
    assert len(data) == packed_size(width, height, packing)
    np.testing.assert_array_equal(unpack(data, width, height, packing), values)


def test_the_two_12_bit_packings_differ_in_their_bytes() -> None:
    # 0xABC and 0x123, by the words of the two standards.
    np.testing.assert_array_equal(unpack(b"\xbc\x3a\x12", 2, 1, "12p"), [[0xABC, 0x123]])
    np.testing.assert_array_equal(unpack(b"\xab\x3c\x12", 2, 1, "12packed"), [[0xABC, 0x123]])
    np.testing.assert_array_equal(unpack(b"\xff\x03\x00\x00\xc0", 4, 1, "10p"), [[1023, 0, 0, 768]])


@pytest.mark.parametrize(
    ("name", "bits"),
    [("a.png", 8), ("a.png", 16), ("a.tif", 8), ("a.tiff", 16), ("a.npy", 8), ("a.npy", 16)],
)
def test_files_that_know_their_size(tmp_path: Path, name: str, bits: int) -> None:
    values = np.random.default_rng(1).uniform(0, 1, (6, 8))
    write_mosaic(tmp_path / name, values, bits=bits)
    stored = read_mosaic(tmp_path / name, RawFormat())
    assert stored.dtype == (np.uint8 if bits == 8 else np.uint16)
    np.testing.assert_array_equal(stored, np.rint(values * (2**bits - 1)))


@pytest.mark.parametrize(
    ("sensor", "rows"), [("IMX250MYR", COLOR), ("IMX264MYR", COLOR), ("IMX250MZR", MONO)]
)
def test_patterns_and_their_offsets(sensor: str, rows: tuple[str, ...]) -> None:
    pattern = sensor_pattern(sensor)
    assert tuple(pattern.rows()) == rows
    period = len(rows)
    for x in range(6):
        for y in range(6):
            moved = [row.split() for row in pattern.shifted(x, y).rows()]
            first = [row.split() for row in rows]
            for row in range(period):
                for column in range(period):
                    assert moved[row][column] == first[(row + y) % period][(column + x) % period]
            corner = pattern.shifted(x, y).cell_corner()
            assert corner == ((x % 2, y % 2) if period == 4 else (0, 0))


@pytest.mark.parametrize(
    ("largest", "used", "container", "bits", "found"),
    [
        (255, 255, 8, None, (8, 255)),
        (4000, 4095, 16, None, (12, 4095)),
        (4096, 8191, 16, None, (16, 65535)),
        (65520, 0xFFF0, 16, None, (16, 65520)),
        (1023, 1023, 16, 10, (10, 1023)),
        (700, 1023, 10, None, (10, 1023)),
        (4095, 4095, 12, None, (12, 4095)),
    ],
)
def test_full_scale(
    largest: int, used: int, container: int, bits: int | None, found: tuple[int, int]
) -> None:
    levels = estimate_levels(largest, used, container, bits=bits, black=0.0, saturation=None)
    assert (levels.bits, levels.white) == found
    assert levels.saturation == levels.white
    values = np.array([[0, levels.white]], np.uint16)
    np.testing.assert_array_equal(levels.linear(values), [[0.0, 1.0]])


def test_levels_out_of_order_are_refused() -> None:
    for changes in ({"black": 300.0}, {"saturation": 300}, {"black": 100.0, "saturation": 90}):
        asked = {"bits": 8, "black": 0.0, "saturation": None, **changes}
        with pytest.raises(PolarguideError, match="0 <= black level < saturation <= 255"):
            estimate_levels(200, 255, 8, **asked)
    with pytest.raises(PolarguideError, match="values below 1024 for 10 bits, found 1025"):
        estimate_levels(1025, 2047, 16, bits=10, black=0.0, saturation=None)


def test_saturated_and_dark_samples() -> None:
    levels = estimate_levels(255, 255, 8, bits=None, black=10.0, saturation=250)
    values = np.full((4, 4), 100, np.uint8)
    values[0, 0], values[0, 1] = 250, 249
    values[2:, 2:] = 10  # a cell without light
    values[2, 0] = 10  # a single angle without light is what Brewster's angle gives
    values[3, 1] = 0  # cut off below black
    saturated, dark = unusable_samples(values, levels)
    assert np.argwhere(saturated).tolist() == [[0, 0]]
    assert np.argwhere(dark).tolist() == [[2, 2], [2, 3], [3, 1], [3, 2], [3, 3]]
    frame = np.full((4, 4), 10, np.float32)
    frame[0, 2:] = 100
    frame[1, 2:] = 100
    assert unusable_samples(values, levels, frame)[1][:2, 2:].all()
    assert levels.linear(values, frame)[0, 2] == 0.0
