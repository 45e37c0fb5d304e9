"""The record of how a capture is presented: what it takes, what it means, and what goes before what."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from faults import Fault
from random_runs import ring

from polarguide.capture.presentation import (
    KNEE,
    PRESENTATION_FILE,
    Crop,
    Presentation,
    colored,
    parse_length,
    read_presentation,
    shown_length,
    with_tone_curve,
    write_presentation,
)
from polarguide.geometry.scene_frame import scene_frame

AROUND = scene_frame(list(ring().values()))
WHOLE = Presentation(
    white_balance=(1.5, 1.0, 0.75),
    tone_curve="soft",
    up_axis=(0.0, 0.0, 2.0),
    meters_per_unit=0.25,
    crop=Crop((-0.1, -0.2, -0.3), (0.1, 0.2, 0.3), (1.0, 0.0, 0.0)),
    title="Cup",
    author="René",
    license="CC-BY-4.0",
    provenance="inv. 7",
)


def test_what_is_written_is_read_and_what_is_missing_is_left_out(tmp_path: Path) -> None:
    assert read_presentation(tmp_path) == Presentation()
    for presentation in (WHOLE, Presentation(author="A")):
        write_presentation(tmp_path, presentation)
        assert read_presentation(tmp_path) == presentation
    assert json.loads((tmp_path / PRESENTATION_FILE).read_text()) == {"author": "A"}


def with_matrix(matrix: str) -> str:
    return f'{{"chart": {{"matrix": {matrix}, "delta_e": 1, "delta_e_worst": 1, "patches": 9, "view": "v"}}}}'


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ('{"white_balance": [1, 1]}', Fault("(white_balance)")),
        ('{"white_balance": [1, 0, 1]}', Fault("(white_balance[1])", "0.02 to 50", "0")),
        ('{"white_balance": [1, NaN, 1]}', Fault(expected="0.02 to 50")),
        ('{"tone_curve": "hard"}', Fault("(tone_curve)", "soft", "hard")),
        ('{"up_axis": [0, 0, 0]}', Fault("(up_axis)", expected="a direction")),
        ('{"meters_per_unit": 0}', Fault("(meters_per_unit)", expected="1e-09 to")),
        ('{"meters_per_unit": 1e-300}', Fault("(meters_per_unit)", expected="1e-09 to")),
        ('{"meters_per_unit": "1"}', Fault("(meters_per_unit)", expected="a number")),
        ('{"crop": {"low": [0, 0, 0], "high": [1, 0, 1]}}', Fault("(crop)", expected="a low side less than")),
        ('{"crop": {"low": [0, 0, 0], "high": [1, 1, 1e9]}}', Fault("(crop)")),
        ('{"author": "two\\nlines"}', Fault("(author)", expected="one line")),
        ('{"licence": "CC0"}', Fault(expected="only white_balance, chart", found="licence")),
        ('{"title": "' + 1001 * "x" + '"}', Fault("(title)")),
        ("[]", Fault(expected="JSON object")),
        (with_matrix("[[1, 0, 0], [0, -1, 0.5], [0, 0, 1]]"), Fault("matrix", "positive sums", "-0.5")),
        (with_matrix("[[-1, 0, 0], [0, -1, 0], [0, 0, -1]]"), Fault("matrix", "positive sums", "-1")),
        (with_matrix("[[0, 0, 0], [0, 0, 0], [0, 0, 0]]"), Fault("matrix", "an inverse")),
        (with_matrix("[[1, 0, 0], [0, 1, 0], [0, 0, NaN]]"), Fault("matrix")),
    ],
)
def test_what_is_wrong_is_refused_by_name(text: str, fault: Fault, tmp_path: Path) -> None:
    (tmp_path / PRESENTATION_FILE).write_text(text)
    error = fault.raised_by(read_presentation, tmp_path)
    assert PRESENTATION_FILE in error.where


def test_a_run_s_own_goes_before_its_scene_s_field_by_field() -> None:
    own = Presentation(meters_per_unit=2.0, author="B")
    both = own.over(WHOLE)
    assert (both.meters_per_unit, both.author) == (2.0, "B")
    assert (both.white_balance, both.crop, both.license) == (WHOLE.white_balance, WHOLE.crop, "CC-BY-4.0")
    assert Presentation().over(WHOLE) == WHOLE
    assert WHOLE.credit == "René, CC-BY-4.0"
    assert not Presentation().credit


def test_the_chosen_axis_replaces_that_of_the_cameras() -> None:
    torch.testing.assert_close(WHOLE.upright(AROUND).up, torch.tensor([0.0, 0, 1], dtype=torch.float64))
    assert Presentation().upright(AROUND) is AROUND


def test_a_crop_box_stands_along_its_own_axis_whatever_is_chosen_later() -> None:
    box = Crop((-0.25, -0.5, -1.0), (0.25, 0.5, 1.0))
    corners = box.corners(AROUND)
    assert corners.shape == (8, 3)
    inner, outer = (
        AROUND.center + 0.99 * (corners - AROUND.center),
        AROUND.center + 1.01 * (corners - AROUND.center),
    )
    assert bool(box.inside(inner, AROUND).all())
    assert not bool(box.inside(outer, AROUND).any())
    turned = Crop(box.low, box.high, (1.0, 0.0, 0.0))
    reach = (turned.corners(AROUND) - AROUND.center)[:, 0].abs()
    torch.testing.assert_close(reach, torch.full_like(reach, 0.5 * AROUND.distance))  # its height is along x


@pytest.mark.parametrize(
    ("text", "meters"),
    [("85mm", 0.085), ("8.5 cm", 0.085), ("2", 2.0), ("1e-3m", 1e-3), ("10in", 0.254), ("3km", 3000)],
)
def test_lengths(text: str, meters: float) -> None:
    assert parse_length(text) == pytest.approx(meters)


@pytest.mark.parametrize("text", ["", "mm", "0", "-1", "1 mile", "1..2", "nan", "inf", "1e99"])
def test_what_is_no_length(text: str) -> None:
    Fault("distance", expected="a length above 0 such as 85mm").raised_by(parse_length, text)


def test_lengths_are_told_with_a_unit() -> None:
    assert shown_length(0.5, None) == "0.5 units"
    assert [shown_length(1.0, m) for m in (0.085, 2.0, 1500.0, 0.0042, 2e-5)] == [
        "8.5 cm", "2 m", "1.5 km", "4.2 mm", "0.02 mm",
    ]  # fmt: skip


def test_white_balance_is_a_factor_on_light() -> None:
    light = torch.rand(4, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(colored(light, WHOLE.color), light * torch.tensor([1.5, 1.0, 0.75]))
    assert colored(light, None) is light
    assert not math.isnan(float(colored(light, WHOLE.color).sum()))


def gray(values: np.ndarray) -> np.ndarray:
    """The soft tone curve of gray pixels with the values."""
    pixels = torch.from_numpy(values)[:, None].expand(-1, 3)
    mapped = with_tone_curve(pixels, "soft")
    assert mapped.dtype == pixels.dtype
    assert bool((mapped == mapped[:, :1]).all())
    return mapped[:, 0].numpy()


def test_the_tone_curve_agrees_with_a_reference_in_double_precision() -> None:
    generator = torch.Generator().manual_seed(0)
    linear = 10 ** (4 * torch.rand(1000, 3, generator=generator) - 3)
    exact = linear.double().numpy()
    largest = exact.max(axis=1, keepdims=True)
    compressed = 1 - (1 - KNEE) ** 2 / (largest + 1 - 2 * KNEE)
    expected = exact * np.where(largest <= KNEE, 1, compressed / largest)
    assert 100 < int((largest <= KNEE).sum()) < 900
    np.testing.assert_allclose(with_tone_curve(linear, "soft").numpy(), expected, rtol=1e-6)


def test_the_tone_curve_is_smooth_at_the_knee_rises_and_approaches_white() -> None:
    step = 1e-6
    below, knee, above = gray(np.array([KNEE - step, KNEE, KNEE + step]))
    assert knee == KNEE
    assert (knee - below) / step == pytest.approx(1, abs=1e-5)
    assert (above - knee) / step == pytest.approx(1, abs=1e-5)
    dark = np.linspace(0, KNEE, 100)
    assert np.array_equal(gray(dark), dark)
    mapped = gray(np.geomspace(1e-3, 1e4, 2000))
    assert (np.diff(mapped) > 0).all()
    assert mapped.max() < 1
    np.testing.assert_allclose(gray(np.array([1.0, 4.0, 1e9, math.inf])), [0.75, 0.9375, 1, 1])


def test_the_tone_curve_keeps_the_hue() -> None:
    linear = torch.tensor([[4.0, 1.0, 0.0], [0.25, 8.0, 2.0]], dtype=torch.float64)
    mapped = with_tone_curve(linear, "soft")
    torch.testing.assert_close(
        mapped / mapped.amax(dim=1, keepdim=True), linear / linear.amax(dim=1, keepdim=True)
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_tone_curve_makes_no_nan(dtype: torch.dtype) -> None:
    most = torch.finfo(dtype).max
    values = [math.nan, math.inf, -math.inf, most, -most, -2.0, 0.0, 3.0]
    pixels = torch.cartesian_prod(*3 * [torch.tensor(values, dtype=dtype)])
    mapped = with_tone_curve(pixels, "soft")
    assert bool(mapped.isfinite().all())
    assert float(mapped.max()) == pytest.approx(1)
    assert bool((mapped.sign() == pixels.nan_to_num(0.0).sign())[~pixels.isinf().any(dim=1)].all())


def test_display_applies_color_and_then_the_tone_curve() -> None:
    light = torch.tensor([[1.0, 0.5, 0.1]])
    bright = Presentation(exposure=2.0)
    assert torch.equal(bright.displayed(light), 4 * light)
    curved = Presentation(exposure=2.0, tone_curve="soft")
    assert torch.equal(curved.displayed(light), with_tone_curve(4 * light, "soft"))
    assert with_tone_curve(light, None) is light
