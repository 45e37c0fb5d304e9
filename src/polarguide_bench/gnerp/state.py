"""All that a training of a field changes, and how it is put into a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.gaussians.gaussians import Adam
from polarguide.geometry.camera import Camera
from polarguide.training.checked import MOST_STEPS, TensorRule, check_tensors, moment_rules
from polarguide.training.state import seeded
from polarguide_bench.gnerp.field import Field, GridField, NetworkField, Region
from polarguide_bench.gnerp.recipe import NeuralRecipe

KINDS: dict[str, type[Field]] = {"grids": GridField, "networks": NetworkField}
# Of Adam. Nodes that few rays see move as far as others, and are not thrown by the one ray that finds them after a
# thousand steps, as a longer memory of the squares would have it.
BETAS = (0.9, 0.99)
EPSILON = 1e-15


@dataclass
class FieldState:
    """The complete state between two steps.

    Attributes:
        step: the next step, 0-based. field: what is learned. optimizer: Adam, whose rates each step sets.
    """

    step: int
    field: Field
    optimizer: Adam

    @classmethod
    def first(
        cls, recipe: NeuralRecipe, cameras: Sequence[Camera], seed: int, device: torch.device | str = "cpu"
    ) -> FieldState:
        """The state before the first step; drawn on the CPU, so that every device begins with the same."""
        return cls.around(0, recipe, Region.around(cameras), seed, device)

    @classmethod
    def around(
        cls, step: int, recipe: NeuralRecipe, region: Region, seed: int, device: torch.device | str
    ) -> FieldState:
        """A field with its first values in a region."""
        field = KINDS[recipe.shape.kind](region, recipe.shape, seeded(seed, 8)).to(device)
        rates = {name: 0.0 for name, _ in field.named_parameters()}
        return cls(step, field, Adam(rates, betas=BETAS, epsilon=EPSILON))

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name, for a checkpoint."""
        region = self.field.region
        out = {f"field.{name}": values.detach() for name, values in self.field.state_dict().items()}
        out["region"] = torch.tensor([*region.center, region.unit, region.radius], dtype=torch.float64)
        out["scalars"] = torch.tensor([self.step], dtype=torch.int64)
        for name, moments in self.optimizer.moments.items():
            for key, moment in moments.items():
                out[f"adam.{name}.{key}"] = moment
        return out

    @classmethod
    def from_tensors(
        cls, tensors: Mapping[str, Tensor], recipe: NeuralRecipe, device: torch.device | str
    ) -> FieldState:
        """The inverse of ``tensors``; everything is checked, as it comes from a file.

        Raises:
            ValueError: something is missing, not known, or has another shape, type or range; the message names it.
        """
        rules = {
            "scalars": TensorRule((1,), 0, MOST_STEPS, torch.int64),
            "region": TensorRule((5,), dtype=torch.float64),
        }
        for name, rule in rules.items():
            check_tensors({name: tensors[name]} if name in tensors else {}, {name: rule})
        state = cls.around(int(tensors["scalars"]), recipe, _region(tensors["region"]), 0, device)
        for name, values in state.field.state_dict().items():
            rules[f"field.{name}"] = TensorRule(tuple(values.shape), dtype=values.dtype)
        moments = {}
        for name, values in state.field.named_parameters():
            own = moment_rules(tensors, f"adam.{name}.", tuple(values.shape))
            rules |= own
            if own:
                moments[name] = own
        check_tensors(tensors, rules)
        fields = {k.removeprefix("field."): t for k, t in tensors.items() if k.startswith("field.")}
        state.field.load_state_dict(fields)
        for name, own in moments.items():
            state.optimizer.moments[name] = {k.rpartition(".")[2]: tensors[k].to(device) for k in own}
        return state


def _region(values: Tensor) -> Region:
    x, y, z, unit, radius = values.tolist()
    if not (0 < unit < 1e12 and 1 <= radius < 1e6):
        raise ValueError(f"region {values.tolist()}")
    return Region((x, y, z), unit, radius)
