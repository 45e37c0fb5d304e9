"""Ground truth for scores: facts of the scene, and the target of each view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, maximum_filter, minimum_filter
from scipy.spatial.distance import pdist
from torch import Tensor

from polarguide.capture import Scene, View
from polarguide.capture.metadata import METAL_CLASSES, SceneObject
from polarguide.capture.variants import black_pixels
from polarguide.capture.view import listed
from polarguide.results.evaluation.metrics import Selection, has_direction, reflective_mask, window_centers

EXTENT = 1.1
"""Ratio of the extent of a scene to the largest distance between two of its cameras."""
BLACK_SHARE = 0.99
"""Share of black pixels outside the masks above which the pictures are assumed to show only the foreground."""
MARGIN = 3
"""Width of the border around a mask that counts neither as foreground nor as outside, in pixels."""
KNOWN = {
    "mask": "masks",
    "normal": "normals",
    "depth": "depths",
    "specular": "specular layers",
    "diffuse": "diffuse layers",
    "object_ids": "object numbers",
}
"""Displayed name of each kind of ground truth."""


@dataclass(frozen=True, eq=False)
class SceneFacts:
    """Facts about all test views of a scene, for their scores.

    Attributes:
        extent: 1.1 times the largest distance between two cameras, in world units.
        objects: foreground objects whose errors are recorded; empty if object numbers or the table of objects are
            missing.
        masks: foreground [H, W] bool of each test view, from the ground truth or, without one, from the user. None if a
            view has no mask.
        object_only: True if the pictures show only the foreground: more than 99 % of the pixels farther than
            3 pixels from the masks are black.
        warnings: sentences about scores that are limited because data is missing.
    """

    extent: float
    objects: tuple[SceneObject, ...] = ()
    masks: dict[str, Tensor] | None = None
    object_only: bool = False
    warnings: tuple[str, ...] = ()

    @classmethod
    def of(cls, scene: Scene) -> SceneFacts:
        """Collect the facts about the test views of a scene."""
        tests = scene.test_views
        centers = torch.stack([view.camera.center for view in scene.views]).numpy()
        warnings = _partial_truth_warnings(tests)
        foregrounds = {view.name: foreground(view) for view in tests}
        masks = {name: mask for name, mask in foregrounds.items() if mask is not None}
        if 0 < len(masks) < len(tests):
            lacking = [name for name in foregrounds if name not in masks]
            warnings.append(
                f"Only {len(masks)} of {len(tests)} test views have a mask (not {listed(lacking)}): stokes_error "
                "covers whole pictures."
            )
        complete = masks if len(masks) == len(tests) else None
        numbered = [view for view in tests if _numbers(view) is not None]
        if numbered:
            warnings += _object_warnings(scene, numbered)
        objects = scene.objects if numbered else ()
        return cls(
            extent=EXTENT * float(pdist(centers).max()) if len(centers) > 1 else 1.0,
            objects=tuple(item for item in objects if item.foreground),
            masks=complete,
            object_only=complete is not None and _on_black(tests, complete),
            warnings=tuple(warnings),
        )


def foreground(view: View) -> Tensor | None:
    """Return the foreground mask [H, W] of a view.

    The mask of the ground truth has priority over the mask of the user. Return None if there is no mask.
    """
    truth = view.ground_truth
    return truth.mask if truth is not None and truth.mask is not None else view.mask


def outside(mask: Tensor) -> Tensor:
    """Return a mask [H, W] of the pixels that are more than ``MARGIN`` rows or columns away from ``mask``."""
    grown = binary_dilation(mask.numpy(), structure=torch.ones(3, 3).numpy(), iterations=MARGIN)
    return torch.from_numpy(~grown)


def _numbers(view: View) -> Tensor | None:
    return None if view.ground_truth is None else view.ground_truth.object_ids


def _on_black(views: Sequence[View], masks: dict[str, Tensor]) -> bool:
    black = total = 0
    for view in views:
        beyond = outside(masks[view.name]) & ~view.invalid
        black += int(black_pixels(view)[beyond].sum())
        total += int(beyond.sum())
    return total > 0 and black > BLACK_SHARE * total


def _partial_truth_warnings(views: Sequence[View]) -> list[str]:
    counts = {key: sum(getattr(view.ground_truth, key, None) is not None for view in views) for key in KNOWN}
    partly = [f"{KNOWN[key]} of {count}" for key, count in counts.items() if 0 < count < len(views)]
    text = (
        f"The ground truth has {', '.join(partly)} of {len(views)} test views: these scores are means over those "
        "views only."
    )
    return [text] if partly else []


def _object_warnings(scene: Scene, views: Sequence[View]) -> list[str]:
    """Return warnings about object numbers without a table entry, and about unspecified materials."""
    if not scene.objects:
        return [
            f"The ground truth has object numbers (objid), but {scene.root / 'scene.json'} has no table of objects "
            "(objects: id, name, foreground, material): no errors by object or material."
        ]
    listed_ids = {item.id for item in scene.objects}
    unlisted: dict[int, str] = {}
    for view in views:
        numbers = _numbers(view)
        assert numbers is not None
        for number in numbers.unique().tolist():
            if number and number not in listed_ids:
                unlisted.setdefault(number, view.name)
    sentences = []
    if unlisted:
        sentences.append(
            f"{scene.root / 'scene.json'} (objects) does not list "
            f"{listed([str(number) for number in sorted(unlisted)])}, although gt/{unlisted[min(unlisted)]}.npz "
            "contains it (objid): in no error by object or material."
        )
    unclear = [item.name for item in scene.objects if item.foreground and item.material.kind is None]
    if unclear:
        sentences.append(
            f"{scene.root / 'scene.json'} (objects) does not specify whether {listed(unclear)} is a metal or a "
            "dielectric: in no error by material."
        )
    return sentences


JUMP = 1.05
"""Ratio of neighboring true depths above which the pixels belong to different surfaces."""
JUMP_MARGIN = 2
"""Minimum distance of a smooth pixel from a jump of depth, in pixels."""


@dataclass(frozen=True, eq=False)
class ViewTarget:
    """Photograph, ground truth and pixels to score of a view, on one device; floats are float64.

    None represents missing data.

    Attributes:
        photograph: [H, W, 3] linear, S0/2.
        valid: pixels of the photograph to score.
        windows: pixels of ``valid`` that are centers of SSIM windows.
        foreground: valid pixels of the true mask. Without a mask, this attribute and all attributes up to ``diffuse``
            are missing.
        reflective: foreground pixels dominated by reflection.
        surface: foreground pixels with a true normal.
        normal: [H, W, 3] world.
        specular, diffuse: [H, W, 3] true linear S0 of the layer.
        polarization: measured S1, then S2, of each channel, [H, W, 6] linear.
        polarized: pixels for the Stokes error. They are valid, not saturated, and in the foreground if masks are known.
        owner: [H, W] int64, index of each pixel's object in ``SceneFacts.objects``. A pixel without an object has the
            number of objects as its index.
        dielectric: foreground pixels of objects that are known to be dielectric.
        depth: [H, W] true camera depth, 0 if unknown.
        near: pixels for the depth error: pixels with a true depth, restricted to the foreground if there is a mask.
        smooth: valid pixels with a true depth and without a jump of depth within 2 pixels.
        mask: [H, W] float64, 1 in the foreground, if the pictures show only the foreground; otherwise None.
        beyond: valid pixels more than 3 pixels outside ``mask``.
        seen: valid pixels whose content is visible in a training view, or None if this was not determined.
        seen_windows: pixels of ``seen`` that are centers of SSIM windows.
        seen_polarized: pixels of ``seen`` that are also in ``polarized``.
        confirmed: valid pixels with a surface that two training views confirm, or None if this was not determined.
        extent: extent of the scene in world units.
    """

    photograph: Tensor
    valid: Selection
    windows: Selection
    foreground: Selection | None
    reflective: Selection | None
    surface: Selection | None
    normal: Tensor | None
    specular: Tensor | None
    diffuse: Tensor | None
    polarization: Tensor | None = None
    polarized: Selection | None = None
    owner: Tensor | None = None
    dielectric: Selection | None = None
    depth: Tensor | None = None
    near: Selection | None = None
    smooth: Selection | None = None
    mask: Tensor | None = None
    beyond: Selection | None = None
    seen: Selection | None = None
    seen_windows: Selection | None = None
    seen_polarized: Selection | None = None
    confirmed: Selection | None = None
    extent: float = 1.0

    @classmethod
    def of(
        cls, photograph: Tensor, invalid: Tensor | None, ground_truth: Any, device: torch.device
    ) -> ViewTarget:
        """Select the pixels on the CPU and copy all data to a device.

        Args:
            photograph: [H, W, 3] linear, S0/2.
            invalid: [H, W] bool, pixels without a valid value (saturated, dark, no data), which no score counts. None
                if all pixels are valid.
            ground_truth: None, or an object with optional attributes: ``mask`` [H, W] bool, ``normal`` [H, W,
                3] world, ``specular`` and ``diffuse`` [H, W, 3] linear S0 of the lobes, ``depth`` [H, W].
            device: device of the rendering.
        """
        valid = torch.ones(photograph.shape[:2], dtype=torch.bool) if invalid is None else ~invalid
        mask = getattr(ground_truth, "mask", None)
        maps = {
            name: None if mask is None else getattr(ground_truth, name, None)
            for name in ("normal", "specular", "diffuse")
        }
        foreground = None if mask is None else mask.to(torch.bool) & valid
        reflective = surface = None
        if foreground is not None and maps["specular"] is not None:
            reflective = reflective_mask(maps["specular"], 2 * photograph.to(torch.float64), foreground)
        if foreground is not None and maps["normal"] is not None:
            surface = foreground & has_direction(maps["normal"])
        depth = getattr(ground_truth, "depth", None)
        near = smooth = None
        if depth is not None:
            near = (valid if foreground is None else foreground) & (depth > 0)
            smooth = valid & without_jumps(depth)
        return cls(
            photograph=photograph.detach().to(device, torch.float64),
            valid=Selection.of(valid, device),
            windows=Selection.of(window_centers(valid), device),
            foreground=_selection(foreground, device),
            reflective=_selection(reflective, device),
            surface=_selection(surface, device),
            normal=_on_device(maps["normal"], device),
            specular=_on_device(maps["specular"], device),
            diffuse=_on_device(maps["diffuse"], device),
            depth=_on_device(depth, device),
            near=_selection(near, device),
            smooth=_selection(smooth, device),
        )

    @classmethod
    def of_view(cls, view: View, facts: SceneFacts, device: torch.device) -> ViewTarget:
        """Create the target of a test view from the view and the facts about its scene."""
        target = cls.of(view.photograph(), view.invalid, view.ground_truth, device)
        masks = facts.masks
        truth = view.ground_truth
        polarization = polarized = None
        if view.is_determined:
            polarization = torch.cat(view.stokes()[1:].unbind(0), dim=-1)
            counts = ~(view.invalid | view.saturated)
            polarized = counts if masks is None else counts & masks[view.name]
        owner = dielectric = None
        if facts.objects and truth is not None and truth.object_ids is not None:
            owner = torch.full_like(truth.object_ids, len(facts.objects), dtype=torch.int64)
            for place, item in enumerate(facts.objects):
                owner[truth.object_ids == item.id] = place
            plain = [item.material.kind not in (None, *METAL_CLASSES) for item in facts.objects]
            dielectric = torch.tensor([*plain, False])[owner] & ~view.invalid
            if truth.mask is not None:
                dielectric &= truth.mask
        mask = masks[view.name] if masks is not None and facts.object_only else None
        return replace(
            target,
            polarization=_on_device(polarization, device),
            polarized=_selection(polarized, device),
            owner=None if owner is None else owner.to(device),
            dielectric=_selection(dielectric, device),
            mask=_on_device(mask, device),
            beyond=_selection(None if mask is None else outside(mask) & ~view.invalid, device),
            extent=facts.extent,
        )

    @property
    def unseen(self) -> Tensor:
        """Mask [H, W] of valid pixels that are visible in no training view; all False if this was not determined."""
        return self.valid.mask & ~(self.valid if self.seen is None else self.seen).mask

    def with_coverage(self, seen: Tensor, confirmed: Tensor | None = None) -> ViewTarget:
        """Return the target with results of the training views.

        Args:
            seen: [H, W] bool on the CPU, pixels whose content is visible in a training view.
            confirmed: [H, W] bool on the CPU, pixels with a surface that two training views confirm.
        """
        device = self.photograph.device
        counted = seen & self.valid.mask.cpu()
        polarized = None if self.polarized is None else counted & self.polarized.mask.cpu()
        return replace(
            self,
            seen=Selection.of(counted, device),
            seen_windows=Selection.of(window_centers(counted), device),
            seen_polarized=_selection(polarized, device),
            confirmed=_selection(None if confirmed is None else confirmed & self.valid.mask.cpu(), device),
        )


def without_jumps(depth: Tensor) -> Tensor:
    """Return a mask [H, W] of pixels with a depth and without a jump of depth within 2 pixels.

    A square of 3 x 3 pixels has a jump if its largest depth exceeds 1.05 times its smallest depth, or if one of its
    depths is missing. The mask contains a pixel if no square of 3 x 3 pixels inside the 5 x 5 pixels around it has a
    jump.
    """
    near_jump = maximum_filter(jumps(depth), size=2 * JUMP_MARGIN - 1, mode="nearest")
    return (depth > 0) & torch.from_numpy(~near_jump)


def jumps(depth: Tensor) -> NDArray[np.bool_]:
    """Return a mask [H, W] of pixels with a jump of depth within the 3 x 3 pixels around them."""
    values = depth.double().numpy()
    low, high = (f(values, size=3, mode="nearest") for f in (minimum_filter, maximum_filter))
    return np.asarray(high > JUMP * low)


def _on_device(values: Tensor | None, device: torch.device) -> Tensor | None:
    return None if values is None else values.detach().to(device).to(torch.float64)


def _selection(pixels: Tensor | None, device: torch.device) -> Selection | None:
    return None if pixels is None else Selection.of(pixels, device)
