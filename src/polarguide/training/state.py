"""Everything that training changes, and how it is put into a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.gaussians.densify import DensityStatistics
from polarguide.gaussians.rows import GaussianRows


class Environment:
    """The learned surroundings: a cubemap of raw texels with its own Adam state."""

    def __init__(self, texels: Tensor, rate: float) -> None:
        self.texels = texels.detach().clone().contiguous().requires_grad_()
        self._optimiser = torch.optim.Adam([self.texels], lr=rate, eps=1e-15, fused=True)

    def step(self) -> None:
        """One Adam step, if there is a gradient."""
        if self.texels.grad is not None:
            self._optimiser.step()
            self._optimiser.zero_grad(set_to_none=True)

    def state(self) -> dict[str, Tensor]:
        """``environment.texels`` and its moments."""
        out = {"environment.texels": self.texels.detach()}
        for key, value in self._optimiser.state.get(self.texels, {}).items():
            out[f"environment.adam.{key}"] = value.detach()
        return out

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor], rate: float) -> Environment:
        """The inverse of ``state``."""
        environment = cls(state["environment.texels"], rate)
        prefix = "environment.adam."
        moments = {k[len(prefix) :]: v.clone() for k, v in state.items() if k.startswith(prefix)}
        if moments:
            environment._optimiser.state[environment.texels] = moments
        return environment


@dataclass
class TrainingState:
    """The complete state between two steps.

    Attributes:
        step: the next step, 0-based.
        rows: the Gaussians.
        environment: learned reflection, None for a recipe without.
        statistics: of the density control.
        frozen: copy of the rows from which the present priors were computed; None before the first refresh.
        opacity_frozen_until: first step at which opacities train again (after a normal propagation).
        opacity_was_reset: whether opacities have been reset yet (then huge Gaussians are pruned).
    """

    step: int
    rows: GaussianRows
    environment: Environment | None
    statistics: DensityStatistics
    frozen: dict[str, Tensor] | None = None
    opacity_frozen_until: int = 0
    opacity_was_reset: bool = False

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name, for a checkpoint."""
        out = self.rows.state()
        if self.environment is not None:
            out.update(self.environment.state())
        out["statistics.gradient"] = self.statistics.gradient
        out["statistics.seen"] = self.statistics.seen
        if self.frozen is not None:
            out.update({f"frozen.{name}": t for name, t in self.frozen.items()})
        out["scalars"] = torch.tensor(
            [self.step, self.opacity_frozen_until, int(self.opacity_was_reset)], dtype=torch.int64
        )
        return out

    @classmethod
    def from_tensors(
        cls, tensors: Mapping[str, Tensor], rates: Mapping[str, float], environment_rate: float
    ) -> TrainingState:
        """The inverse of ``tensors``."""
        rows = GaussianRows.from_state(tensors, rates)
        environment = None
        if "environment.texels" in tensors:
            environment = Environment.from_state(tensors, environment_rate)
        statistics = DensityStatistics(len(rows))
        statistics.gradient, statistics.seen = tensors["statistics.gradient"], tensors["statistics.seen"]
        frozen = {key[7:]: value for key, value in tensors.items() if key.startswith("frozen.")}
        step, frozen_until, was_reset = (int(x) for x in tensors["scalars"])
        return cls(step, rows, environment, statistics, frozen or None, frozen_until, bool(was_reset))
