"""Context of a training, which stays the same in all steps, and its state, with its tensors in a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polarguide.capture import Scene, View
from polarguide.core.errors import PolarguideError
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.system import UNBOUNDED, MemoryBound
from polarguide.gaussians.gaussians import ORIENTED_SHAPES, Gaussians, Trained
from polarguide.gaussians.harmonics import SH_C0
from polarguide.gaussians.initialize import camera_reach, far_away, initial_parameters, scene_extent
from polarguide.optics.color import srgb_decode
from polarguide.raster import Backend
from polarguide.shading.model import Parameter, ShadingModel
from polarguide.training.recipe import Recipe
from polarguide.training.settings import ResolvedSettings
from polarguide.training.storage import ViewStore


@dataclass(frozen=True, eq=False)
class TrainingContext:
    """Inputs and services that a training uses in all its steps.

    Attributes:
        scene: the capture.
        recipe: the method.
        settings: the user's settings.
        backend: device and rasterizer.
        store: cache of computed targets of the views.
        memory: object that returns freed memory to the system.
        reporter: object that receives messages for the user.
    """

    scene: Scene
    recipe: Recipe
    settings: ResolvedSettings
    backend: Backend
    store: ViewStore = field(default_factory=ViewStore)
    memory: MemoryBound = UNBOUNDED
    reporter: Reporter = SILENT

    @cached_property
    def views(self) -> Sequence[View]:
        """The training views."""
        return self.scene.train_views

    @cached_property
    def centers(self) -> Tensor:
        """Camera centers of the training views, [V, 3]."""
        return torch.stack([view.camera.center for view in self.views])

    @cached_property
    def extent(self) -> float:
        """Extent of the scene, the unit of distances."""
        return scene_extent(self.centers)

    @cached_property
    def reach(self) -> float:
        """Distance from the middle of the points that nine tenths of the cameras do not exceed."""
        return self._region[1]

    @cached_property
    def middle(self) -> Tensor:
        """Median of the points on the device of the backend, [3] float32."""
        return torch.from_numpy(self._region[0]).float().to(self.backend.device)

    @cached_property
    def _region(self) -> tuple[NDArray[np.float64], float]:
        return camera_reach(self.scene.points.double().numpy(), self.centers.double().numpy())

    @cached_property
    def shading(self) -> ShadingModel:
        """Shading model of the recipe with the refractive index of the settings."""
        return replace(self.recipe.shading, refractive_index=self.settings.refractive_index)

    @property
    def black(self) -> bool:
        """True if the subject has no background."""
        return self.settings.background != "scene"


HOLDERS = ("callback.", "frozen.", "statistics.")
"""Prefixes of the names of tensors that callbacks hold."""
ANGLE_COLUMNS = 8
"""Number of stored values for a fitted polarizer angle.

These are the values of ``angles.polarizers.FittedAngle``, and a flag that is 1 for a successful fit.
"""


class Environment(Trained):
    """The learned light: named parameters with their own Adam state.

    Args:
        parameters: tensors by name; ``texels`` are the raw texels of a cubemap.
        rates: learning rate of each parameter.

    Raises:
        KeyError: a parameter has no rate.
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
        """Return the prefix for the moments of a tensor. The prefix for ``texels`` is that of the first version."""
        return "environment.adam." if name == "texels" else f"environment.adam.{name}."


class SavedState(Protocol):
    """State of a training as a checkpoint holds it.

    Attributes:
        step: number of finished steps.
    """

    step: int

    def tensors(self) -> dict[str, Tensor]:
        """Return all tensors by name."""


