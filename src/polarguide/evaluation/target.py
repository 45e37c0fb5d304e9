"""What a rendered view is scored against, brought to the device that renders it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter
from torch import Tensor

from polarguide.capture import View
from polarguide.capture.ground_truth import METAL_CLASSES
from polarguide.evaluation.facts import SceneFacts, outside
from polarguide.evaluation.metrics import Selection, has_direction, reflective_mask, window_centers

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
        extent: of the scene, world units.
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
        names = ("normal", "specular", "diffuse")
        known = {name: None if mask is None else getattr(ground_truth, name, None) for name in names}
        there = {name: None if values is None else _there(values, device) for name, values in known.items()}
        foreground = None if mask is None else mask.to(torch.bool) & valid
        reflective = surface = None
        if foreground is not None and known["specular"] is not None:
            reflective = reflective_mask(known["specular"], 2 * photograph.to(torch.float64), foreground)
        if foreground is not None and known["normal"] is not None:
            surface = foreground & has_direction(known["normal"])
        depth = getattr(ground_truth, "depth", None)
        near = smooth = None
        if depth is not None:
            near = (valid if foreground is None else foreground) & (depth > 0)
            smooth = valid & without_jumps(depth)
        return cls(
            photograph=_there(photograph, device),
            valid=Selection.of(valid, device),
            windows=Selection.of(window_centers(valid), device),
            foreground=_chosen(foreground, device),
            reflective=_chosen(reflective, device),
            surface=_chosen(surface, device),
            normal=there["normal"],
            specular=there["specular"],
            diffuse=there["diffuse"],
            depth=None if depth is None else _there(depth, device),
            near=_chosen(near, device),
            smooth=_chosen(smooth, device),
        )

    @classmethod
    def of_view(cls, view: View, facts: SceneFacts, device: torch.device) -> ViewTarget:
        """All that is known of a test view, on a device."""
        target = cls.of(view.photograph(), view.invalid, view.ground_truth, device)
        masks, known = facts.masks, view.ground_truth
        polarization = polarized = None
        if view.is_determined:
            polarization = _there(torch.cat(view.stokes()[1:].unbind(0), dim=-1), device)
            counts = ~(view.invalid | view.saturated)
            polarized = Selection.of(counts if masks is None else counts & masks[view.name], device)
        owner = dielectric = None
        if facts.objects and known is not None and known.object_ids is not None:
            owner = torch.full_like(known.object_ids, len(facts.objects), dtype=torch.int64)
            for place, item in enumerate(facts.objects):
                owner[known.object_ids == item.id] = place
            plain = [item.material.kind not in (None, *METAL_CLASSES) for item in facts.objects]
            dielectric = torch.tensor([*plain, False])[owner] & ~view.invalid
            if known.mask is not None:
                dielectric &= known.mask
        alone = masks[view.name] if masks is not None and facts.object_only else None
        return replace(
            target,
            polarization=polarization,
            polarized=polarized,
            owner=None if owner is None else owner.to(device),
            dielectric=_chosen(dielectric, device),
            mask=None if alone is None else _there(alone, device),
            beyond=None if alone is None else Selection.of(outside(alone) & ~view.invalid, device),
            extent=facts.extent,
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


def _there(values: Tensor, device: torch.device) -> Tensor:
    return values.detach().to(device).to(torch.float64)


def _chosen(pixels: Tensor | None, device: torch.device) -> Selection | None:
    return None if pixels is None else Selection.of(pixels, device)
