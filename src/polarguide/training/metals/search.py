"""Search for metals in a training: its schedule, its decision, and its messages.

The decision minimizes one energy over the whole scene by a minimum cut. With x = 1 for a metal and 0 for a dielectric,
E(x) has two sums. One is the sum of ``-u x`` over all Gaussians. The other is the sum of ``likeness w |x_i - x_j|``
over all pairs of neighbors. The evidence u is the evidence of the views minus the prior, in nats. It is infinite for
Gaussians that the user labels. Each connected piece of metal has an additional fixed cost.

The evidence of the views is the log likelihood ratio of metal and dielectric for each Gaussian
(``training.metals.hypotheses``). A metal in front of light that is darker than the pictures loses evidence.
"""

from __future__ import annotations

import math
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
from polarguide.shading.metal import FIRST_REFLECTANCE, become_metal
from polarguide.shading.model import Light, Parameters, ShadingModel, radiance_cubemap
from polarguide.training.context import TrainingContext, TrainingState
from polarguide.training.metals.hypotheses import (
    UNKNOWNS,
    DielectricTerms,
    SceneLight,
    Setting,
    dielectric_terms,
    log_ratio,
    metal_fit,
    scene_light,
)
from polarguide.training.metals.observations import (
    LEAST_PIXELS,
    contradicted,
    evenly,
    label_weights,
    numbers_in,
    samples_of,
    valid_radiance,
    view_sums,
)
from polarguide.training.recipe import MetalRules, MetalViews, Recipe, Schedule
from polarguide.training.settings import ResolvedSettings

GOLD = 0.38
"""Smallest over largest reflectance of gold, the most deeply colored metal."""
CHUNK = 1 << 14
"""Batch size in Gaussians, which bounds the memory of intermediate tensors."""


class MetalEvidence(NamedTuple):
    """Evidence of the views for N Gaussians.

    Attributes:
        ratio: [N] log likelihood ratio of metal and dielectric, per view.
        views: [N] number of independent views.
        reflectance: [N, 3] reflectance of the best metal.
        color: [N, 3] mean S0.
        labels: [N, 2] weight of pixels that the user labels as dielectric and as metal.
    """

    ratio: Tensor
    views: Tensor
    reflectance: Tensor
    color: Tensor
    labels: Tensor


@torch.no_grad()
def evidence(
    gaussians: Parameters,
    views: Sequence[View],
    rasterize: Rasterize,
    refractive_index: float,
    rules: MetalRules,
    limits: MetalViews,
    memory: MemoryBound = UNBOUNDED,
) -> MetalEvidence:
    """Compute the evidence of the views for each Gaussian, as the module describes.

    Views whose pictures do not determine the Stokes vector contribute only the labels of the user.
    """
    labels = label_weights(gaussians, views, rasterize, memory)
    measured = evenly([view for view in views if view.is_determined], limits.most_views)
    if not measured:
        none = labels.new_zeros(len(labels))
        gray = labels.new_full((len(labels), 3), FIRST_REFLECTANCE)
        return MetalEvidence(none, none, gray, torch.zeros_like(gray), labels)
    looks = [view_sums(gaussians, view, rasterize, limits.least_normal) for view in memory.between(measured)]
    light = scene_light(map(valid_radiance, memory.between(measured)), limits.dark)
    result = of_views(looks, light, labels, neighbors_of(gaussians), refractive_index, rules, limits)
    del looks
    memory.clear()
    return result


def of_views(
    looks: Sequence[Tensor],
    light: SceneLight,
    labels: Tensor,
    neighbors: Tensor,
    refractive_index: float,
    rules: MetalRules,
    limits: MetalViews,
) -> MetalEvidence:
    """Compute the evidence from sums of ``view_sums``, the scene's light, the user's labels, and neighbors [N, K]."""
    sums = torch.stack([look.sum(dim=0) for look in looks]).sum(dim=0)
    setting = Setting(refractive_index, float(sums[1:4].mean() / sums[0].clamp(min=1e-6)), limits.dark)
    parts = []
    for begin in range(0, len(labels), CHUNK):
        samples = samples_of(looks, slice(begin, begin + CHUNK), limits)
        total = samples.weight.sum(dim=0)
        count = total * total / (samples.weight**2).sum(dim=0).clamp(min=1e-9) * (total > LEAST_PIXELS)
        color = (samples.weight[..., None] * samples.s0).sum(dim=0) / total.clamp(min=1e-6)[:, None]
        terms = dielectric_terms(samples, setting)
        fit = metal_fit(samples, setting)
        dark = light.cost(samples, fit.reflectance)
        parts.append((*fit, dark, count, color, total, *terms))
    metal, reflectance, dark, count, color, total, *columns = (
        torch.cat(values) for values in zip(*parts, strict=True)
    )
    views = (count - UNKNOWNS).clamp(min=0)
    nats = log_ratio(metal, DielectricTerms(*columns), views, neighbors)
    # The room behind the camera may be darker than the pictures, so brightness alone does not outweigh all else.
    nats -= (views * dark).clamp(max=rules.trust)
    ratio = nats / views.clamp(min=1e-6) - _tint_cost(color, total, rules)
    return MetalEvidence(ratio, views, reflectance, color.clamp(min=0), labels)


