"""The targets of training views: made when a step first needs them, kept between steps on the backend's device.

Stored data take two bytes a value, in memory up to a limit, beyond it in a file. Nobody has to clean up the file.
Whatever is kept can be made again to the same bits, so that neither the limit nor a file that is gone changes a result.

Targets are rounded to whole numbers of 1/32767 of the largest one of their picture, as soon as they are computed and
whatever the size of the scene, so that a result does not depend on where they were kept meanwhile. That is a hundredth
of a degree of a normal, and an eighth of a step of an 8-bit picture at full scale.
"""

from __future__ import annotations

import contextlib
import itertools
import tempfile
import weakref
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, NamedTuple

import torch
from torch import Tensor

from polarguide.capture import View
from polarguide.capture.variants import SmallerViews, empty_pixels
from polarguide.core.system import UNBOUNDED, MemoryBound
from polarguide.geometry.camera import Camera
from polarguide.optics.color import srgb_encode
from polarguide.raster import Backend
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.training.flat import Flat, flat_surfaces
from polarguide.training.losses import Weights
from polarguide.training.metals.observations import index_picture, metalness_share
from polarguide.training.priors import Unguided, unguided, view_priors
from polarguide.training.recipe import Priors, Recipe
from polarguide.training.targets import PartialView, StepTargets, ViewPriors

FULL = 32767


class Packed(NamedTuple):
    """A tensor as it is kept.

    Attributes:
        codes: int16, or of the tensor's own type where that was not coded.
        top: what the code 32767 stands for, a scalar; None: not coded.
    """

    codes: Tensor
    top: Tensor | None = None

    @property
    def bytes(self) -> int:
        """Size in bytes."""
        return self.codes.numel() * self.codes.element_size()


Entry = dict[str, Packed]
"""What is kept of a view, by name."""


def packed(values: Tensor) -> Packed:
    """Finite float32 values as whole numbers of 1/32767 of the largest absolute one; 0 and the largest stay exact."""
    top = values.abs().amax()
    top = torch.where(top == 0, torch.ones_like(top), top)
    return Packed((values * (FULL / top)).round_().to(torch.int16), top)


def unpacked(entry: Packed) -> Tensor:
    """The values, float32 where they were coded."""
    if entry.top is None:
        return entry.codes
    # A division by 32767 gives back a 1 exactly, a product with its inverse does not.
    values = entry.codes.to(torch.float32).div_(FULL)
    return values if entry.top.device.type == "cpu" and float(entry.top) == 1 else values.mul_(entry.top)


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
    """The priors again; what was not kept is not a number, in its shape.

    Args:
        entry: by ``pack_priors``. camera: camera of the view. settings: that they were computed with.
    """
    values = {name: unpacked(stored) for name, stored in entry.items()}
    device = next(iter(values.values())).device
    nothing = torch.full((), torch.nan, device=device)
    size = (camera.height, camera.width)
    for name in ("specular", "diffuse", "normal", "plane", "chromatic"):
        values.setdefault(name, nothing.expand(*size, 3))
    for name in ("separated", "weight", "chromatic_weight", "stokes_weight", "surface"):
        values.setdefault(name, nothing.expand(size))
    measured = values.pop("stokes", None)
    stokes = (
        nothing.expand(3, *size, 3)
        if measured is None
        else torch.nn.functional.pad(measured, (0, 0, 0, 0, 0, 0, 1, 0), value=torch.nan)
    )
    shares = {"azimuth_share": settings.azimuth_share, "chromatic_share": settings.chromatic_share}
    return ViewPriors(camera=camera, stokes=stokes, **values, **shares)  # type: ignore[arg-type]


ALIGNED = 64


@dataclass
class _Place:
    """Where in the file an entry is: its offset, the room there, and what to make of the bytes."""

    offset: int
    room: int
    parts: dict[str, tuple[torch.dtype, tuple[int, ...], torch.Tensor | None]] | None = None


