"""Resolves what nobody specified of a training's settings: from the run to resume, the scene, or its size."""

from __future__ import annotations

import math
from typing import Any

from polarguide.capture import Scene
from polarguide.errors import PolarguideError
from polarguide.neural.recipe import NeuralRecipe
from polarguide.training.recipe import Method, Recipe
from polarguide.training.settings import STEPS, ResolvedSettings, TrainSettings, index_of

VISITS = 60
"""Least number of times that each training view is looked at."""
LARGE = 1_000_000
"""Pixels of a view from which on twice the steps are taken: finer detail takes more rounds of the density control."""
MOST_GAUSSIANS = 400_000
"""Whatever the pixels, so that a large capture fits into a usual memory; trained scenes of 256 x 192 have 150,000. What
more of them would give at full size was not studied.
"""


def most_gaussians(pixels: int, recipe: Recipe) -> int:
    """How many Gaussians there may be for so many pixels of all views."""
    return min(int(pixels / recipe.densification.pixels_each), MOST_GAUSSIANS)


def resolve(
    settings: TrainSettings,
    scene: Scene,
    method: Method,
    resumed: ResolvedSettings | None = None,
    *,
    processes: int = 1,
) -> ResolvedSettings:
    """The settings of a training, with nothing left open.

    Args:
        settings: as asked for. scene, method: of the training.
        resumed: settings of the run that is resumed, whose values come before those of the scene and its size.
        processes: how many share the views of a step.

    Raises:
        PolarguideError: a setting that means nothing for this method.
    """
    taken: dict[str, Any] = {
        **_by_size(scene, method),
        "refractive_index": index_of(None, scene.refractive_index),
        "views_per_step": processes,
    }
    if resumed is not None:  # where it was open, the run recorded 0
        taken |= {name: value for name in taken if (value := getattr(resumed, name))}
    taken |= {name: value for name, value in vars(settings).items() if value is not None}
    found = ResolvedSettings(**taken)
    if isinstance(method, NeuralRecipe):
        _refuse_for_field(found, method)
    return found


def _by_size(scene: Scene, method: Method) -> dict[str, int]:
    """Steps, and the most Gaussians."""
    if isinstance(method, NeuralRecipe):
        return {"steps": method.steps, "gaussians": 0}
    assert isinstance(method, Recipe)
    sizes = [view.camera.width * view.camera.height for view in scene.train_views]
    steps = max(STEPS, 500 * math.ceil(VISITS * len(sizes) / 500)) * (2 if max(sizes) > LARGE else 1)
    return {"steps": steps, "gaussians": most_gaussians(sum(sizes), method)}


def _refuse_for_field(settings: ResolvedSettings, method: NeuralRecipe) -> None:
    for name, found, most in (
        ("gaussians", settings.gaussians, 0),
        ("views_per_step", settings.views_per_step, 1),
    ):
        if found > most:
            raise PolarguideError(
                name,
                expected=f"{most} with the recipe {method.name}, a field",
                found=str(found),
                remedy="Leave it out.",
            )
