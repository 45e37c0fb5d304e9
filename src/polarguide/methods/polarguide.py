"""Recipes with the three stages of PolarGuide-GSDR (Shan et al. 2026), literally and with corrected physics.

Rates, first strength, environment and SH schedule are the same as in ``3dgs-dr``. Differences between the results of
both methods are therefore caused by the supervision.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from polarguide.methods.baselines import RECIPE_3DGS_DR, SHADING_3DGS_DR
from polarguide.training.recipe import Action, Priors, Recipe, Repeat, Stage, Weights

REFRESH = Repeat("refresh_priors", fraction=0.1, minimum=250)

BEHIND = (1.15, 1.5)
"""Distances between which gradients fade behind the subject, see ``Stage.behind``.

On ten rendered scenes, 95 to 100 % of the subject's pixels are nearer than the first distance.
"""
_PLAIN = Stage("plain", 0.1, reflection=False, densify=True)


def _stages(
    guided: Weights,
    final: Weights,
    *,
    final_rates: Mapping[str, float] | None = None,
    oriented: bool = False,
    hold_normals: bool = True,
    behind: tuple[float, float] | None = BEHIND,
) -> tuple[Stage, ...]:
    """Return the three stages of PolarGuide-GSDR.

    The guided stage is split into a part with density control and a part without.
    """
    enter: tuple[Action, ...] = ("refresh_priors",)
    orient: tuple[Action, ...] = ("orient_normals",) if oriented else ()
    return (
        _PLAIN,
        Stage(
            "guided, densifying",
            0.4,
            reflection=True,
            weights=guided,
            densify=True,
            repeats=(REFRESH,),
            on_enter=enter,
            # Mirrored light misleads normals while the geometry forms, and informs them later.
            hold_normals=hold_normals,
            behind=behind,
        ),
        Stage("guided", 0.35, reflection=True, weights=guided, repeats=(REFRESH,), behind=behind),
        Stage(
            "final",
            0.15,
            reflection=True,
            weights=final,
            on_enter=orient + enter,
            rate_factors=final_rates or {},
            behind=behind,
        ),
    )


_MEASURED = Weights(azimuth=0.15, chromatic=0.05)
_GUIDED = replace(_MEASURED, flatness=0.3, consistency=0.1)
# The final stage favors the picture. Terms on measured normals stay, regularization of the geometry becomes weaker, and
# rotations learn more slowly.
_FINAL = replace(_MEASURED, flatness=0.06, consistency=0.02)
_SLOW = {"quaternions": 0.2}

RECIPE_POLARGUIDE: Recipe = replace(
    RECIPE_3DGS_DR,
    name="polarguide",
    about="PolarGuide-GSDR's three stages with repaired physics: physical candidates, azimuth, exact separation.",
    stages=_stages(
        replace(_GUIDED, specular=0.5, diffuse=0.2),
        _FINAL,
        final_rates=_SLOW,
    ),
    densification=replace(RECIPE_3DGS_DR.densification, faint_pixels=0.1),
    priors=Priors(
        # An ideal sensor measures the azimuth down to a DoLP of a percent; noise has its own mask.
        threshold=0.01,
        full_dolp=0.05,
        azimuth_weight=1.0,
        snr=3.0,
        chromatic=True,
        chromatic_within=(30.0, 45.0),
        azimuth_share=0.5,
        chromatic_share=0.1,
        bright=0.1,
        flat=True,
    ),
)

SHADING_STOKES = replace(
    SHADING_3DGS_DR,
    blend="fresnel",
    local=True,
    local_rate=5e-3,
    first_strength=0.5,
    rough=True,
    metal=True,
    indices=True,
)

RECIPE_POLARGUIDE_STOKES: Recipe = replace(
    RECIPE_POLARGUIDE,
    name="polarguide-stokes",
    about="Renders the measurement: S1 and S2 of Fresnel-weighted layers, with local reflections.",
    stages=_stages(
        replace(_GUIDED, specular=0.25, diffuse=0.1, stokes=1.0),
        replace(_FINAL, stokes=0.2),
        final_rates=_SLOW,
        oriented=True,
    ),
    oriented=True,
    shading=SHADING_STOKES,
)

_PAPER = Priors(
    candidates="paper",
    live=True,
    separation="paper",
    threshold=0.1,
    full_dolp=1e-6,  # a pixel counts fully or not at all
    azimuth_weight=0.0,
    azimuth_share=1.0,  # the mean is over all pixels
)
_PAPER_NORMAL = 0.02
_PAPER_SPECULAR = 0.1
_PAPER_DIFFUSE = 0.05


def _paper_stages(guided: Weights, final: float, *, deferred_first: bool) -> tuple[Stage, ...]:
    """Return the stages of 3DGS-DR, with the loss terms of PolarGuide-GSDR in the second and third stage.

    Args:
        guided: weights of the loss terms between the first and the final stage.
        final: share of all steps that belong to the final stage.
        deferred_first: True to shade the first stage with deferred reflection as well.
    """
    plain, propagate, densify, refine = RECIPE_3DGS_DR.stages
    return (
        replace(plain, reflection=deferred_first),
        replace(propagate, weights=guided, on_enter=("refresh_priors",)),
        replace(densify, weights=guided),
        replace(refine, name="guided", fraction=refine.fraction - final, weights=guided),
        replace(refine, name="final", fraction=final, weights=Weights(normal=guided.normal)),
    )


RECIPE_POLARGUIDE_PAPER: Recipe = replace(
    RECIPE_3DGS_DR,
    name="polarguide-paper",
    about="PolarGuide-GSDR to the letter, on 3DGS-DR: its candidates, loss over all pixels, layers before the blend.",
    stages=_paper_stages(
        Weights(reflection=_PAPER_SPECULAR, base=_PAPER_DIFFUSE, normal=_PAPER_NORMAL),
        final=10 / 97,  # 10,000 of 97,000 steps
        deferred_first=False,
    ),
    priors=_PAPER,
)

RECIPE_POLARGUIDE_PAPER_KIND: Recipe = replace(
    RECIPE_3DGS_DR,
    name="polarguide-paper:kind",
    about="PolarGuide-GSDR as read most favorably: azimuths in place of -n, on 3DGS-DR, deferred from the first step.",
    stages=_paper_stages(
        Weights(specular=_PAPER_SPECULAR, diffuse=_PAPER_DIFFUSE, normal=_PAPER_NORMAL),
        final=0.15,
        deferred_first=True,
    ),
    priors=replace(_PAPER, candidates="azimuths"),
)
