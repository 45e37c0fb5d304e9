"""Recipes by name: the built-in ones and their ablations, and those of installed plug-ins.

An ablation is a recipe with one thing changed, each a piece of data.

A plug-in is a package with entry points of the group ``polarguide.recipes``. Each names a ``Recipe``, a sequence of
them, or a function without arguments that returns either. Plug-ins are loaded for a name that is not
built in, never on import; a run's folder records the recipe's name, and never where its code lies.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from polarguide.core.errors import PolarguideError
from polarguide.recipes.baselines import (
    ABLATIONS_GNERP,
    RECIPE_3DGS,
    RECIPE_3DGS_DR,
    RECIPE_GNERP,
    RECIPE_REF_GS,
)
from polarguide.recipes.polarguide import (
    BEHIND,
    RECIPE_POLARGUIDE,
    RECIPE_POLARGUIDE_PAPER,
    RECIPE_POLARGUIDE_PAPER_KIND,
    RECIPE_POLARGUIDE_STOKES,
)
from polarguide.training.recipe import Action, Method, Recipe, Stage, Weights, check_recipe

Change = Callable[[Recipe], Recipe]


def varied(base: Recipe, *table: tuple[str, str, Change]) -> tuple[Recipe, ...]:
    """The recipes ``base:name`` of a table: a name, what it is about, and how it differs from ``base``."""
    return tuple(
        replace(change(base), name=f"{base.name}:{name}", about=about) for name, about, change in table
    )


def staged(change: Callable[[Stage], Stage]) -> Change:
    """Every stage changed."""
    return lambda recipe: replace(recipe, stages=tuple(change(stage) for stage in recipe.stages))


def weighing(change: Callable[[Weights], Weights]) -> Change:
    """The new weights from the old ones, in every stage that has polarization terms."""
    return staged(
        lambda stage: replace(stage, weights=change(stage.weights)) if stage.weights.priors else stage
    )


def off(*names: str) -> Change:
    """Without the loss terms of these names."""
    return weighing(lambda old: replace(old, **dict.fromkeys(names, 0.0)))


def priors(**values: Any) -> Change:
    """New values of the recipe's ``Priors``."""
    return lambda recipe: replace(recipe, priors=replace(recipe.priors, **values))


def without(action: Action) -> Change:
    """An action does not happen. (Priors are then computed once, when they are first needed.)"""

    def change(stage: Stage) -> Stage:
        repeats = tuple(repeat for repeat in stage.repeats if repeat.action != action)
        return replace(stage, repeats=repeats, on_enter=tuple(a for a in stage.on_enter if a != action))

    return staged(change)


def shading(**values: Any) -> Change:
    """New values of the shading model."""
    return lambda recipe: replace(recipe, shading=replace(recipe.shading, **values))


def both(first: Change, second: Change) -> Change:
    """One change after the other."""
    return lambda recipe: second(first(recipe))


def without_propagation(base: Recipe) -> Recipe:
    """Neither propagations nor resets of the opacities."""
    bare = staged(lambda stage: replace(stage, rounds=None))
    return both(bare, without("reset_opacity"))(base)


def firm_to_the_end(base: Recipe) -> Recipe:
    """The final stage keeps rates and weights (but those of the layers) of the guided one."""
    *before, final = base.stages
    weights = replace(before[-1].weights, specular=0.0, diffuse=0.0)
    return replace(base, stages=(*before, replace(final, weights=weights, rate_factors={})))


def release_rates(**others: float) -> Change:
    """The geometry learns as slowly as in the release of 3DGS; ``others``: more rates of it."""
    slow = {"means": 1.6e-4, "log_scales": 5e-3, **others}
    return lambda recipe: replace(recipe, rates={**recipe.rates, **slow}, means_decay=0.01)


