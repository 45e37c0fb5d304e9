"""Which Gaussians are metals: the minimum of one energy over the whole scene, by a minimum cut.

With x = 1 for a metal, E(x) is the sum over all Gaussians of ``-u x`` and over all pairs of neighbors of
``likeness w |x_i - x_j|``. The evidence u is that of the views (``training.metals.evidence``) less the prior, in nats,
and infinite where the user says what a Gaussian is. Each piece of metal that hangs together costs a fixed amount more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_flow
from scipy.spatial import cKDTree
from torch import Tensor

from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.geometry.vectors import dot
from polarguide.shading.model import Parameters
from polarguide.training.metals.evidence import MetalEvidence
from polarguide.training.metals.observations import LEAST_PIXELS
from polarguide.training.rules import MetalRules

# Neighbors of a Gaussian.
NEIGHBORS = 16
# Capacities of the flow are integers: so many to a nat. INFINITE, in nats, is more than all that others can weigh.
PER_NAT = 100
INFINITE = 1e5
# Radiance (full scale is 1) that is added to colors before they are compared.
DARK = 0.02


class Graph(NamedTuple):
    """Pairs of neighbors: both [M], and what it costs, in nats, to be of different kinds [M]."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    cost: NDArray[np.float64]


def neighbor_graph(gaussians: Parameters, measured: MetalEvidence, rules: MetalRules) -> Graph:
    """The nearest neighbors of each Gaussian, tied by how alike they are turned and how alike their color is.

    The scene tells which colors are alike: the mean square of what neighbors differ by is 1.
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
    seen = measured.views > 0
    typical = (apart.mean(dim=1) * seen).sum() / seen.sum().clamp(min=1)
    alike = dot(axes[:, None], axes[near]) ** 4 * torch.exp(-0.5 * apart / typical.clamp(min=1e-6))
    first = np.repeat(np.arange(len(places)), count - 1)
    # A pair that is near from both sides is there twice.
    return Graph(
        first, near.cpu().numpy().ravel(), (0.5 * rules.likeness * alike).cpu().double().numpy().ravel()
    )


def unary(measured: MetalEvidence, allowed: Tensor, rules: MetalRules) -> Tensor:
    """What metal is better than dielectric for each Gaussian by itself, in nats [N].

    Args:
        allowed: [N] bool, those that may be metals unless the user says so.
    """
    nats = measured.views * measured.ratio - (measured.views + 1) * rules.prior
    nats = torch.where(allowed, nats.clamp(-rules.trust, rules.trust), torch.full_like(nats, -INFINITE))
    words = (measured.labels[:, 1] > measured.labels[:, 0]).to(nats) * 2 - 1
    return torch.where(measured.labels.sum(dim=1) > LEAST_PIXELS, words * INFINITE, nats)


def minimum_cut(nats: NDArray[np.float64], graph: Graph) -> NDArray[np.bool_]:
    """The x [N] of least energy; of several the one with the fewest metals."""
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
    """Those of the metals whose pieces lower the energy by more than a piece costs."""
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
    """Metalness [N] of the Gaussians, the mean over several priors of the minimum of the energy; see the module's text.

    Args:
        allowed: [N] bool, those that may be metals unless the user says so.
        priors: shares of the prior. With one, a Gaussian is a metal (1) or a dielectric (0); with more it is between
            them where the priors decide differently.
    """
    graph = neighbor_graph(gaussians, measured, rules)
    metalness = np.zeros(len(allowed), dtype=np.float32)
    for share in priors:
        nats = unary(measured, allowed, replace(rules, prior=share * rules.prior)).cpu().double().numpy()
        metalness += surfaces(minimum_cut(nats, graph), nats, graph, rules.surface)
    return torch.from_numpy(metalness / len(priors)).to(allowed.device)
