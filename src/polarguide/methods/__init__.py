"""Recipes by name: the methods that ``train`` offers, and their controls without polarization."""

from polarguide.methods.registry import RECIPES, recipe_named

__all__ = ["RECIPES", "recipe_named"]