def _tint_cost(color: Tensor, weight: Tensor, rules: MetalRules) -> Tensor:
    """Return the cost [N] of metals that are more deeply colored than gold, in nats per view.

    The color is relative to the mean light of the scene.
    """
    mean = (color * weight[:, None]).sum(dim=0) / weight.sum().clamp(min=1e-6)
    tints = (color / mean.clamp(min=1e-6)).clamp(min=1e-3)
    tint = (tints.amin(dim=1) / tints.amax(dim=1)).log()
    return 0.5 * ((math.log(GOLD) - tint).clamp(min=0) / rules.tint) ** 2


NEIGHBORS = 16
"""Number of neighbors of a Gaussian."""
PER_NAT = 100
"""Capacity of one nat in the minimum cut, which requires integer capacities."""
INFINITE = 1e5
"""Evidence of a label, in nats, which exceeds all other evidence."""
LEAST_DIFFERENCE = 1e-6
"""Least variance of color differences. It keeps the covariance of a gray scene invertible."""
DARK = 0.02
"""Radiance (full scale is 1) that is added to colors before their comparison."""


class Graph(NamedTuple):
    """Neighboring Gaussians, as M pairs.

    Attributes:
        first, second: [M] indices of the two Gaussians of each pair.
        cost: [M] cost in nats if only one Gaussian of the pair is a metal.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    cost: NDArray[np.float64]


def neighbors_of(gaussians: Parameters) -> Tensor:
    """Return the indices [N, K] of the nearest neighbors of each Gaussian, at most ``NEIGHBORS``."""
    means = gaussians["means"].detach()
    places = means.cpu().double().numpy()
    count = min(NEIGHBORS + 1, len(places))
    indices = torch.from_numpy(cKDTree(places).query(places, k=count)[1])
    return indices.reshape(len(places), count)[:, 1:].to(means.device)


def neighbor_graph(gaussians: Parameters, measured: MetalEvidence, rules: MetalRules) -> Graph:
    """Connect each Gaussian to its nearest neighbors, with costs by the similarity of normals and colors.

    Color differences are Mahalanobis distances: they are relative to the covariance of the differences of neighbors in
    the scene. Neighbors differ more in brightness than in hue, so that a border between two hues is cheap.
    """
    means = gaussians["means"].detach()
    axes = shortest_axis_normals(
        means, gaussians["quaternions"], gaussians["log_scales"], means.new_zeros(3), None
    )
    neighbors = neighbors_of(gaussians)
    logarithms = (measured.color + DARK).log()
    differences = (logarithms[neighbors] - logarithms[:, None]).double()
    sampled = differences[measured.views > 0].flatten(0, 1)
    covariance = sampled.T @ sampled / max(len(sampled), 1)
    covariance += LEAST_DIFFERENCE * torch.eye(3).to(covariance)
    distances = (differences @ torch.linalg.inv(covariance) * differences).sum(dim=-1)
    alike = dot(axes[:, None], axes[neighbors]) ** 4 * torch.exp(-0.5 * distances)
    first = np.repeat(np.arange(len(means)), neighbors.shape[1])
    # A pair of mutual neighbors appears twice.
    return Graph(
        first, neighbors.cpu().numpy().ravel(), (0.5 * rules.likeness * alike).cpu().double().numpy().ravel()
    )


def unary(measured: MetalEvidence, allowed: Tensor, rules: MetalRules) -> Tensor:
    """Return the evidence [N] that each Gaussian is a metal, in nats, regardless of its neighbors.

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
    """Return the mask [N] of metals with the least energy; ties go to the mask with the fewest metals."""
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
    """Return the mask of metals without pieces that lower the energy by less than the cost of a piece."""
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
    """Return the metalness [N] of the Gaussians, averaged over decisions with several priors.

    Each decision is the minimum of the energy for one prior.

    Args:
        measured: evidence of the views.
        gaussians: the Gaussians.
        allowed: [N] bool, Gaussians that may be metals without a label.
        rules: constants of the energy.
        priors: factors on the prior. With a single factor, the metalness of a Gaussian is 1 (metal) or 0 (dielectric).
            With several factors, it is between 0 and 1 where the decisions differ.
    """
    graph = neighbor_graph(gaussians, measured, rules)
    metalness = np.zeros(len(allowed), dtype=np.float32)
    for share in priors:
        nats = unary(measured, allowed, replace(rules, prior=share * rules.prior)).cpu().double().numpy()
        metalness += surfaces(minimum_cut(nats, graph), nats, graph, rules.surface)
    return torch.from_numpy(metalness / len(priors)).to(allowed.device)


