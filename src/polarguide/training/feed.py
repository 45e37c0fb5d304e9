"""Targets of training views, computed when a step first needs them and cached between steps."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence

import torch
from torch import Tensor

from polarguide.capture import View
from polarguide.capture.exposures import Exposure
from polarguide.capture.variants import SmallerViews, empty_pixels
from polarguide.geometry.camera import Camera
from polarguide.optics.color import srgb_encode
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.training.context import TrainingContext, seeded
from polarguide.training.losses import Weights
from polarguide.training.metals.observations import index_picture, metalness_share
from polarguide.training.priors import Flat, Unguided, flat_surfaces, unguided, view_priors
from polarguide.training.recipe import Priors, Recipe
from polarguide.training.storage import Entry, Packed, packed, stored_values
from polarguide.training.targets import PartialView, StepTargets, ViewPriors

KINDS = ("photograph", "unguided", "priors")
"""Kinds of cached entries of a view."""


def is_complete(entry: Entry, fields: frozenset[str]) -> bool:
    """Return True if an entry has all fields. The normal may be replaced by its candidates."""
    missing = fields - entry.keys()
    return not missing or (len(missing) == 1 and missing < {"normal", "candidates"})


def pack_priors(priors: ViewPriors, fields: Collection[str]) -> Entry:
    """Pack the requested fields of priors for the cache.

    Fields that no built-in term reads are always packed.
    """
    selected = {
        name: values
        for name, values in vars(priors).items()
        if isinstance(values, Tensor) and (name in fields or name not in Weights.known_priors())
    }
    if priors.candidates is not None:
        selected.pop("normal", None)  # each step chooses among the candidates
    # No term reads S0.
    return {name: packed(values[1:] if name == "stokes" else values) for name, values in selected.items()}


def unpack_priors(entry: Entry, camera: Camera, settings: Priors) -> ViewPriors:
    """Return the priors of a cache entry. Fields that the entry lacks are ``ABSENT``.

    Args:
        entry: result of ``pack_priors``.
        camera: camera of the view.
        settings: settings of the priors.
    """
    values = {name: stored_values(stored) for name, stored in entry.items()}
    if "stokes" in values:
        values["stokes"] = torch.nn.functional.pad(
            values["stokes"], (0, 0, 0, 0, 0, 0, 1, 0), value=torch.nan
        )
    return ViewPriors(
        camera, azimuth_share=settings.azimuth_share, chromatic_share=settings.chromatic_share, **values
    )


class Feed:
    """Source of the training views and their targets, in the resolution of each step.

    If pictures are large, the first steps use smaller copies, as the recipe specifies.

    Args:
        context: context of the training.

    Attributes:
        guide: Gaussians whose normals resolve the ambiguities of polarization; empty before the first refresh.
    """

    def __init__(self, context: TrainingContext) -> None:
        self.guide: Mapping[str, Tensor] = {}
        self._context = context
        self._backend = context.backend
        self._settings = context.recipe.priors
        self._index = context.settings.refractive_index
        self._store = context.store
        views = context.views
        self._until = coarse_steps(context.recipe, views, context.settings.steps)
        small = SmallerViews(views, context.recipe.coarse.factor) if self._until else views
        self._views = {"small ": small, "": views}
        self._flat: dict[str, dict[str, Flat]] = {}  # by size
        self._partial: dict[tuple[str, str], PartialView] = {}
        self._exposures: dict[str, tuple[Exposure, ...]] = {}

    def _size(self, step: int) -> str:
        """Return the prefix of the keys of cached entries for a step."""
        return "small " if step < self._until else ""

    def view_at(self, step: int) -> View:
        """Return the view of a step.

        Every epoch visits every training view once, in a new order.
        """
        views = self._views[self._size(step)]
        epoch, place = divmod(step, len(views))
        order = torch.randperm(len(views), generator=seeded(self._context.settings.seed, 4, epoch))
        view = views[int(order[place])]
        exposures = self._exposures.get(view.name, view.exposures)
        return view if exposures == view.exposures else view.with_exposures(exposures)

    def set_exposures(self, exposures: Mapping[str, tuple[Exposure, ...]]) -> None:
        """Replace the exposures of views, by the name of the view. The targets of these views are computed again."""
        self._exposures.update(exposures)
        for size, name in itertools.product(self._views, exposures):
            self._partial.pop((size, name), None)
            for kind in KINDS:
                self._store.drop(size + kind, name)

    def refresh_priors(self) -> None:
        """Drop the priors of all views, so that they are computed again."""
        for size in self._views:
            self._store.drop(size + "priors")

    def targets(self, step: int, view: View, weights: Weights) -> StepTargets:
        """Return the targets of the rendering of a view.

        Args:
            step: number of the step.
            view: one of the views of the step.
            weights: weights of the stage, which determine the fields that are read.
        """
        size = self._size(step)
        priors = None
        if step == self._until:  # smaller pictures are not needed any more
            self._partial = {key: entry for key, entry in self._partial.items() if key[0] == size}
            for kind in KINDS:
                self._store.drop("small " + kind)
        determined = view.is_determined
        if weights.priors and determined:
            priors = self._priors(size, view, weights.fields_read)
        entry = self._store.get(size + "photograph", view.name) or self._photograph(size, view)
        valid, empty = (entry[name].codes.float() if name in entry else None for name in ("valid", "empty"))
        if determined:
            return StepTargets(view.camera, stored_values(entry["picture"]), valid, empty, priors=priors)
        if (size, view.name) not in self._partial:
            self._partial[size, view.name] = PartialView.of(view, self._backend.device)
        partial = self._partial[size, view.name]
        return StepTargets(view.camera, partial.shown, valid, empty, partial)

    def _photograph(self, size: str, view: View) -> Entry:
        """Compute and store the displayed photograph, and masks of its valid and of its empty pixels."""
        device = self._backend.device
        entry = {"picture": packed(srgb_encode(view.photograph().clamp(0, 1)).to(device))}
        if bool(view.invalid.any()):
            entry["valid"] = Packed((~view.invalid).to(device))
        if self._context.black:
            entry["empty"] = Packed(empty_pixels(view).to(device))
        self._store.keep(size + "photograph", view.name, entry)
        return entry

    def _priors(self, size: str, view: View, fields: frozenset[str]) -> ViewPriors:
        """Return the priors of a view that determines its Stokes vectors."""
        entry = self._store.get(size + "priors", view.name)
        if entry is None or not is_complete(entry, fields):  # a stage may read more than the previous one
            self._context.memory.clear()
            entry = self._compute_priors(size, view, fields)
            self._store.keep(size + "priors", view.name, entry)
            self._context.memory.clear()  # before the rendering, which needs memory as well
        return unpack_priors(entry, view.camera, self._settings)

    def _compute_priors(self, size: str, view: View, fields: frozenset[str]) -> Entry:
        rasterize = self._backend.rasterize
        with torch.no_grad():
            normal = render(self.guide, view.camera, rasterize, RenderRequest(sh_degree=0)).normal
        metal = metalness_share(self.guide, view.camera, rasterize)
        entry = self._store.get(size + "unguided", view.name)
        if entry is None:
            computed = unguided(view.to(normal.device), self._settings, self._index)._asdict()
            entry = {name: Packed(values) for name, values in computed.items() if values is not None}
            # Disposable, because recomputing this part is cheap compared to the priors and not worth a file.
            self._store.keep(size + "unguided", view.name, entry, disposable=True)
        precomputed = Unguided(**{name: part.codes for name, part in entry.items()})
        flat = self._flat_surfaces(size).get(view.name)
        indices = index_picture(self.guide, view.camera, rasterize, self._index)
        index = self._index if indices is None else indices
        priors = view_priors(view, normal, self._settings, index, precomputed, metal, flat)
        return pack_priors(priors, fields)

    def _flat_surfaces(self, size: str) -> dict[str, Flat]:
        """Return the flat surfaces of all views, which are found when priors are first needed."""
        if size not in self._flat:
            views = self._context.memory.between(self._views[size] if self._settings.flat else ())
            # On the CPU, so that the result is the same on every device.
            surfaces = flat_surfaces(views, self._index, self._settings.flat_rules)
            self._flat[size] = {name: flat.to(self._backend.device) for name, flat in surfaces.items()}
        return self._flat[size]


def coarse_steps(recipe: Recipe, views: Sequence[View], steps: int) -> int:
    """Return the number of first steps that use smaller pictures; 0 if all pictures are small."""
    largest = max((view.camera.width * view.camera.height for view in views), default=0)
    return round(recipe.coarse.share * steps) if largest > recipe.coarse.pixels else 0
