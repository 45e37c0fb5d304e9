"""Views and scenes: their pictures, what is behind the subject, smaller and fewer pictures."""

from __future__ import annotations

import dataclasses
import weakref
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
import torch
from faults import Fault
from tiny_capture import HEIGHT, WIDTH, ideal_intensities, write_tiny_capture
from torch import Tensor

from polarguide.capture import Scene, View, load_scene
from polarguide.capture import box_filter as boxes
from polarguide.capture.exposures import FOUR, PLAIN
from polarguide.capture.variants import (
    SmallerViews,
    black_pixels,
    empty_pixels,
    has_black_background,
    mask_background,
    select_exposures,
)
from polarguide.capture.view import Loader
from polarguide.core.options import Exposures
from polarguide.geometry.camera import Camera, look_at
from polarguide.training.priors import view_priors
from polarguide.training.recipe import Priors
from tests.helpers.tiny import make_scene


@pytest.mark.parametrize("downscale", [1, 2])
def test_a_scene_is_the_same_whether_it_holds_its_pictures(tmp_path: Path, downscale: int) -> None:
    root = write_tiny_capture(tmp_path / "tiny").root
    held = load_scene(root, downscale=downscale)
    stored = load_scene(root, downscale=downscale, hold=False)
    assert (stored.digest, stored.warnings) == (held.digest, held.warnings)
    assert stored.test_names == held.test_names
    for a, b in zip(held.views, stored.views, strict=True):
        assert isinstance(b.pictures, Loader)
        assert (a.name, a.camera.width, a.camera.fx) == (b.name, b.camera.width, b.camera.fx)
        for name in ("codes", "invalid", "saturated"):
            assert torch.equal(getattr(a, name), getattr(b, name)), name
        assert torch.equal(a.photograph(), b.photograph())
        assert (a.mask is None, a.ground_truth is None) == (b.mask is None, b.ground_truth is None)
        if a.ground_truth is not None and a.ground_truth.normal is not None:
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
    Fault("v004_000.png", expected="the same file").raised_by(lambda: scene.view("v004").codes)
    (capture.root / "polar" / "v005_090.png").unlink()
    Fault("v005_090.png").raised_by(lambda: scene.view("v005").codes)


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
    found = CHANGES[name]((SmallerViews(stored, 2) if small else stored)[0])
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


WIDE, HIGH = 40, 30
SUBJECT = (slice(8, 22), slice(10, 30))


def picture(background: float, noise: float = 0.0) -> Tensor:
    """Codes of a gray subject with a dark spot before a background."""
    linear = torch.full((4, HIGH, WIDE, 3), background)
    linear[:, SUBJECT[0], SUBJECT[1]] = 0.4
    linear[:, 13:18, 18:23] = 0.0
    linear += noise * torch.randn(linear.shape, generator=torch.Generator().manual_seed(0))
    return (linear.clamp(0, 1) * 65535).round().to(torch.uint16)


def view(name: str = "v0", background: float = 0.0, mask: Tensor | None = None, noise: float = 0.0) -> View:
    pose = look_at((0.0, -1.0, -4.0), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0))
    camera = Camera(WIDE, HIGH, 40.0, 40.0, WIDE / 2, HIGH / 2, *pose)
    nowhere = torch.zeros(HIGH, WIDE, dtype=torch.bool)
    return View(name, camera, picture(background, noise), nowhere, nowhere, mask)


def subject_mask() -> Tensor:
    mask = torch.zeros(HIGH, WIDE, dtype=torch.bool)
    mask[SUBJECT] = True
    return mask


def scene_of(*views: View) -> Scene:
    points = torch.tensor([[0.0, 0.0, 0.0], [1.9, 0.0, 0.0]])
    return Scene(
        root=Path("object"),
        name="object",
        views=views,
        test_names=(),
        points=points,
        point_colors=torch.tensor([[1, 2, 3], [4, 5, 6]], dtype=torch.uint8),
        refractive_index=None,
        downscale=1,
        transfer="linear",
        digest="",
        warnings=(),
    )


def test_black_edges_are_nothing_also_with_noise_and_gray_ones_are_surroundings() -> None:
    assert has_black_background([view(), view(noise=0.003)])
    assert not has_black_background([view(background=0.02)])
    assert not has_black_background([])


