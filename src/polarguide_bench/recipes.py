"""Recipes of comparisons: those of the product, its ablations, and GNeRP.

An ablation is a recipe with one thing changed, each a piece of data.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from polarguide.recipes import registry
from polarguide.recipes.baselines import RECIPE_3DGS, RECIPE_3DGS_DR
from polarguide.recipes.polarguide import (
    BEHIND,
    RECIPE_POLARGUIDE,
    RECIPE_POLARGUIDE_PAPER,
    RECIPE_POLARGUIDE_PAPER_KIND,
    RECIPE_POLARGUIDE_STOKES,
)
from polarguide.recipes.registry import (
    LAYER_TERMS,
    POLARIZED_TERMS,
    UNPOLARIZED,
    Change,
    both,
    off,
    staged,
    varied,
    weighing,
    without,
)
from polarguide.training.recipe import Recipe, Weights
from polarguide_bench.gnerp.recipe import FieldRates, FieldShape, NeuralRecipe, Sampling

AnyRecipe = Recipe | NeuralRecipe
"""The recipes that a comparison trains."""


def priors(**values: Any) -> Change:
    """New values of the recipe's ``Priors``."""
    return lambda recipe: replace(recipe, priors=replace(recipe.priors, **values))


def shading(**values: Any) -> Change:
    """New values of the shading model."""
    return lambda recipe: replace(recipe, shading=replace(recipe.shading, **values))


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
_UNPOLARIZED_INCONSISTENT = (
    "unpolarized-without-consistency",
    "The same without any polarization, and normals need not agree with the depth.",
    both(off(*POLARIZED_TERMS, "consistency"), without("refresh_priors")),
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
    UNPOLARIZED,
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
    ("only-normals", "Polarization normals alone: no term on the layers.", off(*LAYER_TERMS)),
    ("without-normals", "Separated layers alone: no term on the normals.", off("normal")),
    (
        "counted-pixels",
        "The term on the normals is divided by the pixels that count, not by all.",
        priors(azimuth_share=0.0),
    ),
    UNPOLARIZED,
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

RECIPE_GNERP = NeuralRecipe(
    name="gnerp",
    about="A signed-distance field (dense grids) with color and angle of polarization.",
)

ABLATIONS_GNERP = (
    replace(
        RECIPE_GNERP,
        name="gnerp:circular",
        about="gnerp with angles compared on the circle.",
        weights=replace(RECIPE_GNERP.weights, circular=True),
    ),
    replace(
        RECIPE_GNERP,
        name="gnerp:published",
        about="gnerp with the published networks, samples and steps: for a GPU.",
        steps=100_000,
        shape=FieldShape(kind="networks"),
        sampling=Sampling(coarse=64, fine=128),
        rates=FieldRates(networks=5e-4),
    ),
)

FIELDS: dict[str, NeuralRecipe] = {recipe.name: recipe for recipe in (RECIPE_GNERP, *ABLATIONS_GNERP)}
"""Recipes of signed-distance fields, which comparisons alone train."""

ABLATIONS: dict[str, tuple[AnyRecipe, ...]] = {
    "3dgs": ABLATIONS_3DGS,
    "3dgs-dr": ABLATIONS_3DGS_DR,
    "polarguide-paper": ABLATIONS_PAPER,
    "polarguide-paper:kind": ABLATIONS_KIND,
    "polarguide": ABLATIONS_POLARGUIDE,
    "polarguide-stokes": ABLATIONS_STOKES,
    "gnerp": ABLATIONS_GNERP,
}
"""Variations of a recipe by its name, each with one thing changed, named ``recipe:variation``."""

VARIATIONS: dict[str, Recipe] = {
    recipe.name: recipe for recipes in ABLATIONS.values() for recipe in recipes if isinstance(recipe, Recipe)
}
"""All ablations of Gaussians by name; the product looks names with a colon up here."""


def recipe_named(name: str) -> AnyRecipe:
    """A recipe or an ablation by name.

    Raises:
        PolarguideError: see ``polarguide.recipes.recipe_named``.
    """
    return FIELDS[name] if name in FIELDS else registry.recipe_named(name)


def ablations_of(name: str) -> tuple[AnyRecipe, ...]:
    """The ablations of a recipe: ours, or those that a plug-in offers as ``name:variation``; there may be none.

    Raises:
        PolarguideError: there is no recipe of that name.
    """
    if name in ABLATIONS or name in registry.RECIPES:
        return ABLATIONS.get(name, ())
    recipe_named(name)
    return registry.variations_offered(name)
