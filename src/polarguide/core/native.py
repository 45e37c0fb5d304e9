"""Check of the tensors that native code accepts, and calls of native autograd functions.

Tensors that native code does not accept use the reference implementations.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def fits(*tensors: Tensor | None) -> bool:
    """Return True if all tensors are float32 on the CPU."""
    return all(t is None or (t.device.type == "cpu" and t.dtype == torch.float32) for t in tensors)


def applied(function: type[torch.autograd.Function], *arguments: Any) -> Any:
    """Call an autograd function with ``ctx.needs_input_grad`` set only for gradients that can be needed.

    PyTorch sets this flag for parameters even under ``torch.no_grad``. Then the function would save data that is never
    used.
    """
    if not torch.is_grad_enabled():
        arguments = tuple(a.detach() if isinstance(a, Tensor) else a for a in arguments)
    return function.apply(*arguments)
