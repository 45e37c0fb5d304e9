"""The scene folder while it is written: nothing half-written looks whole, and what is done is done once.

``prepare.json`` keeps what was asked and which views are written; ``scene.json`` takes its place as the last file.
A folder without ``scene.json`` is not finished; the same command goes on with it.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.colmap.poses import Geometry, Poses
from polarguide.capture.colmap.sfm import reconstruct, tone_mapped
from polarguide.capture.colmap.triangulate import add_points
from polarguide.capture.exposures import Angle
from polarguide.capture.filter.consecutive import chosen_matching
from polarguide.capture.view import ANGLES
from polarguide.capture.write import (
    EXACT,
    intensity_codes,
    picture_name,
    picture_names,
    write_png,
    write_view,
)
from polarguide.core.errors import PolarguideError
from polarguide.core.files import check_out, holds_files, make_folder, read_file, require_inside, write_whole
from polarguide.core.progress import Reporter
from polarguide.core.records import decode, read_record, shortened, to_json
from polarguide.core.system import hold_folder
from polarguide.core.text import canonical, stem_of
from polarguide.preparation.journal import Journal, Measured, Request, State, ViewRecord, changed_entry
from polarguide.preparation.settings import PrepareSettings, known_intrinsics
from polarguide.preparation.source import Source, developed

JOURNAL = "prepare.json"
SCENE = "scene.json"
SPLIT = "split.json"
SFM = ".sfm"
PARTIAL = ".sparse.partial"
FOLDERS = ("polar", "invalid", "masks", "sparse")
"""What is written into."""
REMEDY = "Give another --out; nothing was written."
# Of a picture's angle, in its name.
_LABEL = r"(\d{3}(\.\d+)?|unknown|none)(-\d+)?"
_OF_POSES = ("poses", "poses_of", "matching", "sfm_pictures", "intrinsics", "refine_intrinsics", "seed")
_EARLIER_SETTINGS = {"analyzers": None, "angles": None, "poses_of": "auto", "shots_per_view": None}
"""Settings that earlier journals do not have."""


class SceneFolder:
    """An ``--out`` folder, new or gone on with."""

    def __init__(self, root: Path, request: Request, measured_type: type[Measured]) -> None:
        """Open the folder; nothing is written yet.

        Args:
            root: the folder.
            request: source, files and settings of this call. ``settings.poses`` may follow on none.
            measured_type: type of the measurements of the source.

        Raises:
            PolarguideError: the folder holds something else, or a preparation of something else.
        """
        self.root = root
        self.state = State[Any](request)
        self.finished = False
        self._finished_before: bytes | None = None
        self._there_before = root.exists()
        check_out(root)
        finished = root / SCENE
        unfinished = root / JOURNAL
        path = unfinished if unfinished.exists() else finished
        if path.exists():
            follows_none = self._resume(path, request, measured_type)
            self.finished = path == finished and not follows_none
        elif root.exists() and holds_files(root):
            raise PolarguideError(
                root,
                expected="a new or empty folder, or an unfinished preparation",
                found="other files",
                remedy=REMEDY,
            )

    def _resume(self, path: Path, request: Request, measured_type: type[Measured]) -> bool:
        """Read the state of an earlier call; return whether this call adds poses to views without poses."""
        content = read_record(path, dict[str, Any])
        if "prepare" not in content:
            raise PolarguideError(
                self.root,
                expected="a new folder, or one that prepare wrote",
                found=f"a {path.name} of another origin",
                remedy=REMEDY,
            )
        journal: Journal[Any] = decode(content, Journal[measured_type], path, remedy=REMEDY)  # type: ignore[valid-type]
        before = journal.prepare
        for view, record in before.views.items():
            _require_own_files(path, view, record.files)
            if before.request.format == "singles":
                _require_exposures(path, view, record)
        settings = {**_EARLIER_SETTINGS, **before.request.settings}
        now = dict(request.settings)
        if settings.get("white_balance") == "grey":  # its name in earlier journals
            settings["white_balance"] = "gray"
        if settings.get("matching") == "exhaustive" and now["matching"] == "auto":
            now["matching"] = "exhaustive"  # the default of earlier journals
        follows_none = settings.get("poses") == "none" != now["poses"]
        ignored = _OF_POSES if follows_none else ()
        old, new = (
            msgspec.structs.replace(
                each,
                settings={name: value for name, value in given.items() if name not in ignored},
                model={} if follows_none else each.model,
            )
            for each, given in ((before.request, settings), (request, now))
        )
        difference = changed_entry(old, new)
        if difference is not None:
            name, was, is_now = difference
            raise PolarguideError(
                self.root,
                expected=f"a preparation with {name} {was}",
                found=f"{name} {is_now}",
                remedy="Repeat the command as it was, or give another --out; nothing was written.",
            )
        views = {canonical(view): record for view, record in before.views.items()}
        self.state = State(request, before.measured, views)
        return follows_none

    @property
    def views(self) -> dict[str, ViewRecord]:
        """Records of the views that are written."""
        return self.state.views

    @property
    def measured(self) -> Measured:
        """Measurements of the capture."""
        assert self.state.measured is not None
        measured: Measured = self.state.measured
        return measured

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Create the folder, and keep other calls out of it.

        Raises:
            PolarguideError: one is at work in it, or it cannot be created.
        """
        make_folder(self.root)
        try:
            let_go = hold_folder(self.root)
        except BlockingIOError:
            raise PolarguideError(
                self.root,
                expected="a folder that nobody else writes",
                found="another polarguide prepare at work on it",
                remedy="Wait until it has ended, or choose another folder with --out.",
            ) from None
        try:
            yield
        finally:
            let_go()

    def start(self) -> None:
        """Take note of the request."""
        work = self.root / SFM
        require_inside(self.root, *(self.root / name for name in (*FOLDERS, PARTIAL, SFM)), *work.rglob("*"))
        if (self.root / SCENE).exists():
            self._finished_before = read_file(self.root / SCENE)
        make_folder(self.root)
        self.save()  # first: without it nobody could go on with the folder
        make_folder(self.root / "polar")
        make_folder(self.root / "invalid")
        (self.root / SCENE).unlink(missing_ok=True)

    def abandon(self) -> None:
        """Take back what was begun: a scene without poses is as it was, and of a new folder nothing is left.

        Views that an earlier call has written stay for the next one.
        """
        shutil.rmtree(self.root / SFM, ignore_errors=True)
        if self._finished_before is not None:
            write_whole(self.root / SCENE, self._finished_before)
            (self.root / JOURNAL).unlink(missing_ok=True)
        elif not self.views:
            for name in FOLDERS:
                shutil.rmtree(self.root / name, ignore_errors=True)
            (self.root / JOURNAL).unlink(missing_ok=True)
            if not self._there_before:
                with contextlib.suppress(OSError):  # not empty: somebody put something there
                    self.root.rmdir()

    def save(self) -> None:
        """Write the journal."""
        write_whole(self.root / JOURNAL, to_json({"prepare": msgspec.to_builtins(self.state)}))

    def finish(self, summary: dict[str, Any]) -> None:
        """Write ``scene.json``, the sign that the scene is whole, and drop the journal."""
        write_whole(self.root / SCENE, to_json({**summary, "prepare": msgspec.to_builtins(self.state)}))
        (self.root / JOURNAL).unlink(missing_ok=True)

    def has(self, view: str, warp: object) -> bool:
        """Whether a view is written as it would be now."""
        record = self.views.get(view)
        return (
            record is not None
            and record.warp == warp
            and all(
                (self.root / name).is_file() and (self.root / name).stat().st_size == size
                for name, size in record.files.items()
            )
        )

    def write_view(
        self,
        view: str,
        intensities: NDArray[np.float32],
        invalid: NDArray[np.bool_],
        record: ViewRecord,
        mask: NDArray[np.bool_] | None = None,
        angles: Sequence[Angle] = ANGLES,
    ) -> None:
        """Write the pictures of a view, then its record."""
        codes = intensity_codes(intensities, invalid, getattr(self.measured, "rounding", EXACT))
        record.files = write_view(self.root, view, codes, invalid, mask, angles)
        self.views[view] = record
        self.save()

    def hold_out(self, views: Sequence[str]) -> None:
        """Note which views are for tests, unless the user has."""
        if views and not os.path.lexists(self.root / SPLIT):
            write_whole(self.root / SPLIT, to_json({"test": list(views)}))

    def drop(self, view: str) -> None:
        """Remove a view that an earlier call without poses wrote, and that has none."""
        for name in self.views.pop(view).files:
            (self.root / name).unlink(missing_ok=True)
        self.save()


