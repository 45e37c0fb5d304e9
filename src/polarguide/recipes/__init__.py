"""Recipes by name. Data only."""

from polarguide.recipes.baselines import RECIPE_3DGS, RECIPE_3DGS_DR
from polarguide.recipes.polarguide import RECIPE_POLARGUIDE, RECIPE_POLARGUIDE_PAPER
from polarguide.training.stages import Recipe

RECIPES: dict[str, Recipe] = {
    recipe.name: recipe
    for recipe in (RECIPE_3DGS, RECIPE_3DGS_DR, RECIPE_POLARGUIDE, RECIPE_POLARGUIDE_PAPER)
}

__all__ = ["RECIPES"]
