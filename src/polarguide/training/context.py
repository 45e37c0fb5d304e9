"""Context of a training: inputs and services that stay the same in all steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polarguide.capture import Scene, View
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.system import UNBOUNDED, MemoryBound
from polarguide.gaussians.initialize import camera_reach, scene_extent
from polarguide.raster import Backend
from polarguide.shading.model import ShadingModel
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
