"""What is known of a scene as a whole before its views are scored, so that all views are scored alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy.ndimage import binary_dilation
from scipy.spatial.distance import pdist
from torch import Tensor

from polarguide.capture import Scene, View
from polarguide.capture.ground_truth import SceneObject
from polarguide.capture.variants import black_pixels
from polarguide.capture.view import listed

EXTENT = 1.1
"""The extent of a scene, in units of the largest distance between two of its cameras."""
BLACK_SHARE = 0.99
"""Share of the pixels outside the masks that are black where nothing but the foreground is in the pictures."""
MARGIN = 3
"""Pixels by which a mask is grown before what lies outside it is looked at."""
KNOWN = {
    "mask": "masks",
    "normal": "normals",
    "depth": "depths",
    "specular": "specular layers",
    "diffuse": "diffuse layers",
    "object_ids": "object numbers",
}


@dataclass(frozen=True, eq=False)
class SceneFacts:
    """What holds for all test views of a scene.

    Attributes:
        extent: 1.1 times the largest distance between two cameras, in world units.
        objects: those that errors are told apart by: the foreground's, if numbers and table of objects are known.
        masks: foreground of each test view [H, W] bool, of the ground truth or else the user's; None if a view has
            none.
        object_only: whether nothing but the foreground is in the pictures: more than 99 % of the pixels outside the
            masks, grown by 3 pixels, are black.
        warnings: what scores do not mean because something is missing, a sentence each.
    """

    extent: float
    objects: tuple[SceneObject, ...] = ()
    masks: dict[str, Tensor] | None = None
    object_only: bool = False
    warnings: tuple[str, ...] = ()

    @classmethod
    def of(cls, scene: Scene) -> SceneFacts:
        """Look at the test views of a scene."""
        tests = scene.test_views
        centers = torch.stack([view.camera.center for view in scene.views]).numpy()
        warnings, found = _partly_known(tests), {view.name: foreground(view) for view in tests}
        masks = {name: mask for name, mask in found.items() if mask is not None}
        if 0 < len(masks) < len(tests):
            lacking = [name for name in found if name not in masks]
            warnings.append(
                f"Only {len(masks)} of {len(tests)} test views have a mask (not {listed(lacking)}): stokes_error is "
                "over whole pictures."
            )
        complete = masks if len(masks) == len(tests) else None
        numbered = [view for view in tests if _numbers(view) is not None]
        if numbered:
            warnings += _unlisted(scene, numbered)
        objects = scene.objects if numbered else ()
        return cls(
            extent=EXTENT * float(pdist(centers).max()) if len(centers) > 1 else 1.0,
            objects=tuple(item for item in objects if item.foreground),
            masks=complete,
            object_only=complete is not None and _on_black(tests, complete),
            warnings=tuple(warnings),
        )


def foreground(view: View) -> Tensor | None:
    """The foreground [H, W] bool: the ground truth's mask, else the user's; None where neither is there."""
    known = view.ground_truth
    return known.mask if known is not None and known.mask is not None else view.mask


def outside(mask: Tensor) -> Tensor:
    """Pixels [H, W] bool that are more than ``MARGIN`` rows or columns away from a mask."""
    grown = binary_dilation(mask.numpy(), structure=torch.ones(3, 3).numpy(), iterations=MARGIN)
    return torch.from_numpy(~grown)


def _numbers(view: View) -> Tensor | None:
    return None if view.ground_truth is None else view.ground_truth.object_ids


def _on_black(views: Sequence[View], masks: dict[str, Tensor]) -> bool:
    """Whether the photographs are black outside the masks."""
    black = total = 0
    for view in views:
        beyond = outside(masks[view.name]) & ~view.invalid
        black += int(black_pixels(view)[beyond].sum())
        total += int(beyond.sum())
    return total > 0 and black > BLACK_SHARE * total


def _partly_known(views: Sequence[View]) -> list[str]:
    """A sentence if some test views have ground truth that others lack."""
    counts = {key: sum(getattr(view.ground_truth, key, None) is not None for view in views) for key in KNOWN}
    partly = [f"{KNOWN[key]} of {count}" for key, count in counts.items() if 0 < count < len(views)]
    if not partly:
        return []
    return [
        f"The ground truth gives {', '.join(partly)} of {len(views)} test views: scores against it are means over "
        "these alone."
    ]


def _unlisted(scene: Scene, views: Sequence[View]) -> list[str]:
    """Sentences about object numbers that no table explains, or whose material is not said."""
    if not scene.objects:
        return [
            f"The ground truth numbers objects (objid), but {scene.root / 'scene.json'} lists none (objects: id, name, "
            "foreground, material): no errors by object or material."
        ]
    listed_ids = {item.id for item in scene.objects}
    stray: dict[int, str] = {}
    for view in views:
        numbers = _numbers(view)
        assert numbers is not None
        for number in numbers.unique().tolist():
            if number and number not in listed_ids:
                stray.setdefault(number, view.name)
    sentences = []
    if stray:
        sentences.append(
            f"{scene.root / 'scene.json'} (objects) does not list {listed([str(number) for number in sorted(stray)])}, "
            f"which gt/{stray[min(stray)]}.npz shows (objid): in no error by object or material."
        )
    unclear = [item.name for item in scene.objects if item.foreground and item.material.kind is None]
    if unclear:
        sentences.append(
            f"{scene.root / 'scene.json'} (objects) does not say whether {listed(unclear)} is a metal or a dielectric: "
            "in no error by material."
        )
    return sentences
