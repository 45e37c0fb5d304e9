"""Gaussians in training: tensors with one entry per Gaussian, and the moments of Adam (Kingma and Ba 2015).

Gaussians are removed, appended and overwritten only by the methods of this module, so that a tensor and its moments
stay consistent. Adam uses the kernel of torch, but not ``torch.optim.Adam``. That class loads torch's compiler at its
first use, which takes as long as loading torch. Its state also belongs to tensor objects, which are replaced here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol, TypeVar

import torch
from torch import Tensor
from torch.optim.adam import adam

from polarguide.core.errors import PolarguideError

MOMENTS = ("step", "exp_avg", "exp_avg_sq")
"""Names of the state of Adam for a tensor: number of steps, mean gradient, and mean squared gradient."""


class Adam:
    """State and steps of Adam.

    Args:
        rates: learning rate by name of the tensor. Tensors without a rate are not trained.
        betas: decay rates of the first and the second moment.
        epsilon: value that is added to the square root of the second moment.

        Attributes:
            rates, betas: current values of the arguments, which may change between steps.
            moments: state of each tensor by the names in ``MOMENTS``; empty before the first step of the tensor.
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
        """Update every trained tensor with a gradient in place, and drop the gradients."""
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
        """Apply an edit of a tensor to both of its moments, if it has any."""
        if name in self.moments:
            moments = self.moments[name]
            for key in ("exp_avg", "exp_avg_sq"):
                moments[key] = follow(moments[key]).contiguous()


CORE_SHAPES = {
    "means": (3,),
    "quaternions": (4,),
    "log_scales": (3,),
    "opacity_logits": (),
    "sh_dc": (3,),
    "sh_rest": (15, 3),
}
"""Shapes of the values of one Gaussian, for the tensors of every recipe. Shading models add further tensors."""
ORIENTED_SHAPES = {"outward": (3,)}
"""Shape of the direction from which training views see a Gaussian. Oriented recipes have this untrained tensor."""


class Parameters(Protocol):
    """Per-Gaussian tensors by name: the tensors in training, or a frozen copy."""

    def __getitem__(self, name: str, /) -> Tensor: ...
    def get(self, name: str, /) -> Tensor | None:
        """Return a tensor, or None for an unknown name."""


Own = TypeVar("Own", bound="Trained")


class Trained:
    """Named tensors with ``Adam``, whose epsilon is 1e-15 as in 3DGS.

    Args:
        tensors: tensors by name.
        rates: learning rate by name; tensors without a rate are not trained.
    """

    kind = ""
    """Prefix of the names of the tensors in a checkpoint."""

    def __init__(self, tensors: Mapping[str, Tensor], rates: Mapping[str, float]) -> None:
        self._tensors = {
            name: t.detach().clone().contiguous().requires_grad_() for name, t in tensors.items()
        }
        own = {name: rate for name, rate in rates.items() if name in self._tensors}
        self._adam = Adam(own, epsilon=1e-15)

    def set_rate(self, name: str, rate: float) -> None:
        """Set the learning rate of one tensor, if it is trained."""
        if name in self._adam.rates:
            self._adam.rates[name] = rate

    def step(self) -> None:
        """Update every tensor with a gradient by one step of Adam, and drop the gradients."""
        self._adam.step(self._tensors)

    def state(self) -> dict[str, Tensor]:
        """Return all tensors and their moments, by the names that a checkpoint uses."""
        out = {f"{self.kind}.{name}": t.detach().contiguous() for name, t in self._tensors.items()}
        for name, moments in self._adam.moments.items():
            for key, value in moments.items():
                out[self._moments(name) + key] = value.detach().contiguous()
        return out

    @classmethod
    def from_state(cls: type[Own], state: Mapping[str, Tensor], rates: Mapping[str, float]) -> Own:
        """Create the object from the tensors and moments that ``state`` returned."""
        named = {tuple(key.split(".")): value for key, value in state.items()}
        loaded = cls({k[1]: value for k, value in named.items() if k[0] == cls.kind and len(k) == 2}, rates)
        for name in loaded._adam.rates:
            keys = {key: cls._moments(name) + key for key in MOMENTS}
            moments = {key: state[full].clone() for key, full in keys.items() if full in state}
            if moments:
                loaded._adam.moments[name] = moments
        return loaded

    @staticmethod
    def _moments(name: str) -> str:
        """Return the prefix of the names of a tensor's moments."""
        return f"adam.{name}."


