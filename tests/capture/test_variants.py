"""A scene with four pictures of each view, as if fewer had been taken."""

from __future__ import annotations

from typing import get_args

import pytest
import torch

from polarguide import PolarguideError
from polarguide.capture.exposures import FOUR, PLAIN
from polarguide.capture.variants import count_of, pictures_taken, select_exposures
from polarguide.options import Exposures
from tests.helpers.tiny import make_scene

SCENE = make_scene()


@pytest.mark.parametrize("exposures", get_args(Exposures))
def test_test_views_stay_and_pictures_are_counted(exposures: Exposures) -> None:
    scene = select_exposures(SCENE, exposures)
    assert scene.test_views == SCENE.test_views
    assert pictures_taken(scene) == count_of(exposures, len(SCENE.train_views))


def test_what_each_view_gets() -> None:
    assert select_exposures(SCENE, "captured") is SCENE
    assert select_exposures(SCENE, "four").train_views == SCENE.train_views
    ones = select_exposures(SCENE, "one").train_views
    assert [view.exposures for view in ones] == [(FOUR[place % 4],) for place in range(len(ones))]
    for place, (view, whole) in enumerate(zip(ones, SCENE.train_views, strict=True)):
        assert torch.equal(view.codes[0], whole.codes[place % 4])
    for view, known in zip(select_exposures(SCENE, "unknown").train_views, ones, strict=True):
        assert torch.equal(view.codes, known.codes)
        assert not any(exposure.known for exposure in view.exposures)
    assert all(
        view.measures_radiance and not view.is_determined
        for view in select_exposures(SCENE, "two").train_views
    )
    assert [view.is_four for view in select_exposures(SCENE, "mixed").train_views] == [
        True,
        False,
        False,
        False,
        True,
    ]
    assert len(select_exposures(SCENE, "sparse").train_views) == 2


def test_three_and_none_hold_what_four_measured() -> None:
    for view, whole in zip(select_exposures(SCENE, "three").train_views, SCENE.train_views, strict=True):
        assert torch.allclose(view.stokes(), whole.stokes(), atol=1e-4)
    for view, whole in zip(select_exposures(SCENE, "none").train_views, SCENE.train_views, strict=True):
        assert view.exposures == PLAIN
        assert torch.allclose(view.photograph(), whole.photograph(), atol=1e-5)


def test_it_takes_four_pictures() -> None:
    with pytest.raises(PolarguideError, match=r"0, 45, 90 and 135 degrees of every view"):
        select_exposures(select_exposures(SCENE, "one"), "two")
