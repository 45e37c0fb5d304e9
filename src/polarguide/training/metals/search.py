"""The search for metals in a training: when it looks, how it decides, and what it tells the user.

Seeds begin, likely neighbors join, and small or unsure regions are dropped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from polarguide.capture import Scene, View
from polarguide.capture.view import listed
from polarguide.core.system import UNBOUNDED, MemoryBound
from polarguide.gaussians.gaussians import Gaussians
from polarguide.gaussians.initialize import far_away
from polarguide.raster import Backend, Rasterize
from polarguide.shading.gbuffer import render
from polarguide.shading.model import Light, ShadingModel
from polarguide.training.distributed import Ranks
from polarguide.training.metals.evidence import Evidence, evidence
from polarguide.training.metals.observations import contradicted, evenly
from polarguide.training.recipe import Recipe
from polarguide.training.rules import Limits, MetalRules
from polarguide.training.settings import ResolvedSettings
from polarguide.training.state import TrainingState


def decide(measured: Evidence, was: Tensor, allowed: Tensor, rules: MetalRules) -> Tensor:
    """Which Gaussians are metals, [N] bool: hysteresis thresholding on the graph of neighbors.

    Seeds have evidence above ``begin``, or above ``stay`` if they were metals before; the others of those have to join
    again, or a metal would creep on over its surroundings. Regions grow to neighbors with evidence above ``proceed``.
    Isolated Gaussians and regions with few seeds are dropped, and holes are filled. The user's labels override all.

    Args:
        was: [N] bool, metals until now. allowed: [N] bool, those that may be.
    """
    labeled = measured.labels.sum(dim=1) > rules.least_weight
    labeled_metal = labeled & (measured.labels[:, 1] > measured.labels[:, 0])
    allowed = allowed & ~labeled & (measured.tint > rules.least_tint)
    able = allowed & (measured.misfit > rules.proceed_misfit) & (measured.support > rules.least_support)
    no_dielectric = measured.misfit > rules.begin_misfit
    surely = labeled_metal | (able & no_dielectric & (measured.ratio > rules.begin))
    begun = surely | (able & was & (measured.ratio > rules.stay))
    metal = _regions(measured, surely, begun, able & (measured.ratio > rules.proceed), rules)
    surely = able & no_dielectric & _obliquely(measured, rules.begin_oblique)
    likely = able & _obliquely(measured, rules.proceed_oblique)
    metal |= _regions(measured, surely, surely | (was & likely), likely, rules)
    # Nothing is known of what hardly any view shows, and its evidence is 0: among metals, it is one.
    among = allowed & (measured.ratio > rules.among)
    return labeled_metal | _grown(measured, metal, among, rules.majority, rules.filling, rules.nearest)


def _obliquely(measured: Evidence, limits: Limits) -> Tensor:
    """Whether so much is polarized at 45 degrees that it tells of metal, and explains the metal's misfit."""
    much = (measured.oblique > limits.oblique) & (measured.oblique * measured.brightness > limits.light)
    return (
        much
        & (measured.metal_misfit**2 < limits.times * measured.oblique**2)
        & (measured.ratio > limits.ratio)
    )


def _regions(measured: Evidence, surely: Tensor, metal: Tensor, likely: Tensor, rules: MetalRules) -> Tensor:
    """Metals [N]: ``metal`` grown over ``likely``, in connected regions with enough seeds that are sure."""
    metal = _grown(measured, metal, likely, rules.crowd, rules.rounds, rules.nearest)
    metal = metal & (_share_of_nearest(measured, metal, rules.nearest) > rules.alone)
    touching = measured.alike[:, : rules.nearest] > rules.touching
    return metal & _sure_enough(measured.near[:, : rules.nearest], touching, metal, surely, rules)


def _share_of_nearest(measured: Evidence, metal: Tensor, nearest: int) -> Tensor:
    """Share [N] of metals among the nearest of each, by how alike they are."""
    counts = measured.alike[:, :nearest]
    return (metal[measured.near[:, :nearest]] * counts).sum(dim=1) / counts.sum(dim=1).clamp(min=1e-6)


def _grown(
    measured: Evidence, metal: Tensor, likely: Tensor, share: float, rounds: int, nearest: int
) -> Tensor:
    """``metal`` [N], and what is ``likely`` and has more than this share of metals among its nearest, over and over."""
    for _ in range(rounds):
        grown = metal | (likely & (_share_of_nearest(measured, metal, nearest) > share))
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


