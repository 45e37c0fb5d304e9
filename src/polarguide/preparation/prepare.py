"""Prepare a scene folder from camera files. A stopped preparation can be resumed.

``prepare.json`` records the request and the written views. ``scene.json`` replaces it as the last file. A folder
without ``scene.json`` is unfinished, and the same command resumes it.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import shlex
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from polarguide import __version__
from polarguide.capture.calibration import TURNS
from polarguide.capture.colmap.model import read_model
from polarguide.capture.colmap.poses import Geometry, Poses
from polarguide.capture.colmap.sfm import LEAST_VIEWS, NotConnectedError, add_points, reconstruct, tone_mapped
from polarguide.capture.filter.shots import chosen_matching
from polarguide.capture.raw_options import SampledOptions, changed
from polarguide.capture.sensor.pattern import MosaicOptions
from polarguide.capture.view import ANGLES, listed
from polarguide.capture.write import (
    EXACT,
    intensity_codes,
    picture_names,
    rounded_radiance,
    suffix_of,
    write_png_file,
    write_view,
)
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import (
    check_out,
    holds_files,
    make_folder,
    require_inside,
    write_whole,
    writing,
)
from polarguide.core.progress import Reporter
from polarguide.core.records import decode, option_name, read_record, shortened, to_json
from polarguide.core.system import only_writer
from polarguide.core.text import canonical
from polarguide.preparation.filter_source import write_exposure_table
from polarguide.preparation.open_source import (
    POSE_NAMES,
    frames_of_video,
    known_poses,
    open_source,
    origin_of_poses,
    settle_pose_frames,
)
from polarguide.preparation.settings import PrepareSettings, known_intrinsics
from polarguide.preparation.source import (
    Journal,
    Measured,
    Request,
    Source,
    State,
    ViewRecord,
    WarpRecord,
    changed_entry,
    develop_view,
    request_of,
)

JOURNAL = "prepare.json"
SCENE = "scene.json"
SPLIT = "split.json"
SFM = ".sfm"
PARTIAL = ".sparse.partial"
FOLDERS = ("polar", "invalid", "masks", "sparse")
"""Folders of a scene that a preparation writes into."""
REMEDY = "Choose another --out. Nothing was written."


class SceneFolder:
    """Output folder of a preparation, either new or from an unfinished earlier call."""

    def __init__(self, root: Path, request: Request, measured_type: type[Measured]) -> None:
        """Open the folder without writing.

        Args:
            root: the folder.
            request: source, files and settings of this call. They must equal those of an earlier call.
            measured_type: type of the measurements of the source.

        Raises:
            PolarguideError: the folder contains other files, or the result of a different request.
        """
        self.root = root
        self.state = State[Any](request)
        self._existed = root.exists()
        check_out(root)
        unfinished = root / JOURNAL
        self.finished = (root / SCENE).exists() and not unfinished.exists()
        if self.finished or unfinished.exists():
            self._resume(root / SCENE if self.finished else unfinished, request, measured_type)
        elif root.exists() and holds_files(root):
            raise PolarguideError(
                root,
                expected="a new or empty folder, or an unfinished preparation",
                found="other files",
                remedy=REMEDY,
            )

    def _resume(self, path: Path, request: Request, measured_type: type[Measured]) -> None:
        """Read the state of an earlier call."""
        content = read_record(path, dict[str, Any])
        require(
            "prepare" in content,
            self.root,
            expected="a new folder, or one that prepare wrote",
            found=f"a {path.name} of another origin",
            remedy=REMEDY,
        )
        files = content["prepare"].get("request", {}).get("file", {})
        require(
            all(isinstance(digest, str) for digest in files.values()),
            path,
            expected="a preparation by this version",
            found="one by an earlier version",
            remedy="The scene still opens. To prepare again, choose another --out. Nothing was written.",
        )
        journal: Journal[Any] = decode(content, Journal[measured_type], path, remedy=REMEDY)  # type: ignore[valid-type]
        before = journal.prepare
        if before.request.format == "singles":
            for view, record in before.views.items():
                _require_exposures(path, view, record)
        difference = changed_entry(before.request, request)
        if difference is not None:
            name, was, is_now = difference
            raise PolarguideError(
                self.root,
                expected=f"a preparation with {name} {was}",
                found=f"{name} {is_now}",
                remedy="Repeat the earlier command, or choose another --out. Nothing was written.",
            )
        views = {canonical(view): record for view, record in before.views.items()}
        self.state = State(request, before.measured, views)

    @property
    def views(self) -> dict[str, ViewRecord]:
        """Records of the views that have been written, by name."""
        return self.state.views

    @property
    def measured(self) -> Measured:
        """Measurements that all views of the capture share."""
        assert self.state.measured is not None
        measured: Measured = self.state.measured
        return measured

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Create the folder, and lock it against other processes.

        Raises:
            PolarguideError: another process holds the lock, or the folder cannot be created.
        """
        make_folder(self.root)
        with only_writer(
            self.root,
            expected="a folder that no other process writes",
            found="another polarguide prepare that writes it",
        ):
            yield

    def start(self) -> None:
        """Write the request to the journal."""
        work = self.root / SFM
        require_inside(self.root, *(self.root / name for name in (*FOLDERS, PARTIAL, SFM)), *work.rglob("*"))
        make_folder(self.root)
        self.save()  # first, because a later call resumes from it
        make_folder(self.root / "polar")
        make_folder(self.root / "invalid")

    def abandon(self) -> None:
        """Undo a preparation that has written no view."""
        for name in (SFM, *FOLDERS):
            shutil.rmtree(self.root / name, ignore_errors=True)
        (self.root / JOURNAL).unlink(missing_ok=True)
        if not self._existed:
            with contextlib.suppress(OSError):  # another process added files
                self.root.rmdir()

    def save(self) -> None:
        """Write the journal."""
        write_whole(self.root / JOURNAL, to_json({"prepare": msgspec.to_builtins(self.state)}))

    def finish(self, summary: dict[str, Any]) -> None:
        """Write ``scene.json``, which marks the scene as complete, and remove the journal."""
        write_whole(self.root / SCENE, to_json({**summary, "prepare": msgspec.to_builtins(self.state)}))
        (self.root / JOURNAL).unlink(missing_ok=True)

    def has(self, view: str) -> bool:
        """Return True if the folder contains all files of a view."""
        record = self.views.get(view)
        return record is not None and all(
            (self.root / name).is_file() and (self.root / name).stat().st_size == size
            for name, size in record.files.items()
        )


