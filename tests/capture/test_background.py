"""What lies behind the subject: found from the pictures, or from masks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from polarguide.camera import Camera, look_at
from polarguide.capture import Scene, View
from polarguide.capture.variants import empty_pixels, has_black_background, mask_background
from polarguide.errors import PolarguideError

WIDTH, HEIGHT = 40, 30
SUBJECT = (slice(8, 22), slice(10, 30))


def picture(background: float, noise: float = 0.0) -> Tensor:
    """Codes of a gray subject with a dark spot before a background."""
    linear = torch.full((4, HEIGHT, WIDTH, 3), background)
    linear[:, SUBJECT[0], SUBJECT[1]] = 0.4
    linear[:, 13:18, 18:23] = 0.0
    linear += noise * torch.randn(linear.shape, generator=torch.Generator().manual_seed(0))
    return (linear.clamp(0, 1) * 65535).round().to(torch.uint16)


def view(name: str = "v0", background: float = 0.0, mask: Tensor | None = None, noise: float = 0.0) -> View:
    pose = look_at((0.0, -1.0, -4.0), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0))
    camera = Camera(WIDTH, HEIGHT, 40.0, 40.0, WIDTH / 2, HEIGHT / 2, *pose)
    nowhere = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    return View(name, camera, picture(background, noise), nowhere, nowhere, mask)


def subject_mask() -> Tensor:
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
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
    dark = replace(view(), pictures=torch.zeros(4, HEIGHT, WIDTH, 3, dtype=torch.uint16))
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
    assert alone.points.tolist() == [[0.0, 0.0, 0.0]]
    assert alone.point_colors.tolist() == [[1, 2, 3]]


def test_masks_of_test_views_do_not_choose_points() -> None:
    nothing = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    scene = scene_of(view(mask=subject_mask()), view("v1", mask=nothing))
    assert mask_background(replace(scene, test_names=("v1",))).points.tolist() == [[0.0, 0.0, 0.0]]
    with pytest.raises(PolarguideError, match="none of 2 points"):
        mask_background(scene)


def test_a_view_without_a_mask_is_named() -> None:
    with pytest.raises(PolarguideError, match=r"none of view v1.*masks/v1\.png"):
        mask_background(scene_of(view(mask=subject_mask()), view("v1")))


def test_masks_that_hold_no_point_are_refused() -> None:
    corner = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    corner[:3, :3] = True
    with pytest.raises(PolarguideError, match="none of 2 points"):
        mask_background(scene_of(view(mask=corner)))
