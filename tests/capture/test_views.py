"""Views whose pictures are in files, or made smaller, are views like those that are in memory."""

from __future__ import annotations

import dataclasses
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
import torch
from tiny_capture import HEIGHT, WIDTH, ideal_intensities, write_tiny_capture

from polarguide.capture import Scene, View, load_scene
from polarguide.capture import box_filter as boxes
from polarguide.capture.exposures import FOUR
from polarguide.capture.variants import SmallerViews, mask_background, select_exposures
from polarguide.capture.view import Loader
from polarguide.errors import PolarguideError
from polarguide.options import Exposures
from polarguide.training.priors import view_priors
from polarguide.training.recipe import Priors


@pytest.mark.parametrize("downscale", [1, 2])
def test_a_scene_is_the_same_whether_it_holds_its_pictures(tmp_path: Path, downscale: int) -> None:
    root = write_tiny_capture(tmp_path / "tiny").root
    held = load_scene(root, downscale=downscale)
    stored = load_scene(root, downscale=downscale, hold=False)
    assert stored.digest == held.digest
    assert stored.warnings == held.warnings
    assert stored.test_names == held.test_names
    for a, b in zip(held.views, stored.views, strict=True):
        assert isinstance(b.pictures, Loader)
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
    held, stored = (mask_background(load_scene(capture.root, hold=hold)) for hold in (True, False))
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


def masked_scene(folder: Path, *, hold: bool, downscale: int = 1) -> Scene:
    """A capture with a ragged mask of every view."""
    if not folder.exists():
        write_tiny_capture(folder)
        (folder / "masks").mkdir()
        mask = np.random.default_rng(3).random((HEIGHT, WIDTH)) < 0.9
        for index in range(9):
            assert cv2.imwrite(str(folder / "masks" / f"v{index:03d}.png"), mask.astype(np.uint8) * 255)
    return load_scene(folder, hold=hold, downscale=downscale)


def counted(monkeypatch: pytest.MonkeyPatch, where: object, name: str) -> list[str]:
    """Notes every call of a function."""
    calls: list[str] = []
    function = getattr(where, name)
    monkeypatch.setattr(where, name, lambda *given, **more: (calls.append(name), function(*given, **more))[1])
    return calls


CHANGES: dict[str, Callable[[View], View]] = {
    "replace": lambda view: dataclasses.replace(view, name="other"),
    "exposures": lambda view: view.with_exposures(FOUR[:1] * 4),
    "masked": lambda view: view.masked(),
    "device": lambda view: view.to(torch.device("meta")),
    "same device": lambda view: view.to(torch.device("cpu")),
    "pictures": lambda view: view.changed(lambda codes: codes[:1], FOUR[:1]),
}


@pytest.mark.parametrize("small", [False, True])
@pytest.mark.parametrize("name", CHANGES)
def test_a_changed_view_loads_its_pictures_when_they_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, small: bool
) -> None:
    held, stored = (masked_scene(tmp_path / "s", hold=hold).train_views for hold in (True, False))
    decoded = counted(monkeypatch, cv2, "imdecode")
    averaged = counted(monkeypatch, boxes, "mean_codes")
    monkeypatch.setattr("polarguide.capture.variants.mean_codes", boxes.mean_codes)
    views = SmallerViews(stored, 2) if small else stored
    found = CHANGES[name](views[0])
    assert not decoded
    assert not averaged
    expected = CHANGES[name]((SmallerViews(held, 2) if small else held)[0])
    assert found.device == expected.device
    assert (found.name, found.exposures) == (expected.name, expected.exposures)
    assert found.codes.shape == expected.codes.shape
    if found.device.type == "cpu":
        assert torch.equal(found.codes, expected.codes)
    assert decoded


@pytest.mark.parametrize("small", [False, True])
def test_the_pictures_of_a_view_are_made_once_for_its_priors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small: bool
) -> None:
    stored = masked_scene(tmp_path / "s", hold=False).train_views
    views = SmallerViews(stored, 2) if small else stored
    decoded = counted(monkeypatch, cv2, "imdecode")
    averaged = counted(monkeypatch, boxes, "mean_codes")
    monkeypatch.setattr("polarguide.capture.variants.mean_codes", boxes.mean_codes)
    for count, view in enumerate(views[:2], 1):
        normal = torch.tensor([0.0, 0.0, -1.0]).expand(view.camera.height, view.camera.width, 3)
        view_priors(view, normal, Priors(), 1.5)
        assert len(decoded) == 4 * count
        # The reader averages over boxes of one pixel, which changes nothing.
        assert len(averaged) == (8 if small else 4) * count


@pytest.mark.parametrize("hold", [True, False])
@pytest.mark.parametrize("factor", [2, 3])
def test_a_masked_view_made_smaller_is_a_smaller_view_masked(tmp_path: Path, hold: bool, factor: int) -> None:
    whole = mask_background(masked_scene(tmp_path / "s", hold=hold))
    read = mask_background(masked_scene(tmp_path / "s", hold=hold, downscale=factor))
    for made, view in zip(SmallerViews(whole.train_views, factor), read.train_views, strict=True):
        assert made.mask is not None
        assert view.mask is not None
        assert torch.equal(made.mask, view.mask)
        assert torch.equal(made.codes, view.codes)


@pytest.mark.parametrize("exposures", get_args(Exposures))
def test_other_exposures_are_made_of_pictures_in_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exposures: Exposures
) -> None:
    held, stored = (masked_scene(tmp_path / "s", hold=hold) for hold in (True, False))
    decoded = counted(monkeypatch, cv2, "imdecode")
    found = select_exposures(stored, exposures)
    assert not decoded
    for view, other in zip(found.views, select_exposures(held, exposures).views, strict=True):
        assert (view.name, view.exposures) == (other.name, other.exposures)
        assert torch.equal(view.codes, other.codes)


def test_only_the_pictures_of_one_view_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    views = select_exposures(masked_scene(tmp_path / "s", hold=False), "two").train_views
    first = weakref.ref(views[0].codes)
    assert views[0].codes is first()
    decode, there = cv2.imdecode, []
    monkeypatch.setattr(cv2, "imdecode", lambda *given: (there.append(first()), decode(*given))[1])
    _ = views[1].codes
    assert there == [None] * 4, "its memory is free before the next is decoded"
