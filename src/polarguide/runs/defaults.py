"""Settings of a training that follow from the size of its capture, where nobody gave them."""

from __future__ import annotations

import math
from dataclasses import replace

from polarguide.capture import Scene
from polarguide.training.recipe import Recipe
from polarguide.training.settings import TrainSettings

INDEX = 1.5
STEPS = 5000
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


def with_index(settings: TrainSettings, scene: Scene, resumed: TrainSettings | None = None) -> TrainSettings:
    """The settings with a refractive index, where it is 0: of the run that is gone on with, or what the scene says."""
    if settings.refractive_index:
        return settings
    if resumed is not None:
        return replace(settings, refractive_index=resumed.refractive_index)
    return replace(settings, refractive_index=scene.refractive_index or INDEX)


def with_defaults(
    settings: TrainSettings, scene: Scene, recipe: Recipe, resumed: TrainSettings | None = None
) -> TrainSettings:
    """The settings with steps and the most Gaussians filled in, where they are 0.

    Args:
        settings: as asked for. scene, recipe: of the training. resumed: settings of the run that is gone on with.
    """
    sizes = [view.camera.width * view.camera.height for view in scene.train_views]
    steps, gaussians = settings.steps, settings.gaussians
    if resumed is not None:
        return replace(settings, steps=steps or resumed.steps, gaussians=gaussians or resumed.gaussians)
    if not steps:
        steps = max(STEPS, 500 * math.ceil(VISITS * len(sizes) / 500)) * (2 if max(sizes) > LARGE else 1)
    return replace(settings, steps=steps, gaussians=gaussians or most_gaussians(sum(sizes), recipe))
