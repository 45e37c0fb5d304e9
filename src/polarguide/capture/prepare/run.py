"""``prepare_scene``: camera files -> a scene folder."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from polarguide import __version__
from polarguide.capture.colmap import read_model
from polarguide.capture.filter import find_shots
from polarguide.capture.layout import angle_folders, contents
from polarguide.capture.prepare.filter_source import FilterSource
from polarguide.capture.prepare.folder import SFM, SceneFolder, encoded, guarded, write_whole
from polarguide.capture.prepare.mosaic_source import MosaicSource
from polarguide.capture.prepare.poses import Poses
from polarguide.capture.prepare.reporter import Reporter
from polarguide.capture.prepare.settings import PrepareSettings, check_format, check_settings
from polarguide.capture.prepare.sfm import reconstruct, tone_mapped
from polarguide.capture.prepare.source import Geometry, Source
from polarguide.capture.view import listed
from polarguide.errors import PolarguideError

_PARTIAL = ".sparse.partial"


@dataclass(frozen=True)
class Prepared:
    """What came of it.

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
    """Write a scene folder from camera files; see docs/formats.md.

    A call that was stopped is gone on with by the same call. Nothing but unfinished work of the same request
    is ever replaced.

    Args:
        source: folder of raw mosaics or of filter shots.
        out: scene folder: new, empty, or of the same request.
        settings: what to do.
        reporter: where messages and progress go.

    Raises:
        PolarguideError: the source or a setting cannot be used, or ``out`` holds something else.
    """
    settings, reporter = settings or PrepareSettings(), reporter or Reporter()
    root, target = Path(source), Path(out)
    check_settings(settings)
    pictures = open_source(root, settings)
    poses = Poses(Path(settings.poses), pictures.views) if settings.poses not in ("sfm", "none") else None
    folder = SceneFolder(target, _request(root, pictures, settings, poses))
    if folder.finished:
        reporter.say(f"{target} is complete already; nothing to do.")
        return _outcome(folder, pictures, settings, new=False)
    reporter.say(f"{len(pictures.views)} views, format {pictures.kind}.")
    if folder.measured is None:
        with reporter.track("measuring", len(pictures.views)) as advance:
            folder.measured = pictures.measure(advance)
        for note in folder.measured["notes"]:
            reporter.say(note)
    folder.start()
    if settings.poses == "sfm":
        poses = Poses(_structure(folder, pictures, settings, reporter), pictures.views)
    if poses is not None and poses.missing:
        reporter.warn(
            f"{len(poses.missing)} of {len(pictures.views)} views have no pose and are left out "
            f"({listed(poses.missing)})."
        )
    _write_views(folder, pictures, poses, reporter)
    if poses is not None:
        _write_model(folder, poses)
    folder.finish(_summary(folder, pictures, settings))
    shutil.rmtree(target / SFM, ignore_errors=True)
    return _outcome(folder, pictures, settings, new=True)


def open_source(root: Path, settings: PrepareSettings) -> Source:
    """The pictures in a folder, in the format asked for or found.

    Raises:
        PolarguideError: there is no such folder, or nothing in it that can be read.
    """
    if not root.is_dir():
        raise PolarguideError(
            root,
            expected="a folder of camera files",
            found="a file" if root.exists() else "nothing",
            remedy="Give the folder that holds the raw mosaics, or the shots through the filter.",
        )
    kind = settings.format
    if kind == "auto":
        several = any(len(files) > 1 for files in find_shots(root).values())
        kind = "filter" if several or angle_folders(root) else "mosaic"
    check_format(settings, kind)
    found = FilterSource(root, settings) if kind == "filter" else MosaicSource(root, settings)
    if not found.views:
        raise PolarguideError(
            root,
            expected="raw mosaics (PNG, TIFF, .npy, .raw) or four shots per view (folders 0, 45, 90, 135)",
            found=contents(root),
            remedy="See docs/formats.md for the layouts.",
        )
    return found


