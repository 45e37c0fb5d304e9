"""``prepare_scene``: camera files -> a scene folder."""

from __future__ import annotations

import itertools
import os
import shlex
import shutil
from collections import Counter
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from polarguide import __version__
from polarguide.capture.colmap.model import read_model
from polarguide.capture.colmap.poses import Poses
from polarguide.capture.colmap.sfm import LEAST_VIEWS, NotConnectedError
from polarguide.capture.filter.camera_files import TURNS
from polarguide.capture.raw_options import SampledOptions, changed
from polarguide.capture.sensor.pattern import MosaicOptions
from polarguide.capture.view import ANGLES, listed
from polarguide.core.errors import PolarguideError
from polarguide.core.files import make_folder, writing
from polarguide.core.progress import Reporter
from polarguide.core.records import option_name
from polarguide.preparation.exposure_table import write_exposure_table
from polarguide.preparation.folder import JOURNAL, PARTIAL, SCENE, SFM, SceneFolder, Workshop
from polarguide.preparation.journal import request_of
from polarguide.preparation.open_source import (
    frames_of_video,
    known_poses,
    open_source,
    origin_of_poses,
    poses_beside,
    settle_pose_frames,
)
from polarguide.preparation.settings import PrepareSettings
from polarguide.preparation.source import Source, developed

MOSTLY = 0.5
"""Share of saturated pixels from which on a view is warned of."""
# Notes on single views that are printed; sixty alike hide what matters.
_NOTES = 4


@dataclass(frozen=True)
class Prepared:
    """The outcome of a preparation.

    Attributes:
        folder: the scene.
        views: names of the views in it.
        left_out: views without a pose.
        posed: whether it has a COLMAP model.
        new: whether anything was written by this call.
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
    """Write a scene folder from camera files; see docs/reference/formats.md.

    The same call resumes a stopped one. Nothing but unfinished work of the same request
    is ever replaced.

    Args:
        source: folder of raw mosaics, of filter shots, or of single shots; or a video.
        out: scene folder: new, empty, or of the same request.
        settings: what to do.
        reporter: where messages and progress go.

    Raises:
        PolarguideError: the source or a setting cannot be used, ``out`` holds something else, or structure from motion
            does not connect the views; then nothing of this call is left in ``out``.
    """
    settings = settings or PrepareSettings()
    reporter = reporter or Reporter()
    root = Path(source)
    target = Path(out)
    settings = settings.checked()
    root, settings = frames_of_video(root, target, settings, reporter)
    pictures = open_source(root, settings)
    settings = replace(settings, poses=origin_of_poses(pictures, settings.poses))
    if settings.poses != "sfm" and settings.intrinsics is not None:
        raise PolarguideError(
            "--intrinsics",
            expected="poses by structure from motion, which they are for",
            found=f"--poses {settings.poses}",
            remedy="Leave them out: the cameras come with the poses.",
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
    request = request_of(
        root,
        [target / JOURNAL, target / SCENE],
        pictures.kind,
        settings.record(),
        [*pictures.paths, *pictures.masks.values()],
        poses.files if poses is not None else (),
    )
    folder = SceneFolder(target, request, pictures.measured_type)
    if folder.finished:
        reporter.say(f"{target} is complete already; nothing to do.")
        return _outcome(folder, pictures, settings, new=False)
    reporter.say(f"{len(pictures.views)} views, format {pictures.kind}.")
    if frames:
        reporter.say(frames)
    for note in poses.notes if poses is not None else ():
        reporter.say(note)
    for warning in poses.warnings if poses is not None else ():
        reporter.warn(warning)
    beside = poses_beside(root) if settings.poses == "sfm" else []
    if beside:
        ways = " or ".join(f"--poses {shlex.quote(str(root / name))}" for name in beside)
        reporter.say(
            f"Poses by structure from motion. The folder holds poses, too: {ways} takes them instead."
        )
    if folder.state.measured is None:
        with reporter.track("measuring", len(pictures.views)) as advance:
            folder.state.measured = pictures.measure(advance)
        bare = [view for view in pictures.views if view not in pictures.masks]
        if pictures.masks and bare:
            folder.measured.notes.append(
                f"{len(bare)} of {len(pictures.views)} views have no mask and are used whole ({listed(bare)})."
            )
        for note in folder.measured.notes:
            reporter.say(note)
    with folder.held():
        return _write_scene(root, folder, pictures, settings, poses, reporter)


def _write_scene(
    root: Path,
    folder: SceneFolder,
    pictures: Source,
    settings: PrepareSettings,
    poses: Poses | None,
    reporter: Reporter,
) -> Prepared:
    """Write what is missing of a scene that has been measured."""
    tests = () if poses is None else poses.held_out
    folder.start()
    work = Workshop(folder, pictures, settings, reporter)
    points: dict[str, Any] | None = None
    if settings.poses == "sfm":
        try:
            poses = Poses.read(work.structure(), pictures.views)
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
        poses, points = work.points(poses)
    elif poses is not None:
        points = {"from": "the model given", "count": poses.points}
    if poses is not None and poses.missing:
        reporter.warn(
            f"{len(poses.missing)} of {len(pictures.views)} views have no pose and are left out "
            f"({listed(poses.missing)})."
            + "".join(f" {folder} is another model, with {count} views." for folder, count in poses.others())
        )
    _write_views(folder, pictures, poses, reporter)
    if note := _turns(folder):
        reporter.say(note)
    if poses is not None:
        _write_model(folder, poses)
        folder.hold_out([view for view in poses.views if view in tests])
    if pictures.kind == "singles":
        write_exposure_table(folder, settings.gains, posed=poses is not None, reporter=reporter)
    folder.finish(_summary(folder, pictures, settings, points))
    shutil.rmtree(folder.root / SFM, ignore_errors=True)
    return _outcome(folder, pictures, settings, new=True)


def _without_poses(root: Path, pictures: Source, settings: PrepareSettings) -> str:
    """A message's list of what views without poses can be used for."""
    out = f"--out {shlex.quote(root.resolve().name + '-priors')}"
    if pictures.kind == "singles":
        return "--poses none develops the photographs without poses."
    if pictures.kind not in ("mosaic", "filter"):
        return (
            f"Without poses: --poses none develops the views, then polarguide priors SCENE {out} shows each."
        )
    differing = changed(settings)
    names = [f.name for f in (*fields(MosaicOptions), *fields(SampledOptions)) if f.name != "calibration"]
    flags = [f" {option_name(name)} {getattr(settings, name)}" for name in names if name in differing]
    command = f"polarguide priors {shlex.quote(str(root))} {out}{''.join(flags)}"
    return (
        f"Each view alone has S0, DoLP, AoLP, normals and separations: {command}. "
        "Nothing was written; --poses none develops the views without poses."
    )


