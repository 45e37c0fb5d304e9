"""The search for metals in a training: when it looks, what it looks at, and what it tells the user."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial

import torch

from polarguide.capture import Scene, View
from polarguide.capture.view import listed
from polarguide.gaussians.initialize import far_away
from polarguide.raster import Backend
from polarguide.shading.model import ShadingModel
from polarguide.system import MemoryBound
from polarguide.training.distributed import Ranks
from polarguide.training.metals.decision import decide
from polarguide.training.metals.evidence import evidence
from polarguide.training.metals.gain import light_gain
from polarguide.training.metals.words import contradicted
from polarguide.training.recipe import Recipe
from polarguide.training.settings import ResolvedSettings
from polarguide.training.state import TrainingState


class MetalSearch:
    """Finds metals at the refreshes of the priors.

    Args:
        scene: the capture. recipe: says between which shares of the steps metals are looked for.
        settings: the user's choices. shading: the recipe's, for the run's refractive index.
        backend: device and rasterizer. ranks: the processes that share the work.
        warn: told what the user should know. memory: gives back what was freed of each view that is looked at.
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

        Nothing is said of recipes that never refresh their priors, such as controls: they look for no metal.
        """
        if not self._on or not any(_names_metals(view) for view in self._scene.train_views):
            return
        shares = list(refreshes)
        if shares and not any(map(self.is_due, shares)):
            first, last = (100 * share for share in self._between)
            self._warn(
                f"materials/ is heeded at refreshes of the priors between {first:.0f} and {last:.0f} % of the steps. "
                "A training this short has none there, and takes everything for dielectric. Take more steps."
            )

    @torch.no_grad()
    def look(self, state: TrainingState, views: Sequence[View]) -> None:
        """Decide which Gaussians are metals, and begin with what was measured of those that are new."""
        if not any(view.is_determined or view.materials is not None for view in views):
            return
        gaussians, rasterize = state.gaussians, self._backend.rasterize
        found = evidence(gaussians, views, rasterize, self._index, self._rules, self._memory)
        if not self._told and (
            wrong := contradicted(gaussians, views, rasterize, found.said, self._rules, self._memory)
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
        metal = decide(found, was, near.to(was.device), self._rules).float()
        reflectance = found.reflectance
        for values in (metal, reflectance):
            self._ranks.broadcast(values)
        shown = [view for view in views if view.is_determined]
        gain = partial(
            light_gain, gaussians, state.light, shown, rasterize, self._shading, self._rules, self._memory
        )
        self._shading.become_metal(gaussians, state.light, metal > 0, reflectance, gain)
        del found
        self._memory.clear()


def _names_metals(view: View) -> bool:
    """Whether the user says of a view which of what it shows is a metal, or none."""
    return view.materials is not None and bool(((view.materials == 1) | (view.materials == 2)).any())