def _require_exposures(journal: Path, view: str, record: ViewRecord) -> None:
    """Check that a journal contains the exposures of all pictures of a view.

    Raises:
        PolarguideError: exposures are missing.
    """
    angles = [exposure.angle for exposure in record.exposures or ()]
    named = picture_names(view, angles, suffix_of(record.files))
    pictures = sorted(name for name in record.files if name.startswith("polar/"))
    require(
        sorted(named) == pictures and named,
        f"{journal} (views, {shortened(view)})",
        expected=f"the exposures of {shortened(pictures)}",
        found=shortened(named),
        remedy=REMEDY,
    )


def _structure(folder: SceneFolder, pictures: Source, settings: PrepareSettings, reporter: Reporter) -> Path:
    """Estimate the poses of all views by structure from motion, and return the folder of the COLMAP model.

    Raises:
        PolarguideError: too few views are registered.
    """
    photographs = _photographs(folder, pictures, settings, reporter, pictures.views)
    matching = chosen_matching(pictures.views, settings.matching, reporter)
    return reconstruct(
        folder.root / SFM,
        {view: geometry.size for view, geometry in photographs.items()},
        matching=matching,
        seed=settings.seed,
        reporter=reporter,
        untried=_untried(settings, matching, pictures.kind),
        intrinsics=None if settings.intrinsics is None else known_intrinsics(settings.intrinsics),
        lenses=pictures.lenses(),
    )


def _points(
    folder: SceneFolder, pictures: Source, settings: PrepareSettings, poses: Poses, reporter: Reporter
) -> tuple[Poses, dict[str, Any]]:
    """Triangulate points for given poses.

    Returns:
        The poses with points; and a record of the triangulation.

    Raises:
        PolarguideError: the cameras do not look at a common place.
    """
    model, record = add_points(
        folder.root / SFM,
        poses.developed(_photographs(folder, pictures, settings, reporter, poses.views)),
        poses.folder,
        matching=chosen_matching(poses.views, settings.matching, reporter),
        seed=settings.seed,
        reporter=reporter,
    )
    return Poses.read(model, pictures.views), record