def test_a_tenth_of_the_views_may_show_the_subject_at_the_edge_and_no_more() -> None:
    black = [view() for _ in range(9)]
    assert has_black_background([*black, view(background=0.3)])
    assert not has_black_background([*black, view(background=0.3), view(background=0.3)])


def test_pictures_that_are_black_throughout_are_no_background() -> None:
    dark = replace(view(), pictures=torch.zeros(4, HIGH, WIDE, 3, dtype=torch.uint16))
    assert not has_black_background([dark])


def test_empty_is_the_black_around_the_subject_and_not_its_dark_spot() -> None:
    empty = empty_pixels(view())
    assert not bool(empty[SUBJECT].any())
    assert not bool(empty[5, 20]), "the subject is grown by three pixels"
    assert bool(empty[3, 20])
    assert bool(empty[:, :6].all())


def test_a_mask_says_what_is_empty_whatever_the_picture_shows() -> None:
    empty = empty_pixels(view(background=0.5, mask=subject_mask()))
    assert not bool(empty[SUBJECT].any())
    assert bool(empty[:, :6].all())


def test_mask_background_only_the_subject_and_its_points_are_left() -> None:
    alone = mask_background(scene_of(view(background=0.5, mask=subject_mask())))
    (left,) = alone.views
    assert not bool(left.codes.int()[:, ~subject_mask()].any())
    assert torch.equal(left.codes[:, 9, 12], picture(0.5)[:, 9, 12])
    assert (alone.points.tolist(), alone.point_colors.tolist()) == ([[0.0, 0.0, 0.0]], [[1, 2, 3]])


def test_masks_of_test_views_do_not_choose_points() -> None:
    nothing = torch.zeros(HIGH, WIDE, dtype=torch.bool)
    scene = scene_of(view(mask=subject_mask()), view("v1", mask=nothing))
    assert mask_background(replace(scene, test_names=("v1",))).points.tolist() == [[0.0, 0.0, 0.0]]
    Fault(found="none of 2 points").raised_by(mask_background, scene)


def test_a_view_without_a_mask_is_named() -> None:
    Fault(found="no mask for view v1", remedy="masks/v1.png").raised_by(
        mask_background, scene_of(view(mask=subject_mask()), view("v1"))
    )


def test_masks_that_hold_no_point_are_refused() -> None:
    corner = torch.zeros(HIGH, WIDE, dtype=torch.bool)
    corner[:3, :3] = True
    Fault(found="none of 2 points").raised_by(mask_background, scene_of(view(mask=corner)))


SCENE = make_scene()


@pytest.mark.parametrize("exposures", get_args(Exposures))
def test_test_views_stay_and_pictures_are_counted(exposures: Exposures) -> None:
    views = len(SCENE.train_views)
    fourth = -(-views // 4)
    counts = {"three": 3 * views, "two": 2 * views, "mixed": views + 3 * fourth, "sparse": 4 * fourth}
    counts |= dict.fromkeys(("one", "unknown", "none"), views)
    scene = select_exposures(SCENE, exposures)
    assert scene.test_views == SCENE.test_views
    assert sum(len(view.exposures) for view in scene.train_views) == counts.get(exposures, 4 * views)


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
    Fault(expected="0, 45, 90 and 135 degrees").raised_by(
        select_exposures, select_exposures(SCENE, "one"), "two"
    )


def test_black_pixels_are_dark_with_their_neighbors_at_all_angles(tiny_scene: Scene) -> None:
    view = tiny_scene.views[0]

    def bright(codes: Tensor) -> int:
        return int((~black_pixels(replace(view, pictures=codes))).sum())

    codes = torch.zeros_like(view.codes)
    codes[:, 3:6, 3:6] = 2000  # nine pixels, whose neighbors are averaged with them
    assert 9 < bright(codes) <= 25
    assert not black_pixels(view).any()
    codes[:] = torch.randint(0, 200, codes.shape)  # noise is black
    assert bright(codes) == 0
    codes[0] = 0  # the filter may block the light at one angle
    codes[1:] = 2000
    assert bright(codes) == codes[0, ..., 0].numel()
