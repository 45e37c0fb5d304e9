"""What is said about pictures that can be read but look wrong."""

from __future__ import annotations

import numpy as np
import pytest
from tiny_capture import NAMES, TinyCapture, encode_srgb

from polarguide.capture import checks, load_scene


def warnings_of(capture: TinyCapture, **arguments: str) -> tuple[str, ...]:
    return load_scene(capture.root, **arguments).warnings  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "order",
    [(0, 2, 1, 3), (3, 1, 2, 0), (0, 1, 3, 2), (1, 0, 2, 3)],
    ids=["45-90", "0-135", "90-135", "0-45"],
)
def test_swapped_files_are_found(capture: TinyCapture, order: tuple[int, ...]) -> None:
    capture.rewrite(lambda linear: linear[list(order)])
    (warning,) = warnings_of(capture)
    assert warning.startswith("I0 + I90 differs from I45 + I135 by ")
    assert "in 9 of 9 views (v000, v001, v002, v003 and 5 more)" in warning
    swapped = (
        "45 and 90 (or 0 and 135)" if order in ((0, 2, 1, 3), (3, 1, 2, 0)) else "90 and 135 (or 0 and 45)"
    )
    assert warning.endswith(f"The pictures at {swapped} degrees are probably swapped.")


def test_one_view_with_swapped_files_is_named(capture: TinyCapture) -> None:
    capture.write_view("v006", capture.linear["v006"][[0, 2, 1, 3]])
    (warning,) = warnings_of(capture)
    assert "in 1 of 9 views (v006);" in warning


def test_one_dimmer_picture_is_found(capture: TinyCapture) -> None:
    gains = np.array([1.0, 0.8, 1.0, 0.8])[:, None, None, None]
    capture.rewrite(lambda linear: linear * gains)
    warning = warnings_of(capture)[0]
    assert warning.startswith("I0 + I90 differs from I45 + I135 by 22.2% of S0")
    assert warning.endswith("Probably files are swapped, or the transfer is wrong.")


def test_gain_differences_of_real_sensors_pass(capture: TinyCapture) -> None:
    gains = np.array([0.99, 1.0, 0.98, 1.01])[:, None, None, None]
    capture.rewrite(lambda linear: linear * gains)
    assert warnings_of(capture) == ()


@pytest.mark.parametrize("bits", [8, 16])
def test_display_encoding_is_noticed(capture: TinyCapture, bits: int) -> None:
    capture.rewrite(encode_srgb, bits=bits)
    (warning,) = warnings_of(capture)
    assert warning.startswith("The pictures look sRGB-encoded (curvature -0.")
    assert warning.endswith("if they are, read them with transfer srgb.")
    assert warnings_of(capture, transfer="srgb") == ()


def test_linear_pictures_read_as_srgb_are_noticed(capture: TinyCapture) -> None:
    warnings = warnings_of(capture, transfer="srgb")
    assert warnings[-1].startswith("The pictures look linear already (curvature 0.")
    assert warnings[-1].endswith("read them with transfer linear.")


def test_black_pictures(capture: TinyCapture) -> None:
    for name in NAMES[:2]:
        capture.write_view(name, capture.linear[name] * 0.005)
    capture.write_view("v002", np.zeros((4, 10, 12, 3)))
    (warning,) = warnings_of(capture)
    assert warning.startswith("3 of 9 views are almost black: 99% of their values are under 1% of full scale")
    assert "(v000, v001, v002)" in warning
    assert load_scene(capture.root).view("v002").saturated.all()


def test_saturated_pictures(capture: TinyCapture) -> None:
    capture.write_view("v004", np.clip(capture.linear["v004"] * 4.0, 0.0, 1.0))
    scene = load_scene(capture.root)
    (warning,) = scene.warnings
    assert warning.startswith("1 of 9 views are heavily saturated: up to ")
    assert "(v004). Expose shorter." in warning
    assert scene.view("v004").saturated.float().mean() > 0.3


@pytest.mark.parametrize(("bits", "factor"), [(10, 64), (12, 16)])
def test_bits_that_were_not_scaled(capture: TinyCapture, bits: int, factor: int) -> None:
    capture.rewrite(lambda linear: linear * (2**bits - 1) / 65535)
    (warning,) = warnings_of(capture)
    assert f"they look like unscaled {bits}-bit data. Multiply the values by {factor}." in warning


def test_full_scale_below_the_largest_code(capture: TinyCapture) -> None:
    """Pictures quantized in steps of 64 saturate at 65472."""
    capture.rewrite(lambda linear: np.floor(np.clip(linear * 2.5, 0, 1) * 1023.99) * 64 / 65535)
    scene = load_scene(capture.root)
    for view in scene.views:
        clipped = (view.codes.numpy() == 65472).any(axis=(0, 3))
        assert 0.1 < clipped.mean() < 1.0
        np.testing.assert_array_equal(view.saturated.numpy(), clipped)


def histogram(**counts: int) -> np.ndarray:
    values = np.concatenate([np.full(count, int(code[1:])) for code, count in counts.items()])
    return checks.top_histogram(values.astype(np.uint16))


@pytest.mark.parametrize(
    ("counts", "scale"),
    [
        ({"c100": 5}, None),
        ({"c65535": 1}, 65535),
        ({"c65472": 30, "c65408": 2, "c65344": 4}, 65472),
        ({"c65472": 3, "c65408": 2}, None),
        ({"c65472": 2}, None),
        ({"c65000": 500}, None),
        ({"c65520": 40, "c65504": 3}, 65520),
    ],
)
def test_full_scale_needs_a_pile_at_the_top(counts: dict[str, int], scale: int | None) -> None:
    assert checks.full_scale(histogram(**counts), 65535) == scale


def test_full_scale_of_eight_bits() -> None:
    assert checks.full_scale(checks.top_histogram(np.array([3, 254, 254], np.uint8)), 255) is None
    assert checks.full_scale(checks.top_histogram(np.array([3, 254, 255], np.uint8)), 255) == 255


def test_curvature_needs_polarized_light() -> None:
    gray = np.full((4, 60, 60, 3), 30000, np.uint16)
    usable = np.ones((60, 60), bool)
    assert checks.curvature([checks.measure(gray, usable)]) is None
    assert checks.curvature([checks.measure(gray, ~usable)]) is None
