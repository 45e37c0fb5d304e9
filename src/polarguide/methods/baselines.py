"""Recipes of the baselines 3DGS (Kerbl et al. 2023), 3DGS-DR (Ye et al. 2024) and Ref-GS (Zhang et al. 2025)."""

from __future__ import annotations

from polarguide.shading.deferred import DeferredShading
from polarguide.shading.directional import DirectionalShading
from polarguide.training.recipe import Recipe, Repeat, Rounds, Stage, Weights

RATES = {
    "means": 3.2e-4,
    "sh_dc": 2.5e-3,
    "sh_rest": 2.5e-3 / 20,
    "opacity_logits": 0.05,
    "log_scales": 1e-2,
    "quaternions": 1e-2,
}
"""Learning rates of every recipe: those of the 3DGS release, except for the geometry.

The release trains for 30,000 steps. To converge in a few thousand steps, means and scales have twice its learning rates
and rotations ten times. The rate of the means is relative to the scene's extent. It falls to a tenth
(``Recipe.means_decay``), not to a hundredth as in the release.
"""

RESET = Repeat("reset_opacity", fraction=0.1, minimum=700)
"""Reset of the opacities after every tenth of the steps, as in the release, but at least 700 steps apart.

Short trainings need this time to recover.
"""

RECIPE_3DGS = Recipe(
    name="3dgs",
    about="Plain 3D Gaussian splatting: no reflection, no polarization.",
    stages=(
        Stage("densify", 0.5, reflection=False, densify=True, repeats=(RESET,)),
        Stage("refine", 0.5, reflection=False),
    ),
    rates=RATES,
)

PROPAGATION_DR = Rounds(("propagate_normals", "reset_opacity"), 1.5 / 61, minimum=350)
"""Normal propagations and opacity resets, which take turns.

The release resets opacities every 3,000 of 61,000 steps, and propagates normals at all other multiples of 1,000 steps.
Here one propagation lies in the middle between two resets. A reset removes the opacity and width that a propagation
adds.
"""
RESET_DR = Repeat("reset_opacity", fraction=3 / 61, minimum=700)

# The initial values of the release (0.001, 5, 0.05, 128) need its 61,000 steps: see docs/explanation/baselines.md.
SHADING_3DGS_DR = DeferredShading(
    first_strength=0.05,
    environment_spread=0.2,
    environment_rate=0.01,
    environment_resolution=32,
)

RECIPE_3DGS_DR = Recipe(
    name="3dgs-dr",
    about="3DGS with deferred reflection and normal propagation: RGB alone.",
    stages=(
        Stage("plain", 6 / 61, reflection=False, densify=True),
        Stage("propagate", 18 / 61, reflection=True, densify=True, rounds=PROPAGATION_DR),
        # The last turn of the last round removes the opacity that the propagation has given to unneeded Gaussians.
        Stage(
            "densify",
            6 / 61,
            reflection=True,
            densify=True,
            repeats=(RESET_DR,),
            on_enter=("reset_opacity",),
        ),
        Stage("refine", 31 / 61, reflection=True),
    ),
    rates=RATES,
    sh_fractions=(10 / 61, 11 / 61, 12 / 61),
    shading=SHADING_3DGS_DR,
)


WEIGHTS = Weights(consistency=0.05, flatness=0.1)

RECIPE_REF_GS = Recipe(
    name="ref-gs",
    about="Deferred shading with a learned directional grid and an MLP: RGB alone.",
    stages=(
        # Opacities are not reset, because a few thousand steps are too few to recover.
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