def _photographs(
    folder: SceneFolder, pictures: Source, settings: PrepareSettings, reporter: Reporter, views: list[str]
) -> dict[str, Geometry]:
    """Write tone-mapped pictures and object masks of views to a hidden folder of the scene.

    Returns:
        Size and orientation of each picture by view.
    """
    images = folder.root / SFM / "images"
    masks = folder.root / SFM / "masks"
    known = folder.measured.photographs or {}
    folder.measured.photographs = known
    for path in (images, masks):
        make_folder(path)
    with reporter.track("photographs", len(views)) as advance:
        for count, view in enumerate(views, 1):
            path = images / f"{view}.png"
            if view not in known or not path.exists():
                done = develop_view(pictures, view, folder.measured)
                if done.mask is not None:
                    write_png_file(masks / f"{view}.png", done.mask.astype(np.uint8) * 255)
                write_png_file(path, tone_mapped(done.intensities, settings.sfm_pictures))
                known[view] = done.record.geometry
                folder.save()
            advance(count)
    return {view: known[view] for view in views}


def _untried(settings: PrepareSettings, matching: str, kind: str) -> str:
    """Return the options that may improve structure from motion and were not used, for a message."""
    ways = ["--matching exhaustive (compares all pairs)"] if matching != "exhaustive" else []
    if settings.sfm_pictures != "minimum" and kind != "singles":  # the minimum of one picture is the picture
        ways.append("--sfm-pictures minimum (less glare)")
    if settings.intrinsics is None:
        ways.append("--intrinsics fx,fy,cx,cy (in pixels of the developed pictures)")
    ways.append("--poses PATH (a COLMAP model, or cameras of another program)")
    return f"Options that may help: {', '.join(ways)}."


MOSTLY = 0.5
"""Share of saturated pixels above which a warning about the view is printed."""
# Largest number of notes on single views that are printed.
_NOTES = 4


@dataclass(frozen=True)
class Prepared:
    """Result of a preparation.

    Attributes:
        folder: folder of the scene.
        views: names of the views in it.
        left_out: names of views that were left out because they have no pose.
        posed: True if the scene has a COLMAP model.
        new: True if this call wrote files.
    """

    folder: Path
    views: list[str]
    left_out: list[str]
    posed: bool
    new: bool


def prepare_scene(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    settings: PrepareSettings | None = None,
    reporter: Reporter | None = None,
) -> Prepared:
    """Write a scene folder from camera files. docs/reference/formats.md describes its files.

    If a call was stopped, the same call resumes it. Files of a different request are never replaced.

    Args:
        source: folder of raw mosaics, of filter shots, or of single shots; or a video.
        out: scene folder. It is new, empty, or contains the unfinished result of an equal call.
        settings: settings of the preparation.
        reporter: receiver of messages and progress.

    Raises:
        PolarguideError: the source or a setting is invalid, ``out`` contains other files, or structure from motion does
            not connect the views. In the last case, this call leaves no files in ``out``.
    """
    reporter = reporter or Reporter()
    target = Path(out)
    settings = (settings or PrepareSettings()).checked()
    root, settings = frames_of_video(Path(source), target, settings, reporter)
    pictures = open_source(root, settings)
    settings = replace(settings, poses=origin_of_poses(pictures, settings.poses))
    require(
        settings.poses == "sfm" or settings.intrinsics is None,
        "--intrinsics",
        expected="--poses sfm with --intrinsics",
        found=f"--poses {settings.poses}",
        remedy="Omit --intrinsics: the poses contain the cameras.",
    )
    if settings.poses == "sfm" and len(pictures.views) < LEAST_VIEWS:
        raise PolarguideError(
            root,
            expected=f"at least {LEAST_VIEWS} views for poses by structure from motion",
            found=f"{len(pictures.views)} ({listed(pictures.views)})",
            remedy=_without_poses(root, pictures, settings),
        )
    poses = known_poses(root, pictures, settings.poses, settings.poses_of)
    frames = ""
    if poses is not None and settings.poses != "dataset":
        frames = settle_pose_frames(pictures, poses, settings.poses_of)
    model = () if poses is None else poses.files
    files = [*pictures.paths, *pictures.masks.values(), *model]
    request = request_of(root, pictures.kind, settings.record(), files)
    folder = SceneFolder(target, request, pictures.measured_type)
    if folder.finished:
        reporter.say(f"{target} is already complete.")
        return _outcome(folder, pictures, settings, new=False)
    reporter.say(f"{pictures.description}.")
    if poses is not None:
        for note in filter(None, (frames, *poses.notes)):
            reporter.say(note)
    unused = [f"--poses {shlex.quote(str(root / name))}" for name in POSE_NAMES if (root / name).exists()]
    if unused and settings.poses == "sfm":
        options = " or ".join(unused)
        reporter.say(f"Poses by structure from motion. The folder also contains poses: use {options}.")
    if folder.state.measured is None:
        with reporter.track("measuring", len(pictures.views)) as advance:
            folder.state.measured = pictures.measure(advance)
        bare = [view for view in pictures.views if view not in pictures.masks]
        if pictures.masks and bare:
            folder.measured.notes.append(
                f"{len(bare)} of {len(pictures.views)} views have no mask and are used completely ({listed(bare)})."
            )
        for note in folder.measured.notes:
            reporter.say(note)
    with folder.lock():
        return _write_scene(root, folder, pictures, settings, poses, reporter)


