"""Where the error of a view is, pixel by pixel, and its sums over each object."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from polarguide.capture.ground_truth import SceneObject
from polarguide.color import shown
from polarguide.evaluation.measures import LEAST_POLARIZED
from polarguide.evaluation.metrics import Selection, decibels, normal_angles_deg
from polarguide.evaluation.table import HIGHEST_PSNR, OBJECT_METRICS, Layers
from polarguide.evaluation.target import ViewTarget

HALF = 0.5
"""Share of metals from which on a pixel counts as one."""


class ErrorMap(NamedTuple):
    """An error of every pixel; over any pixels the metric is the sum of ``error`` over that of ``weight``.

    Attributes:
        error: [H, W], 0 where it does not count. weight: [H, W], 0 where it does not count.
    """

    error: Tensor
    weight: Tensor


def error_maps(target: ViewTarget, layers: Layers) -> dict[str, ErrorMap]:
    """The maps of ``OBJECT_METRICS`` as far as layers and truth are there, float64.

    Squared error of shown pictures (mean over channels) for PSNRs; degrees; sum over channels of |S1 error| + |S2
    error|, whose weight is that of |S1| + |S2|.
    """
    maps = {"psnr": _squared(layers["final"], target.photograph, target.valid)}
    for name in ("specular", "diffuse"):
        lobe = getattr(target, name)
        maps[f"{name}_psnr"] = _squared(layers[name], None if lobe is None else lobe / 2, target.foreground)
    normal, true, surface = layers["normal"], target.normal, target.surface
    maps["normal_mae_deg"] = None
    if normal is not None and true is not None and surface is not None:
        angles = torch.where(surface.mask, normal_angles_deg(normal, true), 0.0)
        maps["normal_mae_deg"] = ErrorMap(angles, surface.mask.to(torch.float64))
    stokes, measured, keep = layers.get("polarization"), target.polarization, target.polarized
    maps["stokes_error"] = None
    if stokes is not None and measured is not None and keep is not None:
        errors = ((stokes - measured).abs().sum(dim=-1), measured.abs().sum(dim=-1))
        maps["stokes_error"] = ErrorMap(*(torch.where(keep.mask, values, 0.0) for values in errors))
    return {key: found for key in OBJECT_METRICS if (found := maps[key]) is not None}


def _squared(pred: Tensor | None, true: Tensor | None, keep: Selection | None) -> ErrorMap | None:
    if pred is None or true is None or keep is None:
        return None
    error = ((shown(pred) - shown(true)) ** 2).mean(dim=-1)
    return ErrorMap(torch.where(keep.mask, error, 0.0), keep.mask.to(torch.float64))


class ErrorsByObject:
    """Sums of errors over the pixels of each object, and of each class of material, in all views.

    They stay on the views' device until they are asked for.

    Args:
        objects: in the order of ``ViewTarget.owner``.
    """

    def __init__(self, objects: Sequence[SceneObject]) -> None:
        self._objects = tuple(objects)
        self._kinds = sorted({item.material.kind for item in objects if item.material.kind is not None})
        self._members = torch.tensor(
            [[item.material.kind == kind for item in objects] for kind in self._kinds], dtype=torch.float64
        ).reshape(len(self._kinds), len(self._objects))
        self._sums: Tensor | None = None
        self._tells_metals = False

    def add(self, target: ViewTarget, layers: Layers) -> None:
        """Add a view; one whose pixels' objects are not known adds nothing."""
        owner = target.owner
        if owner is None:
            return
        maps = error_maps(target, layers)
        counts = (target.valid if target.foreground is None else target.foreground).mask
        nothing = torch.zeros_like(target.photograph[..., 0])
        lit = nothing if target.polarized is None else 2 * target.photograph.sum(-1) * target.polarized.mask
        columns = [values for key in OBJECT_METRICS for values in maps.get(key, (nothing, nothing))]
        metalness = layers.get("metalness")
        self._tells_metals = metalness is not None
        metal = nothing if metalness is None else (metalness > HALF).to(torch.float64)
        columns += [metal, lit, counts.to(torch.float64)]
        table = torch.stack(columns, dim=-1).flatten(0, 1) * counts.flatten()[:, None]
        sums = torch.stack(
            [(owner.flatten() == place).to(table.dtype) @ table for place in range(len(self._objects))]
        )
        sums = torch.cat((sums, self._members.to(sums.device) @ sums))
        sums = torch.cat((sums, (sums[:, -1:] > 0).to(sums.dtype)), dim=1)
        self._sums = sums if self._sums is None else self._sums + sums

    def records(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Errors by the object's name, and by class of material, as ``metrics.json`` has them; waits for the device."""
        if self._sums is None:
            return {}, {}
        rows = [_record(row, metals=self._tells_metals) for row in self._sums.cpu().tolist()]
        count = len(self._objects)
        by_object = {
            item.name: {"material": item.material.kind, **row}
            for item, row in zip(self._objects, rows[:count], strict=True)
        }
        return by_object, dict(zip(self._kinds, rows[count:], strict=True))


def _record(sums: Sequence[float], *, metals: bool) -> dict[str, Any]:
    *pairs, metal, light, pixels, views = sums
    record: dict[str, Any] = {"pixels": int(pixels), "views": int(views)}
    for key, error, weight in zip(OBJECT_METRICS, pairs[::2], pairs[1::2], strict=True):
        known = weight > 0 and (key != "stokes_error" or weight >= LEAST_POLARIZED * light)
        value = error / weight if known else None
        if value is not None and key.endswith("psnr"):
            value = min(decibels(value), HIGHEST_PSNR)
        record[key] = value
    if metals and pixels:
        record["metal_share"] = metal / pixels
    return record
