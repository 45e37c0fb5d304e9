"""Resolves open settings of a training from the run to resume, the scene, or its size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from polarguide.capture import Scene
from polarguide.capture.variants import has_black_background
from polarguide.core.errors import PolarguideError
from polarguide.core.options import index_of
from polarguide.fields.recipe import NeuralRecipe
from polarguide.training.recipe import Method, Recipe
from polarguide.training.settings import STEPS, Background, ResolvedSettings, TrainSettings

OPEN = ("steps", "refractive_index", "views_per_step", "background")
"""Settings that may be left open, beside the number of Gaussians, which bounds memory before the pictures are read."""
VISITS = 60
"""Least number of times that each training view is looked at."""
LARGE = 1_000_000
"""Pixels of a view from which on twice the steps are taken: finer detail takes more rounds of the density control."""
MOST_GAUSSIANS = 400_000
"""Whatever the pixels, so that a large capture fits into a usual memory; trained scenes of 256 x 192 have 150,000. What
more of them would give at full size was not studied.
"""


def most_gaussians(
    pixels: int, method: Method, settings: TrainSettings, resumed: ResolvedSettings | None = None
) -> int:
    """How many Gaussians there may be for so many pixels of all views; 0 of a field, which has none.

    Args:
        pixels: of the training views. asked, resumed: as for ``resolve``.
    """
    if isinstance(method, NeuralRecipe):
        return 0
    assert isinstance(method, Recipe)
    recorded = {} if resumed is None else _recorded(resumed)
    by_size = min(int(pixels / method.densification.pixels_each), MOST_GAUSSIANS)
    return recorded.get("gaussians", by_size) if settings.gaussians is None else settings.gaussians


def compared_steps(*specified: int | None) -> int:
    """Steps of a run of a comparison: the first number that was specified, else ``STEPS``.

    They do not follow from the size of the pictures: scenes are compared.
    """
    return next((steps for steps in specified if steps is not None), STEPS)


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
        settings: as specified. scene, method: of the training.
        resumed: settings of the run that is resumed, whose values come before those of the scene and its size.
        processes: how many share the views of a step.

    Raises:
        PolarguideError: a setting that means nothing for this method.
    """
    recorded = {} if resumed is None else _recorded(resumed)
    sizes = [view.camera.width * view.camera.height for view in scene.train_views]
    values: dict[str, Any] = {
        **vars(settings),
        "steps": _steps(sizes, method),
        "refractive_index": index_of(None, scene.refractive_index),
        "views_per_step": processes,
        **{name: recorded[name] for name in OPEN if name in recorded},
        "gaussians": most_gaussians(sum(sizes), method, settings, resumed),
        **settings.specified(),
    }
    if values["background"] == "auto":
        values["background"] = _background(scene, method)
    resolved = ResolvedSettings(**values)
    if isinstance(method, NeuralRecipe):
        _refuse_for_field(resolved, method)
    return resolved


def _recorded(resumed: ResolvedSettings) -> dict[str, Any]:
    """Settings that a run recorded; the first versions recorded 0 and "auto" for open ones."""
    return {name: value for name, value in resumed.specified().items() if value != 0}


def _steps(sizes: Sequence[int], method: Method) -> int:
    if isinstance(method, NeuralRecipe):
        return method.steps
    return max(STEPS, 500 * math.ceil(VISITS * len(sizes) / 500)) * (2 if max(sizes) > LARGE else 1)


def _background(scene: Scene, method: Method) -> Background:
    """The background behind the subject, by the edges of the pictures; fields ignore it."""
    if isinstance(method, NeuralRecipe):
        return "scene"
    return "black" if has_black_background(scene.train_views) else "scene"


def _refuse_for_field(settings: ResolvedSettings, method: NeuralRecipe) -> None:
    for name, value, most in (
        ("gaussians", settings.gaussians, 0),
        ("views_per_step", settings.views_per_step, 1),
    ):
        if value > most:
            raise PolarguideError(
                name,
                expected=f"{most} with the recipe {method.name}, a field",
                found=str(value),
                remedy="Leave it out.",
            )