def _request(root: Path, pictures: Source, settings: PrepareSettings, poses: Poses | None) -> dict[str, Any]:
    """What must not change between the calls that write one scene."""

    def fingerprint(path: Path) -> list[int]:
        found = path.stat()
        return [found.st_size, found.st_mtime_ns]

    request = {
        "source": str(root.resolve()),
        "format": pictures.kind,
        "settings": settings.record(),
        "file": {str(path): fingerprint(path) for path in pictures.paths if path.exists()},
    }
    if poses is not None:
        request["model"] = {path.name: fingerprint(path) for path in sorted(poses.folder.iterdir())}
    return request


def _structure(folder: SceneFolder, pictures: Source, settings: PrepareSettings, reporter: Reporter) -> Path:
    """Tone-mapped photographs of all views, and the model that SfM finds in them."""
    images = folder.root / SFM / "images"
    guarded(lambda: images.mkdir(parents=True, exist_ok=True), images)
    sizes: dict[str, tuple[int, int]] = {}
    assert folder.measured is not None
    with reporter.track("photographs for SfM", len(pictures.views)) as advance:
        for count, view in enumerate(pictures.views, 1):
            path = images / f"{view}.png"
            known = folder.measured.setdefault("sfm_sizes", {})
            if view not in known or not path.exists():
                shown = tone_mapped(pictures.develop(view, folder.measured).intensities)
                write_whole(path, encoded(shown))
                known[view] = [shown.shape[1], shown.shape[0]]
                folder.save()
            sizes[view] = (known[view][0], known[view][1])
            advance(count)
    return reconstruct(
        folder.root / SFM, sizes, matching=settings.matching, seed=settings.seed, reporter=reporter
    )


def _write_views(folder: SceneFolder, pictures: Source, poses: Poses | None, reporter: Reporter) -> None:
    assert folder.measured is not None
    views = pictures.views if poses is None else poses.views
    for view in folder.views.keys() - set(views):
        folder.drop(view)
    with reporter.track("writing views", len(views)) as advance:
        for count, view in enumerate(views, 1):
            known = folder.views.get(view)
            if known is not None and poses is not None:
                warp = poses.warp(view, Geometry.of(known["geometry"])).record()
            else:
                warp = None
            if not folder.has(view, warp):
                _write_view(folder, pictures, view, poses, reporter)
            advance(count)


def _write_view(
    folder: SceneFolder, pictures: Source, view: str, poses: Poses | None, reporter: Reporter
) -> None:
    assert folder.measured is not None
    done = pictures.develop(view, folder.measured)
    intensities, invalid, record = done.intensities, done.invalid, None
    if poses is not None:
        warp = poses.warp(view, done.geometry)
        intensities, invalid = warp.apply(intensities, invalid)
        record = warp.record()
    folder.write_view(
        view, intensities, invalid, {**done.record, "geometry": done.geometry.record(), "warp": record}
    )
    for note in done.notes:
        reporter.say(note)


def _write_model(folder: SceneFolder, poses: Poses) -> None:
    """Put the model into place in one step, after reading it back."""
    partial, final = folder.root / _PARTIAL, folder.root / "sparse"
    for old in (partial, final):
        shutil.rmtree(old, ignore_errors=True)
    guarded(lambda: (partial / "sparse" / "0").mkdir(parents=True), partial)
    poses.write(partial / "sparse" / "0")
    model = read_model(partial)
    for view in poses.views:
        model.camera(view)
    guarded(lambda: (partial / "sparse").rename(final), final)
    shutil.rmtree(partial, ignore_errors=True)


def _summary(folder: SceneFolder, pictures: Source, settings: PrepareSettings) -> dict[str, Any]:
    """What ``scene.json`` says to people; everything else is under "prepare"."""
    measured = dict(folder.measured or {})
    measured.pop("sfm_sizes", None)
    shares = [record["clipped_share"] for record in folder.views.values()]
    return {
        "prepared_by": f"polarguide {__version__}",
        "format": pictures.kind,
        "sensor": settings.sensor,
        "packing": settings.packing,
        **measured,
        "calibration": settings.calibration.record(),
        "clipped_share": round(sum(shares) / max(1, len(shares)), 6),
        "poses": settings.poses,
    }


def _outcome(folder: SceneFolder, pictures: Source, settings: PrepareSettings, *, new: bool) -> Prepared:
    views = sorted(folder.views)
    left_out = [view for view in pictures.views if view not in folder.views]
    return Prepared(folder.root, views, left_out, settings.poses != "none", new)
