"""What a training of a field compares with: of each view the shown picture, and degree and angle of polarization."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.capture import View
from polarguide.color import srgb_encode
from polarguide.optics import aolp, dolp, luminance
from polarguide.training.packing import Entry, Packed, packed, unpacked
from polarguide.training.view_store import ViewStore


@dataclass(frozen=True, eq=False)
class Target:
    """Of one view, row by row: P = H W pixels.

    Attributes:
        picture: shown colors [P, 3]. dolp: [P] in [0, 1], 0 where nothing is known of the polarization.
        aolp: [P] radians in [0, pi), in the lens frame. valid: numbers of the pixels that count, [V].
    """

    picture: Tensor
    dolp: Tensor
    aolp: Tensor
    valid: Tensor


def target_of(view: View, store: ViewStore, device: torch.device) -> Target:
    """What a view is compared with, made once and kept as two bytes a value."""

    def make() -> Entry:
        entry = {"picture": packed(srgb_encode(view.photograph().clamp(0, 1)).to(device))}
        if bool(view.invalid.any()):
            entry["valid"] = Packed((~view.invalid).to(device))
        if view.is_determined:
            gray = luminance(view.stokes())
            known = dolp(gray) * ~(view.saturated | view.invalid)
            entry["dolp"], entry["aolp"] = packed(known.to(device)), packed(aolp(gray).to(device))
        return entry

    kept = store.get("target", view.name, make)
    picture = unpacked(kept["picture"]).view(-1, 3)
    nothing = torch.zeros(len(picture), device=device)
    degree, angle = (unpacked(kept[name]).flatten() if name in kept else nothing for name in ("dolp", "aolp"))
    valid = kept["valid"].codes.flatten() if "valid" in kept else nothing == 0
    return Target(picture, degree, torch.remainder(angle, torch.pi), valid.nonzero()[:, 0])
