"""All that a training of a field changes, and how it is put into a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.gaussians.adam import MOMENTS, Adam
from polarguide.geometry.camera import Camera
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
        step = _step(_tensor_of(tensors, "scalars"))
        region = _region(_tensor_of(tensors, "region"))
        state = cls.around(step, recipe, region, 0, device)
        own = {f"field.{name}": values for name, values in state.field.state_dict().items()}
        loaded = {name: _like(values, _tensor_of(tensors, name), name) for name, values in own.items()}
        state.field.load_state_dict({name.removeprefix("field."): t for name, t in loaded.items()})
        names_known = {"scalars", "region", *own}
        for name, values in state.field.named_parameters():
            names = {key: f"adam.{name}.{key}" for key in MOMENTS}
            names_known |= set(names.values())
            if not tensors.keys().isdisjoint(names.values()):
                state.optimizer.moments[name] = {
                    key: _like(values if key != "step" else torch.zeros(()), _tensor_of(tensors, full), full)
                    for key, full in names.items()
                }
        strangers = sorted(tensors.keys() - names_known)
        if strangers:
            raise ValueError(f"{strangers[0][:80]}, which is not known")
        return state


def _tensor_of(tensors: Mapping[str, Tensor], name: str) -> Tensor:
    if name not in tensors:
        raise ValueError(f"no {name}")
    return tensors[name]


def _like(own: Tensor, values: Tensor, name: str) -> Tensor:
    """The values, checked to be finite and of the shape and type that the recipe has."""
    if values.shape != own.shape or values.dtype != own.dtype:
        expected = f"{list(own.shape)}, {own.dtype}"
        raise ValueError(f"{name} of shape {list(values.shape)}, {values.dtype}, not {expected}")
    if not bool(torch.isfinite(values).all()):
        raise ValueError(f"{name} with values that are not finite")
    return values.to(own.device)


def _step(scalars: Tensor) -> int:
    if scalars.dtype != torch.int64 or scalars.shape != (1,) or not 0 <= int(scalars[0]) <= 1 << 50:
        raise ValueError(f"scalars {scalars.tolist()}")
    return int(scalars[0])


def _region(values: Tensor) -> Region:
    if values.dtype != torch.float64 or values.shape != (5,) or not bool(torch.isfinite(values).all()):
        raise ValueError(f"region {values.tolist()}")
    x, y, z, unit, radius = values.tolist()
    if not (0 < unit < 1e12 and 1 <= radius < 1e6):
        raise ValueError(f"region {values.tolist()}")
    return Region((x, y, z), unit, radius)
