"""The baseline GNeRP (Li et al. 2024): a signed-distance field trained with the angle of polarization."""

from __future__ import annotations

from dataclasses import replace

from polarguide.fields.recipe import FieldRates, FieldShape, NeuralRecipe, Sampling

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
