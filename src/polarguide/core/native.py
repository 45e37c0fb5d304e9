"""Tensors that the native passes accept, and calls of native functions.

Other tensors use the reference implementations.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def fits(*tensors: Tensor | None) -> bool:
    """Return whether all tensors are float32 on the CPU."""
    return all(t is None or (t.device.type == "cpu" and t.dtype == torch.float32) for t in tensors)


def applied(function: type[torch.autograd.Function], *arguments: Any) -> Any:
    """Call an autograd function. Its ``ctx.needs_input_grad`` is true only if a gradient can be needed.

    Under ``torch.no_grad`` PyTorch sets it for parameters as well, so that unused data would be kept.
    """
    if not torch.is_grad_enabled():
        arguments = tuple(a.detach() if isinstance(a, Tensor) else a for a in arguments)
    return function.apply(*arguments)
