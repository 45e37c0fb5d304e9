"""The scene folder while it is written: nothing half-written looks whole, and what is done is done once.

``prepare.json`` keeps what was asked and which views are written; ``scene.json`` takes its place as the last file.
A folder without ``scene.json`` is not finished; the same command goes on with it.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from polarguide.capture.colmap.poses import Geometry, Poses
from polarguide.capture.colmap.sfm import reconstruct, tone_mapped
from polarguide.capture.colmap.triangulate import add_points
from polarguide.capture.exposures import Angle
from polarguide.capture.filter.consecutive import chosen_matching
from polarguide.capture.sensor.pattern import Levels
from polarguide.capture.view import ANGLES, FULL_CODE, listed
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
from polarguide.core.system import only_writer
from polarguide.core.text import canonical, stem_of
from polarguide.preparation.request import FileStamp, first_difference
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


_Code = Annotated[int, msgspec.Meta(ge=0, le=FULL_CODE)]
_Factor = Annotated[float, msgspec.Meta(gt=0, le=1e12)]
_Multiple = tuple[_Code, Annotated[int, msgspec.Meta(ge=1, le=FULL_CODE)]]


class _Settings(msgspec.Struct):
    poses: str


class _Request(msgspec.Struct):
    settings: _Settings
    source: str
    format: str
    file: dict[str, FileStamp]
    model: dict[str, FileStamp] = {}


class _Exposure(msgspec.Struct):
    """One of the single shots of a view."""

    source: str
    angle: float | Literal["unknown", "none"]
    light: _Factor | None
    given_gain: _Factor | None


class _View(msgspec.Struct):
    files: dict[str, int]
    geometry: Geometry
    clipped_share: float
    warp: Any
    exposures: list[_Exposure] = []


class _Measured(msgspec.Struct):
    rounding: Annotated[tuple[_Multiple, ...], msgspec.Meta(min_length=1)] = ((0, 1),)
    levels: Levels | None = None
    gains: tuple[_Factor, _Factor, _Factor, _Factor] | None = None
    white_balance: tuple[_Factor, _Factor, _Factor] | None = None
    scale: _Factor | None = None
    transfer: Literal["linear", "srgb"] | None = None
    light: dict[str, _Factor] | None = None
    sense: Literal["ccw", "cw"] | None = None


class _State(msgspec.Struct):
    request: _Request
    views: dict[str, _View] = {}
    measured: _Measured | None = None


class _Journal(msgspec.Struct):
    """The fields of a journal that are read; it has others."""

    prepare: _State


class SceneFolder:
    """An ``--out`` folder, new or gone on with."""

    def __init__(self, root: Path, request: dict[str, Any]) -> None:
        """Open it; nothing is written yet.

        Args:
            root: the folder.
            request: what is asked for: source, its files, settings. ``settings.poses`` may follow on none.

        Raises:
            PolarguideError: the folder holds something else, or a preparation of something else.
        """
        self.root = root
        self.request = request
        self.measured: dict[str, Any] | None = None
        self.views: dict[str, dict[str, Any]] = {}
        self.finished = self.begun = False
        self._follows_none = False
        self._finished_before: bytes | None = None
        self._there_before = root.exists()
        check_out(root)
        whole = root / SCENE
        journal = root / JOURNAL
        path = journal if journal.exists() else whole
        if path.exists():
            self._go_on(path)
            self.begun = True
            self.finished = path == whole and not self._follows_none
        elif root.exists() and holds_files(root):
            raise PolarguideError(
                root,
                expected="a new or empty folder, or an unfinished preparation",
                found="other files",
                remedy=REMEDY,
            )

    def _go_on(self, path: Path) -> None:
        content = read_record(path, dict[str, Any])
        if "prepare" not in content:
            raise PolarguideError(
                self.root,
                expected="a new folder, or one that prepare wrote",
                found=f"a {path.name} of another origin",
                remedy=REMEDY,
            )
        journal = decode(content, _Journal, path, remedy=REMEDY)
        for view, record in journal.prepare.views.items():
            _require_own_files(path, view, record.files)
            if journal.prepare.request.format == "singles":
                _require_exposures(path, view, record)
        state = content["prepare"]
        before = json.loads(json.dumps(state["request"]))
        now = json.loads(json.dumps(self.request))
        if before["settings"].get("white_balance") == "grey":  # its name in earlier journals
            before["settings"]["white_balance"] = "gray"
        for name in ("analyzers", "angles"):  # earlier journals do not know them
            before["settings"].setdefault(name, None)
        before["settings"].setdefault("poses_of", "auto")
        before["settings"].setdefault("shots_per_view", None)
        if before["settings"]["matching"] == "exhaustive" and now["settings"]["matching"] == "auto":
            now["settings"]["matching"] = "exhaustive"  # the default of earlier journals
        self._follows_none = before["settings"]["poses"] == "none" != now["settings"]["poses"]
        if self._follows_none:
            for record in (before, now):
                record["settings"] = {k: v for k, v in record["settings"].items() if k not in _OF_POSES}
                record.pop("model", None)
        differing = first_difference(before, now)
        if differing is not None:
            name, old, new = differing
            raise PolarguideError(
                self.root,
                expected=f"a preparation with {name} {old}",
                found=f"{name} {new}",
                remedy="Repeat the command as it was, or give another --out; nothing was written.",
            )
        self.measured = state.get("measured")
        self.views = {canonical(view): record for view, record in state.get("views", {}).items()}

    def require_measured(self, needs: Collection[str]) -> None:
        """Check that what an earlier call has measured, if there was one, has all that is read of it.

        Raises:
            PolarguideError: something is missing.
        """
        missing = [key for key in needs if self.measured is not None and self.measured.get(key) is None]
        if missing:
            raise PolarguideError(
                self.root / (JOURNAL if (self.root / JOURNAL).exists() else SCENE),
                expected="the measurements of an earlier call",
                found=f"no {listed(missing)}",
                remedy="Remove the folder, and begin anew.",
            )

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Create the folder, and keep other calls out of it.

        Raises:
            PolarguideError: one is at work in it, or it cannot be created.
        """
        make_folder(self.root)
        with only_writer(
            self.root,
            expected="a folder that nobody else writes",
            found="another polarguide prepare at work on it",
        ):
            yield

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
        write_whole(self.root / JOURNAL, to_json({"prepare": self._state()}))

    def finish(self, summary: dict[str, Any]) -> None:
        """Write ``scene.json``, the sign that the scene is whole, and drop the journal."""
        write_whole(self.root / SCENE, to_json({**summary, "prepare": self._state()}))
        (self.root / JOURNAL).unlink(missing_ok=True)

    def has(self, view: str, warp: object) -> bool:
        """Whether a view is written as it would be now."""
        record = self.views.get(view)
        return (
            record is not None
            and record["warp"] == warp
            and all(
                (self.root / name).is_file() and (self.root / name).stat().st_size == size
                for name, size in record["files"].items()
            )
        )

    def write_view(
        self,
        view: str,
        intensities: NDArray[np.float32],
        invalid: NDArray[np.bool_],
        record: dict[str, Any],
        mask: NDArray[np.bool_] | None = None,
        angles: Sequence[Angle] = ANGLES,
    ) -> None:
        """Write the pictures of a view, then note it."""
        codes = intensity_codes(intensities, invalid, (self.measured or {}).get("rounding", EXACT))
        sizes = write_view(self.root, view, codes, invalid, mask, angles)
        self.views[view] = {**record, "files": sizes}
        self.save()

    def hold_out(self, views: Sequence[str]) -> None:
        """Note which views are for tests, unless the user has."""
        if views and not os.path.lexists(self.root / SPLIT):
            write_whole(self.root / SPLIT, to_json({"test": list(views)}))

    def drop(self, view: str) -> None:
        """Remove a view that an earlier call without poses wrote, and that has none."""
        for name in self.views.pop(view)["files"]:
            (self.root / name).unlink(missing_ok=True)
        self.save()

    def _state(self) -> dict[str, Any]:
        return {"request": self.request, "measured": self.measured, "views": self.views}


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


