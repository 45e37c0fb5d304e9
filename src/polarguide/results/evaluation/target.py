"""Targets of scoring: facts of the scene as a whole, and the target of each view."""

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
    """Facts of all test views of a scene.

    Attributes:
        extent: 1.1 times the largest distance between two cameras, in world units.
        objects: whose errors are recorded one by one: the foreground's, if numbers and table of objects are known.
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
        warnings = _partly_known(tests)
        foregrounds = {view.name: foreground(view) for view in tests}
        masks = {name: mask for name, mask in foregrounds.items() if mask is not None}
        if 0 < len(masks) < len(tests):
            lacking = [name for name in foregrounds if name not in masks]
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
    truth = view.ground_truth
    return truth.mask if truth is not None and truth.mask is not None else view.mask


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
    """Sentences about object numbers that no table explains, or whose material is not specified."""
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


JUMP = 1.05
"""Neighboring true depths whose ratio exceeds this do not belong to one surface."""
JUMP_MARGIN = 2


@dataclass(frozen=True, eq=False)
class ViewTarget:
    """The photograph, what else is known about a view, and which pixels count; all on one device, floats as float64.

    Attributes:
        photograph: [H, W, 3] linear, S0/2.
        valid: the pixels that count at all. windows: those of them that are centers of SSIM's windows.
        foreground: valid pixels of the true mask; None without a mask, and then all up to ``diffuse`` is None.
        reflective: those that are mostly seen by their reflection; None where the true specular lobe is not known.
        surface: foreground pixels with a true normal; None where normals are not known.
        normal: [H, W, 3] world. specular, diffuse: [H, W, 3] linear S0 of the lobes. None where not known.
        polarization: measured S1, then S2, of each channel, [H, W, 6] linear.
        polarized: the pixels whose polarization counts: valid, not saturated, and foreground where masks are known.
        owner: place of each pixel's object in the scene's ``SceneFacts.objects``, as many for none, [H, W] int64.
        dielectric: foreground pixels of objects that are known to be no metal.
        depth: [H, W] true camera depth, 0 where not known. near: the pixels whose depth counts: foreground with a true
            depth, any with a true depth where there is no mask.
        smooth: valid pixels with a true depth at least 2 pixels from any jump of it.
        mask: [H, W] float64, 1 in the foreground; None unless the pictures show nothing else.
        beyond: valid pixels more than 3 pixels outside the mask; None likewise.
        seen: valid pixels whose content a training view shows; None if not determined. seen_windows: centers of
            SSIM's windows among them. seen_polarized: those of them whose polarization counts.
        extent: extent of the scene, world units.
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
    extent: float = 1.0

    @classmethod
    def of(
        cls, photograph: Tensor, invalid: Tensor | None, ground_truth: Any, device: torch.device
    ) -> ViewTarget:
        """Choose the pixels where the view lies, which is the CPU, and copy everything to the device.

        Args:
            photograph: [H, W, 3] linear, S0/2.
            invalid: [H, W] bool, pixels of the photograph that do not count (saturated, dark, no data); None: all
                count. It applies to every score.
            ground_truth: None, or an object whose attributes may each be None: ``mask`` [H, W] bool, ``normal``
                [H, W, 3] world, ``specular`` and ``diffuse`` [H, W, 3] linear S0 of the lobes, ``depth`` [H, W].
            device: where the view will be rendered.
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
            foreground=_chosen(foreground, device),
            reflective=_chosen(reflective, device),
            surface=_chosen(surface, device),
            normal=_there(maps["normal"], device),
            specular=_there(maps["specular"], device),
            diffuse=_there(maps["diffuse"], device),
            depth=_there(depth, device),
            near=_chosen(near, device),
            smooth=_chosen(smooth, device),
        )

    @classmethod
    def of_view(cls, view: View, facts: SceneFacts, device: torch.device) -> ViewTarget:
        """All that is known of a test view, on a device."""
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
        alone = masks[view.name] if masks is not None and facts.object_only else None
        return replace(
            target,
            polarization=_there(polarization, device),
            polarized=_chosen(polarized, device),
            owner=None if owner is None else owner.to(device),
            dielectric=_chosen(dielectric, device),
            mask=_there(alone, device),
            beyond=_chosen(None if alone is None else outside(alone) & ~view.invalid, device),
            extent=facts.extent,
        )

    def with_coverage(self, seen: Tensor) -> ViewTarget:
        """Return the target with the pixels [H, W] bool (CPU) whose content a training view shows."""
        device = self.photograph.device
        counted = seen & self.valid.mask.cpu()
        polarized = None if self.polarized is None else counted & self.polarized.mask.cpu()
        return replace(
            self,
            seen=Selection.of(counted, device),
            seen_windows=Selection.of(window_centers(counted), device),
            seen_polarized=_chosen(polarized, device),
        )


def without_jumps(depth: Tensor) -> Tensor:
    """Where a depth [H, W] is known and does not jump within 2 pixels: [H, W] bool.

    It jumps in a square of 3 x 3 pixels whose largest depth exceeds 1.05 times the smallest, or in which some pixel has
    none. A pixel is without jumps if no such square lies in the square that reaches 2 pixels to each side.
    """
    near_jump = maximum_filter(jumps(depth), size=2 * JUMP_MARGIN - 1, mode="nearest")
    return (depth > 0) & torch.from_numpy(~near_jump)


def jumps(depth: Tensor) -> NDArray[np.bool_]:
    """Whether a depth [H, W] jumps in the square of 3 x 3 pixels around each pixel."""
    values = depth.double().numpy()
    low, high = (f(values, size=3, mode="nearest") for f in (minimum_filter, maximum_filter))
    return np.asarray(high > JUMP * low)


def _there(values: Tensor | None, device: torch.device) -> Tensor | None:
    return None if values is None else values.detach().to(device).to(torch.float64)


def _chosen(pixels: Tensor | None, device: torch.device) -> Selection | None:
    return None if pixels is None else Selection.of(pixels, device)
