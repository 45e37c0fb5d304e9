"""Recipes by name: built-in recipes, their controls, ablations, and recipes of installed plug-ins.

A control is a recipe without any polarization. Other ablations belong to ``polarguide_bench``.

A plug-in is a package with entry points of the group ``polarguide.recipes``. An entry point refers to a ``Recipe``, a
sequence of recipes, or a function without arguments that returns one of these. Plug-ins are not loaded on import, but
only when a name is not built in. A run folder records the name of the recipe, not the location of its code.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points

from polarguide.core.errors import PolarguideError, require
from polarguide.methods.baselines import RECIPE_3DGS, RECIPE_3DGS_DR, RECIPE_REF_GS
from polarguide.methods.polarguide import (
    RECIPE_POLARGUIDE,
    RECIPE_POLARGUIDE_PAPER,
    RECIPE_POLARGUIDE_PAPER_KIND,
    RECIPE_POLARGUIDE_STOKES,
)
from polarguide.training.recipe import Action, Recipe, Stage, Weights, check_recipe

Change = Callable[[Recipe], Recipe]
"""Function that derives a recipe from another one."""


def varied(base: Recipe, *table: tuple[str, str, Change]) -> tuple[Recipe, ...]:
    """Return the variations ``base:name`` of a recipe.

    Args:
        base: recipe to vary.
        table: rows with the name, the description and the change of each variation.
    """
    return tuple(
        replace(change(base), name=f"{base.name}:{name}", about=about) for name, about, change in table
    )


def staged(change: Callable[[Stage], Stage]) -> Change:
    """Return a change that applies ``change`` to every stage."""
    return lambda recipe: replace(recipe, stages=tuple(change(stage) for stage in recipe.stages))


def weighing(change: Callable[[Weights], Weights]) -> Change:
    """Return a change that replaces weights in every stage with polarization terms."""
    return staged(
        lambda stage: replace(stage, weights=change(stage.weights)) if stage.weights.priors else stage
    )


def off(*names: str) -> Change:
    """Return a change that removes the loss terms of these names."""
    return weighing(lambda old: replace(old, **dict.fromkeys(names, 0.0)))


def without(action: Action) -> Change:
    """Return a change that removes an action from all stages.

    Without the action that refreshes priors, they are computed once, when they are first needed.
    """

    def change(stage: Stage) -> Stage:
        repeats = tuple(repeat for repeat in stage.repeats if repeat.action != action)
        return replace(stage, repeats=repeats, on_enter=tuple(a for a in stage.on_enter if a != action))

    return staged(change)


def both(first: Change, second: Change) -> Change:
    """Return a change that applies two changes in order."""
    return lambda recipe: second(first(recipe))


LAYER_TERMS = ("specular", "diffuse", "reflection", "base")
POLARIZED_TERMS = ("normal", "azimuth", "chromatic", "stokes", *LAYER_TERMS)
UNPOLARIZED = (
    "unpolarized",
    "The same without any polarization: normals agree with the depth everywhere, where the recipe has them agree.",
    both(off(*POLARIZED_TERMS), without("refresh_priors")),
)


GROUP = "polarguide.recipes"
"""Group of the entry points of plug-ins."""
NEIGHBOR = "polarguide_bench.recipes"
"""Module that defines the ablations."""
_ONLY_COMPARED = "gnerp"
"""Name of a method based on a signed-distance field, which only ``polarguide_bench`` can train."""

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
"""The built-in recipes."""

CONTROLS: dict[str, Recipe] = {
    control.name: control
    for base in (
        RECIPE_POLARGUIDE_PAPER,
        RECIPE_POLARGUIDE_PAPER_KIND,
        RECIPE_POLARGUIDE,
        RECIPE_POLARGUIDE_STOKES,
    )
    for control in varied(base, UNPOLARIZED)
}
"""The built-in recipes without polarization."""

_BUILT_IN = {
    **RECIPES,
    RECIPE_POLARGUIDE_PAPER_KIND.name: RECIPE_POLARGUIDE_PAPER_KIND,
    **CONTROLS,
}


REGISTERED: dict[str, Recipe] = {}
"""Recipes of ``register_recipe``."""


def recipe_named(name: str) -> Recipe:
    """Return a recipe or a variation by name. Ablations and plug-ins are loaded if the name is not built in.

    Raises:
        PolarguideError: the name is unknown or belongs to two plug-ins, or its plug-in cannot be loaded.
    """
    if name in _BUILT_IN:
        return _BUILT_IN[name]
    base = name.partition(":")[0]
    require(
        not _is_only_compared(name),
        "recipe",
        expected="a recipe of Gaussians",
        found=f"{name}, a signed-distance field, which is a baseline of comparisons",
        remedy=f"Train and score it with polarguide compare SCENE --recipes {name}.",
    )
    ablations = _ablations()
    if name in ablations:
        return ablations[name]
    if name in REGISTERED:
        return REGISTERED[name]
    offers, failures = _plugins()
    offered = offers.get(name, {})
    if len(offered) == 1:
        return next(iter(offered.values()))
    require(
        not offered,
        f"recipe {name}",
        expected="one plug-in with that name",
        found=" and ".join(offered),
        remedy="Uninstall one of them.",
    )
    if base in failures:
        raise failures[base]
    names = [*RECIPES, *(key for key in {**_BUILT_IN, **ablations} if key.startswith(f"{base}:")), *offers]
    broken = "".join(f"; a plug-in that cannot be loaded: {error}" for error in failures.values())
    raise PolarguideError(
        "recipe",
        expected="one of " + ", ".join(names),
        found=name + broken,
        remedy="Choose one of these. For a recipe of another package or version, install that package or version.",
    )


class RecipeTable(dict[str, Recipe]):
    """Recipes by name, displayed as one line for each recipe."""

    def __repr__(self) -> str:
        """Return the name and the description of each recipe."""
        width = max(map(len, self), default=0)
        return "\n".join(f"{name:{width}}  {recipe.about}" for name, recipe in self.items())


def recipes() -> RecipeTable:
    """Return all recipes that ``train`` accepts, by name.

    These are built-in recipes, controls, ablations, recipes of plug-ins, and registered recipes.

    Example:
        >>> mine = dataclasses.replace(polarguide.recipes()["3dgs"], name="mine", ssim_weight=0.3)    # doctest: +SKIP
    """
    plugins = {name: offered for name, offered in _plugins()[0].items() if len(offered) == 1}
    names = dict.fromkeys((*_BUILT_IN, *_ablations(), *plugins, *REGISTERED))
    return RecipeTable({name: recipe_named(name) for name in names})


def register_recipe(recipe: Recipe) -> None:
    """Make a recipe available by its name in this process. It replaces a registered recipe of the same name.

    Raises:
        PolarguideError: a value is invalid, or the name belongs to another recipe.
    """
    where = f"recipe {recipe.name}"
    check_recipe(recipe, where)
    require(
        not _is_only_compared(recipe.name),
        where,
        expected=f"a name that does not begin with {_ONLY_COMPARED}",
        found=f"a name of the baseline {_ONLY_COMPARED}",
        remedy="Rename it: dataclasses.replace(recipe, name=...).",
    )
    taken = {**_BUILT_IN, **_ablations(), **_plugins()[0]}
    require(
        recipe.name not in taken,
        where,
        expected="a name that no other recipe has",
        found="a recipe of this name with other values",
        remedy="Rename it: dataclasses.replace(recipe, name=...).",
    )
    REGISTERED[recipe.name] = recipe


def _is_only_compared(name: str) -> bool:
    """Return True for the name of the baseline that only ``polarguide_bench`` can train, and of its variations."""
    return name.partition(":")[0] == _ONLY_COMPARED


def variations_offered(name: str) -> tuple[Recipe, ...]:
    """Return the recipes that plug-ins offer as ``name:variation``."""
    return tuple(recipe_named(key) for key in _plugins()[0] if key.startswith(f"{name}:"))


def _ablations() -> dict[str, Recipe]:
    """Return the ablations by name; empty if their package is not installed."""
    if importlib.util.find_spec(NEIGHBOR.partition(".")[0]) is None:
        return {}
    ablations: dict[str, Recipe] = importlib.import_module(NEIGHBOR).VARIATIONS
    return ablations


def _plugins() -> tuple[dict[str, dict[str, Recipe]], dict[str, PolarguideError]]:
    """Load all plug-ins.

    Returns a tuple of two mappings. The first has, for each name of a recipe, the recipes by entry point. The second
    has the errors by the name of the entry point.
    """
    offers: dict[str, dict[str, Recipe]] = {}
    failures: dict[str, PolarguideError] = {}
    for entry in entry_points(group=GROUP):
        try:
            for recipe in _recipes_of(entry):
                offers.setdefault(recipe.name, {})[entry.value] = recipe
        except PolarguideError as error:
            failures[entry.name] = error
    return offers, failures


@lru_cache
def _recipes_of(entry: EntryPoint) -> tuple[Recipe, ...]:
    """Return the recipes of an entry point.

    Raises:
        PolarguideError: the entry point cannot be loaded, returns no recipe, or has the name of a built-in recipe.
    """
    where = f"plug-in {entry.name} ({entry.value})"
    remedy = "Update or uninstall the package that brings it."
    try:
        loaded = entry.load()
        loaded = loaded() if callable(loaded) else loaded
        recipes = (loaded,) if isinstance(loaded, Recipe) else tuple(loaded)
    except (Exception, SystemExit) as error:  # another package may raise any error
        actual = f"{type(error).__name__}: {error}"
        raise PolarguideError(where, expected="recipes", found=actual, remedy=remedy) from error
    for recipe in recipes:
        if not isinstance(recipe, Recipe):
            raise PolarguideError(where, expected="recipes", found=repr(recipe), remedy=remedy)
        check_recipe(recipe, where)
        if recipe.name in _BUILT_IN or _is_only_compared(recipe.name):
            actual = f"{recipe.name}, which is built in"
            raise PolarguideError(where, expected="a unique name", found=actual, remedy=remedy)
    return recipes