_NORMAL_TERMS_OFF = off("normal", "azimuth", "chromatic", "consistency")
_LAYER_TERMS = ("specular", "diffuse", "reflection", "base")
_POLARIZED_TERMS = ("normal", "azimuth", "chromatic", "stokes", *_LAYER_TERMS)
_UNPOLARIZED = (
    "unpolarized",
    "The same without any polarization: normals agree with the depth everywhere, where the recipe has them agree.",
    both(off(*_POLARIZED_TERMS), without("refresh_priors")),
)
_UNPOLARIZED_INCONSISTENT = (
    "unpolarized-without-consistency",
    "The same without any polarization, and normals need not agree with the depth.",
    both(off(*_POLARIZED_TERMS, "consistency"), without("refresh_priors")),
)
_COMMON = (
    (
        "without-colour",
        "Nothing is read from the polarization of color differences.",
        both(off("chromatic"), priors(chromatic=False)),
    ),
    (
        "colour-unchecked",
        "Normals of gray bodies' color differences count however far the Gaussians' normals are from them.",
        priors(chromatic_within=None),
    ),
    (
        "without-easing",
        "Every term weighs as much in the final stage as before, and rotations learn as fast.",
        firm_to_the_end,
    ),
    ("without-consistency", "Normals need not agree with the depth.", off("consistency")),
    (
        "consistency-by-dolp",
        "Normals agree with the depth only where the light is polarized.",
        priors(bright=0.0),
    ),
    (
        "normals-move-all",
        "Terms on normals also move Gaussians behind the subject.",
        staged(lambda stage: replace(stage, behind=None)),
    ),
    (
        "without-planes",
        "Large flat surfaces are not looked for.",
        priors(flat=False),
    ),
    (
        "layers-turn-normals",
        "Gradients of the layer terms reach the normals through the reflection from the beginning.",
        staged(lambda stage: replace(stage, hold_normals=False)),
    ),
    (
        "layers-hold-normals",
        "The terms on the layers reach the normals through Fresnel's equations alone, to the end.",
        staged(lambda stage: replace(stage, hold_normals=True)),
    ),
    (
        "few-pixels-pull",
        "The terms on directions are averaged over polarized pixels alone, however few.",
        priors(azimuth_share=0.0, chromatic_share=0.0),
    ),
    (
        "release-rates",
        "Means and scales learn as slowly as in the release of 3DGS, which takes 30,000 steps.",
        release_rates(),
    ),
    _UNPOLARIZED,
    _UNPOLARIZED_INCONSISTENT,
)

ABLATIONS_3DGS = varied(
    RECIPE_3DGS,
    (
        "release-rates",
        "The geometry learns as slowly as in the release, which takes 30,000 steps.",
        release_rates(quaternions=1e-3),
    ),
)

ABLATIONS_3DGS_DR = varied(
    RECIPE_3DGS_DR,
    (
        "consistent",
        "Flat Gaussians whose normals agree with the depth: what geometry gives without polarization.",
        staged(
            lambda stage: replace(
                stage, weights=replace(stage.weights, consistency=0.05, flatness=0.1), behind=BEHIND
            )
        ),
    ),
    (
        "without-propagation",
        "Neither propagations nor resets of the opacities: the row to compare with on real captures.",
        without_propagation,
    ),
)


def layers_before_the_blend(weights: Weights) -> Weights:
    """The terms on the layers compare mirrored light and base color, before the blend with the reflection strength."""
    return replace(weights, specular=0.0, diffuse=0.0, reflection=weights.specular, base=weights.diffuse)


def layers_after_the_blend(weights: Weights) -> Weights:
    """The terms on the layers compare what each adds to the picture."""
    return replace(weights, specular=weights.reflection, diffuse=weights.base, reflection=0.0, base=0.0)


_PUBLISHED = (
    ("only-normals", "Polarization normals alone: no term on the layers.", off(*_LAYER_TERMS)),
    ("without-normals", "Separated layers alone: no term on the normals.", off("normal")),
    (
        "counted-pixels",
        "The term on the normals is divided by the pixels that count, not by all.",
        priors(azimuth_share=0.0),
    ),
    _UNPOLARIZED,
)
"""The two ablations of the publication, another reading of its normal term, and the control."""

ABLATIONS_PAPER = (
    RECIPE_POLARGUIDE_PAPER_KIND,
    *varied(
        RECIPE_POLARGUIDE_PAPER,
        *_PUBLISHED,
        (
            "after-the-blend",
            "The layers are compared after the blend with the reflection strength.",
            weighing(layers_after_the_blend),
        ),
    ),
)
ABLATIONS_KIND = varied(
    RECIPE_POLARGUIDE_PAPER_KIND,
    *_PUBLISHED,
    (
        "before-the-blend",
        "The layers are compared before the blend with the reflection strength.",
        weighing(layers_before_the_blend),
    ),
)

