"""The targets of training views: made when a step first needs them, kept between steps on the backend's device."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence

import torch
from torch import Tensor

from polarguide.capture import View
from polarguide.capture.variants import SmallerViews, empty_pixels
from polarguide.geometry.camera import Camera
from polarguide.optics.color import srgb_encode
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.training.context import TrainingContext
from polarguide.training.flat import Flat, flat_surfaces
from polarguide.training.losses import Weights
from polarguide.training.metals.observations import index_picture, metalness_share
from polarguide.training.priors import Unguided, unguided, view_priors
from polarguide.training.recipe import Priors, Recipe
from polarguide.training.storage import Entry, Packed, packed, stored_values
from polarguide.training.targets import PartialView, StepTargets, ViewPriors


def holds(entry: Entry, fields: frozenset[str]) -> bool:
    """Whether an entry has all that is read; of the normal and its candidates it has one."""
    missing = fields - entry.keys()
    return not missing or (len(missing) == 1 and missing < {"normal", "candidates"})


def pack_priors(priors: ViewPriors, fields: Collection[str]) -> Entry:
    """The priors that terms read, and all those of which no term is known to read."""
    entry = {}
    for name, values in vars(priors).items():
        if isinstance(values, Tensor) and (name in fields or name not in Weights.known_priors()):
            entry[name] = packed(values[1:]) if name == "stokes" else packed(values)  # no term reads S0
    if priors.candidates is not None:
        entry.pop("normal", None)  # each step chooses
    return entry


def unpack_priors(entry: Entry, camera: Camera, settings: Priors) -> ViewPriors:
    """Return the priors of an entry; fields that were not kept are ``ABSENT``.

    Args:
        entry: by ``pack_priors``. camera: camera of the view. settings: settings of the priors.
    """
    values = {name: stored_values(stored) for name, stored in entry.items()}
    if "stokes" in values:
        values["stokes"] = torch.nn.functional.pad(
            values["stokes"], (0, 0, 0, 0, 0, 0, 1, 0), value=torch.nan
        )
    return ViewPriors(
        camera, azimuth_share=settings.azimuth_share, chromatic_share=settings.chromatic_share, **values
    )


KINDS = ("photograph", "unguided", "priors")
"""What is kept of a view."""


class Feed:
    """The training views at the size of a step, and what their renderings are compared with.

    Where the capture's pictures are large, the first steps look at smaller ones, as the recipe says.

    Args:
        context: context of the training.
    """

    def __init__(self, context: TrainingContext) -> None:
        self._context = context
        self._backend = context.backend
        self._settings = context.recipe.priors
        self._index = context.settings.refractive_index
        self._store = context.store
        self._memory = context.memory
        views = context.views
        self._until = coarse_steps(context.recipe, views, context.settings.steps)
        small = SmallerViews(views, context.recipe.coarse.factor) if self._until else views
        self._views = {"small ": small, "": views}
        self._flat: dict[str, dict[str, Flat]] = {}  # by the size of the pictures, as far as needed
        self._partial: dict[tuple[str, str], PartialView] = {}

    def _size(self, step: int) -> str:
        """Prefix of the keys of stored entries for a step."""
        return "small " if step < self._until else ""

    def views(self, step: int) -> Sequence[View]:
        """The views of a step."""
        return self._views[self._size(step)]

    def forget(self, names: Collection[str]) -> None:
        """Make the targets of these views anew: their exposures have changed."""
        for size, name in itertools.product(self._views, names):
            self._partial.pop((size, name), None)
            for kind in KINDS:
                self._store.drop(size + kind, name)

    def refresh_priors(self) -> None:
        """Make the priors of all views anew: there is another guide."""
        for size in self._views:
            self._store.drop(size + "priors")

    def targets(
        self, step: int, view: View, weights: Weights, guide: Mapping[str, Tensor] | None
    ) -> StepTargets:
        """Targets of the rendering of one of a step's views.

        Args:
            weights: weights of the stage, which say what its terms read.
            guide: Gaussians whose normals resolve what polarization leaves open; needed where a term reads priors.
        """
        size = self._size(step)
        priors = None
        if step == self._until:  # what was kept of smaller pictures goes
            self._partial = {key: entry for key, entry in self._partial.items() if key[0] == size}
            for kind in KINDS:
                self._store.drop("small " + kind)
        if weights.priors and view.is_determined:
            assert guide is not None
            priors = self._priors(size, view, weights.fields_read, guide)
        entry = self._store.get(size + "photograph", view.name, lambda: self._photograph(view))
        valid, empty = (entry[name].codes.float() if name in entry else None for name in ("valid", "empty"))
        if view.is_determined:
            return StepTargets(view.camera, stored_values(entry["picture"]), valid, empty, priors=priors)
        if (size, view.name) not in self._partial:
            self._partial[size, view.name] = PartialView.of(view, self._backend.device)
        partial = self._partial[size, view.name]
        return StepTargets(view.camera, partial.shown, valid, empty, partial)

    def _photograph(self, view: View) -> Entry:
        """The photograph as displayed, where it counts, and where it shows nothing."""
        device = self._backend.device
        entry = {"picture": packed(srgb_encode(view.photograph().clamp(0, 1)).to(device))}
        if bool(view.invalid.any()):
            entry["valid"] = Packed((~view.invalid).to(device))
        if self._context.black:
            entry["empty"] = Packed(empty_pixels(view).to(device))
        return entry

    def _priors(
        self, size: str, view: View, fields: frozenset[str], guide: Mapping[str, Tensor]
    ) -> ViewPriors:
        """The fields of the priors of a view that determines its Stokes vectors."""

        def make() -> Entry:
            self._memory.clear()
            entry = self._new_priors(size, view, fields, guide)
            self._memory.clear()  # before there is a picture, which takes memory, too
            return entry

        entry = self._store.get(size + "priors", view.name, make)
        if not holds(entry, fields):  # the stage reads more than the one before
            self._store.drop(size + "priors", view.name)
            entry = self._store.get(size + "priors", view.name, make)
        return unpack_priors(entry, view.camera, self._settings)

    def _new_priors(
        self, size: str, view: View, fields: frozenset[str], frozen: Mapping[str, Tensor]
    ) -> Entry:
        with torch.no_grad():
            guide = render(frozen, view.camera, self._backend.rasterize, RenderRequest(sh_degree=0)).normal
        assert guide is not None
        metal = metalness_share(frozen, view.camera, self._backend.rasterize)

        def make() -> Entry:
            fields = unguided(view.to(guide.device), self._settings, self._index)._asdict()
            return {name: Packed(values) for name, values in fields.items() if values is not None}

        # It can be had again for a part of the work, so that it is not worth a file.
        entry = self._store.get(size + "unguided", view.name, make, disposable=True)
        unguided_part = Unguided(**{name: part.codes for name, part in entry.items()})
        flat = self._flat_surfaces(size).get(view.name)
        own = index_picture(frozen, view.camera, self._backend.rasterize, self._index)
        index = self._index if own is None else own
        return pack_priors(
            view_priors(view, guide, self._settings, index, unguided_part, metal, flat), fields
        )

    def _flat_surfaces(self, size: str) -> dict[str, Flat]:
        """Flat surfaces of all views, found when the first priors are needed."""
        if size not in self._flat:
            views = self._views[size] if self._settings.flat else ()
            # On the CPU, so that it is the same wherever one trains.
            surfaces = flat_surfaces(self._memory.between(views), self._index, self._settings.flat_rules)
            self._flat[size] = {name: flat.to(self._backend.device) for name, flat in surfaces.items()}
        return self._flat[size]


def coarse_steps(recipe: Recipe, views: Sequence[View], steps: int) -> int:
    """Steps at the beginning that look at smaller pictures; 0 where those of the capture are small."""
    most = max((view.camera.width * view.camera.height for view in views), default=0)
    return round(recipe.coarse.share * steps) if most > recipe.coarse.pixels else 0
