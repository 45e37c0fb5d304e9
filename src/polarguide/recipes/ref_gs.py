"""The baseline Ref-GS (Zhang et al. 2025) on our Gaussians: directional factorization, RGB alone."""

from __future__ import annotations

from polarguide.recipes.baselines import RATES
from polarguide.shading.directional import DirectionalShading
from polarguide.training.recipe import Recipe, Stage, Weights

WEIGHTS = Weights(consistency=0.05, flatness=0.1)

RECIPE_REF_GS = Recipe(
    name="ref-gs",
    about="Deferred shading with a learned directional grid and an MLP: RGB alone.",
    stages=(
        # No resets of the opacity: thousands of steps, not tens of thousands, do not make up for them here.
        Stage("densify", 0.5, reflection=True, weights=WEIGHTS, densify=True),
        Stage("refine", 0.5, reflection=True, weights=WEIGHTS),
    ),
    rates=RATES,
    shading=DirectionalShading(
        width=64,
        mlp_rate=1.5e-3,
        albedo_rate=3e-3,
        feature_rate=6e-3,
        environment_spread=0.5,
        environment_rate=1e-2,
        environment_resolution=32,
    ),
)
