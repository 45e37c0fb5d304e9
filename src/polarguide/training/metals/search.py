"""Search for metals in a training: its steps, its decision, and its messages.

The decision is the minimum of one energy over the whole scene, found by a minimum cut. With x = 1 for a metal, E(x) is
the sum over all Gaussians of ``-u x`` and over all pairs of neighbors of ``likeness w |x_i - x_j|``. The evidence u is
that of the views (``training.metals.evidence``) minus the prior, in nats, and infinite for Gaussians that the user
labels. Each connected piece of metal has an additional fixed cost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_flow
from scipy.spatial import cKDTree
from torch import Tensor

from polarguide.capture import View
from polarguide.capture.view import listed
from polarguide.core.system import UNBOUNDED, MemoryBound
from polarguide.gaussians.gaussians import Gaussians
from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.gaussians.initialize import far_away
from polarguide.geometry.vectors import dot
from polarguide.raster import Rasterize
from polarguide.shading.gbuffer import render
from polarguide.shading.metal import become_metal
from polarguide.shading.model import Light, Parameters, ShadingModel
from polarguide.training.context import TrainingContext
from polarguide.training.metals.evidence import MetalEvidence, evidence
from polarguide.training.metals.observations import LEAST_PIXELS, contradicted, evenly, numbers_in
from polarguide.training.recipe import MetalRules, MetalViews, Recipe, Schedule
from polarguide.training.settings import ResolvedSettings
from polarguide.training.state import TrainingState

NEIGHBORS = 16
"""Number of neighbors of a Gaussian."""
PER_NAT = 100
"""Capacity of one nat in the flow, whose capacities are integers."""
INFINITE = 1e5
"""Evidence of a label, in nats, which exceeds all other evidence."""
DARK = 0.02
"""Radiance (full scale is 1) that is added to colors before their comparison."""


class Graph(NamedTuple):
    """Pairs of neighbors.

    Attributes:
        first, second: [M] indices of both Gaussians.
        cost: [M] cost of different materials, in nats.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    cost: NDArray[np.float64]


def neighbor_graph(gaussians: Parameters, measured: MetalEvidence, rules: MetalRules) -> Graph:
    """Return the nearest neighbors of each Gaussian, connected by the similarity of their normals and colors.

    Color differences are relative to the root mean square difference of neighbors in the scene.
    """
    means = gaussians["means"].detach()
    axes = shortest_axis_normals(
        means, gaussians["quaternions"], gaussians["log_scales"], means.new_zeros(3), None
    )
    places = means.cpu().double().numpy()
    count = min(NEIGHBORS + 1, len(places))
    near = torch.from_numpy(cKDTree(places).query(places, k=count)[1]).reshape(len(places), count)[:, 1:]
    near = near.to(means.device)
    logarithms = (measured.color + DARK).log()
    apart = (logarithms[near] - logarithms[:, None]).square().mean(dim=-1)
    visible = measured.views > 0
    typical = (apart.mean(dim=1) * visible).sum() / visible.sum().clamp(min=1)
    alike = dot(axes[:, None], axes[near]) ** 4 * torch.exp(-0.5 * apart / typical.clamp(min=1e-6))
    first = np.repeat(np.arange(len(places)), count - 1)
    # A pair of mutual neighbors appears twice.
    return Graph(
        first, near.cpu().numpy().ravel(), (0.5 * rules.likeness * alike).cpu().double().numpy().ravel()
    )


def unary(measured: MetalEvidence, allowed: Tensor, rules: MetalRules) -> Tensor:
    """Return the evidence [N] for metal of each Gaussian alone, in nats.

    Args:
        measured: evidence of the views.
        allowed: [N] bool, Gaussians that may be metals without a label.
        rules: constants of the energy.
    """
    nats = measured.views * measured.ratio - (measured.views + 1) * rules.prior
    nats = torch.where(allowed, nats.clamp(-rules.trust, rules.trust), torch.full_like(nats, -INFINITE))
    signs = (measured.labels[:, 1] > measured.labels[:, 0]).to(nats) * 2 - 1
    return torch.where(measured.labels.sum(dim=1) > LEAST_PIXELS, signs * INFINITE, nats)


def minimum_cut(nats: NDArray[np.float64], graph: Graph) -> NDArray[np.bool_]:
    """Return the x [N] of least energy; in a tie, the one with the fewest metals."""
    count = len(nats)
    every = np.arange(count)
    source = np.full(count, count)
    sink = np.full(count, count + 1)
    begin = np.concatenate((graph.first, graph.second, source, every))
    end = np.concatenate((graph.second, graph.first, every, sink))
    weights = np.concatenate((graph.cost, graph.cost, nats.clip(min=0), (-nats).clip(min=0)))
    capacities = np.rint(weights * PER_NAT).astype(np.int32)
    network = coo_matrix((capacities, (begin, end)), shape=(count + 2, count + 2)).tocsr()
    left = network - maximum_flow(network, count, count + 1).flow
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    metal = np.zeros(count + 2, dtype=bool)
    metal[breadth_first_order(left, count, return_predecessors=False)] = True
    return metal[:count]


