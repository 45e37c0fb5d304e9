"""Held-out pictures behind a polarizer: scored by an analyzer that is fitted on the other half of the picture."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from polarguide.capture import View
from polarguide.capture.exposures import FOUR, Exposure
from polarguide.evaluation.held_out import cross_fitted
from tests.helpers.tiny import make_scene

WHOLE = make_scene().views[0]
STOKES = WHOLE.stokes()
FINAL = STOKES[0] / 2


def single(place: int, gain: float = 1.0) -> View:
    codes = (WHOLE.codes[place : place + 1].to(torch.float32) * gain).round().to(torch.int32).to(torch.uint16)
    return dataclasses.replace(WHOLE, pictures=codes, exposures=(Exposure(),))


@pytest.mark.parametrize("place", range(4))
@pytest.mark.parametrize("gain", [1.0, 0.8])
def test_a_model_that_is_right_predicts_any_picture(place: int, gain: float) -> None:
    view = single(place, gain)
    assert torch.allclose(cross_fitted(view, FINAL, STOKES), view.photograph(), atol=2e-3)


def test_no_pixel_takes_part_in_its_own_fit() -> None:
    """Whatever the left half shows, its prediction stays the same."""
    view = single(1)
    changed = view.codes.clone()
    middle = changed.shape[2] // 2
    changed[:, :, :middle] = (changed[:, :, :middle].to(torch.int32) // 2).to(torch.uint16)
    ours = cross_fitted(view, FINAL, STOKES)
    theirs = cross_fitted(dataclasses.replace(view, pictures=changed), FINAL, STOKES)
    assert torch.equal(ours[:, :middle], theirs[:, :middle])
    assert not torch.allclose(ours[:, middle:], theirs[:, middle:], atol=1e-2)


def test_without_a_prediction_the_gain_alone_is_fitted() -> None:
    found = cross_fitted(single(0), FINAL, None)
    ratio = found / FINAL
    middle = found.shape[1] // 2
    for half in (ratio[:, :middle], ratio[:, middle:]):
        assert math.isclose(float(half.min()), float(half.max()), rel_tol=1e-4)


def test_s0_needs_no_such_thing() -> None:
    assert WHOLE.exposures == FOUR
    assert WHOLE.measures_radiance
    assert not single(0).measures_radiance