def _require_own_files(journal: Path, view: str, files: Iterable[str]) -> None:
    """Refuse a journal that counts files as a view's that are not: what is noted there may be removed.

    Raises:
        PolarguideError: there is one.
    """
    pictures = re.compile(rf"polar/{re.escape(view)}_{_LABEL}\.png")
    own = {f"invalid/{view}.png", f"masks/{view}.png"}
    strangers = sorted(name for name in set(files) - own if not pictures.fullmatch(name))
    if strangers or "/" in view or "\\" in view or "\0" in view:
        raise PolarguideError(
            f"{journal} (views, {shortened(view)})",
            expected=f"pictures of this view, {picture_name('VIEW', 0)} and so on",
            found=shortened(strangers[0] if strangers else view),
            remedy=REMEDY,
        )


def _require_exposures(journal: Path, view: str, record: ViewRecord) -> None:
    """Refuse a journal that does not say what the pictures of a view are.

    Raises:
        PolarguideError: the journal lacks it.
    """
    named = picture_names(view, [exposure.angle for exposure in record.exposures or ()])
    pictures = sorted(name for name in record.files if name.startswith("polar/"))
    if sorted(named) != pictures or not named:
        raise PolarguideError(
            f"{journal} (views, {shortened(view)})",
            expected=f"the exposures of {shortened(pictures)}",
            found=shortened(named),
            remedy=REMEDY,
        )


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
        matching = chosen_matching(self._pictures.views, self._settings.matching, self._reporter)
        settings = replace(self._settings, matching=matching)  # type: ignore[arg-type]
        return reconstruct(
            self._root,
            sizes,
            matching=matching,
            seed=settings.seed,
            reporter=self._reporter,
            untried=_untried(settings, self._pictures.kind),
            intrinsics=None if settings.intrinsics is None else known_intrinsics(settings.intrinsics),
            refine=settings.refine_intrinsics,
            lenses=self._pictures.lenses(),
        )

    def points(self, poses: Poses) -> tuple[Poses, dict[str, Any]]:
        """The same poses with points, and how these came about.

        Raises:
            PolarguideError: there is no place that the cameras look at.
        """
        cameras = poses.developed(self._photographs(poses.views))
        settings = self._settings
        model, record = add_points(
            self._root,
            cameras,
            poses.folder,
            matching=chosen_matching(poses.views, settings.matching, self._reporter),
            seed=settings.seed,
            reporter=self._reporter,
        )
        return Poses.read(model, self._pictures.views), record

    def _photographs(self, views: list[str]) -> dict[str, Geometry]:
        """Tone-mapped pictures and object masks of views, and how they lie in the files."""
        images = self._root / "images"
        masks = self._root / "masks"
        measured = self._folder.measured
        known = measured.photographs or {}
        measured.photographs = known
        if images.is_dir() and any(stem_of(path) not in views for path in images.iterdir()):
            shutil.rmtree(self._root, ignore_errors=True)  # of an earlier call with other poses
            known.clear()
        for path in (images, masks):
            make_folder(path)
        with self._reporter.track("photographs", len(views)) as advance:
            for count, view in enumerate(views, 1):
                path = images / f"{view}.png"
                if view not in known or not path.exists():
                    done = developed(self._pictures, view, measured)
                    if done.mask is not None:
                        write_png(masks / f"{view}.png", done.mask.astype(np.uint8) * 255)
                    write_png(path, tone_mapped(done.intensities, self._settings.sfm_pictures))
                    known[view] = done.record.geometry
                    self._folder.save()
                advance(count)
        return {view: known[view] for view in views}


def _untried(settings: PrepareSettings, kind: str) -> str:
    """The options that change something about structure from motion, for a message."""
    ways = ["--matching exhaustive (compares all pairs)"] if settings.matching != "exhaustive" else []
    if settings.sfm_pictures != "minimum" and kind != "singles":  # of one picture, the minimum is the picture
        ways.append("--sfm-pictures minimum (less glare)")
    if settings.intrinsics is None:
        ways.append("--intrinsics fx,fy,cx,cy (in pixels of the developed pictures)")
    ways.append("--poses PATH (a COLMAP model, or cameras of another program)")
    return f"Options that may help: {', '.join(ways)}."
