"""Checks of all tensors of a checkpoint before a computation reads them.

The kernels and the fused optimizer do not check shapes. They would read beyond the end of a tensor of a wrong shape. A
value that is not finite would lead to an empty picture.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.training.context import ANGLE_COLUMNS
from polarguide.training.recipe import Recipe

LARGEST_VALUE = 1e8
"""Largest absolute value of a parameter without a range of its own."""
RANGES = {"means": (-1e12, 1e12), "log_scales": (-1e4, 60.0)}
"""Allowed ranges of parameters by name."""
MOST_STEPS = 1 << 50
"""Largest number of steps."""


@dataclass(frozen=True)
class TensorRule:
    """Shape, type and range of a tensor; values must be finite."""

    shape: tuple[int, ...]
    low: float = -sys.float_info.max
    high: float = sys.float_info.max
    dtype: torch.dtype = torch.float32

    def check(self, name: str, values: Tensor) -> None:
        """Check a tensor.

        Raises:
            ValueError: it has another shape, type or range; the message names it.
        """
        if values.dtype != self.dtype or tuple(values.shape) != self.shape:
            actual = f"{list(values.shape)}, {values.dtype}"
            raise ValueError(f"{name} of shape {actual}, not {list(self.shape)}, {self.dtype}")
        if values.numel():
            low, high = (float(end) for end in values.aminmax())
            if not (low >= self.low and high <= self.high):  # false for NaN
                raise ValueError(f"{name} with values from {low:g} to {high:g}")


def check_tensors(tensors: Mapping[str, Tensor], rules: Mapping[str, TensorRule]) -> None:
    """Check that each tensor has a rule and satisfies it, and that no tensor is missing.

    Raises:
        ValueError: a tensor is missing, is unknown, or has a wrong shape, type or range; the message names it.
    """
    for name, rule in rules.items():
        rule.check(name, _tensor(tensors, name))
    unknown = sorted(tensors.keys() - rules.keys())
    if unknown:
        raise ValueError(f"unknown {unknown[0][:80]}")


def moment_rules(tensors: Mapping[str, Tensor], prefix: str, shape: tuple[int, ...]) -> dict[str, TensorRule]:
    """Return the rules for the moments of Adam of a tensor with this shape; empty if no moment is stored."""
    rules = {
        "step": TensorRule((), 0.0),
        "exp_avg": TensorRule(shape),
        "exp_avg_sq": TensorRule(shape, 0.0),
    }
    named = {prefix + key: rule for key, rule in rules.items()}
    return {} if tensors.keys().isdisjoint(named) else named


def refuse_foreign(tensors: Mapping[str, Tensor], recipe: Recipe) -> None:
    """Check that tensors belong to a training of the recipe.

    The recipe and its shading model determine the shapes. The copy of the Gaussians from which priors are computed may
    have a different number of Gaussians. Callbacks of the user check their own tensors.

    Raises:
        ValueError: a tensor is missing, is unknown, or has a wrong shape, type or range; the message names it.
    """
    count = _count(tensors, "gaussians.means")
    light = {name: parameter.shape for name, parameter in recipe.shading.light_parameters.items()}
    kinds = {
        "gaussians": {name: (count, *shape) for name, shape in recipe.shapes.items()},
        "environment": light,
    }
    if any(name.startswith("frozen.") for name in tensors):
        frozen = _count(tensors, "frozen.means")
        kinds["frozen"] = {name: (frozen, *shape) for name, shape in recipe.shapes.items()}
    sums = TensorRule((count,), 0.0)
    rules = {
        "statistics.gradient": sums,
        "statistics.seen": sums,
        "scalars": TensorRule((2,), 0, MOST_STEPS, torch.int64),
    }
    for kind, shapes in kinds.items():
        for name, shape in shapes.items():
            rules[f"{kind}.{name}"] = TensorRule(shape, *RANGES.get(name, (-LARGEST_VALUE, LARGEST_VALUE)))
    for name in recipe.learning_rates:
        rules |= moment_rules(tensors, f"adam.{name}.", kinds["gaussians"][name])
    for name, shape in light.items():
        prefix = "environment.adam." if name == "texels" else f"environment.adam.{name}."
        rules |= moment_rules(tensors, prefix, shape)
    if "footprints" in tensors:
        rules["footprints"] = TensorRule((count,), 0.0, RANGES["means"][1])
    if "angles" in tensors:
        fits, pictures = (tensors["angles"].shape + (0, 0))[:2]
        rules["angles"] = TensorRule((fits, pictures, ANGLE_COLUMNS), 0.0, dtype=torch.float64)
    check_tensors({n: t for n, t in tensors.items() if not n.startswith("callback.")}, rules)
    _check_lengths(tensors, (f"{kind}.quaternions" for kind in kinds if kind != "environment"))
    if "angles" in tensors and not (tensors["angles"][..., 1] > 0).all():
        raise ValueError("angles with gains that are not positive")


def _tensor(tensors: Mapping[str, Tensor], name: str) -> Tensor:
    if name not in tensors:
        raise ValueError(f"no {name}")
    return tensors[name]


def _count(tensors: Mapping[str, Tensor], name: str) -> int:
    means = _tensor(tensors, name)
    if means.ndim != 2 or not len(means):  # densification leaves at least one
        raise ValueError(f"{name} of shape {list(means.shape)}, not [N, 3] with N > 0")
    return len(means)


def _check_lengths(tensors: Mapping[str, Tensor], names: Iterable[str]) -> None:
    for name in names:
        if not bool(tensors[name].any(dim=-1).all()):
            raise ValueError(f"{name} with rotations of length zero")
