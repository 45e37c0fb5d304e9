"""Work on poses and points between measuring and writing: photographs of all views, and COLMAP on them."""

from __future__ import annotations

import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from polarguide.capture.colmap.poses import Poses
from polarguide.capture.colmap.sfm import reconstruct, tone_mapped
from polarguide.capture.colmap.triangulate import add_points
from polarguide.capture.colmap.undistort import Geometry
from polarguide.capture.write import write_png
from polarguide.files import make_folder
from polarguide.preparation.folder import SFM, SceneFolder
from polarguide.preparation.settings import PrepareSettings, known_intrinsics
from polarguide.preparation.source import Source
from polarguide.progress import Reporter

PHOTOGRAPHS = "photographs"


class Workshop:
    """A hidden folder in the scene while it is made."""

    def __init__(
        self, folder: SceneFolder, pictures: Source, settings: PrepareSettings, reporter: Reporter
    ) -> None:
        self._folder = folder
        self._pictures = pictures
        self._settings = settings
        self._reporter = reporter
        self._root = folder.root / SFM

    def structure(self) -> Path:
        """The model that structure from motion finds for all views.

        Raises:
            PolarguideError: too few views are registered.
        """
        sizes = {view: geometry.size for view, geometry in self._photographs(self._pictures.views).items()}
        asked = self._settings
        return reconstruct(
            self._root,
            sizes,
            matching=asked.matching,
            seed=asked.seed,
            reporter=self._reporter,
            untried=_untried(asked, self._pictures.kind),
            intrinsics=None if asked.intrinsics is None else known_intrinsics(asked.intrinsics),
            refine=asked.refine_intrinsics,
        )

    def points(self, poses: Poses) -> tuple[Poses, dict[str, Any]]:
        """The same poses with points, and how these came about.

        Raises:
            PolarguideError: there is no place that the cameras look at.
        """
        cameras = poses.developed(self._photographs(poses.views))
        asked = self._settings
        model, found = add_points(
            self._root,
            cameras,
            poses.folder,
            matching=asked.matching,
            seed=asked.seed,
            reporter=self._reporter,
        )
        return Poses.read(model, self._pictures.views), found

    def _photographs(self, views: list[str]) -> dict[str, Geometry]:
        """Tone-mapped pictures and object masks of views, and how they lie in the files."""
        images, masks = self._root / "images", self._root / "masks"
        measured = self._folder.measured
        assert measured is not None
        known = measured.setdefault(PHOTOGRAPHS, {})
        if images.is_dir() and any(path.stem not in views for path in images.iterdir()):
            shutil.rmtree(self._root, ignore_errors=True)  # of an earlier call with other poses
            known.clear()
        for path in (images, masks):
            make_folder(path)
        with self._reporter.track("photographs", len(views)) as advance:
            for count, view in enumerate(views, 1):
                path = images / f"{view}.png"
                if view not in known or not path.exists():
                    done = self._pictures.develop(view, measured)
                    if done.mask is not None:
                        write_png(masks / f"{view}.png", done.mask.astype(np.uint8) * 255)
                    write_png(path, tone_mapped(done.intensities, self._settings.sfm_pictures))
                    known[view] = asdict(done.geometry)
                    self._folder.save()
                advance(count)
        return {view: msgspec.convert(known[view], Geometry) for view in views}


def _untried(asked: PrepareSettings, kind: str) -> str:
    """The options that change something about structure from motion, for a message."""
    ways = ["--matching exhaustive (compares all pairs)"] if asked.matching != "exhaustive" else []
    if asked.sfm_pictures != "minimum" and kind != "singles":  # of one picture, the minimum is the picture
        ways.append("--sfm-pictures minimum (less glare)")
    if asked.intrinsics is None:
        ways.append("--intrinsics fx,fy,cx,cy (in pixels of the developed pictures)")
    ways.append("--poses PATH (a COLMAP model, or cameras of another program)")
    return f"Options that may help: {', '.join(ways)}."
