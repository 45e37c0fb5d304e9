"""Which tensors the native passes take, and how they are called; others go the way of the reference implementations."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def fits(*tensors: Tensor | None) -> bool:
    """Whether all that is given is float32 on the CPU."""
    return all(t is None or (t.device.type == "cpu" and t.dtype == torch.float32) for t in tensors)


def applied(function: type[torch.autograd.Function], *arguments: Any) -> Any:
    """The outputs of an autograd function; its ``ctx.needs_input_grad`` is true only where a gradient can be needed.

    Under ``torch.no_grad`` it is true all the same for parameters, for which much would be kept that nobody reads.
    """
    if not torch.is_grad_enabled():
        arguments = tuple(a.detach() if isinstance(a, Tensor) else a for a in arguments)
    return function.apply(*arguments)
