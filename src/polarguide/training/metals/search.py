"""The search for metals in a training: when it looks, what it changes, and what it tells the user."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from polarguide.capture import View
from polarguide.capture.view import listed
from polarguide.core.system import UNBOUNDED, MemoryBound
from polarguide.gaussians.gaussians import Gaussians
from polarguide.gaussians.initialize import far_away
from polarguide.raster import Rasterize
from polarguide.shading.gbuffer import render
from polarguide.shading.metal import become_metal
from polarguide.shading.model import Light, ShadingModel
from polarguide.training.context import TrainingContext
from polarguide.training.metals.cut import decide
from polarguide.training.metals.evidence import MetalEvidence, evidence
from polarguide.training.metals.observations import contradicted, evenly, numbers_in
from polarguide.training.recipe import Recipe, Schedule
from polarguide.training.rules import MetalViews
from polarguide.training.settings import ResolvedSettings
from polarguide.training.state import TrainingState

# Shares of the prior that decide before the last look; metalness is the share of these decisions that say metal.
SOFT_PRIORS = (1 / 3, 2 / 3, 1.0)


@torch.no_grad()
def light_gain(
    gaussians: Gaussians,
    light: Light,
    views: Sequence[View],
    rasterize: Rasterize,
    shading: ShadingModel,
    limits: MetalViews,
    memory: MemoryBound = UNBOUNDED,
) -> float:
    """By how much the light should be brighter, as the first metals show it.

    Dielectrics fix the product of strength and light alone. Metals, whose reflectance is known, fix the light.

    Returns:
        The median of what they show over what is rendered of them; 1 without views and where they are hardly seen. Not
        so little that strengths would have to exceed 1.
    """
    ratios = []
    pixels = 0
    for view in memory.between(evenly(views, limits.gain_views)):
        photograph = view.photograph().to(gaussians["means"].device).flatten(0, 1)
        metal = render(gaussians, view.camera, rasterize, shading=shading, light=light).metal
        pixels += len(photograph)
        if metal is None:
            continue
        clear = (metal.share > limits.gain_share) & ~(view.saturated | view.invalid).to(
            photograph.device
        ).flatten()[metal.pixels]
        rendered = metal.specular[clear].mean(dim=1) / metal.share[clear]
        ratios.append(((photograph[metal.pixels[clear]].mean(dim=1) + 1e-3) / (rendered + 1e-3)).log())
    ratio = torch.cat(ratios) if ratios else gaussians["means"].new_zeros(0)
    if not len(ratio) or len(ratio) < limits.gain_pixels * pixels:
        return 1.0
    body = gaussians["metalness"] == 0
    least = (
        torch.quantile(shading.strength(gaussians)[body], 0.9) if bool(body.any()) else ratio.new_tensor(0.1)
    )
    return float(ratio.median().exp().clamp(min=float(least), max=limits.most_gain))


class MetalSearch:
    """Finds metals at the refreshes of the priors, within the share of the steps that the recipe specifies.

    Args:
        context: context of the training.
    """

    def __init__(self, context: TrainingContext) -> None:
        self._context = context
        self._warned = False
        self._looks = looks(context.recipe, context.settings)

    def is_due(self, step: int) -> bool:
        """Whether a refresh at this step looks for metals."""
        context = self._context
        steps = context.settings.steps
        return _searches(context.recipe, context.settings) and _within(context.recipe.metals, step, steps)

    @torch.no_grad()
    def look(self, state: TrainingState) -> None:
        """Decide which Gaussians are metals, and begin with what was measured of those that are new."""
        context = self._context
        views = context.views
        if not any(view.is_determined or view.materials is not None for view in views):
            return
        gaussians = state.gaussians
        rasterize = context.backend.rasterize
        limits = context.recipe.metal_views
        measured = self._measure(state)
        if not self._warned:
            self._warn_of_contradictions(gaussians, measured.labels)
        priors = self._priors(state.step)
        metal = decide(measured, gaussians, self._allowed(state), context.recipe.metal_rules, priors)
        reflectance = measured.reflectance
        for values in (metal, reflectance):
            context.ranks.broadcast(values)
        determined = [view for view in views if view.is_determined]
        gain = partial(
            light_gain, gaussians, state.light, determined, rasterize, context.shading, limits, context.memory
        )
        cubemap = context.shading.radiance_cubemap
        if cubemap is not None:
            become_metal(gaussians, state.light[cubemap.name], cubemap.radiance, metal, reflectance, gain)
        del measured
        context.memory.clear()

    def _warn_of_contradictions(self, gaussians: Gaussians, labels: Tensor) -> None:
        """Warn once of files of materials that other views contradict."""
        context = self._context
        limits = context.recipe.metal_views
        rasterize = context.backend.rasterize
        wrong = contradicted(gaussians, context.views, rasterize, labels, limits, context.memory)
        if not wrong:
            return
        self._warned = True
        names = listed([f"materials/{name}.png" for name in wrong])
        context.reporter.warn(
            f"other views contradict {names} on {100 * max(wrong.values()):.0f} % of what is said there, at most: "
            "dielectric in one view, metal in another. The larger part counts; look at these files."
        )

    @torch.no_grad()
    def undecided(self, state: TrainingState) -> Tensor | None:
        """Gaussians [N] bool that are dielectrics by the prior alone: what was measured of them would make them metals.

        None where a training does not look for metals, or no view determines the Stokes vector.
        """
        if not self._looks or not any(view.is_determined for view in self._context.views):
            return None
        gaussians = state.gaussians
        rules = self._context.recipe.metal_rules
        without = decide(self._measure(state), gaussians, self._allowed(state), rules, (0.0,))
        return (without > 0) & (gaussians["metalness"] == 0)

    def _measure(self, state: TrainingState) -> MetalEvidence:
        context = self._context
        return evidence(
            state.gaussians,
            context.views,
            context.backend.rasterize,
            context.settings.refractive_index,
            context.recipe.metal_rules,
            context.recipe.metal_views,
            context.memory,
        )

    def _allowed(self, state: TrainingState) -> Tensor:
        """Gaussians [N] bool that may be metals unless the user says so: none where nothing tells how far a label
        reaches.
        """
        context = self._context
        means = state.gaussians["means"].detach()
        reach = context.recipe.metal_views.reach
        far = far_away(means.cpu(), context.scene.points, context.centers, reach).to(means.device)
        return ~far & any(view.is_determined for view in context.views)

    def _priors(self, step: int) -> tuple[float, ...]:
        """Shares of the prior that decide at a step: several before the last look, so that metalness is soft first.

        Normals of a metal that is shaded as a dielectric are wrong, and its evidence with them. What is likely is
        therefore shaded as a mixture first, and is a dielectric again where its own normals do not confirm it.
        """
        return SOFT_PRIORS if step < max(self._looks, default=step) else (1.0,)


def refreshes(recipe: Recipe, steps: int) -> list[int]:
    """The steps of a training that refresh its priors."""
    schedule = Schedule(recipe, steps)
    return [step for step in range(steps) if "refresh_priors" in schedule.at(step).actions]


def looks(recipe: Recipe, settings: ResolvedSettings) -> list[int]:
    """The steps at which a training decides what is metal; none: it takes everything for dielectric."""
    if not _searches(recipe, settings):
        return []
    steps = settings.steps
    return [step for step in refreshes(recipe, steps) if _within(recipe.metals, step, steps)]


def warn_of_unused_materials(context: TrainingContext) -> None:
    """Warn if ``materials/``, or refractive indices of single materials, have no effect on a training.

    Recipes that never refresh their priors, such as controls, do not look for metals and get no warning of these.
    """
    recipe = context.recipe
    settings = context.settings
    views = context.views
    refreshed = refreshes(recipe, settings.steps)
    searches = _searches(recipe, settings) and any(map(_names_metals, views))
    if searches and refreshed and not looks(recipe, settings):
        first, last = (100 * share for share in recipe.metals)
        context.reporter.warn(
            f"materials/ is read at refreshes of the priors between {first:.0f} and {last:.0f} % of the steps. "
            "A training this short has none there, and takes everything for dielectric. Take more steps."
        )
    indices = context.scene.indices
    if not indices:
        return
    if not ("index_offset" in recipe.shading.parameters and refreshed):
        why = f"the recipe {recipe.name} takes the run's for everything"
    elif not any(numbers_in(view) & indices.keys() for view in views):
        why = "no picture in materials/ of a training view has one of their numbers"
    else:
        return
    context.reporter.warn(
        f"the refractive indices that scene.json lists under materials are not used: {why}."
    )


def _searches(recipe: Recipe, settings: ResolvedSettings) -> bool:
    return "metalness" in recipe.shading.parameters and settings.materials == "auto"


def _within(shares: tuple[float, float], step: int, steps: int) -> bool:
    return shares[0] <= step / steps < shares[1]


def _names_metals(view: View) -> bool:
    """Whether the user says of a view which of what it shows is a metal, or none."""
    return view.materials is not None and bool(((view.materials == 1) | (view.materials == 2)).any())