def _write_scene(
    root: Path,
    folder: SceneFolder,
    pictures: Source,
    settings: PrepareSettings,
    poses: Poses | None,
    reporter: Reporter,
) -> Prepared:
    """Write the missing parts of a scene whose capture has been measured."""
    tests = () if poses is None else poses.held_out
    folder.start()
    points: dict[str, Any] | None = None
    if settings.poses == "sfm":
        try:
            poses = Poses.read(_structure(folder, pictures, settings, reporter), pictures.views)
        except NotConnectedError as error:
            folder.abandon()
            raise PolarguideError(
                root,
                expected=error.expected,
                found=error.found,
                remedy=f"{error.remedy} {_without_poses(root, pictures, settings)}",
            ) from None
        points = {"from": "structure from motion", "count": poses.points}
    elif poses is not None and not poses.points:
        poses, points = _points(folder, pictures, settings, poses, reporter)
    elif poses is not None:
        points = {"from": "the model given", "count": poses.points}
    if poses is not None and poses.missing:
        reporter.warn(
            f"{len(poses.missing)} of {len(pictures.views)} views have no pose and are skipped "
            f"({listed(poses.missing)})."
            + (f" Other models: {listed([str(folder) for folder in poses.others])}." if poses.others else "")
        )
    _write_views(folder, pictures, poses, reporter)
    if note := _turns(folder):
        reporter.say(note)
    if poses is not None:
        _write_model(folder, poses)
        held_out = [view for view in poses.views if view in tests]
        if held_out and not os.path.lexists(folder.root / SPLIT):
            write_whole(folder.root / SPLIT, to_json({"test": held_out}))
    if pictures.kind == "singles":
        write_exposure_table(
            folder.root, folder.views, settings.gains, posed=poses is not None, reporter=reporter
        )
    folder.finish(_summary(folder, pictures, settings, points))
    shutil.rmtree(folder.root / SFM, ignore_errors=True)
    return _outcome(folder, pictures, settings, new=True)


def _without_poses(root: Path, pictures: Source, settings: PrepareSettings) -> str:
    """Return the remedy for a capture whose poses cannot be estimated. It contains commands that need no poses."""
    out = f"--out {shlex.quote(root.resolve().name + '-priors')}"
    if pictures.kind == "singles":
        return "--poses none develops the photographs without poses."
    if pictures.kind not in ("mosaic", "filter"):
        return (
            f"Without poses: --poses none develops the views, and polarguide priors SCENE {out} shows them."
        )
    differing = changed(settings)
    names = [f.name for f in (*fields(MosaicOptions), *fields(SampledOptions)) if f.name != "calibration"]
    flags = [f" {option_name(name)} {getattr(settings, name)}" for name in names if name in differing]
    command = f"polarguide priors {shlex.quote(str(root))} {out}{''.join(flags)}"
    return (
        f"S0, DoLP, AoLP, normals and separation of single views: {command}. "
        "Nothing was written. --poses none develops the views without poses."
    )


def _write_views(folder: SceneFolder, pictures: Source, poses: Poses | None, reporter: Reporter) -> None:
    views = pictures.views if poses is None else poses.views
    faults: list[str] = []
    notes: list[str] = []
    with reporter.track("writing views", len(views)) as advance:
        for count, view in enumerate(views, 1):
            if not folder.has(view):
                view_faults, view_notes = _write_view(folder, pictures, view, poses)
                faults += view_faults
                notes += view_notes
            advance(count)
    for text in _shorten(faults, "views are black, saturated or masked"):
        reporter.warn(text)
    for text in _shorten(notes, "notes on views"):
        reporter.say(text)


def _shorten(texts: list[str], others: str) -> list[str]:
    """Return the first texts. If there are more, add a sentence with their number."""
    rest = len(texts) - _NOTES
    more = [f"{rest} more {others}. {SCENE} lists their figures."] if rest > 0 else []
    return [*texts[:_NOTES], *more]