SOFT_PRIORS = (1 / 3, 2 / 3, 1.0)
"""Factors on the prior in all searches except the last. Metalness is the share of the decisions for metal."""


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
    """Return the factor by which the learned light should become brighter.

    Dielectrics determine only the product of reflection strength and light. Metals have a known reflectance and
    therefore determine the light itself.

    Returns:
        The median of measured over rendered light on the first metals. It is limited to at most ``most_gain``, and to
        at least a value that keeps strengths below 1. The factor is 1 if there are no views or too few pixels of metal.
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
    strengths = torch.sigmoid(gaussians["strength_logits"])[gaussians["metalness"] == 0]
    smallest = float(torch.quantile(strengths, 0.9)) if len(strengths) else 0.1
    return float(ratio.median().exp().clamp(min=smallest, max=limits.most_gain))


class MetalSearch:
    """Search for metals, which runs at refreshes of the priors in the share of the steps that the recipe specifies.

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
        """Decide which Gaussians are metals, and initialize new metals with their measured reflectance."""
        context = self._context
        if not any(view.is_determined or view.materials is not None for view in context.views):
            return
        gaussians = state.gaussians
        measured = self._measure(state)
        if not self._warned:
            self._warn_of_contradictions(gaussians, measured.labels)
        priors = self._priors(state.step)
        metal = decide(measured, gaussians, self.allowed(state), context.recipe.metal_rules, priors)
        reflectance = measured.reflectance
        determined = [view for view in context.views if view.is_determined]
        gain = partial(
            light_gain,
            gaussians,
            state.light,
            determined,
            context.backend.rasterize,
            context.shading,
            context.recipe.metal_views,
            context.memory,
        )
        cubemap = radiance_cubemap(context.shading)
        if cubemap is not None:
            become_metal(gaussians, state.light[cubemap.name], cubemap.radiance, metal, reflectance, gain)
        del measured
        context.memory.clear()

    def _warn_of_contradictions(self, gaussians: Gaussians, labels: Tensor) -> None:
        """Warn once about views whose labels contradict other views."""
        context = self._context
        wrong = contradicted(
            gaussians,
            context.views,
            context.backend.rasterize,
            labels,
            context.recipe.metal_views,
            context.memory,
        )
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
        """Return a mask [N] of dielectric Gaussians that the opposite prior would make metals.

        The prior requires that a metal is likelier by a margin. A certain dielectric is likelier by the same margin.
        Return None if the training does not search for metals, or if no view determines the Stokes vector.
        """
        if not self._looks or not any(view.is_determined for view in self._context.views):
            return None
        rules = self._context.recipe.metal_rules
        opposite = decide(self._measure(state), state.gaussians, self.allowed(state), rules, (-1.0,))
        return (opposite > 0) & (state.gaussians["metalness"] == 0)

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

    def allowed(self, state: TrainingState) -> Tensor:
        """Return a mask [N] of Gaussians that may be metals without a label.

        Without polarization, no Gaussian is allowed, because the extent of a labeled surface is then unknown.
        """
        context = self._context
        means = state.gaussians["means"].detach()
        reach = context.recipe.metal_views.reach
        is_far = far_away(means.cpu(), context.scene.points, context.centers, reach).to(means.device)
        return ~is_far & any(view.is_determined for view in context.views)

    def _priors(self, step: int) -> tuple[float, ...]:
        """Return the factors on the prior at a step: several before the last search, and one in the last search.

        A metal that is shaded as a dielectric has wrong normals and thus wrong evidence. A likely metal is therefore
        first shaded as a mixture. It becomes a dielectric again if its new normals do not confirm that it is a metal.
        """
        return SOFT_PRIORS if step < max(self._looks, default=step) else (1.0,)


def refreshes(recipe: Recipe, steps: int) -> list[int]:
    """Return the steps at which a training refreshes its priors."""
    schedule = Schedule(recipe, steps)
    return [step for step in range(steps) if "refresh_priors" in schedule.at(step).actions]


def looks(recipe: Recipe, settings: ResolvedSettings) -> list[int]:
    """Return the steps at which a training searches for metals; empty if all surfaces are dielectrics."""
    if not _searches(recipe, settings):
        return []
    steps = settings.steps
    return [step for step in refreshes(recipe, steps) if _within(recipe.metals, step, steps)]


def warn_of_unused_materials(context: TrainingContext) -> None:
    """Warn if ``materials/``, or refractive indices of single materials, have no effect on a training.

    Recipes that never refresh their priors, such as controls, do not search for metals. They get no warning about
    labels of metals.
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
