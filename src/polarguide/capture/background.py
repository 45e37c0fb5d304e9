"""What is behind the subject: a background, or nothing; and where a picture is black."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import label
from torch import Tensor

from polarguide.camera import seen_at
from polarguide.capture.view import Scene, View
from polarguide.errors import PolarguideError

BLACK = 0.005
"""Linear S0/2 up to which a pixel is black: a little over one step of 8 bits, which is what noise and rounding leave of
no light."""
BLACK_EDGE = 0.95
"""Share of a picture's outermost pixels that are black where there is nothing behind the subject."""
BLACK_VIEWS = 0.9
"""Share of the views whose edge has to be black."""
GROWN = 3
"""Pixels by which a subject is grown before what is outside counts as empty: edges are blended."""
INSIDE = 0.8
"""A point belongs to the subject if it is in the mask in this share of the pictures that see it."""


def black_pixels(view: View) -> Tensor:
    """Where the photograph shows no light, [H, W] bool, on the CPU: what *black* means wherever pictures are judged.

    It is the mean over the color channels and 3 x 3 pixels that is compared, so that noise does not lighten a pixel.
    """
    picture = view.photograph().cpu().mean(dim=-1).numpy()
    return torch.from_numpy(np.asarray(cv2.blur(picture, (3, 3)) <= BLACK))


def has_black_background(views: Sequence[View]) -> bool:
    """Whether nothing is behind the subject: the edges of nearly all pictures are black, see ``BLACK_EDGE``."""
    black = sum(_black_edge(view) for view in views)
    return bool(views) and black >= BLACK_VIEWS * len(views)


def empty_pixels(view: View) -> Tensor:
    """Where a picture of a subject before black shows nothing, [H, W] bool.

    That is outside its mask, where it has one; elsewhere the black that reaches the edge of the picture, so that a dark
    spot of the subject is not taken for a hole. The subject is grown by ``GROWN`` pixels.
    """
    if view.mask is not None:
        subject = view.mask.cpu().numpy()
    else:
        black = _black(view)
        regions, _ = label(black)
        outside = np.unique(np.concatenate([regions[0], regions[-1], regions[:, 0], regions[:, -1]]))
        subject = ~np.isin(regions, outside[outside > 0])
    return torch.from_numpy(~_grown(subject, GROWN))


def mask_background(scene: Scene) -> Scene:
    """The scene with black pictures outside the masks, and with the points of the subject only.

    Raises:
        PolarguideError: a view has no mask, or no point lies in the masks.
    """
    views = []
    for view in scene.views:
        if view.mask is None:
            raise PolarguideError(
                scene.root / "masks",
                expected="a mask of every view for --background masked",
                found=f"none of view {view.name}",
                remedy=f"Add masks/{view.name}.png, white where the subject is, or choose another background.",
            )
        views.append(view.masked())
    # The masks of test views tell training nothing.
    inside = _in_masks(scene.points, [view for view in views if view.name not in scene.test_names])
    if len(scene.points) and not bool(inside.any()):
        raise PolarguideError(
            scene.root / "masks",
            expected="masks with points of the COLMAP model in them",
            found=f"none of {len(scene.points)} points",
            remedy="White is the subject there: invert the masks, or choose another background.",
        )
    return replace(
        scene, views=tuple(views), points=scene.points[inside], point_colors=scene.point_colors[inside]
    )


def _in_masks(points: Tensor, views: Sequence[View]) -> Tensor:
    """Which points [M, 3] lie in the grown masks of most of the pictures that they fall into, [M] bool."""
    seen, inside = torch.zeros(len(points)), torch.zeros(len(points))
    for view in views:
        assert view.mask is not None
        mask = torch.from_numpy(_grown(view.mask.cpu().numpy(), GROWN))
        pixel, _, within = seen_at(points.double() - view.camera.center, view.camera)
        seen += within
        inside += within & mask[pixel]
    return (seen > 0) & (inside >= INSIDE * seen)


def _black(view: View) -> NDArray[np.bool_]:
    """Where the picture is black, [H, W]; pixels marked as invalid count as black."""
    return (black_pixels(view) | view.invalid.cpu()).numpy()


def _black_edge(view: View) -> bool:
    black = _black(view)
    edge = np.concatenate([black[0], black[-1], black[1:-1, 0], black[1:-1, -1]])
    return bool(edge.mean() >= BLACK_EDGE) and not bool(black.all())


def _grown(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disk) > 0)