def _write_view(
    folder: SceneFolder, pictures: Source, view: str, poses: Poses | None
) -> tuple[list[str], tuple[str, ...]]:
    """Write the pictures of a view.

    Returns:
        Faults of the view; and notes about it for the user.
    """
    done = develop_view(pictures, view, folder.measured)
    intensities = done.intensities
    invalid = done.invalid
    mask = done.mask
    record = done.record
    if poses is not None:
        warp = poses.warp(view, record.geometry)
        intensities, invalid = warp.apply(intensities, invalid)
        mask = None if mask is None else warp.apply_mask(mask)
        removed = warp.record()
        record.warp = None if removed is None else WarpRecord(**removed)
    rounding = getattr(folder.measured, "rounding", EXACT)
    if not folder.measured.bracketed:
        codes: NDArray[Any] = intensity_codes(intensities, invalid, rounding)
    else:
        codes = intensities if rounding == EXACT else rounded_radiance(intensities)
    record.files = write_view(folder.root, view, codes, invalid, mask, done.angles)
    folder.views[view] = record
    folder.save()
    faults = [] if mask is None or mask.any() else [f"{view}: its mask shows no object."]
    if record.clipped_share > MOSTLY:
        faults.append(f"{view}: {record.clipped_share:.0%} of its pixels are saturated.")
    elif not all(picture.any() for picture in intensities):
        faults.append(f"{view}: one of its pictures is completely black.")
    elif len(intensities) > 1 and all(np.array_equal(intensities[0], other) for other in intensities[1:]):
        faults.append(f"{view}: its {'four ' * (len(intensities) == 4)}pictures are identical.")
    elif list(done.angles or ANGLES) == list(ANGLES):
        faults += [
            f"{view}: its pictures at {ANGLES[a]} and {ANGLES[b]} degrees are identical."
            for a, b in itertools.combinations(range(len(ANGLES)), 2)
            if np.array_equal(intensities[a], intensities[b])
        ]
    return faults, done.notes


def _turns(folder: SceneFolder) -> str:
    """Return a note on the views that were rotated for display. The note is empty if there are no such views."""
    records = [record for record in folder.views.values() if record.turned]
    if not records:
        return ""
    counts = sorted(Counter(int(record.orientation or 1) for record in records).items())
    turned = listed([f"{count} {TURNS[code]}" for code, count in counts])
    noted = [shot.angle for record in records for shot in record.exposures or ()]
    # The list is empty if all views have shots at the usual four angles.
    angles = not noted or any(not isinstance(angle, str) for angle in noted)
    also = ", including their polarizer angles" if angles else ""
    return f"EXIF orientation: {len(records)} of {len(folder.views)} views were rotated for display{also} ({turned})."


def _write_model(folder: SceneFolder, poses: Poses) -> None:
    """Write the COLMAP model, validate it by reading it, and then replace the old model in one step."""
    partial = folder.root / PARTIAL
    final = folder.root / "sparse"
    for old in (partial, final):
        shutil.rmtree(old, ignore_errors=True)
    make_folder(partial / "sparse" / "0")
    for view in poses.views:
        poses.warp(view, folder.views[view].geometry)
    poses.write(partial / "sparse" / "0")
    model = read_model(partial)
    for view in poses.views:
        model.camera(view)
    with writing(final):
        (partial / "sparse").rename(final)
    shutil.rmtree(partial, ignore_errors=True)


def _summary(
    folder: SceneFolder, pictures: Source, settings: PrepareSettings, points: dict[str, Any] | None
) -> dict[str, Any]:
    """Return the part of ``scene.json`` that describes the scene to users.

    All remaining values of the preparation are in its entry "prepare".
    """
    measured = msgspec.to_builtins(folder.measured)
    for name in ("photographs", "light"):
        measured.pop(name, None)
    calibration = settings.calibration.record()
    calibration["sense"] = measured.pop("sense", calibration["sense"])
    shares = [record.clipped_share for record in folder.views.values()]
    return {
        "prepared_by": f"polarguide {__version__}",
        "format": pictures.kind,
        **({"polarizer": "filter"} if pictures.kind in ("filter", "singles") else {}),
        "sensor": settings.sensor,
        "packing": settings.packing,
        **measured,
        "calibration": calibration,
        "clipped_share": round(sum(shares) / max(1, len(shares)), 6),
        "poses": settings.poses,
        "points": points,
    }


def _outcome(folder: SceneFolder, pictures: Source, settings: PrepareSettings, *, new: bool) -> Prepared:
    views = sorted(folder.views)
    left_out = [view for view in pictures.views if view not in folder.views]
    return Prepared(folder.root, views, left_out, settings.poses != "none", new)
