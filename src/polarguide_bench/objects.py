"""Recipes and metrics that a user passes to a comparison as objects, for the processes that train and score."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

import cloudpickle

from polarguide.core.definitions import definition_digest
from polarguide.core.errors import PolarguideError, require
from polarguide.methods import registry
from polarguide.results.evaluation import table
from polarguide.training.recipe import Recipe
from polarguide_bench.children import Definitions
from polarguide_bench.gnerp.recipe import NeuralRecipe
from polarguide_bench.recipes import AnyRecipe, recipe_named


def chosen_recipes(recipes: Sequence[str | AnyRecipe]) -> tuple[AnyRecipe, ...]:
    """Return recipes by name or object. A recipe with a new name is registered, so that its name is known afterwards.

    Raises:
        PolarguideError: a name is unknown or occurs twice, or a recipe has the name of another recipe.
    """
    chosen: dict[str, AnyRecipe] = {}
    for recipe in recipes:
        require(
            isinstance(recipe, str | Recipe | NeuralRecipe),
            "recipes",
            expected="names of recipes, or recipes",
            found=repr(recipe)[:100],
            remedy="polarguide.recipes() returns all recipes by name.",
        )
        if isinstance(recipe, Recipe) and recipe not in registry.recipes().values():
            registry.register_recipe(recipe)
        own = recipe_named(recipe if isinstance(recipe, str) else recipe.name)
        require(
            isinstance(recipe, str) or recipe == own,
            "recipes",
            expected=f"the registered recipe {own.name}",
            found="a recipe of this name with other values",
            remedy="Rename the recipe, and register it as an entry point of the group polarguide.recipes.",
        )
        require(
            own.name not in chosen,
            "recipes",
            expected="no name more than once",
            found=f"{own.name} twice",
            remedy="List each name once.",
        )
        chosen[own.name] = own
    require(chosen, "compare", expected="a recipe", found="none", remedy="Name at least one recipe.")
    return tuple(chosen.values())


def recipe_digest(recipe: AnyRecipe) -> str:
    """Return a digest of the user's code of a registered recipe, or an empty text for any other recipe."""
    return definition_digest(recipe) if recipe.name in registry.REGISTERED else ""


def packed_definitions() -> Definitions | None:
    """Return all registered recipes and metrics for another process, or None without a registration.

    Raises:
        PolarguideError: a definition cannot be pickled.
    """
    if not registry.REGISTERED and not table.REGISTERED:
        return None
    try:
        data = cloudpickle.dumps((registry.REGISTERED, table.REGISTERED))
    except Exception as error:  # pickling calls code of the user
        raise PolarguideError(
            "recipes, metrics",
            expected="functions and classes that can be sent to another process",
            found=f"{type(error).__name__}: {error}",
            remedy="Do not use open files, locks or modules loaded in an unusual way in them.",
        ) from error
    return Definitions(tuple(os.path.abspath(path) for path in sys.path), data)


def register_definitions(packed: Definitions) -> None:
    """Register the recipes and metrics of another process. Modules are also looked for in its folders.

    Raises:
        PolarguideError: a definition cannot be loaded, or its name is taken.
    """
    sys.path += [path for path in packed.path if path not in sys.path]
    try:
        recipes, metrics = cloudpickle.loads(packed.data)
    except Exception as error:  # loading imports modules of the user
        raise PolarguideError(
            "recipes, metrics",
            expected="modules that every worker can import",
            found=f"{type(error).__name__}: {error}",
            remedy="Put these modules into a folder that all machines share, or install them.",
        ) from error
    registry.REGISTERED.update(recipes)
    for metric, digest in metrics.values():
        table.register_metric(metric, digest)
