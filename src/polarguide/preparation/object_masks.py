"""Object masks from a folder of the user."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.formats.headers import read_picture
from polarguide.capture.formats.pictures import SUFFIXES, decode_mask
from polarguide.capture.view import listed
from polarguide.errors import PolarguideError
from polarguide.preparation.source import DevelopedView, Source
from polarguide.progress import Advance


class MaskedSource(Source):
    """A source with object masks from a folder; the object is where a mask has at least half of its maximum."""

    def __init__(self, pictures: Source, folder: Path) -> None:
        """Find the masks, named like the views.

        Args:
            pictures: the source without them.
            folder: with one picture for each view that has a mask.

        Raises:
            PolarguideError: there is no such folder, or none of its pictures is named like a view.
        """
        if not folder.is_dir():
            raise PolarguideError(
                "--masks",
                expected="a folder of masks named like the views",
                found=f"{folder}, which is not a folder",
                remedy="Give the folder that holds <view>.png.",
            )
        found = {p.stem: p for p in sorted(folder.iterdir()) if p.suffix.lower() in SUFFIXES}
        self._masks = {view: found[view] for view in pictures.views if view in found}
        if not self._masks:
            raise PolarguideError(
                folder,
                expected=f"masks named like the views ({listed(pictures.views, 3)})",
                found=listed(sorted(found), 3) or "no picture",
                remedy="Rename them; views without a mask are used whole.",
            )
        self._pictures = pictures
        self.needs = pictures.needs
        self.kind, self.cameras, self.views = pictures.kind, pictures.cameras, pictures.views
        self.paths = [*pictures.paths, *self._masks.values()]

    def measure(self, advance: Advance) -> dict[str, Any]:
        """Measure the source, and note views without a mask."""
        measured = self._pictures.measure(advance)
        bare = [view for view in self.views if view not in self._masks]
        if bare:
            note = f"{len(bare)} of {len(self.views)} views have no mask and are used whole ({listed(bare)})."
            measured["notes"] = [*measured["notes"], note]
        return measured

    def develop(self, view: str, measured: dict[str, Any]) -> DevelopedView:
        """Read one view, with its mask.

        Raises:
            PolarguideError: the mask cannot be read, or is neither of the stored nor the developed size.
        """
        done = self._pictures.develop(view, measured)
        path = self._masks.get(view)
        return done if path is None else replace(done, mask=_fitted(path, done))


def _fitted(path: Path, view: DevelopedView) -> NDArray[np.bool_]:
    """A mask at the size of the developed picture: True where at least half of a pixel is object."""
    mask = decode_mask(path, read_picture(path), any_value=False)
    geometry = view.geometry
    size = (mask.shape[1], mask.shape[0])
    if size == geometry.size:
        return mask
    if size != geometry.stored:
        (width, height), stored = geometry.size, geometry.stored
        raise PolarguideError(
            path,
            expected=f"the size of the picture, {width}x{height}, or of the file, {stored[0]}x{stored[1]}",
            found=f"{size[0]}x{size[1]}",
            remedy="Make the mask at one of these sizes.",
        )
    (left, top), (width, height), step = geometry.crop, geometry.size, geometry.step
    cut = mask[top : top + height * step, left : left + width * step].astype(np.float32)
    return np.asarray(cv2.resize(cut, geometry.size, interpolation=cv2.INTER_AREA) >= 0.5)
