"""Recipes that can be compared: the recipes of polarguide, their ablations, and GNeRP.

An ablation is a recipe with one change, for example without a loss term.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from polarguide.core.errors import require
from polarguide.methods import registry
from polarguide.methods.baselines import RECIPE_3DGS, RECIPE_3DGS_DR
from polarguide.methods.polarguide import (
    BEHIND,
    RECIPE_POLARGUIDE,
    RECIPE_POLARGUIDE_PAPER,
    RECIPE_POLARGUIDE_PAPER_KIND,
    RECIPE_POLARGUIDE_STOKES,
)
from polarguide.methods.registry import (
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
from polarguide_bench.gnerp.recipe import NeuralRecipe
from polarguide_bench.polgs import RECIPE_POLGS

AnyRecipe = Recipe | NeuralRecipe
"""Recipe of a comparison."""


def priors(**values: Any) -> Change:
    """Return a change of values in the recipe's ``Priors``."""
    return lambda recipe: replace(recipe, priors=replace(recipe.priors, **values))


def shading(**values: Any) -> Change:
    """Return a change of values in the recipe's shading model."""
    return lambda recipe: replace(recipe, shading=replace(recipe.shading, **values))


def firm_to_the_end(base: Recipe) -> Recipe:
    """Use the rates and weights of the guided stage in the final stage as well, except the weights of the layers."""
    *before, final = base.stages
    weights = replace(before[-1].weights, specular=0.0, diffuse=0.0)
    return replace(base, stages=(*before, replace(final, weights=weights, rate_factors={})))


def release_rates(**others: float) -> Change:
    """Return a change to the geometry's learning rates in the 3DGS release. ``others`` adds other parameters."""
    slow = {"means": 1.6e-4, "log_scales": 5e-3, **others}
    return lambda recipe: replace(recipe, rates={**recipe.rates, **slow}, means_decay=0.01)


_NORMAL_TERMS_OFF = off("normal", "azimuth", "chromatic", "consistency")
_UNPOLARIZED_INCONSISTENT = (
    "unpolarized-without-consistency",
    "Without polarization and without agreement of normals and depth.",
    both(off(*POLARIZED_TERMS, "consistency"), without("refresh_priors")),
)
_COMMON = (
    (
        "without-colour",
        "Without the polarization of color differences.",
        both(off("chromatic"), priors(chromatic=False)),
    ),
    (
        "colour-unchecked",
        "Normals from color differences count at any distance from the Gaussians' normals.",
        priors(chromatic_within=None),
    ),
    (
        "without-easing",
        "The final stage has the weights and rates of the previous stage.",
        firm_to_the_end,
    ),
    ("without-consistency", "Without agreement of normals and depth.", off("consistency")),
    (
        "consistency-by-dolp",
        "Normals and depth agree only on polarized pixels.",
        priors(bright=0.0),
    ),
    (
        "normals-move-all",
        "Terms on normals also move Gaussians behind the subject.",
        staged(lambda stage: replace(stage, behind=None)),
    ),
    (
        "without-planes",
        "Without a search for large flat surfaces.",
        priors(flat=False),
    ),
    (
        "layers-turn-normals",
        "Gradients of the layer terms reach the normals through the reflection in all stages.",
        staged(lambda stage: replace(stage, hold_normals=False)),
    ),
    (
        "layers-hold-normals",
        "Gradients of the layer terms reach the normals only through Fresnel's equations in all stages.",
        staged(lambda stage: replace(stage, hold_normals=True)),
    ),
    (
        "few-pixels-pull",
        "The terms on directions are means over polarized pixels only.",
        priors(azimuth_share=0.0, chromatic_share=0.0),
    ),
    (
        "release-rates",
        "Rates of means and scales of the 3DGS release, which trains for 30,000 steps.",
        release_rates(),
    ),
    UNPOLARIZED,
    _UNPOLARIZED_INCONSISTENT,
)

ABLATIONS_3DGS = varied(
    RECIPE_3DGS,
    (
        "release-rates",
        "Rates of the geometry of the release, which trains for 30,000 steps.",
        release_rates(quaternions=1e-3),
    ),
)

ABLATIONS_3DGS_DR = varied(
    RECIPE_3DGS_DR,
    (
        "consistent",
        "Flat Gaussians with agreement of normals and depth: geometry without polarization.",
        staged(
            lambda stage: replace(
                stage, weights=replace(stage.weights, consistency=0.05, flatness=0.1), behind=BEHIND
            )
        ),
    ),
    (
        "without-propagation",
        "Without propagations and resets of the opacities: the reference on real captures.",
        both(staged(lambda stage: replace(stage, rounds=None)), without("reset_opacity")),
    ),
)


def layers_before_the_blend(weights: Weights) -> Weights:
    """Apply the loss to mirrored light and base color themselves, before the reflection strength blends them."""
    return replace(weights, specular=0.0, diffuse=0.0, reflection=weights.specular, base=weights.diffuse)


def layers_after_the_blend(weights: Weights) -> Weights:
    """Apply the loss to the contribution of each layer to the picture, after the reflection strength blends them."""
    return replace(weights, specular=weights.reflection, diffuse=weights.base, reflection=0.0, base=0.0)


_PUBLISHED = (
    ("only-normals", "Only polarization normals, without terms on the layers.", off(*LAYER_TERMS)),
    ("without-normals", "Only separated layers, without terms on the normals.", off("normal")),
    (
        "counted-pixels",
        "The term on the normals is a mean over valid pixels instead of all.",
        priors(azimuth_share=0.0),
    ),
    UNPOLARIZED,
)
"""Ablations of the publication, a variant of its normal term, and the control without polarization."""