def _write_views(folder: SceneFolder, pictures: Source, poses: Poses | None, reporter: Reporter) -> None:
    views = pictures.views if poses is None else poses.views
    for view in folder.views.keys() - set(views):
        folder.drop(view)
    faults: list[str] = []
    notes: list[str] = []
    with reporter.track("writing views", len(views)) as advance:
        for count, view in enumerate(views, 1):
            known = folder.views.get(view)
            warp = None
            if known is not None and known.turned and pictures.used_as_stored(view):
                folder.drop(view)  # an earlier call without poses turned it for display
                known = None
            if known is not None and poses is not None:
                warp = poses.warp(view, known.geometry).record()
            if not folder.has(view, warp):
                found_faults, found_notes = _write_view(folder, pictures, view, poses)
                faults += found_faults
                notes += found_notes
            advance(count)
    for text in faults[:_NOTES]:
        reporter.warn(text)
    if len(faults) > _NOTES:
        reporter.warn(
            f"{len(faults) - _NOTES} more views are black, saturated or masked; {SCENE} has their figures."
        )
    for note in notes[:_NOTES]:
        reporter.say(note)
    if len(notes) > _NOTES:
        reporter.say(f"... and {len(notes) - _NOTES} more notes on views; {SCENE} has their figures.")


def _write_view(
    folder: SceneFolder, pictures: Source, view: str, poses: Poses | None
) -> tuple[list[str], tuple[str, ...]]:
    """Write the pictures of a view; returns what makes it useless, and the notes about it."""
    done = developed(pictures, view, folder.measured)
    intensities = done.intensities
    invalid = done.invalid
    mask = done.mask
    record = done.record
    if poses is not None:
        warp = poses.warp(view, record.geometry)
        intensities, invalid = warp.apply(intensities, invalid)
        mask = None if mask is None else warp.apply_mask(mask)
        record.warp = warp.record()
    folder.write_view(view, intensities, invalid, record, mask, done.angles)
    faults = [] if mask is None or mask.any() else [f"{view}: its mask shows no object."]
    if record.clipped_share > MOSTLY:
        faults.append(f"{view}: {record.clipped_share:.0%} of its pixels are saturated.")
    elif not all(picture.any() for picture in intensities):
        faults.append(f"{view}: a picture of it is black throughout.")
    elif len(intensities) > 1 and all(np.array_equal(intensities[0], other) for other in intensities[1:]):
        faults.append(
            f"{view}: its {'four ' * (len(intensities) == 4)}pictures are the same, as copies of one are."
        )
    elif list(done.angles or ANGLES) == list(ANGLES):
        faults += [
            f"{view}: its pictures at {ANGLES[a]} and {ANGLES[b]} degrees are the same, as copies of one are."
            for a, b in itertools.combinations(range(len(ANGLES)), 2)
            if np.array_equal(intensities[a], intensities[b])
        ]
    return faults, done.notes


def _turns(folder: SceneFolder) -> str:
    """Which views were turned for display, and their polarizer angles with them; empty where none was."""
    records = [record for record in folder.views.values() if record.turned]
    if not records:
        return ""
    counts = sorted(Counter(int(record.orientation or 1) for record in records).items())
    turned = listed([f"{count} {TURNS[code]}" for code, count in counts])
    noted = [shot.angle for record in records for shot in record.exposures or ()]
    # Shots of a view at the usual four angles have no list of exposures.
    angles = not noted or any(not isinstance(angle, str) for angle in noted)
    also = ", and the polarizer angles with them" if angles else ""
    return f"EXIF orientation: {len(records)} of {len(folder.views)} views were turned for display{also} ({turned})."


def _write_model(folder: SceneFolder, poses: Poses) -> None:
    """Put the model into place in one step, after reading it back."""
    partial = folder.root / PARTIAL
    final = folder.root / "sparse"
    for old in (partial, final):
        shutil.rmtree(old, ignore_errors=True)
    make_folder(partial / "sparse" / "0")
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
    """The notes in ``scene.json`` for readers; everything else is under "prepare"."""
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
