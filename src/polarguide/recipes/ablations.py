"""Ablations: a recipe with one thing changed, each a piece of data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from polarguide.recipes.baselines import RECIPE_3DGS_DR
from polarguide.recipes.polarguide import RECIPE_POLARGUIDE, RECIPE_POLARGUIDE_STOKES, SHADING_STOKES
from polarguide.training.recipe import Action, Recipe, Weights


def varied(
    base: Recipe,
    name: str,
    about: str,
    *,
    weights: Callable[[Weights], Weights] | None = None,
    priors: dict[str, Any] | None = None,
    without: Action | None = None,
    **fields: Any,
) -> Recipe:
    """A recipe named ``base:name`` that differs from ``base`` in what is given.

    Args:
        weights: the new weights from the old ones, in every stage that has polarization terms.
        priors: new values of its ``Priors``.
        without: an action that does not happen. (Priors are then computed once, when they are first needed.)
        fields: new values of the recipe itself.
    """

    def weights_of(old: Weights) -> Weights:
        return weights(old) if weights and old.priors else old

    stages = tuple(
        replace(
            stage,
            weights=weights_of(stage.weights),
            repeats=tuple(r for r in stage.repeats if r.action != without),
            on_enter=tuple(a for a in stage.on_enter if a != without),
        )
        for stage in base.stages
    )
    changed = replace(base.priors, **(priors or {}))
    return replace(base, name=f"{base.name}:{name}", about=about, stages=stages, priors=changed, **fields)


def off(*names: str) -> Callable[[Weights], Weights]:
    """Weights without the terms of these names."""
    return lambda old: replace(old, **dict.fromkeys(names, 0.0))


def firm_to_the_end(base: Recipe) -> Recipe:
    """``base:without-easing``: the final stage keeps rates and weights (but those of the layers) of the guided one."""
    *before, final = base.stages
    weights = off("specular", "diffuse")(before[-1].weights)
    return replace(
        base,
        name=f"{base.name}:without-easing",
        about="Every term weighs as much in the final stage as before, and rotations learn as fast.",
        stages=(*before, replace(final, weights=weights, rate_factors={})),
    )


_NORMAL_TERMS_OFF = off("normal", "azimuth", "chromatic", "consistency")

ABLATIONS_3DGS_DR: tuple[Recipe, ...] = (
    replace(
        RECIPE_3DGS_DR,
        name="3dgs-dr:consistent",
        about="Flat Gaussians whose normals agree with the depth: what geometry gives without polarization.",
        stages=tuple(
            replace(stage, weights=replace(stage.weights, consistency=0.05, flatness=0.1))
            for stage in RECIPE_3DGS_DR.stages
        ),
    ),
)

ABLATIONS_POLARGUIDE: tuple[Recipe, ...] = (
    varied(
        RECIPE_POLARGUIDE,
        "only-normals",
        "Polarization normals alone: no term on the separated layers.",
        weights=off("specular", "diffuse"),
    ),
    varied(
        RECIPE_POLARGUIDE,
        "without-normals",
        "Separated layers alone: no term on the normals.",
        weights=_NORMAL_TERMS_OFF,
    ),
    varied(
        RECIPE_POLARGUIDE,
        "paper-candidates",
        "The paper's four candidates in place of the six that physics allows.",
        priors={"candidates": "paper"},
    ),
    varied(
        RECIPE_POLARGUIDE,
        "paper-separation",
        "The paper's separation cue in place of the exact solution.",
        priors={"separation": "paper"},
    ),
    varied(
        RECIPE_POLARGUIDE,
        "without-azimuth-weighting",
        "Zenith trusted like azimuth, in the choice and in the term.",
        weights=lambda old: replace(old, azimuth=0.0, normal=old.azimuth),
        priors={"azimuth_weight": 0.0},
    ),
    varied(
        RECIPE_POLARGUIDE,
        "without-refresh",
        "Priors computed once, not again as the Gaussians improve.",
        without="refresh_priors",
    ),
    varied(
        RECIPE_POLARGUIDE,
        "without-mask",
        "Every pixel's polarization counts fully, however weak and noisy.",
        priors={"threshold": 0.0, "full_dolp": 1e-6, "snr": 0.0},
    ),
    varied(
        RECIPE_POLARGUIDE,
        "without-colour",
        "Nothing is read from the polarization of color differences.",
        weights=off("chromatic"),
        priors={"chromatic": False},
    ),
    firm_to_the_end(RECIPE_POLARGUIDE),
    varied(
        RECIPE_POLARGUIDE,
        "without-consistency",
        "Normals need not agree with the depth.",
        weights=off("consistency"),
    ),
    varied(
        RECIPE_POLARGUIDE,
        "without-flatness",
        "Gaussians need not be flat.",
        weights=off("flatness"),
    ),
)

ABLATIONS_STOKES: tuple[Recipe, ...] = (
    varied(
        RECIPE_POLARGUIDE_STOKES,
        "without-stokes",
        "S1 and S2 are not rendered.",
        weights=off("stokes"),
    ),
    varied(
        RECIPE_POLARGUIDE_STOKES,
        "without-separation",
        "No term on the separated layers.",
        weights=off("specular", "diffuse"),
    ),
    varied(
        RECIPE_POLARGUIDE_STOKES,
        "without-normals",
        "No term on the normals but what S1 and S2 say.",
        weights=_NORMAL_TERMS_OFF,
    ),
    varied(
        RECIPE_POLARGUIDE_STOKES,
        "without-fresnel",
        "Strength does not depend on the angle: the lerp of 3DGS-DR.",
        shading=replace(SHADING_STOKES, blend="lerp", first_strength=0.05),
    ),
    varied(
        RECIPE_POLARGUIDE_STOKES,
        "without-local",
        "Nothing near is reflected: the environment alone.",
        shading=replace(SHADING_STOKES, local=False),
    ),
    varied(
        RECIPE_POLARGUIDE_STOKES,
        "without-outer-side",
        "Normals are always turned to the camera.",
        without="orient_normals",
        oriented=False,
    ),
    varied(
        RECIPE_POLARGUIDE_STOKES,
        "without-colour",
        "Nothing is read from the polarization of color differences.",
        weights=off("chromatic"),
        priors={"chromatic": False},
    ),
    firm_to_the_end(RECIPE_POLARGUIDE_STOKES),
    varied(
        RECIPE_POLARGUIDE_STOKES,
        "without-consistency",
        "Normals need not agree with the depth.",
        weights=off("consistency"),
    ),
)