ABLATIONS_PAPER = (
    RECIPE_POLARGUIDE_PAPER_KIND,
    *varied(
        RECIPE_POLARGUIDE_PAPER,
        *_PUBLISHED,
        (
            "after-the-blend",
            "Layers are compared after the blend with the reflection strength.",
            weighing(layers_after_the_blend),
        ),
    ),
)
ABLATIONS_KIND = varied(
    RECIPE_POLARGUIDE_PAPER_KIND,
    *_PUBLISHED,
    (
        "before-the-blend",
        "Layers are compared before the blend with the reflection strength.",
        weighing(layers_before_the_blend),
    ),
)

ABLATIONS_POLARGUIDE = varied(
    RECIPE_POLARGUIDE,
    (
        "only-normals",
        "Only polarization normals, without terms on the separated layers.",
        off("specular", "diffuse"),
    ),
    ("without-normals", "Only separated layers, without terms on the normals.", _NORMAL_TERMS_OFF),
    (
        "without-polar-normals",
        "Without polarization normals, but with agreement of normals and depth.",
        off("normal", "azimuth", "chromatic"),
    ),
    (
        "paper-candidates",
        "PolarGuide-GSDR's four candidates instead of the six physical ones.",
        priors(candidates="paper"),
    ),
    (
        "paper-separation",
        "PolarGuide-GSDR's separation cue instead of the exact solution.",
        priors(separation="paper"),
    ),
    (
        "without-azimuth-weighting",
        "The zenith has the weight of the azimuth, in the choice and in the term.",
        both(weighing(lambda old: replace(old, azimuth=0.0, normal=old.azimuth)), priors(azimuth_weight=0.0)),
    ),
    (
        "without-refresh",
        "Priors are computed only once.",
        without("refresh_priors"),
    ),
    (
        "without-mask",
        "The polarization of each pixel has full weight, even if it is weak or noisy.",
        priors(threshold=0.0, full_dolp=1e-6, snr=0.0),
    ),
    *_COMMON,
    ("without-flatness", "Without the flatness of Gaussians.", off("flatness")),
)

ABLATIONS_STOKES = varied(
    RECIPE_POLARGUIDE_STOKES,
    ("without-stokes", "Without rendered S1 and S2.", off("stokes")),
    ("without-separation", "Without terms on the separated layers.", off("specular", "diffuse")),
    ("without-normals", "Without terms on the normals, except the term on S1 and S2.", _NORMAL_TERMS_OFF),
    (
        "without-fresnel",
        "The reflection strength does not depend on the angle: the lerp of 3DGS-DR.",
        shading(blend="lerp", first_strength=0.05, rough=False),
    ),
    (
        "without-roughness",
        "Only metals have a roughness. Dielectrics are mirrors.",
        shading(rough=False),
    ),
    ("without-local", "Only the environment is reflected, without near light.", shading(local=False)),
    (
        "without-outer-side",
        "Normals always face the camera.",
        both(without("orient_normals"), lambda recipe: replace(recipe, oriented=False)),
    ),
    *_COMMON,
)

ABLATIONS_POLGS = varied(
    RECIPE_POLGS,
    (
        "strength",
        "Each Gaussian learns how strongly it reflects.",
        shading(first_strength=0.5),
    ),
    ("unpolarized", "The same without S1 and S2.", off("polarization")),
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
)

FIELDS: dict[str, NeuralRecipe] = {recipe.name: recipe for recipe in (RECIPE_GNERP, *ABLATIONS_GNERP)}
"""Recipes that train signed-distance fields, by name. Only comparisons use them."""

ABLATIONS: dict[str, tuple[AnyRecipe, ...]] = {
    "3dgs": ABLATIONS_3DGS,
    "3dgs-dr": ABLATIONS_3DGS_DR,
    "polarguide-paper": ABLATIONS_PAPER,
    "polarguide-paper:kind": ABLATIONS_KIND,
    "polarguide": ABLATIONS_POLARGUIDE,
    "polarguide-stokes": ABLATIONS_STOKES,
    "polgs": ABLATIONS_POLGS,
    "gnerp": ABLATIONS_GNERP,
}
"""Ablations of each recipe, by the name of the recipe. An ablation is named ``recipe:variation``."""

VARIATIONS: dict[str, Recipe] = {
    recipe.name: recipe
    for recipes in ((RECIPE_POLGS,), *ABLATIONS.values())
    for recipe in recipes
    if isinstance(recipe, Recipe)
}
"""Ablations of Gaussian recipes, and the baselines of this package, by name. polarguide looks up other names here."""


def recipe_named(name: str) -> AnyRecipe:
    """Return a recipe or an ablation by name.

    Raises:
        PolarguideError: the name is unknown, see ``polarguide.methods.recipe_named``.
    """
    if name in FIELDS:
        return FIELDS[name]
    require(
        not name.startswith("gnerp:"),
        "recipe",
        expected=f"a recipe of this version: {', '.join(sorted(FIELDS))}",
        found=name,
        remedy="Name one of these recipes.",
    )
    return registry.recipe_named(name)


def ablations_of(name: str) -> tuple[AnyRecipe, ...]:
    """Return the ablations of a recipe, including those that plug-ins register as ``name:variation``.

    Raises:
        PolarguideError: the recipe is unknown.
    """
    if name in ABLATIONS or name in registry.RECIPES:
        return ABLATIONS.get(name, ())
    recipe_named(name)
    return registry.variations_offered(name)
