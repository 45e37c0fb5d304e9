"""What the user says of materials and a training makes no use of."""

from __future__ import annotations

from collections.abc import Callable

from polarguide.capture import Scene
from polarguide.raster import Backend
from polarguide.system import UNBOUNDED
from polarguide.training.distributed import ALONE
from polarguide.training.indices import numbers_in
from polarguide.training.metals.search import MetalSearch
from polarguide.training.recipe import Recipe
from polarguide.training.schedule import Schedule
from polarguide.training.settings import ResolvedSettings


def warn_of_unused_materials(
    scene: Scene, recipe: Recipe, settings: ResolvedSettings, backend: Backend, warn: Callable[[str], None]
) -> None:
    """Warn if ``materials/``, or refractive indices of single materials, have no effect on a training."""
    steps, shading = settings.steps, recipe.shading.bind(settings.refractive_index)
    schedule = Schedule(recipe, steps)
    refreshes = [step / steps for step in range(steps) if "refresh_priors" in schedule.at(step).actions]
    MetalSearch(scene, recipe, settings, shading, backend, ALONE, warn, UNBOUNDED).warn_if_never(refreshes)
    if not scene.indices:
        return
    if not (shading.knows_indices and refreshes):
        why = f"the recipe {recipe.name} takes the run's for everything"
    elif not any(numbers_in(view) & scene.indices.keys() for view in scene.train_views):
        why = "no picture in materials/ of a training view has one of their numbers"
    else:
        return
    warn(f"the refractive indices that scene.json lists under materials are not used: {why}.")
