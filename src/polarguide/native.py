"""Which tensors the native passes take; all others go the way of the reference implementations."""

from __future__ import annotations

import torch
from torch import Tensor


def fits(*tensors: Tensor | None) -> bool:
    """Whether all that is given is float32 on the CPU."""
    return all(t is None or (t.device.type == "cpu" and t.dtype == torch.float32) for t in tensors)
