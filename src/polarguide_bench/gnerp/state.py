"""State of a field's training, and its tensors in a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.gaussians.gaussians import Adam
from polarguide.geometry.camera import Camera
from polarguide.training.checkpoint_checks import MOST_STEPS, TensorRule, check_tensors, moment_rules
from polarguide.training.context import seeded
from polarguide_bench.gnerp.field import Field, Region
from polarguide_bench.gnerp.recipe import NeuralRecipe

BETAS = (0.9, 0.99)
EPSILON = 1e-15


@dataclass
class FieldState:
    """Complete state of a training between two steps.

    Attributes:
        step: index of the next step, 0-based.
        field: the field.
        optimizer: the optimizer Adam, whose learning rates each step sets.
    """

    step: int
    field: Field
    optimizer: Adam

    @classmethod
    def first(
        cls, recipe: NeuralRecipe, cameras: Sequence[Camera], seed: int, device: torch.device | str = "cpu"
    ) -> FieldState:
        """Create the initial state. Random values are drawn on the CPU, so they do not depend on the device."""
        return cls.around(0, recipe, Region.around(cameras), seed, device)

    @classmethod
    def around(
        cls, step: int, recipe: NeuralRecipe, region: Region, seed: int, device: torch.device | str
    ) -> FieldState:
        """Create a state with the initial values of a field in a region."""
        field = Field(region, recipe.shape, seeded(seed, 8)).to(device)
        rates = {name: 0.0 for name, _ in field.named_parameters()}
        return cls(step, field, Adam(rates, betas=BETAS, epsilon=EPSILON))

    def tensors(self) -> dict[str, Tensor]:
        """Return all tensors by name, for a checkpoint."""
        region = self.field.region
        return {
            **{f"field.{name}": values.detach() for name, values in self.field.state_dict().items()},
            "region": torch.tensor([*region.center, region.unit, region.radius], dtype=torch.float64),
            "scalars": torch.tensor([self.step], dtype=torch.int64),
            **{
                f"adam.{name}.{key}": moment
                for name, moments in self.optimizer.moments.items()
                for key, moment in moments.items()
            },
        }

    @classmethod
    def from_tensors(
        cls, tensors: Mapping[str, Tensor], recipe: NeuralRecipe, device: torch.device | str
    ) -> FieldState:
        """Create a state from the result of ``tensors``, and validate all values, because they come from a file.

        Raises:
            ValueError: a tensor is missing or unknown, or has an invalid shape, type or value. The message names the
                tensor.
        """
        rules = {
            "scalars": TensorRule((1,), 0, MOST_STEPS, torch.int64),
            "region": TensorRule((5,), dtype=torch.float64),
        }
        check_tensors({name: tensors[name] for name in rules if name in tensors}, rules)
        state = cls.around(int(tensors["scalars"]), recipe, _region(tensors["region"]), 0, device)
        for name, values in state.field.state_dict().items():
            rules[f"field.{name}"] = TensorRule(tuple(values.shape), dtype=values.dtype)
        moments = {
            name: moment_rules(tensors, f"adam.{name}.", tuple(values.shape))
            for name, values in state.field.named_parameters()
        }
        for own in moments.values():
            rules |= own
        check_tensors(tensors, rules)
        fields = {k.removeprefix("field."): t for k, t in tensors.items() if k.startswith("field.")}
        state.field.load_state_dict(fields)
        for name, own in moments.items():
            if own:
                state.optimizer.moments[name] = {k.rpartition(".")[2]: tensors[k].to(device) for k in own}
        return state


def _region(values: Tensor) -> Region:
    x, y, z, unit, radius = values.tolist()
    if not (0 < unit < 1e12 and 1 <= radius < 1e6):
        raise ValueError(f"region {values.tolist()}")
    return Region((x, y, z), unit, radius)
