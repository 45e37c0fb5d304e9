"""The search for metals in a training: when it looks, what it changes, and what it tells the user."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from polarguide.capture import Scene, View
from polarguide.capture.view import listed
from polarguide.core.system import UNBOUNDED, MemoryBound
from polarguide.gaussians.gaussians import Gaussians
from polarguide.gaussians.initialize import far_away
from polarguide.raster import Backend, Rasterize
from polarguide.shading.gbuffer import render
from polarguide.shading.metal import become_metal
from polarguide.shading.model import Light, ShadingModel
from polarguide.training.distributed import Ranks
from polarguide.training.metals.cut import decide
from polarguide.training.metals.evidence import Evidence, evidence
from polarguide.training.metals.observations import contradicted, evenly
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
        self._scene = scene
        self._shading = shading
        self._between = recipe.metals
        self._rules = recipe.metal_rules
        self._limits = recipe.metal_views
        self._index = settings.refractive_index
        self._backend = backend
        self._ranks = ranks
        self._warn = warn
        self._memory = memory
        self._on = "metalness" in shading.parameters and settings.materials == "auto"
        self._told = False
        self._steps = settings.steps
        self._refreshes = refreshes(recipe, settings.steps)
        self._looks = looks(recipe, settings)

    def is_due(self, step: int) -> bool:
        """Whether a refresh at this step looks for metals."""
        return self._on and _within(self._between, step, self._steps)

    def warn_if_never(self) -> None:
        """Say so where the user names materials and no refresh is due.

        Recipes that never refresh their priors, such as controls, do not look for metals and get no warning.
        """
        if not self._on or not any(_names_metals(view) for view in self._scene.train_views):
            return
        if self._refreshes and not self._looks:
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
        gaussians = state.gaussians
        rasterize = self._backend.rasterize
        measured = self._measure(state, views)
        if not self._told and (
            wrong := contradicted(gaussians, views, rasterize, measured.labels, self._limits, self._memory)
        ):
            self._told = True
            names = listed([f"materials/{name}.png" for name in wrong])
            self._warn(
                f"other views contradict {names} on {100 * max(wrong.values()):.0f} % of what is said there, at most: "
                "dielectric in one view, metal in another. The larger part counts; look at these files."
            )
        metal = decide(
            measured, gaussians, self._allowed(state, views), self._rules, self._priors(state.step)
        )
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
            self._limits,
            self._memory,
        )
        cubemap = self._shading.radiance_cubemap
        if cubemap is not None:
            become_metal(gaussians, state.light[cubemap.name], cubemap.radiance, metal, reflectance, gain)
        del measured
        self._memory.clear()

    @torch.no_grad()
    def undecided(self, state: TrainingState, views: Sequence[View]) -> Tensor | None:
        """Gaussians [N] bool that are dielectrics by the prior alone: what was measured of them would make them metals.

        None where a training does not look for metals, or no view determines the Stokes vector.
        """
        if not self._looks or not any(view.is_determined for view in views):
            return None
        gaussians = state.gaussians
        measured = self._measure(state, views)
        without = decide(measured, gaussians, self._allowed(state, views), self._rules, (0.0,))
        return (without > 0) & (gaussians["metalness"] == 0)

    def _measure(self, state: TrainingState, views: Sequence[View]) -> Evidence:
        rasterize = self._backend.rasterize
        return evidence(
            state.gaussians, views, rasterize, self._index, self._rules, self._limits, self._memory
        )

    def _allowed(self, state: TrainingState, views: Sequence[View]) -> Tensor:
        """Gaussians [N] bool that may be metals unless the user says so: none where nothing tells how far a label
        reaches.
        """
        means = state.gaussians["means"].detach()
        centers = torch.stack([view.camera.center for view in self._scene.train_views])
        far = far_away(means.cpu(), self._scene.points, centers, self._limits.reach).to(means.device)
        return ~far & any(view.is_determined for view in views)

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
    if "metalness" not in recipe.shading.parameters or settings.materials != "auto":
        return []
    steps = settings.steps
    return [step for step in refreshes(recipe, steps) if _within(recipe.metals, step, steps)]


def _within(shares: tuple[float, float], step: int, steps: int) -> bool:
    return shares[0] <= step / steps < shares[1]


def _names_metals(view: View) -> bool:
    """Whether the user says of a view which of what it shows is a metal, or none."""
    return view.materials is not None and bool(((view.materials == 1) | (view.materials == 2)).any())
