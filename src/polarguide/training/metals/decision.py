"""Which Gaussians are metals, by the evidence: what is sure begins, what is likely joins, small or unsure pieces go."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from polarguide.training.metals.evidence import Evidence
from polarguide.training.metals.rules import Limits, MetalRules


def decide(found: Evidence, was: Tensor, allowed: Tensor, rules: MetalRules) -> Tensor:
    """Which Gaussians are metals, [N] bool: hysteresis thresholding on the graph of neighbors.

    Seeds have evidence above ``begin``, or above ``stay`` if they were metals before; the others of those have to join
    again, or a metal would creep on over its surroundings. Regions grow to neighbors with evidence above ``proceed``.
    Isolated Gaussians and regions with few seeds are dropped, and holes are filled. The user's labels override all.

    Args:
        was: [N] bool, metals until now. allowed: [N] bool, those that may be.
    """
    labeled = found.said.sum(dim=1) > rules.least_weight
    labeled_metal = labeled & (found.said[:, 1] > found.said[:, 0])
    allowed = allowed & ~labeled & (found.tint > rules.least_tint)
    able = allowed & (found.misfit > rules.proceed_misfit) & (found.support > rules.least_support)
    no_dielectric = found.misfit > rules.begin_misfit
    surely = labeled_metal | (able & no_dielectric & (found.ratio > rules.begin))
    begun = surely | (able & was & (found.ratio > rules.stay))
    metal = _regions(found, surely, begun, able & (found.ratio > rules.proceed), rules)
    surely = able & no_dielectric & _obliquely(found, rules.begin_oblique)
    likely = able & _obliquely(found, rules.proceed_oblique)
    metal |= _regions(found, surely, surely | (was & likely), likely, rules)
    # Nothing is known of what hardly any view shows, and its evidence is 0: among metals, it is one.
    among = allowed & (found.ratio > rules.among)
    return labeled_metal | _grown(found, metal, among, rules.majority, rules.filling, rules.nearest)


def _obliquely(found: Evidence, limits: Limits) -> Tensor:
    """Whether so much is polarized at 45 degrees that it tells of metal, and explains the metal's misfit."""
    much = (found.oblique > limits.oblique) & (found.oblique * found.brightness > limits.light)
    return much & (found.metal_misfit**2 < limits.times * found.oblique**2) & (found.ratio > limits.ratio)


def _regions(found: Evidence, surely: Tensor, metal: Tensor, likely: Tensor, rules: MetalRules) -> Tensor:
    """Metals [N]: ``metal`` grown over ``likely``, in connected regions with enough seeds that are sure."""
    metal = _grown(found, metal, likely, rules.crowd, rules.rounds, rules.nearest)
    metal = metal & (_share_of_nearest(found, metal, rules.nearest) > rules.alone)
    touching = found.alike[:, : rules.nearest] > rules.touching
    return metal & _sure_enough(found.near[:, : rules.nearest], touching, metal, surely, rules)


def _share_of_nearest(found: Evidence, metal: Tensor, nearest: int) -> Tensor:
    """Share [N] of metals among the nearest of each, by how alike they are."""
    counts = found.alike[:, :nearest]
    return (metal[found.near[:, :nearest]] * counts).sum(dim=1) / counts.sum(dim=1).clamp(min=1e-6)


def _grown(found: Evidence, metal: Tensor, likely: Tensor, share: float, rounds: int, nearest: int) -> Tensor:
    """``metal`` [N], and what is ``likely`` and has more than this share of metals among its nearest, over and over."""
    for _ in range(rounds):
        grown = metal | (likely & (_share_of_nearest(found, metal, nearest) > share))
        if bool((grown == metal).all()):
            break
        metal = grown
    return metal


def _sure_enough(
    nearest: Tensor, touching: Tensor, metal: Tensor, surely: Tensor, rules: MetalRules
) -> Tensor:
    """Which metals [N] lie in a connected region with enough seeds that are sure."""
    near, inside, sure = nearest.cpu().numpy(), metal.cpu().numpy(), surely.cpu().numpy()
    edges = touching.cpu().numpy() & inside[:, None] & inside[near]
    rows, columns = np.nonzero(edges)
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, near[rows, columns])), shape=(len(inside),) * 2)
    regions, region = connected_components(graph, directed=False)
    counts = np.bincount(region, minlength=regions)
    certain = np.bincount(region[sure & inside], minlength=regions)
    enough = (certain >= rules.fewest_sure) & (certain >= rules.sure_share * counts)
    return torch.from_numpy(enough[region]).to(metal.device)
