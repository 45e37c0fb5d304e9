"""View of a capture: a camera pose and the pictures from there, usually four at different polarizer angles."""

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
"""Width of a thumbnail in pixels."""


def figure(radiance: NDArray[Any], caption: str) -> str:
    """Return an HTML thumbnail with a caption for linear radiance [H, W, 3].

    The 99th percentile of the radiance is displayed as white, or the value 1 if the percentile is larger.
    """
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
    """Return an HTML table with a title and a row for the name and text of each fact."""
    rows = "".join(
        f'<tr><th style="text-align:left">{html.escape(name)}</th>'
        f'<td style="text-align:left;white-space:pre-line">{html.escape(text)}</td></tr>'
        for name, text in facts.items()
    )
    return f"<table><caption>{html.escape(title)}</caption>{rows}</table>"


T = TypeVar("T")


class Latest:
    """Cache for the latest result of several loaders.

    Attributes:
        loaded: the loader of the cached value and the value, or None if the cache is empty.
    """

    def __init__(self) -> None:
        self.loaded: tuple[object, Any] | None = None


class Loader(Generic[T]):
    """Function without arguments that loads a value of a view, such as its pictures, when it is called.

    A view is usually used several times before the next view. The cache ``latest`` therefore keeps one value only, and
    the other views take no memory.

    Args:
        make: function that creates the value.
        latest: cache that all loaders of a scene share.
        derived: True if ``make`` calls another loader with the same cache. This other loader then clears the cache.
    """

    def __init__(self, make: Callable[[], T], latest: Latest, *, derived: bool = False) -> None:
        self._make = make
        self._latest = latest
        self._derived = derived

    def __call__(self) -> T:
        """Return the value from the cache, or load it."""
        latest = self._latest.loaded
        if latest is not None and latest[0] is self:
            return latest[1]
        del latest  # frees its memory for the next value
        if not self._derived:
            self._latest.loaded = None
        value = self._make()
        self._latest.loaded = self, value
        return value

    def then(self, change: Callable[[T], T]) -> Loader[T]:
        """Return a loader that applies ``change`` to the value of this loader."""
        return Loader(lambda: change(self()), self._latest, derived=True)


EVEN = (1.0, 1.0, 1.0)
"""Gains of R, G and B of a view whose exposure and white balance are the mean of all views."""