def _require_exposures(journal: Path, view: str, record: _View) -> None:
    """Refuse a journal that does not say what the pictures of a view are.

    Raises:
        PolarguideError: the journal lacks it.
    """
    named = picture_names(view, [exposure.angle for exposure in record.exposures])
    pictures = sorted(name for name in record.files if name.startswith("polar/"))
    if sorted(named) != pictures or not named:
        raise PolarguideError(
            f"{journal} (views, {shortened(view)})",
            expected=f"the exposures of {shortened(pictures)}",
            found=shortened(named),
            remedy=REMEDY,
        )


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
        assert measured is not None
        known = measured.setdefault(PHOTOGRAPHS, {})
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
                    known[view] = asdict(done.geometry)
                    self._folder.save()
                advance(count)
        return {view: msgspec.convert(known[view], Geometry) for view in views}


def _untried(settings: PrepareSettings, kind: str) -> str:
    """The options that change something about structure from motion, for a message."""
    ways = ["--matching exhaustive (compares all pairs)"] if settings.matching != "exhaustive" else []
    if settings.sfm_pictures != "minimum" and kind != "singles":  # of one picture, the minimum is the picture
        ways.append("--sfm-pictures minimum (less glare)")
    if settings.intrinsics is None:
        ways.append("--intrinsics fx,fy,cx,cy (in pixels of the developed pictures)")
    ways.append("--poses PATH (a COLMAP model, or cameras of another program)")
    return f"Options that may help: {', '.join(ways)}."
