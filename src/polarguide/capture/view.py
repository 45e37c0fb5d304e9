"""A view of a capture: one camera pose with its pictures, mostly four behind a polarizer."""

from __future__ import annotations

import base64
import html
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polarguide import optics
from polarguide.capture.exposures import (
    FOUR,
    Exposure,
    analyzers,
    determine_stokes,
    measure_radiance,
    radiance_places,
)
from polarguide.capture.formats.pictures import FULL_CODE as FULL_CODE
from polarguide.capture.metadata import GroundTruth
from polarguide.core.errors import PolarguideError
from polarguide.core.text import listed as listed
from polarguide.geometry.camera import Camera
from polarguide.geometry.polarizer import ANGLES as ANGLES
from polarguide.optics import Mount
from polarguide.optics.color import srgb_encode_array

_WIDTH = 160
"""Pixels of a thumbnail."""


def figure(radiance: NDArray[Any], caption: str) -> str:
    """A picture of linear radiance [H, W, 3] as a thumbnail with a caption; white is its 99th percentile at most."""
    white = min(1.0, max(float(np.percentile(radiance, 99)), 1e-6))
    shades = srgb_encode_array(np.clip(radiance / white, 0, 1)) * 255
    height, width = shades.shape[:2]
    size = _WIDTH, max(1, round(_WIDTH * height / width))
    way = cv2.INTER_AREA if width > _WIDTH else cv2.INTER_NEAREST
    small = cv2.resize(np.rint(shades[..., ::-1]).astype(np.uint8), size, interpolation=way)
    data = base64.b64encode(cv2.imencode(".jpg", small)[1].tobytes()).decode()
    return (
        '<figure style="display:inline-block;margin:0 8px 8px 0">'
        f'<img src="data:image/jpeg;base64,{data}" width="{size[0]}" alt="{html.escape(caption)}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def table(title: str, facts: Mapping[str, str]) -> str:
    """Facts in two columns, below a title."""
    rows = "".join(
        f'<tr><th style="text-align:left">{html.escape(name)}</th>'
        f'<td style="text-align:left;white-space:pre-line">{html.escape(text)}</td></tr>'
        for name, text in facts.items()
    )
    return f"<table><caption>{html.escape(title)}</caption>{rows}</table>"


T = TypeVar("T")


class Latest:
    """Room for one value: the last one that any of the loaders which share it made."""

    def __init__(self) -> None:
        self.loaded: tuple[object, Any] | None = None


class Loader(Generic[T]):
    """Makes a value when it is called.

    Views are worked on one after the other, and each is read several times. So the last value stays in ``latest``, and
    those of all other views take no memory.

    Args:
        make: makes the value. latest: shared by all loaders of a scene.
        derived: whether ``make`` calls another loader of ``latest``, which clears it where it has to.
    """

    def __init__(self, make: Callable[[], T], latest: Latest, *, derived: bool = False) -> None:
        self._make = make
        self._latest = latest
        self._derived = derived

    def __call__(self) -> T:
        """The value."""
        latest = self._latest.loaded
        if latest is not None and latest[0] is self:
            return latest[1]
        del latest  # so that its memory can be taken for the next
        if not self._derived:
            self._latest.loaded = None
        value = self._make()
        self._latest.loaded = self, value
        return value

    def then(self, change: Callable[[T], T]) -> Loader[T]:
        """A loader of the value after a change."""
        return Loader(lambda: change(self()), self._latest, derived=True)


EVEN = (1.0, 1.0, 1.0)
"""Gains of a view that is exposed like the others."""


@dataclass(frozen=True, eq=False)
class View:
    """One camera pose with its pictures, mostly four behind a polarizer, and masks of their pixels.

    Everything lies on one device. ``dataclasses.replace`` and the methods that give another view load no pictures.

    Attributes:
        name: name of the view, unique in its scene.
        camera: pose and intrinsics at the size of the pictures.
        pictures: ``codes`` where they are in memory, else what loads them.
        invalid: pixels that the capture marks as unusable (``invalid/<view>.png``), [H, W] bool. Metrics exclude these
            pixels and no others.
        saturated: pixels without polarization information: one angle at full scale in any channel, or all
            black; [H, W] bool. Priors and losses exclude them.
        mask: the user's foreground mask (``masks/<view>.png``), [H, W] bool, or None.
        truth: ``ground_truth`` where it is in memory, else what loads it.
        exposures: what the K pictures are.
        mount: where the polarizer was.
        materials: the user's labels of surfaces (``materials/<view>.png``), [H, W] uint8, or None: 0 no label,
            1 dielectric, 2 metal; from 3 on, a dielectric whose refractive index is ``Scene.indices[number]``.
        subject_only: whether ``codes`` are 0 outside the mask, which then is needed.
        gains: exposure of R, G and B relative to other views, beside those of ``exposures``.
    """

    name: str
    camera: Camera
    pictures: Tensor | Loader[Tensor]
    invalid: Tensor
    saturated: Tensor
    mask: Tensor | None = None
    truth: GroundTruth | Loader[GroundTruth | None] | None = None
    exposures: tuple[Exposure, ...] = FOUR
    mount: Mount = "sensor"
    materials: Tensor | None = None
    subject_only: bool = False
    gains: tuple[float, float, float] = EVEN

    @property
    def codes(self) -> Tensor:
        """Linear intensities of the exposures, at 0, 45, 90 and 135 degrees unless ``exposures`` differ, coded as
        round(65535 * intensity), [K, H, W, 3] uint16, RGB. Coded because large captures do not fit into memory as
        floats.

        Raises:
            PolarguideError: a file of the view has changed or was deleted.
        """
        codes = self.pictures() if isinstance(self.pictures, Loader) else self.pictures
        if not self.subject_only or self.mask is None:
            return codes
        return codes * self.mask.to(codes)[None, ..., None]

    @property
    def ground_truth(self) -> GroundTruth | None:
        """Ground truth of the view, or None.

        Raises:
            PolarguideError: the file has changed or was deleted.
        """
        return self.truth() if isinstance(self.truth, Loader) else self.truth

    def __repr__(self) -> str:
        size = f"{self.camera.width}x{self.camera.height}"
        angles = ", ".join(e.label for e in self.exposures)
        beside = {"mask": self.mask, "materials": self.materials, "ground truth": self.truth}
        more = ", ".join(name for name, there in beside.items() if there is not None) or "no mask"
        return (
            f"<View {self.name}: {size} pixels, {len(self.exposures)} pictures ({angles})\n"
            f" {more}; {float(self.invalid.float().mean()):.1%} invalid, "
            f"{float(self.saturated.float().mean()):.1%} without polarization>"
        )

    def _repr_html_(self) -> str:
        facts = {"pictures": ", ".join(exposure.label for exposure in self.exposures), "state": repr(self)}
        return figure(self.photograph().cpu().numpy(), self.name) + table(self.name, facts)

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self.invalid.device

    @property
    def is_four(self) -> bool:
        """Whether it has the four pictures of a polarization camera."""
        return self.mount == "sensor" and self.exposures == FOUR

    @property
    def is_determined(self) -> bool:
        """Whether its pictures determine a Stokes vector at every pixel."""
        return self.exposures == FOUR or determine_stokes(self.exposures)

    @property
    def measures_radiance(self) -> bool:
        """Whether its pictures measure S0."""
        return self.exposures == FOUR or measure_radiance(self.exposures)

    def to(self, device: torch.device) -> View:
        """The view on a device, without its ground truth; the view itself if it is already there."""
        if self.device == device:
            return self
        moved = self.changed(lambda codes: codes.to(device))
        return replace(
            moved,
            invalid=self.invalid.to(device),
            saturated=self.saturated.to(device),
            mask=None if self.mask is None else self.mask.to(device),
            truth=None,
            materials=None if self.materials is None else self.materials.to(device),
        )

    def changed(
        self, change: Callable[[Tensor], Tensor], exposures: tuple[Exposure, ...] | None = None
    ) -> View:
        """The view with other pictures: made now where its own are in memory, else when they are read.

        Args:
            change: makes new codes of the view's. exposures: exposures of the new pictures; None: they stay.
        """
        pictures = self.pictures
        made = pictures.then(change) if isinstance(pictures, Loader) else change(pictures)
        return replace(self, pictures=made, exposures=self.exposures if exposures is None else exposures)

    def with_exposures(self, exposures: tuple[Exposure, ...]) -> View:
        """The view with other knowledge of its pictures."""
        return replace(self, exposures=exposures)

    def masked(self) -> View:
        """The view with black pixels outside its mask, which it has to have."""
        assert self.mask is not None
        return replace(self, subject_only=True)

    def intensities(self) -> Tensor:
        """Linear intensities of the exposures (0, 45, 90, 135 degrees mostly) on one scale, in [0, 1] unless their
        gains differ: [K, H, W, 3] float32.
        """
        intensities = self._even(self.codes.to(torch.float32) / FULL_CODE)
        gains = [exposure.gain for exposure in self.exposures]
        if all(gain == 1 for gain in gains):
            return intensities
        return intensities / intensities.new_tensor(gains)[:, None, None, None]

    def _even(self, intensities: Tensor) -> Tensor:
        """Intensities [..., 3] on the scale of the scene's other views."""
        return intensities if self.gains == EVEN else intensities / intensities.new_tensor(self.gains)

    def stokes(self) -> Tensor:
        """Stokes vectors [3, H, W, 3] in the lens frame, by least squares.

        Raises:
            PolarguideError: the pictures do not determine them; ``is_determined`` tells before.
        """
        if self.is_four:
            return optics.stokes(self.intensities())
        if not self.is_determined:
            raise self.undetermined("a Stokes vector")
        places = [k for k, exposure in enumerate(self.exposures) if exposure.known]
        rays = self.camera.rays(device=self.device)
        rows = analyzers([self.exposures[k] for k in places], rays, self.mount)
        return optics.fitted_stokes(self.intensities()[places], rows)

    def photograph(self) -> Tensor:
        """Linear S0 / 2 in [0, 1], [H, W, 3] float32: of four pictures, their mean.

        Where the pictures do not measure S0 (``measures_radiance``), it is the mean of what there is.
        """
        if self.is_four:
            return self._even(self.codes.to(torch.float32).mean(dim=0) / FULL_CODE)
        if self.is_determined:
            return self.stokes()[0] / 2
        places = radiance_places(self.exposures)
        return (self.intensities()[list(places)] if places else self.intensities()).mean(dim=0)

    def undetermined(self, what: str) -> PolarguideError:
        """The error that the pictures do not determine ``what``."""
        angles = ", ".join(exposure.label for exposure in self.exposures)
        return PolarguideError(
            f"view {self.name}",
            expected=f"pictures that determine {what}: at three or more angles that differ enough",
            found=f"{len(self.exposures)} ({angles})",
            remedy="Choose views with more pictures.",
        )
