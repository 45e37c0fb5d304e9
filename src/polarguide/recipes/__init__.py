"""Recipes by name: the methods that ``train`` offers, and their controls without polarization."""

import sys
from types import ModuleType

from polarguide.recipes.registry import RECIPES, RecipeTable, recipe_named, recipes

__all__ = ["RECIPES", "recipe_named"]


class _RecipesModule(ModuleType):
    """Module that can be called: ``polarguide.recipes()`` returns all recipes.

    The import system binds the name ``recipes`` of the package to the module.
    """

    def __call__(self) -> RecipeTable:
        """Return all recipes by name; see ``polarguide.recipes.registry.recipes``."""
        return recipes()


sys.modules[__name__].__class__ = _RecipesModule
