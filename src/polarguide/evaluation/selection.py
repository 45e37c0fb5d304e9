"""The pixels of a picture that count, chosen before anybody computes with them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Selection:
    """Pixels that count, as a mask and by their numbers.

    A device that picks by a mask has to count it first, and whoever asked waits for the answer. So masks are counted on
    the CPU, where they come from, and pixels are picked by number: the same ones in the same order.

    Attributes:
        mask: [H, W] bool. places: [P] int64, the pixels in it, counted along the rows.
    """

    mask: Tensor
    places: Tensor

    @classmethod
    def of(cls, mask: Tensor, device: torch.device) -> Selection:
        """The pixels of a mask [H, W] bool, on a device; the mask itself should lie on the CPU."""
        return cls(mask.to(device), mask.flatten().nonzero()[:, 0].to(device))

    def pick(self, values: Tensor) -> Tensor:
        """[P, ...] of values [H, W, ...] on the same device."""
        return values.flatten(0, 1).index_select(0, self.places)
