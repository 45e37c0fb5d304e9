"""Which Gaussians are metals, by the evidence: what is sure begins, what is likely joins, small or unsure pieces go."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from polarguide.training.metals.evidence import Evidence
from polarguide.training.metals.words import LEAST_SEEN

# Share of the cameras' distance from the middle of the points within which metals are looked for: what is farther away
# is behind the subject in all views from the other side.
REACH = 0.5
NEAREST = 16
# Share of the neighbors that has to be known.
LEAST_SUPPORT = 0.35
# Evidence from which on a neighborhood begins to be metal, and goes on where enough of the nearest are.
BEGIN, CONTINUE, STAY = 2.2, 0.4, 1.3
BEGIN_MISFIT, CONTINUE_MISFIT = 0.05, 0.02
CROWD, ALONE = 0.12, 0.2
# Evidence down to which what lies among metal joins it, and from which share of its nearest on: what mirrors something
# even could be either.
AMONG, MAJORITY = -0.7, 0.4
# Of a piece that hangs together, the share, and how many, that have to be surely metal. True ones had 0.25 to 0.56, a
# plate in polarized light 0.02 to 0.13. Neighbors hang together from this likeness of their normals on.
SURE_SHARE, FEWEST_SURE = 0.18, 10
TOUCHING = 0.2
# No metal reflects one color less than about 0.38 times another (gold, blue and red). A body whose colors, over those
# of the scene, differ by more than this is none.
LEAST_TINT = 0.25
ROUNDS, FILLING = 12, 40


class Limits(NamedTuple):
    """From which on a neighborhood is metal in polarized light.

    Attributes:
        oblique: what is polarized at 45 degrees, as a share of what is seen. light: of the scene's mean light.
        times: how many times its square that of the metal's misfit may be.
        ratio: evidence below which a dielectric explains more.
    """

    oblique: float
    light: float
    times: float
    ratio: float


BEGIN_OBLIQUELY, CONTINUE_OBLIQUELY = Limits(0.03, 0.08, 4.0, 0.0), Limits(0.02, 0.02, 6.0, -0.5)


def decide(found: Evidence, was: Tensor, allowed: Tensor) -> Tensor:
    """Which Gaussians are metals, [N] bool.

    What is surely metal begins; what is likely joins where enough of its nearest neighbors are. What was metal before
    and still is rather plainly begins, too; the rest of it has to join again, or a metal would creep on over what lies
    beside it. Single ones are none, and neither are pieces of which little is sure: a metal is plainly one over much of
    its surface. What lies among metal joins even where a dielectric explains it a little better. What the user says of
    a Gaussian is so.

    Args:
        was: [N] bool, metal until now. allowed: [N] bool, those that may be.
    """
    told = found.said.sum(dim=1) > LEAST_SEEN
    told_metal = told & (found.said[:, 1] > found.said[:, 0])
    allowed = allowed & ~told & (found.tint > LEAST_TINT)
    able = allowed & (found.misfit > CONTINUE_MISFIT) & (found.support > LEAST_SUPPORT)
    no_dielectric = found.misfit > BEGIN_MISFIT
    surely = told_metal | (able & no_dielectric & (found.ratio > BEGIN))
    begun = surely | (able & was & (found.ratio > STAY))
    metal = _pieces(found, surely, begun, able & (found.ratio > CONTINUE))
    surely = able & no_dielectric & _obliquely(found, BEGIN_OBLIQUELY)
    likely = able & _obliquely(found, CONTINUE_OBLIQUELY)
    metal |= _pieces(found, surely, surely | (was & likely), likely)
    # Of what hardly any view shows nothing is known, and the ratio is 0: among metal, it is metal.
    return told_metal | _grown(found, metal, allowed & (found.ratio > AMONG), MAJORITY, FILLING)


def _obliquely(found: Evidence, limits: Limits) -> Tensor:
    """Whether so much is polarized at 45 degrees that it tells of metal, and explains the metal's misfit."""
    much = (found.oblique > limits.oblique) & (found.oblique * found.brightness > limits.light)
    return much & (found.metal_misfit**2 < limits.times * found.oblique**2) & (found.ratio > limits.ratio)


def _pieces(found: Evidence, surely: Tensor, metal: Tensor, likely: Tensor) -> Tensor:
    """What is metal [N] where ``metal`` begins and ``likely`` joins, in pieces of which enough is sure."""
    metal = _grown(found, metal, likely, CROWD, ROUNDS)
    metal = metal & (_share_of_nearest(found, metal) > ALONE)
    touching = found.alike[:, :NEAREST] > TOUCHING
    return metal & _sure_enough(found.near[:, :NEAREST], touching, metal, surely)


def _share_of_nearest(found: Evidence, metal: Tensor) -> Tensor:
    """Share [N] of metals among the nearest of each, by how alike they are."""
    counts = found.alike[:, :NEAREST]
    return (metal[found.near[:, :NEAREST]] * counts).sum(dim=1) / counts.sum(dim=1).clamp(min=1e-6)


def _grown(found: Evidence, metal: Tensor, likely: Tensor, share: float, rounds: int) -> Tensor:
    """``metal`` [N], and what is ``likely`` and has more than this share of metals among its nearest, over and over."""
    for _ in range(rounds):
        grown = metal | (likely & (_share_of_nearest(found, metal) > share))
        if bool((grown == metal).all()):
            break
        metal = grown
    return metal


def _sure_enough(nearest: Tensor, touching: Tensor, metal: Tensor, surely: Tensor) -> Tensor:
    """Which metals [N] lie in a connected piece of them of which enough is sure."""
    near, inside, sure = nearest.cpu().numpy(), metal.cpu().numpy(), surely.cpu().numpy()
    edges = touching.cpu().numpy() & inside[:, None] & inside[near]
    rows, columns = np.nonzero(edges)
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, near[rows, columns])), shape=(len(inside),) * 2)
    pieces, piece = connected_components(graph, directed=False)
    counts = np.bincount(piece, minlength=pieces)
    certain = np.bincount(piece[sure & inside], minlength=pieces)
    enough = (certain >= FEWEST_SURE) & (certain >= SURE_SHARE * counts)
    return torch.from_numpy(enough[piece]).to(metal.device)
