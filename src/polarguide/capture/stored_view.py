"""Views of a large capture, whose pictures stay in their files until they are looked at."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from polarguide.camera import Camera
from polarguide.capture.exposures import Exposure
from polarguide.capture.ground_truth import read_ground_truth
from polarguide.capture.layout import Layout
from polarguide.capture.view import GroundTruth, View
from polarguide.capture.view_reader import Files, ViewData, changed, read_codes
from polarguide.optics import Mount


class ViewFiles:
    """Decodes the pictures of views again, and keeps those of the last one.

    Args:
        layout: the files. downscale, transfer: as they were read. digests: SHA-256 of the files as they were then.
    """

    def __init__(self, layout: Layout, downscale: int, transfer: str, digests: Mapping[Path, str]) -> None:
        self._layout, self._downscale, self._transfer = layout, downscale, transfer
        self._digests = digests
        self._last: tuple[str, Tensor] | None = None

    def codes(self, name: str) -> Tensor:
        """``View.codes``.

        Raises:
            PolarguideError: a file has changed, or is gone.
        """
        last = self._last
        if last is None or last[0] != name:
            self._last = None  # its memory can be taken for the next
            how = {"factor": self._downscale, "transfer": self._transfer}
            codes = read_codes(self._layout, name, **how, digests=self._digests)  # type: ignore[arg-type]
            last = self._last = name, torch.from_numpy(codes)
        return last[1]

    def ground_truth(self, name: str, size: tuple[int, int]) -> GroundTruth | None:
        """``View.ground_truth``. size: height and width of the pictures as they are stored.

        Raises:
            PolarguideError: the file has changed, or is gone.
        """
        path = self._layout.ground_truth.get(name)
        if path is None:
            return None
        files = Files()
        data = files.read(path)
        if files.digests[path] != self._digests[path]:
            raise changed(path)
        return read_ground_truth(path, data, size=size, factor=self._downscale)


class StoredView(View):
    """A view whose codes and ground truth are read from their files whenever they are asked for.

    Args:
        data: what was read of it; its codes and ground truth are not looked at.
        camera: of the view. full_scale: as for ``ViewData.view``.
        files: of its scene. mount: where the polarizer was. masked: whether only its subject is to be seen.
    """

    _files: ViewFiles
    _size: tuple[int, int]
    _masked: bool

    def __init__(
        self,
        data: ViewData,
        camera: Camera,
        full_scale: int | None,
        files: ViewFiles,
        mount: Mount = "sensor",
        *,
        masked: bool = False,
    ) -> None:
        values = {
            "name": data.name,
            "camera": camera,
            "invalid": _compact(torch.from_numpy(data.invalid)),
            "saturated": _compact(torch.from_numpy(data.saturated(full_scale))),
            "mask": None if data.mask is None else torch.from_numpy(data.mask),
            "exposures": data.exposures,
            "mount": mount,
            "materials": None if data.materials is None else torch.from_numpy(data.materials),
            "_files": files,
            "_size": (data.size[1], data.size[0]),
            "_masked": masked,
        }
        vars(self).update(values)

    @property
    def codes(self) -> Tensor:
        """As in ``View``."""
        codes = self._files.codes(self.name)
        return (
            codes if not self._masked or self.mask is None else codes * self.mask.to(codes)[None, ..., None]
        )

    @property
    def ground_truth(self) -> GroundTruth | None:
        """As in ``View``."""
        return self._files.ground_truth(self.name, self._size)

    def subject_alone(self) -> View:
        """As in ``View``."""
        return self._but(_masked=True)

    def with_exposures(self, exposures: tuple[Exposure, ...]) -> View:
        """As in ``View``."""
        return self._but(exposures=exposures)

    def _but(self, **changed: object) -> View:
        other = object.__new__(StoredView)
        vars(other).update({**vars(self), **changed})
        return other


def _compact(mask: Tensor) -> Tensor:
    """The mask, without memory where nothing is set."""
    return mask if bool(mask.any()) else torch.zeros((), dtype=torch.bool).expand(mask.shape)
