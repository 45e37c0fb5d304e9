"""The targets of training views: made when a step first needs them, kept between steps on the backend's device."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import torch
from torch import Tensor

from polarguide.capture import View
from polarguide.capture.background import empty_pixels
from polarguide.color import srgb_encode
from polarguide.raster import Backend
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.system import UNBOUNDED, MemoryBound
from polarguide.training.flat import Flat, flat_surfaces
from polarguide.training.indices import index_picture
from polarguide.training.losses import Weights
from polarguide.training.metals.looks import metalness_share
from polarguide.training.packing import (
    Entry,
    Packed,
    holds,
    pack_priors,
    packed,
    unpack_priors,
    unpacked,
)
from polarguide.training.priors import Unguided, unguided, view_priors
from polarguide.training.recipe import Priors
from polarguide.training.targets import PartialView, StepTargets, ViewPriors
from polarguide.training.view_store import ViewStore


class Feed:
    """Makes and keeps the targets of training views.

    Args:
        backend: device and rasterizer. priors: the recipe's. index: of refraction.
        black: whether nothing is behind the subject.
        store: keeps what is computed of the views. views: that are trained on.
        label: of what is kept; views of another size have another.
        memory: gives back what was freed before and after the priors of a view are made.
    """

    def __init__(
        self,
        backend: Backend,
        priors: Priors,
        index: float,
        store: ViewStore,
        views: Sequence[View],
        *,
        black: bool,
        label: str = "",
        memory: MemoryBound = UNBOUNDED,
    ) -> None:
        self._backend, self._settings, self._index, self._black = backend, priors, index, black
        self._store, self._views, self._memory = store, views, memory
        kinds = (label + kind for kind in ("photograph", "unguided", "priors"))
        self._photographs, self._unguided, self._priors = kinds
        self._flat: dict[str, Flat] | None = None
        self._partial: dict[str, PartialView] = {}

    def forget(self, names: Collection[str]) -> None:
        """Make the targets of these views anew: their exposures have changed."""
        for name in names:
            self._partial.pop(name, None)
            for kind in (self._photographs, self._unguided, self._priors):
                self._store.drop(kind, name)

    def clear(self) -> None:
        """Forget everything; it is made again where it is asked for."""
        self._partial.clear()
        for kind in (self._photographs, self._unguided, self._priors):
            self._store.drop(kind)

    def refresh_priors(self) -> None:
        """Make the priors of all views anew: there is another guide."""
        self._store.drop(self._priors)

    def targets(self, view: View, weights: Weights, guide: Mapping[str, Tensor] | None) -> StepTargets:
        """What a step compares the rendering of a view with.

        Args:
            weights: of the stage, which say what its terms read.
            guide: Gaussians whose normals resolve what polarization leaves open; needed where a term reads priors.
        """
        priors = None
        if weights.priors and view.is_determined:
            assert guide is not None
            priors = self._priors_of(view, weights.fields_read, guide)
        kept = self._store.get(self._photographs, view.name, lambda: self._photograph(view))
        valid, empty = (kept[name].codes.float() if name in kept else None for name in ("valid", "empty"))
        if view.is_determined:
            return StepTargets(view.camera, unpacked(kept["picture"]), valid, empty, priors=priors)
        if view.name not in self._partial:
            self._partial[view.name] = PartialView.of(view, self._backend.device)
        partial = self._partial[view.name]
        return StepTargets(view.camera, partial.shown, valid, empty, partial)

    def _photograph(self, view: View) -> Entry:
        """The photograph as displayed, where it counts, and where it shows nothing."""
        device = self._backend.device
        entry = {"picture": packed(srgb_encode(view.photograph().clamp(0, 1)).to(device))}
        if bool(view.invalid.any()):
            entry["valid"] = Packed((~view.invalid).to(device))
        if self._black:
            entry["empty"] = Packed(empty_pixels(view).to(device))
        return entry

    def _priors_of(self, view: View, fields: frozenset[str], guide: Mapping[str, Tensor]) -> ViewPriors:
        """The fields of the priors of a view that determines its Stokes vectors."""

        def make() -> Entry:
            self._memory.clear()
            entry = self._new_priors(view, fields, guide)
            self._memory.clear()  # before there is a picture, which takes memory, too
            return entry

        entry = self._store.get(self._priors, view.name, make)
        if not holds(entry, fields):  # the stage reads more than the one before
            self._store.drop(self._priors, view.name)
            entry = self._store.get(self._priors, view.name, make)
        return unpack_priors(entry, view.camera, self._settings)

    def _new_priors(self, view: View, fields: frozenset[str], frozen: Mapping[str, Tensor]) -> Entry:
        with torch.no_grad():
            guide = render(frozen, view.camera, self._backend.rasterize, RenderRequest(sh_degree=0)).normal
        assert guide is not None
        metal = metalness_share(frozen, view.camera, self._backend.rasterize)

        def make() -> Entry:
            found = unguided(view.to(guide.device), self._settings, self._index)._asdict()
            return {name: Packed(values) for name, values in found.items() if values is not None}

        # It can be had again for a part of the work, so that it is not worth a file.
        kept = self._store.get(self._unguided, view.name, make, disposable=True)
        known = Unguided(**{name: part.codes for name, part in kept.items()})
        flat = self._flat_surfaces().get(view.name)
        own = index_picture(frozen, view.camera, self._backend.rasterize, self._index)
        index = self._index if own is None else own
        return pack_priors(view_priors(view, guide, self._settings, index, known, metal, flat), fields)

    def _flat_surfaces(self) -> dict[str, Flat]:
        """Flat surfaces of all views, found when the first priors are asked for."""
        if self._flat is None:
            views = self._views if self._settings.flat else ()
            # On the CPU, so that it is the same wherever one trains.
            found = flat_surfaces(self._memory.between(views), self._index)
            self._flat = {name: flat.to(self._backend.device) for name, flat in found.items()}
        return self._flat
