"""Neural recipes so small that a test can train them."""

from dataclasses import replace

from polarguide_bench.gnerp.recipe import FieldShape, NeuralRecipe, Sampling
from polarguide_bench.recipes import RECIPE_GNERP

SMALL_SHAPE = FieldShape(resolutions=(8, 16), channels=2, width=16, background=(8,))
SMALL_SAMPLING = Sampling(rays=48, coarse=12, fine=8, background=4, neighbors=2)


def small(recipe: NeuralRecipe = RECIPE_GNERP, **weights: float) -> NeuralRecipe:
    """Return a recipe with small grids and few rays, and some changed weights."""
    return replace(
        recipe,
        name="gnerp-small",
        shape=SMALL_SHAPE,
        sampling=SMALL_SAMPLING,
        weights=replace(recipe.weights, **weights),
    )
