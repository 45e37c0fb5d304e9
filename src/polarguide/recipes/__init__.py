"""Recipes by name: the methods that ``train`` offers, and their ablations."""

from polarguide.recipes.registry import ABLATIONS, RECIPES, ablations_of, recipe_named

__all__ = ["ABLATIONS", "RECIPES", "ablations_of", "recipe_named"]
