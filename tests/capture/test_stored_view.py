"""Views whose pictures stay in their files show what views that hold them show."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tiny_capture import HEIGHT, WIDTH, ideal_intensities, write_tiny_capture

from polarguide.capture import load_scene
from polarguide.capture.background import without_surroundings
from polarguide.capture.stored_view import StoredView
from polarguide.errors import PolarguideError


@pytest.mark.parametrize("downscale", [1, 2])
def test_a_scene_is_the_same_whether_it_holds_its_pictures(tmp_path: Path, downscale: int) -> None:
    root = write_tiny_capture(tmp_path / "tiny").root
    held = load_scene(root, downscale=downscale)
    stored = load_scene(root, downscale=downscale, hold=False)
    assert stored.digest == held.digest
    assert stored.warnings == held.warnings
    assert stored.test_names == held.test_names
    for a, b in zip(held.views, stored.views, strict=True):
        assert isinstance(b, StoredView)
        assert (a.name, a.camera.width, a.camera.fx) == (b.name, b.camera.width, b.camera.fx)
        for name in ("codes", "invalid", "saturated"):
            assert torch.equal(getattr(a, name), getattr(b, name)), name
        assert torch.equal(a.photograph(), b.photograph())
        assert (a.mask is None) == (b.mask is None)
        assert (a.ground_truth is None) == (b.ground_truth is None)
        if a.ground_truth is not None and a.ground_truth.normal is not None:
            assert b.ground_truth is not None
            assert b.ground_truth.normal is not None
            assert torch.equal(a.ground_truth.normal, b.ground_truth.normal)


def test_a_subject_before_nothing_is_the_same(tmp_path: Path) -> None:
    capture = write_tiny_capture(tmp_path / "tiny")
    (capture.root / "masks").mkdir(exist_ok=True)
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:3] = 0
    for index in range(9):
        assert cv2.imwrite(str(capture.root / "masks" / f"v{index:03d}.png"), mask)
    held, stored = (without_surroundings(load_scene(capture.root, hold=hold)) for hold in (True, False))
    assert torch.equal(held.points, stored.points)
    for a, b in zip(held.views, stored.views, strict=True):
        assert torch.equal(a.codes, b.codes)
        assert not b.codes[:, :3].any()
        assert b.codes[:, 3:].any()


def test_a_picture_that_has_changed_is_refused(tmp_path: Path) -> None:
    capture = write_tiny_capture(tmp_path / "tiny")
    scene = load_scene(capture.root, hold=False)
    capture.write_view("v004", ideal_intensities(99))
    with pytest.raises(PolarguideError, match=r"v004_000\.png: expected the file that was there"):
        _ = scene.view("v004").codes
    (capture.root / "polar" / "v005_090.png").unlink()
    with pytest.raises(PolarguideError, match=r"v005_090\.png"):
        _ = scene.view("v005").codes
