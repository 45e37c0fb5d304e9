"""Recipes by name: the methods that ``train`` offers, and their ablations."""

from __future__ import annotations

from polarguide.errors import PolarguideError
from polarguide.recipes.ablations import ABLATIONS_3DGS_DR, ABLATIONS_POLARGUIDE, ABLATIONS_STOKES
from polarguide.recipes.baselines import RECIPE_3DGS, RECIPE_3DGS_DR
from polarguide.recipes.polarguide import RECIPE_POLARGUIDE, RECIPE_POLARGUIDE_PAPER, RECIPE_POLARGUIDE_STOKES
from polarguide.recipes.ref_gs import RECIPE_REF_GS
from polarguide.training.recipe import Recipe

RECIPES: dict[str, Recipe] = {
    recipe.name: recipe
    for recipe in (
        RECIPE_3DGS,
        RECIPE_3DGS_DR,
        RECIPE_REF_GS,
        RECIPE_POLARGUIDE_PAPER,
        RECIPE_POLARGUIDE,
        RECIPE_POLARGUIDE_STOKES,
    )
}
ABLATIONS: dict[str, tuple[Recipe, ...]] = {
    "3dgs-dr": ABLATIONS_3DGS_DR,
    "polarguide": ABLATIONS_POLARGUIDE,
    "polarguide-stokes": ABLATIONS_STOKES,
}
"""Variations of a recipe by its name, each with one thing changed, named ``recipe:variation``."""


def recipe_named(name: str) -> Recipe:
    """A recipe or a variation by name.

    Raises:
        PolarguideError: there is none of that name.
    """
    base = name.partition(":")[0]
    known = {**RECIPES, **{recipe.name: recipe for recipe in ABLATIONS.get(base, ())}}
    if name not in known:
        raise PolarguideError(
            "recipe",
            expected="one of " + ", ".join(known),
            found=name,
            remedy="Take one of these; a recipe of another version needs that version.",
        )
    return known[name]


__all__ = ["ABLATIONS", "RECIPES", "recipe_named"]
