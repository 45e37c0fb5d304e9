"""Adam (Kingma and Ba 2015) on named tensors.

The kernel is torch's. ``torch.optim.Adam`` around it loads torch's compiler at its first use, which takes as long as
loading torch itself, in every process that trains; and its state hangs on tensors, where ours change under way.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor
from torch.optim.adam import adam

MOMENTS = ("step", "exp_avg", "exp_avg_sq")
"""Names of a tensor's state: how many steps it has made, and the means of its gradients and their squares."""


class Adam:
    """The state of Adam, and its steps.

    Args:
        rates: learning rate by name of the tensor; others are not trained.
        betas: decay of both moments. epsilon: added to the root of the second moment.

    Attributes:
        rates, betas: as above; they may be changed between steps.
        moments: by name of the tensor, tensors by ``MOMENTS``; none before its first step.
    """

    def __init__(
        self, rates: Mapping[str, float], *, betas: tuple[float, float] = (0.9, 0.999), epsilon: float
    ) -> None:
        self.rates = dict(rates)
        self.betas = betas
        self._epsilon = epsilon
        self.moments: dict[str, dict[str, Tensor]] = {}

    @torch.no_grad()
    def step(self, tensors: Mapping[str, Tensor]) -> None:
        """One step of every trained tensor that has a gradient, in place; then the gradients are dropped."""
        for name, rate in self.rates.items():
            tensor = tensors[name]
            if tensor.grad is None:
                continue
            if name not in self.moments:
                self.moments[name] = {
                    "step": torch.zeros((), dtype=torch.float32, device=tensor.device),
                    "exp_avg": torch.zeros_like(tensor, memory_format=torch.preserve_format),
                    "exp_avg_sq": torch.zeros_like(tensor, memory_format=torch.preserve_format),
                }
            moments = self.moments[name]
            adam(
                [tensor],
                [tensor.grad],
                [moments["exp_avg"]],
                [moments["exp_avg_sq"]],
                [],
                [moments["step"]],
                fused=True,
                amsgrad=False,
                beta1=self.betas[0],
                beta2=self.betas[1],
                lr=rate,
                weight_decay=0.0,
                eps=self._epsilon,
                maximize=False,
            )
            tensor.grad = None

    def change(self, name: str, follow: Callable[[Tensor], Tensor]) -> None:
        """Edit both moments of a tensor, where it has any, as the tensor itself was edited."""
        if name in self.moments:
            moments = self.moments[name]
            for key in ("exp_avg", "exp_avg_sq"):
                moments[key] = follow(moments[key]).contiguous()