@torch.no_grad()
def light_gain(
    gaussians: Gaussians,
    light: Light,
    views: Sequence[View],
    rasterize: Rasterize,
    shading: ShadingModel,
    rules: MetalRules,
    memory: MemoryBound = UNBOUNDED,
) -> float:
    """By how much the light should be brighter, as the first metals show it.

    Dielectrics fix the product of strength and light alone. Metals, whose reflectance is known, fix the light.

    Returns:
        The median of what they show over what is rendered of them; 1 without views and where they are hardly seen. Not
        so little that strengths would have to exceed 1.
    """
    ratios, pixels = [], 0
    for view in memory.between(evenly(views, rules.gain_views)):
        photograph = view.photograph().to(gaussians["means"].device).flatten(0, 1)
        metal = render(gaussians, view.camera, rasterize, shading=shading, light=light).metal
        pixels += len(photograph)
        if metal is None:
            continue
        clear = (metal.share > rules.gain_share) & ~(view.saturated | view.invalid).to(
            photograph.device
        ).flatten()[metal.pixels]
        rendered = metal.specular[clear].mean(dim=1) / metal.share[clear]
        ratios.append(((photograph[metal.pixels[clear]].mean(dim=1) + 1e-3) / (rendered + 1e-3)).log())
    ratio = torch.cat(ratios) if ratios else gaussians["means"].new_zeros(0)
    if not len(ratio) or len(ratio) < rules.gain_pixels * pixels:
        return 1.0
    body = gaussians["metalness"] == 0
    least = (
        torch.quantile(shading.strength(gaussians)[body], 0.9) if bool(body.any()) else ratio.new_tensor(0.1)
    )
    return float(ratio.median().exp().clamp(min=float(least), max=rules.most_gain))


class MetalSearch:
    """Finds metals at the refreshes of the priors.

    Args:
        scene: the capture. recipe: says between which shares of the steps metals are looked for.
        settings: the user's choices. shading: the recipe's, for the run's refractive index.
        backend: device and rasterizer. ranks: the processes that share the work.
        warn: receives messages for the user. memory: gives back what was freed of each view that is looked at.
    """

    def __init__(
        self,
        scene: Scene,
        recipe: Recipe,
        settings: ResolvedSettings,
        shading: ShadingModel,
        backend: Backend,
        ranks: Ranks,
        warn: Callable[[str], None],
        memory: MemoryBound,
    ) -> None:
        self._scene, self._shading = scene, shading
        self._between, self._rules = recipe.metals, recipe.metal_rules
        self._index, self._backend, self._ranks, self._warn = settings.refractive_index, backend, ranks, warn
        self._memory = memory
        self._on = shading.knows_metals and settings.materials == "auto"
        self._told = False

    def is_due(self, share: float) -> bool:
        """Whether a refresh after this share of the steps looks for metals."""
        first, last = self._between
        return self._on and first <= share < last

    def warn_if_never(self, refreshes: Iterable[float]) -> None:
        """Say so where the user names materials and no refresh is due, of those after these shares of the steps.

        Recipes that never refresh their priors, such as controls, do not look for metals and get no warning.
        """
        if not self._on or not any(_names_metals(view) for view in self._scene.train_views):
            return
        shares = list(refreshes)
        if shares and not any(map(self.is_due, shares)):
            first, last = (100 * share for share in self._between)
            self._warn(
                f"materials/ is read at refreshes of the priors between {first:.0f} and {last:.0f} % of the steps. "
                "A training this short has none there, and takes everything for dielectric. Take more steps."
            )

    @torch.no_grad()
    def look(self, state: TrainingState, views: Sequence[View]) -> None:
        """Decide which Gaussians are metals, and begin with what was measured of those that are new."""
        if not any(view.is_determined or view.materials is not None for view in views):
            return
        gaussians, rasterize = state.gaussians, self._backend.rasterize
        measured = evidence(gaussians, views, rasterize, self._index, self._rules, self._memory)
        if not self._told and (
            wrong := contradicted(gaussians, views, rasterize, measured.labels, self._rules, self._memory)
        ):
            self._told = True
            names = listed([f"materials/{name}.png" for name in wrong])
            self._warn(
                f"other views contradict {names} on {100 * max(wrong.values()):.0f} % of what is said there, at most: "
                "dielectric in one view, metal in another. The larger part counts; look at these files."
            )
        centers = torch.stack([view.camera.center for view in self._scene.train_views])
        near = ~far_away(gaussians["means"].detach().cpu(), self._scene.points, centers, self._rules.reach)
        was = gaussians["metalness"] > 0
        metal = decide(measured, was, near.to(was.device), self._rules).float()
        reflectance = measured.reflectance
        for values in (metal, reflectance):
            self._ranks.broadcast(values)
        determined = [view for view in views if view.is_determined]
        gain = partial(
            light_gain,
            gaussians,
            state.light,
            determined,
            rasterize,
            self._shading,
            self._rules,
            self._memory,
        )
        self._shading.become_metal(gaussians, state.light, metal > 0, reflectance, gain)
        del measured
        self._memory.clear()


def _names_metals(view: View) -> bool:
    """Whether the user says of a view which of what it shows is a metal, or none."""
    return view.materials is not None and bool(((view.materials == 1) | (view.materials == 2)).any())