@dataclass(frozen=True, eq=False)
class View:
    """Pictures of a scene from one camera pose, usually four at different polarizer angles, and masks of their pixels.

    All tensors are on one device. The view may load its pictures from files when ``codes`` is read. Methods that
    return another view do not load them.

    Attributes:
        name: name of the view, unique in its scene.
        camera: pose and intrinsics at the size of the pictures.
        pictures: pictures in memory, or a loader of them. Use the property ``codes`` to read them.
        invalid: mask of the pixels that the capture marks as unusable (``invalid/<view>.png``), [H, W] bool. Metrics
            exclude only these pixels.
        saturated: mask of the pixels without polarization information, [H, W] bool. One of their pictures is at full
            scale in some channel, or all of their pictures are black. Priors and losses exclude these pixels.
        mask: foreground mask by the user (``masks/<view>.png``), [H, W] bool, or None.
        truth: ground truth in memory, or a loader of it. Use the property ``ground_truth`` to read it.
        exposures: polarizer angle and gain of each of the K pictures.
        mount: place of the polarizer: "sensor", or "filter" in front of the lens.
        materials: labels of surfaces by the user (``materials/<view>.png``), [H, W] uint8, or None. The label 0 means
            unlabeled, 1 dielectric and 2 metal. A larger label means a dielectric with the refractive index
            ``Scene.indices[label]``.
        subject_only: if True, ``codes`` are 0 outside the mask.
        gains: exposure of R, G and B relative to the other views, in addition to the gains in ``exposures``.
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
        """Linear intensities of the K pictures as 16-bit codes ``round(65535 * intensity)``, [K, H, W, 3] uint16, RGB.

        ``exposures`` has the angle of each picture, usually 0, 45, 90 and 135 degrees. Codes take half the memory of
        floating-point numbers. Radiance above full scale, as from merged exposures, has float32 codes in the same unit.

        Raises:
            PolarguideError: a file of the view was changed or deleted.
        """
        codes = self.pictures() if isinstance(self.pictures, Loader) else self.pictures
        if not self.subject_only or self.mask is None:
            return codes
        return codes * self.mask.to(codes)[None, ..., None]

    @property
    def ground_truth(self) -> GroundTruth | None:
        """Ground truth of the view, or None.

        Raises:
            PolarguideError: the file was changed or deleted.
        """
        return self.truth() if isinstance(self.truth, Loader) else self.truth

    def __repr__(self) -> str:
        size = f"{self.camera.width}x{self.camera.height}"
        angles = ", ".join(e.label for e in self.exposures)
        optional = {"mask": self.mask, "materials": self.materials, "ground truth": self.truth}
        parts = ", ".join(name for name, value in optional.items() if value is not None) or "no mask"
        return (
            f"<View {self.name}: {size} pixels, {len(self.exposures)} pictures ({angles})\n"
            f" {parts}; {float(self.invalid.float().mean()):.1%} invalid, "
            f"{float(self.saturated.float().mean()):.1%} without polarization>"
        )

    def _repr_html_(self) -> str:
        facts = {"pictures": ", ".join(exposure.label for exposure in self.exposures), "state": repr(self)}
        return figure(self.photograph().cpu().numpy(), self.name) + table(self.name, facts)

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self.invalid.device

    @property
    def is_four(self) -> bool:
        """True if the view has the four pictures of a polarization camera, at 0, 45, 90 and 135 degrees."""
        return self.mount == "sensor" and self.exposures == FOUR

    @property
    def is_determined(self) -> bool:
        """True if the pictures determine a Stokes vector at every pixel."""
        return self.exposures == FOUR or determine_stokes(self.exposures)

    @property
    def measures_radiance(self) -> bool:
        """True if the pictures measure S0.

        S0 follows from a picture without a filter, from two pictures at a right angle, or from a full Stokes vector.
        """
        return self.is_determined or bool(radiance_places(self.exposures))

    def to(self, device: torch.device) -> View:
        """Return a copy of the view on a device, without ground truth.

        If the view is already on the device, return it unchanged.
        """
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
        """Return the view with pictures that ``change`` computes.

        The pictures are computed at once if this view has its pictures in memory. Otherwise they are computed when
        they are read.

        Args:
            change: function that computes the new codes from the codes of this view.
            exposures: exposures of the new pictures; default: those of this view.
        """
        pictures = self.pictures
        new = pictures.then(change) if isinstance(pictures, Loader) else change(pictures)
        return replace(self, pictures=new, exposures=self.exposures if exposures is None else exposures)

    def with_exposures(self, exposures: tuple[Exposure, ...]) -> View:
        """Return the view with the same pictures but other exposures."""
        return replace(self, exposures=exposures)

    def masked(self) -> View:
        """Return the view with black pixels outside its mask. The view must have a mask."""
        assert self.mask is not None
        return replace(self, subject_only=True)

    def intensities(self) -> Tensor:
        """Return the linear intensities of the K pictures, divided by their gains, [K, H, W, 3] float32.

        The values are in [0, 1] if all gains are 1. Merged exposures have larger values.
        """
        intensities = self._even(self.codes.to(torch.float32) / FULL_CODE)
        gains = [exposure.gain for exposure in self.exposures]
        if all(gain == 1 for gain in gains):
            return intensities
        return intensities / intensities.new_tensor(gains)[:, None, None, None]

    def _even(self, intensities: Tensor) -> Tensor:
        """Divide intensities [..., 3] by the gains of the view."""
        return intensities if self.gains == EVEN else intensities / intensities.new_tensor(self.gains)

    def stokes(self) -> Tensor:
        """Return the Stokes vectors in the lens frame, [3, H, W, 3]. They are fitted by least squares.

        Raises:
            PolarguideError: the pictures do not determine Stokes vectors, see ``is_determined``.
        """
        if self.is_four:
            return optics.stokes(self.intensities())
        if not self.is_determined:
            raise self.undetermined("a Stokes vector")
        places = [k for k, exposure in enumerate(self.exposures) if exposure.known]
        rows = analyzers(
            [self.exposures[k] for k in places], self.camera.rays(device=self.device), self.mount
        )
        return optics.fitted_stokes(self.intensities()[places], rows)

    def photograph(self) -> Tensor:
        """Return the picture without a polarizer, as linear ``S0 / 2`` in [0, 1], [H, W, 3] float32.

        It is the mean of the pictures of a polarization camera. If the pictures do not measure S0 (see
        ``measures_radiance``), the result is the mean of the available pictures.
        """
        if self.is_four:
            return self._even(self.codes.to(torch.float32).mean(dim=0) / FULL_CODE)
        if self.is_determined:
            return self.stokes()[0] / 2
        places = radiance_places(self.exposures)
        return (self.intensities()[list(places)] if places else self.intensities()).mean(dim=0)

    def undetermined(self, what: str) -> PolarguideError:
        """Return the error for pictures that do not determine a quantity.

        Args:
            what: name of the quantity, such as "a Stokes vector".
        """
        angles = ", ".join(exposure.label for exposure in self.exposures)
        return PolarguideError(
            f"view {self.name}",
            expected=f"pictures that determine {what}: at three or more angles that differ enough",
            found=f"{len(self.exposures)} ({angles})",
            remedy="Choose views with more pictures.",
        )