ABLATIONS_POLARGUIDE = varied(
    RECIPE_POLARGUIDE,
    (
        "only-normals",
        "Polarization normals alone: no term on the separated layers.",
        off("specular", "diffuse"),
    ),
    ("without-normals", "Separated layers alone: no term on the normals.", _NORMAL_TERMS_OFF),
    (
        "without-polar-normals",
        "No polarization normals, but normals still agree with the depth.",
        off("normal", "azimuth", "chromatic"),
    ),
    (
        "paper-candidates",
        "PolarGuide-GSDR's four candidates in place of the six that physics allows.",
        priors(candidates="paper"),
    ),
    (
        "paper-separation",
        "PolarGuide-GSDR's separation cue in place of the exact solution.",
        priors(separation="paper"),
    ),
    (
        "without-azimuth-weighting",
        "Zenith trusted like azimuth, in the choice and in the term.",
        both(weighing(lambda old: replace(old, azimuth=0.0, normal=old.azimuth)), priors(azimuth_weight=0.0)),
    ),
    (
        "without-refresh",
        "Priors computed once, not again as the Gaussians improve.",
        without("refresh_priors"),
    ),
    (
        "without-mask",
        "Every pixel's polarization counts fully, however weak and noisy.",
        priors(threshold=0.0, full_dolp=1e-6, snr=0.0),
    ),
    *_COMMON,
    ("without-flatness", "Gaussians need not be flat.", off("flatness")),
)

ABLATIONS_STOKES = varied(
    RECIPE_POLARGUIDE_STOKES,
    ("without-stokes", "S1 and S2 are not rendered.", off("stokes")),
    ("without-separation", "No term on the separated layers.", off("specular", "diffuse")),
    ("without-normals", "No term on the normals except that on S1 and S2.", _NORMAL_TERMS_OFF),
    (
        "without-fresnel",
        "Strength does not depend on the angle: the lerp of 3DGS-DR.",
        shading(blend="lerp", first_strength=0.05, rough=False),
    ),
    (
        "without-roughness",
        "Dielectrics are mirrors; metals alone have a roughness.",
        shading(rough=False),
    ),
    ("without-local", "Nothing near is reflected: the environment alone.", shading(local=False)),
    (
        "without-outer-side",
        "Normals are always turned to the camera.",
        both(without("orient_normals"), lambda recipe: replace(recipe, oriented=False)),
    ),
    *_COMMON,
)


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
    "polarguide-paper:kind": ABLATIONS_KIND,
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
        remedy="Choose one of these. For a recipe of another package or version, install that package or version.",
    )


def recipe_names() -> list[str]:
    """Names of all recipes that ``train`` and ``compare`` take: built-in ones, their ablations, and those of plug-ins.

    Example:
        >>> polarguide.recipe_names()[:2]    # doctest: +SKIP
        ['3dgs', '3dgs-dr']
    """
    return [*RECIPES, *(name for name in _BUILT_IN if name not in RECIPES), *_plugins()[0]]


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
        PolarguideError: the entry point cannot be loaded, is no recipe, or has the name of a built-in one.
    """
    where = f"plug-in {entry.name} ({entry.value})"
    remedy = "Update or uninstall the package that brings it."
    try:
        loaded = entry.load()
        loaded = loaded() if callable(loaded) else loaded
        recipes = (loaded,) if isinstance(loaded, Method) else tuple(loaded)
    except (Exception, SystemExit) as error:  # another package may fail in any way
        found = f"{type(error).__name__}: {error}"
        raise PolarguideError(where, expected="recipes", found=found, remedy=remedy) from error
    for recipe in recipes:
        if not isinstance(recipe, Method):
            raise PolarguideError(where, expected="recipes", found=repr(recipe), remedy=remedy)
        check_recipe(recipe, where)
        if recipe.name in _BUILT_IN:
            found = f"{recipe.name}, which is built in"
            raise PolarguideError(where, expected="a name that no other has", found=found, remedy=remedy)
    return recipes