class StateHolder(Protocol):
    """Holder of tensors that a resumed training needs, such as a callback.

    Attributes:
        prefix: prefix of their names in a checkpoint.
    """

    @property
    def prefix(self) -> str: ...

    def state_dict(self) -> dict[str, Tensor]:
        """Return the tensors by name, without the prefix."""

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore the tensors that ``state_dict`` returned."""


@dataclass
class TrainingState:
    """The complete state between two steps.

    Attributes:
        step: the next step, 0-based.
        gaussians: the Gaussians.
        environment: the learned light; None if the shading model has none.
        opacity_frozen_until: first step at which opacities are trained again after a propagation of normals.
        angles: [F, P, ``ANGLE_COLUMNS``] float64, fitted angles of P pictures in F successive fits, see
            ``angles.polarizers``. None before the first fit.
        footprints: [N] size of a training pixel at each Gaussian, see ``raster.magnification``. None before the end of
            the training.
        extra: tensors of holders that are not attached, by their names in a checkpoint.
        holders: attached holders by prefix.
    """

    step: int
    gaussians: Gaussians
    environment: Environment | None
    opacity_frozen_until: int = 0
    angles: Tensor | None = None
    footprints: Tensor | None = None
    extra: dict[str, Tensor] = field(default_factory=dict)
    holders: dict[str, StateHolder] = field(default_factory=dict)

    @property
    def light(self) -> dict[str, Tensor]:
        """Parameters of the learned light by name; empty for a shading model without light."""
        return self.environment.parameters if self.environment else {}

    @property
    def optimized(self) -> list[Trained]:
        """All optimized parameters: the Gaussians and the learned light."""
        return [self.gaussians, *([self.environment] if self.environment else [])]

    def attach(self, holder: StateHolder) -> None:
        """Let a holder take over its tensors."""
        prefix = holder.prefix
        own = {name: values for name, values in self._held().items() if name.startswith(prefix)}
        if own:
            holder.load_state_dict({name.removeprefix(prefix): values for name, values in own.items()})
        self.extra = {name: values for name, values in self.extra.items() if name not in own}
        self.holders[prefix] = holder

    def further_callbacks(self) -> set[str]:
        """Return the names of callbacks of the user that have tensors in a checkpoint."""
        return {name.split(".")[1] for name in self._held() if name.startswith("callback.")}

    def _held(self) -> dict[str, Tensor]:
        """Return the tensors of all holders by their names in a checkpoint."""
        attached = {
            f"{prefix}{key}": values
            for prefix, holder in self.holders.items()
            for key, values in holder.state_dict().items()
        }
        return self.extra | attached

    def tensors(self) -> dict[str, Tensor]:
        """Return all tensors by name, for a checkpoint."""
        own = {"angles": self.angles, "footprints": self.footprints}
        state = {name: values for trained in self.optimized for name, values in trained.state().items()}
        state |= {name: values for name, values in own.items() if values is not None}
        scalars = torch.tensor([self.step, self.opacity_frozen_until], dtype=torch.int64)
        return {**state, **self._held(), "scalars": scalars}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor], recipe: Recipe) -> TrainingState:
        """Create a state from tensors; tensors of a file must pass ``refuse_foreign`` first."""
        rates = recipe.light_rates
        step, frozen_until = (int(value) for value in tensors["scalars"])
        return cls(
            step,
            Gaussians.from_state(tensors, recipe.learning_rates),
            Environment.from_state(tensors, rates) if rates else None,
            frozen_until,
            tensors["angles"].cpu() if "angles" in tensors else None,
            tensors.get("footprints"),
            {name: values for name, values in tensors.items() if name.startswith(HOLDERS)},
        )


def seeded(*numbers: int) -> torch.Generator:
    """Return a random generator whose seed combines all the numbers; its values do not depend on other generators."""
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
    """Check first values of a shading model against the shapes of its declared parameters.

    Raises:
        PolarguideError: values are missing or have another shape.
    """
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
    """Return the state before the first step, without the tensors of callbacks.

    Random values are drawn on the CPU, so that they are the same on every device. Distant Gaussians are added unless
    the subject has no background.

    Raises:
        PolarguideError: first values of the shading model differ from its declared parameters.
    """
    scene = context.scene
    recipe = context.recipe
    seed = context.settings.seed
    device = context.backend.device
    initialization = recipe.initialization
    if context.black:
        initialization = replace(initialization, shell=0)
    if not all(view.is_determined for view in context.views):
        initialization = replace(initialization, shell_radii=initialization.near_radii)
    colors = srgb_decode(scene.point_colors.float() / 255)
    centers = context.centers
    tensors = initial_parameters(scene.points, colors, centers, initialization, seed=seed)
    count = tensors["means"].shape[0]
    if recipe.oriented:
        tensors |= {name: torch.zeros(count, *shape) for name, shape in ORIENTED_SHAPES.items()}
    generator = seeded(seed, recipe.shading.stream)
    far = far_away(tensors["means"], scene.points, centers)
    own, first_light = recipe.shading.initialize(tensors["sh_dc"] * SH_C0 + 0.5, far, generator)
    tensors |= own
    light = {name: t.to(device) for name, t in first_light.items()}
    _check_first_values(recipe.shading, recipe.shading.parameters, tensors, (count,))
    _check_first_values(recipe.shading, recipe.shading.light_parameters, light, ())
    environment = Environment(light, recipe.light_rates) if light else None
    gaussians = Gaussians({name: t.to(device) for name, t in tensors.items()}, recipe.learning_rates)
    return TrainingState(0, gaussians, environment)