def surfaces(
    metal: NDArray[np.bool_], nats: NDArray[np.float64], graph: Graph, least: float
) -> NDArray[np.bool_]:
    """Return the metals in pieces that lower the energy by more than the cost of a piece."""
    count = len(metal)
    first, second, cost = graph
    inside = metal[first] & metal[second] & (cost > 0.5 / PER_NAT)
    pieces = coo_matrix((np.ones(inside.sum()), (first[inside], second[inside])), shape=(count, count))
    number, piece = connected_components(pieces, directed=False)
    border = metal[first] != metal[second]
    owner = np.where(metal[first], first, second)[border]
    gains = np.bincount(piece, weights=nats * metal, minlength=number)
    gains -= np.bincount(piece[owner], weights=cost[border], minlength=number)
    return metal & (gains > least)[piece]


def decide(
    measured: MetalEvidence,
    gaussians: Parameters,
    allowed: Tensor,
    rules: MetalRules,
    priors: Sequence[float] = (1.0,),
) -> Tensor:
    """Return the metalness [N]: the mean of the minimum of the energy over several priors.

    Args:
        measured: evidence of the views.
        gaussians: the Gaussians.
        allowed: [N] bool, Gaussians that may be metals without a label.
        rules: constants of the energy.
        priors: shares of the prior. With one share, a Gaussian is a metal (1) or a dielectric (0). With more, metalness
            is between them where the priors lead to different decisions.
    """
    graph = neighbor_graph(gaussians, measured, rules)
    metalness = np.zeros(len(allowed), dtype=np.float32)
    for share in priors:
        nats = unary(measured, allowed, replace(rules, prior=share * rules.prior)).cpu().double().numpy()
        metalness += surfaces(minimum_cut(nats, graph), nats, graph, rules.surface)
    return torch.from_numpy(metalness / len(priors)).to(allowed.device)


SOFT_PRIORS = (1 / 3, 2 / 3, 1.0)
"""Shares of the prior before the last search; metalness is the share of these decisions for metal."""


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
    """Return the factor by which the light should be brighter, according to the first metals.

    Dielectrics determine only the product of strength and light. Metals, whose reflectance is known, determine the
    light.

    Returns:
        The median of measured over rendered light of metals, at most ``most_gain`` and at least a value that keeps
        strengths below 1. 1 without views, and for too few metal pixels.
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
    """Search for metals at the refreshes of the priors, within the share of the steps that the recipe specifies.

    Args:
        context: context of the training.
    """

    def __init__(self, context: TrainingContext) -> None:
        self._context = context
        self._warned = False
        self._looks = looks(context.recipe, context.settings)

    def is_due(self, step: int) -> bool:
        """Return True if a refresh at this step searches for metals."""
        context = self._context
        steps = context.settings.steps
        return _searches(context.recipe, context.settings) and _within(context.recipe.metals, step, steps)

    @torch.no_grad()
    def look(self, state: TrainingState) -> None:
        """Decide which Gaussians are metals, and initialize new metals with the measurement."""
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
            f"other views contradict {names} on up to {100 * max(wrong.values()):.0f} % of their labels: dielectric "
            "in one view, metal in another. The majority counts; check these files."
        )

    @torch.no_grad()
    def undecided(self, state: TrainingState) -> Tensor | None:
        """Return a mask [N] of Gaussians that are dielectrics by the prior alone, and metals by their measurement.

        None if the training does not search for metals, or if no view determines the Stokes vector.
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
        """Return a mask [N] of Gaussians that may be metals without a label.

        It is empty without polarization, because the range of a label is then unknown.
        """
        context = self._context
        means = state.gaussians["means"].detach()
        reach = context.recipe.metal_views.reach
        far = far_away(means.cpu(), context.scene.points, context.centers, reach).to(means.device)
        return ~far & any(view.is_determined for view in context.views)

    def _priors(self, step: int) -> tuple[float, ...]:
        """Return the shares of the prior at a step: several before the last search, for soft metalness.

        A metal that is shaded as a dielectric has wrong normals and wrong evidence. A likely metal is therefore shaded
        as a mixture first, and becomes a dielectric again if its new normals do not confirm the metal.
        """
        return SOFT_PRIORS if step < max(self._looks, default=step) else (1.0,)


def refreshes(recipe: Recipe, steps: int) -> list[int]:
    """Return the steps of a training that refresh its priors."""
    schedule = Schedule(recipe, steps)
    return [step for step in range(steps) if "refresh_priors" in schedule.at(step).actions]


def looks(recipe: Recipe, settings: ResolvedSettings) -> list[int]:
    """Return the steps at which a training decides on metals; empty if all surfaces are dielectrics."""
    if not _searches(recipe, settings):
        return []
    steps = settings.steps
    return [step for step in refreshes(recipe, steps) if _within(recipe.metals, step, steps)]


def warn_of_unused_materials(context: TrainingContext) -> None:
    """Warn if ``materials/``, or refractive indices of single materials, have no effect on a training.

    Recipes that never refresh their priors, such as controls, do not search for metals and get no warning of these.
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
            "This training is too short for such a refresh and treats all surfaces as dielectrics. Use more steps."
        )
    indices = context.scene.indices
    if not indices:
        return
    if not ("index_offset" in recipe.shading.parameters and refreshed):
        why = f"the recipe {recipe.name} uses that of the run for all surfaces"
    elif not any(numbers_in(view) & indices.keys() for view in views):
        why = "no picture in materials/ of a training view contains their numbers"
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
    """Return True if the user labels metals or dielectrics in a view."""
    return view.materials is not None and bool(((view.materials == 1) | (view.materials == 2)).any())
