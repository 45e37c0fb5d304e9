"""Everything that training changes, and how it is put into a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import torch
from torch import Tensor

from polarguide.core.errors import PolarguideError
from polarguide.gaussians.densify import DensityStatistics
from polarguide.gaussians.gaussians import ORIENTED_SHAPES, Gaussians, Trained
from polarguide.gaussians.harmonics import SH_C0
from polarguide.gaussians.initialize import far_away, initial_parameters
from polarguide.optics.color import srgb_decode
from polarguide.shading.model import Parameter, ShadingModel
from polarguide.training.context import TrainingContext
from polarguide.training.recipe import Recipe

ANGLE_COLUMNS = 8
"""Values of a fitted polarizer angle, see ``angles.fit.FittedAngle``, and whether there was anything to fit."""


class Environment(Trained):
    """The learned light: named parameters with their own Adam state.

    Args:
        parameters: by name; a cubemap's raw texels are ``texels``.
        rates: learning rate of each.

    Raises:
        KeyError: a parameter without a rate.
    """

    kind = "environment"

    def __init__(self, parameters: Mapping[str, Tensor], rates: Mapping[str, float]) -> None:
        super().__init__(parameters, {name: rates[name] for name in parameters})

    @property
    def parameters(self) -> dict[str, Tensor]:
        """The parameters by name."""
        return self._tensors

    @staticmethod
    def _moments(name: str) -> str:
        """The texels' had the prefix to themselves in the first checkpoints."""
        return "environment.adam." if name == "texels" else f"environment.adam.{name}."


class SavedState(Protocol):
    """The state of a training as far as a checkpoint holds it.

    Attributes:
        step: number of finished steps.
    """

    step: int

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name."""


@dataclass
class TrainingState:
    """The complete state between two steps.

    Attributes:
        step: the next step, 0-based.
        gaussians: the Gaussians.
        environment: the learned light; None if the shading model has none.
        statistics: sums over steps from which the density control decides.
        frozen: copy of the Gaussians from which the present priors were computed; None before the first refresh.
        opacity_frozen_until: first step at which opacities train again after surface normals were propagated.
        angles: [F, P, ``ANGLE_COLUMNS``] float64, polarizers of P pictures in F successive fits, see
            ``angles.polarizers``; None before the first fit.
        footprints: [N] size of a training pixel at each Gaussian, see ``raster.magnification``; None before the end of
            the training.
        extra: tensors of further callbacks, named ``callback.NAME.KEY``.
    """

    step: int
    gaussians: Gaussians
    environment: Environment | None
    statistics: DensityStatistics
    frozen: dict[str, Tensor] | None = None
    opacity_frozen_until: int = 0
    angles: Tensor | None = None
    footprints: Tensor | None = None
    extra: dict[str, Tensor] = field(default_factory=dict)

    @property
    def light(self) -> dict[str, Tensor]:
        """The learned light's parameters by name; empty for a shading model without."""
        return self.environment.parameters if self.environment else {}

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name, for a checkpoint."""
        out = self.gaussians.state()
        if self.environment is not None:
            out.update(self.environment.state())
        out["statistics.gradient"] = self.statistics.gradient
        out["statistics.seen"] = self.statistics.seen
        if self.frozen is not None:
            out.update({f"frozen.{name}": t for name, t in self.frozen.items()})
        if self.angles is not None:
            out["angles"] = self.angles
        if self.footprints is not None:
            out["footprints"] = self.footprints
        out.update(self.extra)
        out["scalars"] = torch.tensor([self.step, self.opacity_frozen_until], dtype=torch.int64)
        return out

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor], recipe: Recipe) -> TrainingState:
        """The inverse of ``tensors``; what comes from a file is for ``refuse_foreign`` to check first."""
        gaussians = Gaussians.from_state(tensors, recipe.learning_rates)
        rates = recipe.light_rates
        environment = Environment.from_state(tensors, rates) if rates else None
        statistics = DensityStatistics.of(tensors["statistics.gradient"], tensors["statistics.seen"])
        frozen = {key[7:]: value for key, value in tensors.items() if key.startswith("frozen.")}
        step, frozen_until = (int(x) for x in tensors["scalars"])
        angles = tensors["angles"].cpu() if "angles" in tensors else None
        return cls(
            step,
            gaussians,
            environment,
            statistics,
            frozen or None,
            frozen_until,
            angles,
            tensors.get("footprints"),
            {name: values for name, values in tensors.items() if name.startswith("callback.")},
        )


def seeded(*numbers: int) -> torch.Generator:
    """A generator that depends on all the numbers: draws do not depend on what was drawn before."""
    value = 0
    for number in numbers:
        value = (value * 1_000_003 + number + 1) % (2**63 - 1)
    return torch.Generator().manual_seed(value)


def _check_first_values(
    shading: ShadingModel,
    declared: Mapping[str, Parameter],
    first: Mapping[str, Tensor],
    leading: tuple[int, ...],
) -> None:
    """Refuse first values of a shading model that differ from the parameters that it declares."""
    for name, parameter in declared.items():
        shape = (*leading, *parameter.shape)
        if name not in first or tuple(first[name].shape) != shape:
            raise PolarguideError(
                f"{type(shading).__name__}, {name}",
                expected=f"first values of the declared shape {list(shape)}",
                found=f"{list(first[name].shape)}" if name in first else "no values",
                remedy="Declare the parameter in that shape, or return such values.",
            )


def first_state(context: TrainingContext) -> TrainingState:
    """The state before the first step; drawn on the CPU, so that every device begins with the same.

    Far Gaussians are added unless nothing is behind the subject.
    """
    scene = context.scene
    recipe = context.recipe
    settings = context.settings
    device = context.backend.device
    initialization = replace(recipe.initialization, shell=0) if context.black else recipe.initialization
    colors = srgb_decode(scene.point_colors.float() / 255)
    centers = context.centers
    tensors = initial_parameters(scene.points, colors, centers, initialization, seed=settings.seed)
    count = tensors["means"].shape[0]
    if recipe.oriented:
        tensors |= {name: torch.zeros(count, *shape) for name, shape in ORIENTED_SHAPES.items()}
    generator = seeded(settings.seed, recipe.shading.stream)
    far = far_away(tensors["means"], scene.points, centers)
    own, first_light = recipe.shading.initialize(tensors["sh_dc"] * SH_C0 + 0.5, far, generator)
    tensors |= own
    light = {name: t.to(device) for name, t in first_light.items()}
    for declared, first, leading in (
        (recipe.shading.parameters, tensors, (count,)),
        (recipe.shading.light_parameters, light, ()),
    ):
        _check_first_values(recipe.shading, declared, first, leading)
    environment = Environment(light, recipe.light_rates) if light else None
    gaussians = Gaussians({name: t.to(device) for name, t in tensors.items()}, recipe.learning_rates)
    statistics = DensityStatistics(count, settings.views_per_step, gaussians["means"].device)
    return TrainingState(0, gaussians, environment, statistics)