class ViewStore:
    """Keeps entries by kind and view.

    Which of them lie in memory is decided as they come, and stays so: views are visited in changing order, in which
    what was used last is not what is used next, so that exchanging them would only write more.

    Args:
        limit: bytes of entries in memory; None: all.
        folder: for the file of the others. It has no name there, and is gone with the process; None: entries over the
            limit are not kept but made again.
        warn: receives a message where the file cannot be written; entries over the limit are then computed again.
    """

    def __init__(
        self,
        limit: int | None = None,
        folder: Path | None = None,
        warn: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._limit = limit
        self._folder = folder
        self._warn = warn
        self._entries: dict[tuple[str, str], Entry] = {}
        self._places: dict[tuple[str, str], _Place] = {}
        self._file: IO[bytes] | None = None
        self.in_memory = 0
        self.in_file = 0

    def get(self, kind: str, view: str, make: Callable[[], Entry], *, disposable: bool = False) -> Entry:
        """An entry; it is made where it is not kept.

        Args:
            kind, view: its name. make: makes it. disposable: over the limit it is made again, not put into the file.
        """
        key = (kind, view)
        entry = self._entries.get(key) or self._read(key)
        if entry is None:
            entry = make()
            self._keep(key, entry, disposable)
        return entry

    def drop(self, kind: str, view: str | None = None) -> None:
        """Forget the entries of a kind, or one of them.

        An entry that is made again takes its old place in the file if it still fits there. A larger one is put at the
        end, and its old place stays empty: entries only grow when a stage reads more than the one before.
        """
        for key in [key for key in self._entries if key[0] == kind and view in (None, key[1])]:
            self.in_memory -= _size(self._entries.pop(key))
        for key, place in self._places.items():
            if key[0] == kind and view in (None, key[1]):
                place.parts = None

    def close(self) -> None:
        """Forget everything."""
        self._entries.clear()
        self._places.clear()
        self.in_memory = self.in_file = 0
        if self._file is not None:
            self._file.close()
            self._file = None

    def _keep(self, key: tuple[str, str], entry: Entry, disposable: bool) -> None:
        size = _size(entry)
        if self._limit is None or self.in_memory + size <= self._limit:
            self._entries[key] = entry
            self.in_memory += size
        elif self._folder is not None and not disposable:
            try:
                self._write(key, entry, size)
            except OSError as error:
                self._places.pop(key, None)
                self._folder = None
                self._warn(
                    f"what a training keeps of its views cannot be put into a file ({error.strerror or error}): it is "
                    "computed again for every step, which is slow. Make room on the disk, or give more --memory."
                )

    def _write(self, key: tuple[str, str], entry: Entry, size: int) -> None:
        if self._file is None:
            self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115, until close
            weakref.finalize(self, self._file.close)
        place = self._places.get(key)
        if place is None or place.room < size:
            place = _Place(self.in_file, size)
            self.in_file += -(-size // ALIGNED) * ALIGNED
            self._places[key] = place
        place.parts = None
        self._file.seek(place.offset)
        for part in entry.values():
            rest = memoryview(part.codes.contiguous().view(torch.uint8).numpy()).cast("B")
            while rest:
                rest = rest[self._file.write(rest) :]
        place.parts = {name: (p.codes.dtype, tuple(p.codes.shape), p.top) for name, p in entry.items()}

    def _read(self, key: tuple[str, str]) -> Entry | None:
        """An entry from the file; None where it is not there, or cannot be read."""
        place = self._places.get(key)
        if place is None or place.parts is None or self._file is None:
            return None
        entry = {}
        with contextlib.suppress(OSError):
            self._file.seek(place.offset)
            for name, (kind, shape, top) in place.parts.items():
                codes = torch.empty(shape, dtype=kind)
                rest = memoryview(codes.view(torch.uint8).numpy()).cast("B")
                while rest:
                    count = self._file.readinto(rest)  # type: ignore[attr-defined]
                    if not count:
                        return None
                    rest = rest[count:]
                entry[name] = Packed(codes, top)
            return entry
        return None


def _size(entry: Entry) -> int:
    return sum(part.bytes for part in entry.values())


KINDS = ("photograph", "unguided", "priors")
"""What is kept of a view."""


class Feed:
    """The training views at the size of a step, and what their renderings are compared with.

    Where the capture's pictures are large, the first steps look at smaller ones, as the recipe says.

    Args:
        backend: device and rasterizer. recipe: the method. index: of refraction.
        store: keeps what is computed of the views. views: that are trained on. steps: steps of the training.
        black: whether nothing is behind the subject.
        memory: gives back what was freed before and after the priors of a view are made.
    """

    def __init__(
        self,
        backend: Backend,
        recipe: Recipe,
        index: float,
        store: ViewStore,
        views: Sequence[View],
        steps: int,
        *,
        black: bool,
        memory: MemoryBound = UNBOUNDED,
    ) -> None:
        self._backend = backend
        self._settings = recipe.priors
        self._index = index
        self._black = black
        self._store = store
        self._memory = memory
        self._until = coarse_steps(recipe, views, steps)
        small = SmallerViews(views, recipe.coarse.factor) if self._until else views
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
            return StepTargets(view.camera, unpacked(entry["picture"]), valid, empty, priors=priors)
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
        if self._black:
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
