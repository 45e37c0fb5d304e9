"""Recipes by name: the built-in ones and their ablations, and those of installed plug-ins.

A plug-in is a package with entry points of the group ``polarguide.recipes``. Each names a ``Recipe``, a sequence of
them, or a function without arguments that returns either. Plug-ins are loaded for a name that is not
built in, never on import; a run's folder records the recipe's name, and never where its code lies.
"""

from __future__ import annotations

from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points

from polarguide.core.errors import PolarguideError
from polarguide.recipes.ablations import (
    ABLATIONS_3DGS,
    ABLATIONS_3DGS_DR,
    ABLATIONS_PAPER,
    ABLATIONS_POLARGUIDE,
    ABLATIONS_STOKES,
)
from polarguide.recipes.baselines import (
    ABLATIONS_GNERP,
    RECIPE_3DGS,
    RECIPE_3DGS_DR,
    RECIPE_GNERP,
    RECIPE_REF_GS,
)
from polarguide.recipes.polarguide import RECIPE_POLARGUIDE, RECIPE_POLARGUIDE_PAPER, RECIPE_POLARGUIDE_STOKES
from polarguide.training.recipe import Method

GROUP = "polarguide.recipes"

RECIPES: dict[str, Method] = {
    recipe.name: recipe
    for recipe in (
        RECIPE_3DGS,
        RECIPE_3DGS_DR,
        RECIPE_REF_GS,
        RECIPE_POLARGUIDE_PAPER,
        RECIPE_POLARGUIDE,
        RECIPE_POLARGUIDE_STOKES,
        RECIPE_GNERP,
    )
}
"""The built-in recipes."""

ABLATIONS: dict[str, tuple[Method, ...]] = {
    "3dgs": ABLATIONS_3DGS,
    "3dgs-dr": ABLATIONS_3DGS_DR,
    "polarguide-paper": ABLATIONS_PAPER,
    "polarguide": ABLATIONS_POLARGUIDE,
    "polarguide-stokes": ABLATIONS_STOKES,
    "gnerp": ABLATIONS_GNERP,
}
"""Variations of a built-in recipe by its name, each with one thing changed, named ``recipe:variation``."""

_BUILT_IN = {**RECIPES, **{recipe.name: recipe for group in ABLATIONS.values() for recipe in group}}


def recipe_named(name: str) -> Method:
    """A recipe or a variation by name; plug-ins are loaded if it is not built in.

    Raises:
        PolarguideError: there is none of that name, two plug-ins have it, or its plug-in cannot be loaded.
    """
    if name in _BUILT_IN:
        return _BUILT_IN[name]
    base = name.partition(":")[0]
    offers, failures = _plugins()
    offered = offers.get(name, {})
    if len(offered) == 1:
        return next(iter(offered.values()))
    if offered:
        raise PolarguideError(
            f"recipe {name}",
            expected="one plug-in with that name",
            found=" and ".join(offered),
            remedy="Uninstall one of them.",
        )
    if base in failures:
        raise failures[base]
    names = [*RECIPES, *(key for key in _BUILT_IN if key.startswith(f"{base}:")), *offers]
    broken = "".join(f"; a plug-in that cannot be loaded: {error}" for error in failures.values())
    raise PolarguideError(
        "recipe",
        expected="one of " + ", ".join(names),
        found=name + broken,
        remedy="Take one of these; a recipe of another version needs that version.",
    )


def ablations_of(name: str) -> tuple[Method, ...]:
    """The ablations of a recipe: built-in ones, or what plug-ins offer as ``name:variation``; there may be none.

    Raises:
        PolarguideError: as ``recipe_named``.
    """
    recipe_named(name)
    if name in _BUILT_IN:
        return ABLATIONS.get(name, ())
    return tuple(recipe_named(key) for key in _plugins()[0] if key.startswith(f"{name}:"))


def _plugins() -> tuple[dict[str, dict[str, Method]], dict[str, PolarguideError]]:
    """Recipes of plug-ins by name, each by the entry points that offer it; and failures by the entry point's name."""
    offers: dict[str, dict[str, Method]] = {}
    failures: dict[str, PolarguideError] = {}
    for entry in entry_points(group=GROUP):
        try:
            for recipe in _recipes_of(entry):
                offers.setdefault(recipe.name, {})[entry.value] = recipe
        except PolarguideError as error:
            failures[entry.name] = error
    return offers, failures


@lru_cache
def _recipes_of(entry: EntryPoint) -> tuple[Method, ...]:
    """The recipes of an entry point.

    Raises:
        PolarguideError: it cannot be loaded, is no recipe, or has the name of a built-in one.
    """
    where = f"plug-in {entry.name} ({entry.value})"
    remedy = "Update or uninstall the package that brings it."
    try:
        loaded = entry.load()
        loaded = loaded() if callable(loaded) else loaded
        recipes = (loaded,) if isinstance(loaded, Method) else tuple(loaded)
    except Exception as error:
        found = f"{type(error).__name__}: {error}"
        raise PolarguideError(where, expected="recipes", found=found, remedy=remedy) from error
    for recipe in recipes:
        if not isinstance(recipe, Method):
            raise PolarguideError(where, expected="recipes", found=repr(recipe), remedy=remedy)
        if recipe.name in _BUILT_IN:
            found = f"{recipe.name}, which is built in"
            raise PolarguideError(where, expected="a name of its own", found=found, remedy=remedy)
    return recipes
