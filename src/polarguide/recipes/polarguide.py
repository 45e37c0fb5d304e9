"""Our recipes: the paper's three stages on 3DGS-DR's machinery, by the letter and with the physics repaired."""

from __future__ import annotations

from dataclasses import replace

from polarguide.recipes.baselines import PROPAGATE, RATES_REFLECTION, RESET_DR
from polarguide.training.stages import Priors, Recipe, Repeat, Stage, Weights

REFRESH = Repeat("refresh_priors", fraction=0.05, minimum=100)

_GUIDED = Weights(specular=0.5, diffuse=0.2, normal=0.0, azimuth=0.3)
_FINAL = Weights(azimuth=0.3)

RECIPE_POLARGUIDE = Recipe(
    name="polarguide",
    about="The paper's three stages with repaired physics: physical candidates, azimuth, exact separation.",
    stages=(
        Stage("plain", 0.1, reflection=False, densify=True),
        Stage(
            "guided",
            0.4,
            reflection=True,
            weights=_GUIDED,
            densify=True,
            repeats=(RESET_DR, PROPAGATE, REFRESH),
            on_enter=("refresh_priors",),
        ),
        Stage("guided, fixed density", 0.35, reflection=True, weights=_GUIDED, repeats=(REFRESH,)),
        Stage("final", 0.15, reflection=True, weights=_FINAL, on_enter=("refresh_priors",)),
    ),
    rates=RATES_REFLECTION,
    sh_fractions=(10 / 61, 11 / 61, 12 / 61),
)

_LETTER = Weights(specular=0.5, diffuse=0.2, normal=0.2)

RECIPE_POLARGUIDE_PAPER = replace(
    RECIPE_POLARGUIDE,
    name="polarguide-paper",
    about="The paper to the letter: its four candidates and its separation cue; kept for comparison.",
    stages=(
        RECIPE_POLARGUIDE.stages[0],
        replace(RECIPE_POLARGUIDE.stages[1], weights=_LETTER),
        replace(RECIPE_POLARGUIDE.stages[2], weights=_LETTER),
        replace(RECIPE_POLARGUIDE.stages[3], weights=Weights(normal=0.2)),
    ),
    priors=Priors(candidates="paper", separation="paper", azimuth_weight=0.0),
)