class Gaussians(Trained):
    """Named per-Gaussian tensors with their Adam moments.

    Args:
        tensors: the tensors in ``CORE_SHAPES`` and any others, all with the same first axis.
        rates: learning rate by name; tensors without a rate are not trained.
    """

    kind = "gaussians"

    def __init__(self, tensors: Mapping[str, Tensor], rates: Mapping[str, float]) -> None:
        super().__init__(tensors, rates)
        self._nonzero: dict[str, bool] = {}
        self._check()

    def _check(self) -> None:
        counts = {name: t.shape[0] for name, t in self._tensors.items()}
        if len(set(counts.values())) > 1:
            raise PolarguideError(
                "Gaussians",
                expected="the same number in every tensor",
                found=str(counts),
                remedy="Use one entry per Gaussian in every tensor.",
            )

    def __len__(self) -> int:
        return self._tensors["means"].shape[0]

    def __getitem__(self, name: str) -> Tensor:
        return self._tensors[name]

    def get(self, name: str) -> Tensor | None:
        """Return a tensor, or None for an unknown name."""
        return self._tensors.get(name)

    def any_nonzero(self, name: str) -> bool:
        """Return True if an untrained tensor has a value other than 0; False without such a tensor.

        The device is read once between two changes of the tensor.
        """
        if name not in self._nonzero:
            self._nonzero[name] = any_nonzero(self._tensors, name)
        return self._nonzero[name]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all tensors."""
        return tuple(self._tensors)

    def only(self, mask: Tensor) -> dict[str, Tensor]:
        """Return all tensors, restricted to the Gaussians of a mask [N], detached."""
        return {name: t.detach()[mask] for name, t in self._tensors.items()}

    def snapshot(self) -> dict[str, Tensor]:
        """Return detached copies of all tensors."""
        return {name: t.detach().clone() for name, t in self._tensors.items()}

    @torch.no_grad()
    def overwrite(self, name: str, values: Tensor, rows: Tensor | None = None) -> None:
        """Replace a tensor's values and zero its moments, as 3DGS does at every reset.

        Args:
            name: name of the tensor.
            values: values of all Gaussians, even if ``rows`` selects only some.
            rows: [N] bool, True for Gaussians whose values are replaced and whose moments are zeroed. None means all.
        """
        self._nonzero.pop(name, None)
        tensor = self._tensors[name]
        chosen = slice(None) if rows is None else rows
        tensor[chosen] = values[chosen]

        def zeroed(moment: Tensor) -> Tensor:
            moment[chosen] = 0
            return moment

        self._adam.change(name, zeroed)

    def keep(self, index: Tensor) -> None:
        """Remove all Gaussians except the ones that ``index``, a mask or a tensor of indices, selects."""
        self._replace({name: t.detach()[index] for name, t in self._tensors.items()}, lambda m: m[index])

    def append(self, gaussians: Mapping[str, Tensor]) -> None:
        """Append Gaussians, given the values of all tensors. Their moments are zero."""
        joined = {name: torch.cat((t.detach(), gaussians[name])) for name, t in self._tensors.items()}
        count = gaussians["means"].shape[0]
        self._replace(joined, lambda m: torch.cat((m, m.new_zeros(count, *m.shape[1:]))))

    def _replace(self, tensors: Mapping[str, Tensor], follow: Callable[[Tensor], Tensor]) -> None:
        """Replace tensors, and apply ``follow`` to their moments, which must make the same edit."""
        self._nonzero.clear()
        for name, values in tensors.items():
            self._tensors[name] = values.contiguous().requires_grad_()
            self._adam.change(name, follow)
        self._check()


def any_nonzero(gaussians: Parameters, name: str) -> bool:
    """Return True if an untrained tensor has a value other than 0; False without such a tensor."""
    if isinstance(gaussians, Gaussians):
        return gaussians.any_nonzero(name)
    values = gaussians.get(name)
    return values is not None and not values.is_meta and bool(values.any())
