"""Detect the format of a capture, and find its poses.

Poses refer to the pictures as stored, or to the pictures after rotation by EXIF orientation. This module decides which.
"""

from __future__ import annotations

import shlex
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from polarguide.capture.calibration import QUARTER_TURNS, TURNS
from polarguide.capture.colmap.model import holds_model, view_of_name
from polarguide.capture.colmap.poses import Poses
from polarguide.capture.exposures import TABLE, angles_of_names, folders_of_angles, parse_angle
from polarguide.capture.filter.shots import (
    SHOT_SUFFIXES,
    extract_frames,
    find_shots,
    find_videos,
    shots_of_one_place,
)
from polarguide.capture.formats.pictures import decode_picture
from polarguide.capture.formats.stored import SUFFIXES, read_picture
from polarguide.capture.layout import (
    angle_folders,
    describe_contents,
    index_shot_files,
    list_shot_files,
    numbered_like_angles,
    shot_stem,
)
from polarguide.capture.pose_files import SUFFIXES as POSE_FILES
from polarguide.capture.pose_files import TEST, parts_of_poses, read_parts
from polarguide.capture.sensor.mosaics import RAW_SUFFIXES
from polarguide.capture.sensor.pattern import SENSOR_NAMES
from polarguide.capture.view import ANGLES, listed
from polarguide.core.errors import PolarguideError, PolarguideWarning, import_part, require
from polarguide.core.files import require_folder
from polarguide.core.progress import Reporter
from polarguide.core.text import command, stem_of
from polarguide.preparation.datasets import READER_MODULE, detect_dataset
from polarguide.preparation.filter_source import FilterSource, ShotsSource, SinglesSource
from polarguide.preparation.mosaic_source import MosaicSource
from polarguide.preparation.settings import (
    FilterSettings,
    MosaicSettings,
    PrepareSettings,
    SinglesSettings,
    settings_of_format,
)
from polarguide.preparation.source import Source


def _find_masks(folder: Path, views: Sequence[str]) -> dict[str, Path]:
    """Return the object masks of a folder by view.

    Masks are named like views, or as in COLMAP and Metashape (``cup.jpg.png``, ``cup_mask.png``).

    Raises:
        PolarguideError: the folder does not exist, or no picture in it is named like a view.
    """
    require(
        folder.is_dir(),
        "--masks",
        expected="a folder of masks named like the views",
        found=f"{folder}, which is not a folder",
        remedy="Specify the folder that contains <view>.png.",
    )
    files = sorted(folder.iterdir())
    masks: dict[str, Path] = {}
    for shorten in (str, view_of_name, lambda name: name.removesuffix("_mask")):
        for path in files:
            view = shorten(stem_of(path))
            if view in views and path.suffix.lower() in SUFFIXES:
                masks.setdefault(view, path)
    require(
        masks,
        folder,
        expected=f"masks named like the views ({listed(list(views), 3)})",
        found=listed([path.name for path in files], 3) or "no file",
        remedy="Rename them. Views without a mask are used completely.",
    )
    return masks


def open_source(root: Path, settings: PrepareSettings) -> Source:
    """Open the pictures in a folder, in the specified or detected format.

    Raises:
        PolarguideError: the folder does not exist, or contains no readable picture.
    """
    require_folder(
        root,
        expected="a folder of camera files",
        remedy="Specify the folder that contains the raw mosaics, or the shots through the filter.",
    )
    kind: str = settings.format
    settings, shots, assumed = _consecutive(root, settings)
    if shots is not None and kind == "auto":
        kind = "filter"
        settings = replace(settings, angles=None, shots_per_view=None)
    elif kind == "auto":
        kind = detect_dataset(root) or ("singles" if are_single_shots(root, settings) else "filter")
        if kind == "filter" and not angle_folders(root):
            shots = find_shots(root, nested=settings.sensor is None)
            kind = "filter" if any(len(files) > 1 for files in shots.values()) else "mosaic"
            if kind == "mosaic" and settings.sensor is None:
                _require_photographs(root)
                kind = "singles"
                settings = replace(settings, angles="none")
                assumed = (_ORDINARY,)
    source = _source(root, settings, kind, shots)
    if isinstance(source, ShotsSource):
        source.assumed = assumed
    if not source.views:
        raise PolarguideError(
            root,
            expected="raw mosaics (PNG, TIFF, .npy, .raw) or shots through a filter (folders 0, 45, 90, 135, ...)"
            if kind in ("mosaic", "filter", "singles")
            else f"the files of a {kind} dataset",
            found=describe_contents(root),
            remedy="See docs/reference/formats.md for the layouts.",
        )
    if settings.masks is not None:
        source.masks = _find_masks(settings.masks, source.views)
    return source


_ORDINARY = (
    "No angles are stated: the pictures are read as ordinary photographs (--angles none). For shots through a filter, "
    "use --angles unknown, or state their angles."
)
Shots = dict[str, dict[int, Path]]


def _consecutive(
    root: Path, settings: PrepareSettings
) -> tuple[PrepareSettings, Shots | None, tuple[str, ...]]:
    """Group consecutive pictures into views, by ``--shots-per-view`` or by their content.

    Returns:
        The settings, including a detected number of shots; the shots by view and angle if the angles are the usual
        four, else None; and sentences for the user about assumptions.

    Raises:
        PolarguideError: the number of pictures in a group differs from the number of angles.
    """
    angles = settings.angles
    if angles is None or angles == "none" or angles.lower().endswith(".csv"):
        return settings, None, ()
    stated = [parse_angle(part) for part in angles.split(",")]
    files = list(index_shot_files(root, SHOT_SUFFIXES).values())
    notes: tuple[str, ...] = ()
    each = settings.shots_per_view
    if each is None and (each := shots_of_one_place(files)) is not None:
        require(
            len(stated) in (1, each),
            "--angles",
            expected=f"{each} angles, because every {each} consecutive pictures show one place",
            found=angles,
            remedy="Correct the angles, or use --shots-per-view 1 if every picture is a view of its own.",
        )
        notes = (
            f"Groups of {each} consecutive pictures show one place. Each is one view, named like its first picture "
            "(--shots-per-view 1 makes a view of every picture).",
        )
        settings = replace(settings, shots_per_view=each)
    elif each is None and len(stated) > 1:
        count = len(stated)
        notes = (
            f"Every picture is a view of its own. If {count} consecutive pictures are one view, use --shots-per-view "
            f"{count}.",
        )
    four = [angle for angle in stated if isinstance(angle, float)]
    usual = len(four) == len(stated) == each and sorted(four) == list(ANGLES)
    if not usual or len(files) % len(ANGLES):
        return settings, None, notes
    shots: Shots = {}
    for number, path in enumerate(files):
        place = number % len(ANGLES)
        shots.setdefault(shot_stem(files[number - place]), {})[round(four[place])] = path
    return settings, shots, notes


def _require_photographs(root: Path) -> None:
    """Check that pictures without angles in their names are ordinary photographs.

    Raises:
        PolarguideError: the folder contains raw mosaics, gray pictures or no picture; names of pictures contain numbers
            that may be angles; or consecutive pictures show one place, as shots through a filter do.
    """
    files = list(index_shot_files(root, SHOT_SUFFIXES).values())
    if not files or index_shot_files(root, tuple(set(RAW_SUFFIXES) - set(SHOT_SUFFIXES))):
        raise _unknown_layout(root)
    for path in (files[0], files[-1]):
        require(
            path.suffix.lower() not in RAW_SUFFIXES or not _is_gray(path),
            root,
            expected="photographs in color, or an option for gray pictures",
            found=f"{path.name}, which is gray",
            remedy=f"Raw mosaics: --sensor, one of {SENSOR_NAMES}. Ordinary photographs: --angles none. Shots "
            "through a filter: --angles unknown, or angles in their names.",
        )
    numbered = numbered_like_angles(files)
    require(
        not numbered,
        root,
        expected="angles as in cup_45 or in folders 0, 45, 90 and 135",
        found=f"pictures with angles in another form "
        f"({listed([path.name for group in numbered[:1] for path in group.values()])})",
        remedy="Rename them. Ordinary photographs without a filter: --angles none.",
    )
    each = shots_of_one_place(files)
    if each is not None:
        angles = ",".join(f"{180 * k / each:g}" for k in range(each))
        raise PolarguideError(
            root,
            expected="the angles of shots through a filter",
            found=f"{len(files)} pictures without angles, in which groups of {each} show one place each",
            remedy=f"Specify the angles in the order of the pictures, such as --angles {angles} --shots-per-view "
            f"{each}. For ordinary photographs without a filter, use --angles none.",
        )


def _is_gray(path: Path) -> bool:
    pixels = decode_picture(path, read_picture(path))
    return bool((pixels[..., 0] == pixels[..., 1]).all())


def describe_source(root: Path, settings: PrepareSettings) -> str:
    """Return a description of the capture in a folder, as ``prepare_scene`` recognizes it. Nothing is written.

    Raises:
        PolarguideError: the folder does not exist, or contains no readable picture.
    """
    if _is_video(root):
        return f"the video {listed([video.name for video in find_videos(root)])}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PolarguideWarning)  # the preparation repeats them
        return open_source(root, settings.checked()).description


def _is_video(root: Path) -> bool:
    """Return True if a path is a video, or a folder of videos without pictures and folders."""
    pictures = SHOT_SUFFIXES + RAW_SUFFIXES
    return bool(find_videos(root)) and not (
        root.is_dir() and any(path.is_dir() or path.suffix.lower() in pictures for path in root.iterdir())
    )


def frames_of_video(
    root: Path, out: Path, settings: PrepareSettings, reporter: Reporter
) -> tuple[Path, PrepareSettings]:
    """Return the folder of pictures to prepare, and the settings. Frames of a video are first written to a folder.

    A folder whose only file is a video is treated like the video. The frames are written next to ``out``. They are
    photographs in sRGB unless the settings specify a different encoding.

    Raises:
        PolarguideError: there are several videos, or a video cannot be read.
    """
    videos = find_videos(root)
    if not videos:
        return root, settings
    names = listed([video.name for video in videos])
    if not _is_video(root):
        reporter.say(
            f"Not used: {names}. To prepare frames of a video, use polarguide prepare VIDEO --out SCENE."
        )
        return root, settings
    require(
        len(videos) <= 1,
        root,
        expected="one video",
        found=names,
        remedy="Specify one path: polarguide prepare VIDEO.",
    )
    folder = out.resolve().with_name(f"{out.resolve().name}-frames")
    count = extract_frames(videos[0], folder, reporter)
    reporter.say(f"{count} frames of {names} are in {folder}: the sharpest frame of each time interval.")
    return folder, replace(
        settings,
        angles=settings.angles or "none",
        transfer="srgb" if settings.transfer == "auto" else settings.transfer,
    )


def are_single_shots(root: Path, settings: PrepareSettings) -> bool:
    """Return True if a folder contains single photographs through a filter instead of four shots per view.

    This holds if there is a table or an option with angles, an angle other than the usual four, or only one angle per
    view. If only some of the four angles are missing, the result is False, because files may have been forgotten.
    ``--format singles`` accepts them nevertheless.
    """
    if settings.sensor is not None:
        return False
    if settings.angles is not None or (root / TABLE).exists():
        return True
    files = list_shot_files(root, SHOT_SUFFIXES)
    if not files:
        return any(angle not in ANGLES for angle in folders_of_angles(root).values())
    shots = [name for name in angles_of_names([shot_stem(path) for path in files]) if name is not None]
    if any(angle not in ANGLES for _, angle in shots):
        return True
    return len({view for view, _ in shots}) == len(files)


def _unknown_layout(root: Path) -> PolarguideError:
    """Return the error for a folder whose format is not recognized. It lists the files and possible commands."""
    mosaics = index_shot_files(root, RAW_SUFFIXES)
    folders = sorted(path.name for path in root.iterdir() if path.is_dir() and not path.name.startswith("."))
    names = listed(sorted(path.name for path in mosaics.values()))
    contents = [f"{len(mosaics)} pictures without angles in their names ({names})"] if mosaics else []
    contents += [f"folders {listed(folders)}"] if folders else []
    prepare = command("prepare", root, "--out", f"{root.resolve().name}-scene")
    remedy = (
        "Four shots through a filter: name the folders 0, 45, 90 and 135, or the files <view>_0 to <view>_135, then "
        f"{prepare}."
    )
    if mosaics:
        remedy = f"Raw mosaics: {prepare} --sensor IMX250MYR, or your sensor of {SENSOR_NAMES}. {remedy}"
    else:
        suffixes = SHOT_SUFFIXES + RAW_SUFFIXES
        inside = (path.parent for path in root.rglob("*") if path.name.lower().endswith(suffixes))
        folder = next(inside, None)
        remedy = (
            remedy if folder is None else f"Specify the folder of the pictures, such as {folder}. {remedy}"
        )
    return PolarguideError(
        root,
        expected="shots through a filter, raw mosaics with --sensor, or a published dataset",
        found=" and ".join(contents) or "nothing to read",
        remedy=remedy,
    )


POSE_NAMES = (
    "sparse",
    "transforms.json",
    "transforms_train.json",
    "cameras.xml",
    "cameras.npz",
    "cameras_new.npz",
    "cameras_sphere.npz",
)
"""Names of files and folders with poses that may be next to the pictures."""


def _source(
    root: Path, settings: PrepareSettings, kind: str, shots: dict[str, dict[int, Path]] | None
) -> Source:
    match settings_of_format(settings, kind):
        case SinglesSettings() as singles:
            return SinglesSource(root, singles)
        case FilterSettings() as pictures:
            return FilterSource(root, pictures, shots)
        case MosaicSettings() as mosaics if kind == "mosaic":
            return MosaicSource(root, mosaics)
        case others:
            source: Source = import_part(READER_MODULE, f"{root} (dataset {kind})").dataset_source(
                root, kind, others
            )
            return source


def origin_of_poses(pictures: Source, origin: str) -> str:
    """Return the origin of the poses: "dataset", "sfm", "none" or a path."""
    if origin == "auto":
        return "sfm" if pictures.cameras is None else "dataset"
    require(
        origin != "dataset" or pictures.cameras is not None,
        "--poses",
        expected=f"sfm, none or the path of a COLMAP model for the format {pictures.kind}",
        found="dataset",
        remedy="Only published datasets contain poses.",
    )
    return origin


def known_poses(root: Path, pictures: Source, origin: str, poses_of: str = "auto") -> Poses | None:
    """Read poses from a dataset, a file or a folder. Return None if the origin is "sfm" or "none".

    Args:
        root: folder of the capture.
        pictures: source of the pictures.
        origin: result of ``origin_of_poses``.
        poses_of: orientation of the pixels that the poses refer to. Cameras without a size get the size of these
            pixels.
    """
    if origin in ("sfm", "none"):
        return None
    if origin == "dataset":
        assert pictures.cameras is not None
        return Poses.of_cameras(pictures.cameras, root, pictures.views)
    path = Path(origin)
    parts = {"all": path} if path.suffix.lower() in POSE_FILES and path.is_file() else {}
    if path.is_dir() and not holds_model(path):
        parts = parts_of_poses(path)
    if parts:
        known = set(pictures.views)
        assumed = set[str]()

        def sizes(view: str) -> tuple[tuple[int, int], ...]:
            assumed.add(view)
            stored = pictures.stored(view if view in known else pictures.views[0])
            rotates = poses_of == "displayed" and stored.orientation in QUARTER_TURNS
            original, *others = stored.sizes or ((0, 0),)
            return (others[0], original, *others[1:]) if rotates and others else stored.sizes

        cameras, tests = read_parts(parts, pictures.views, sizes)
        poses = Poses.of_cameras(cameras, path, pictures.views, list(parts.values()))
        poses.assumed_sizes = frozenset(assumed)
        poses.held_out = tuple(view for view in poses.views if view in tests)
        poses.notes = _notes_of_parts(path, parts, poses)
        return poses
    return Poses.read(path, pictures.views)


def _notes_of_parts(path: Path, parts: Mapping[str, Path], poses: Poses) -> tuple[str, ...]:
    """Return sentences for the user about the parts of a capture and their poses."""
    if path.is_dir() and len(parts) > 1:
        note = f"Poses of {listed([file.name for file in parts.values()])}."
        if TEST in parts:
            note += f" {len(poses.held_out)} views of {parts[TEST].name} are held out for tests."
        return (note,)
    siblings = parts_of_poses(path.parent) if path.is_file() else {}
    if path in siblings.values() and len(siblings) > 1 and poses.missing:
        others = listed([file.name for file in siblings.values() if file != path])
        return (f"{others} in the folder of {path.name}: --poses {shlex.quote(str(path.parent))} reads all.",)
    return ()


CONVENTION = "the convention of COLMAP, Metashape and nerfstudio"
"""Reason for the user why poses refer to stored pixels if the sizes of the cameras do not decide."""


def settle_pose_frames(pictures: Source, poses: Poses, frame_given: str) -> str:
    """Decide for each view whether its poses refer to the pixels as stored, and configure the source accordingly.

    COLMAP, Metashape and nerfstudio read pixels as stored and ignore the orientation tag. Other programs rotate the
    pictures first. If a quarter turn exchanges width and height, the size of the pose's camera decides. The remaining
    views (half a turn, a mirror image, a square) follow that decision. The default is the stored orientation.

    Args:
        pictures: the source, before the first view is developed.
        poses: poses of another program, with sizes of cameras.
        frame_given: value of ``--poses-of``.

    Returns:
        A sentence for the user; empty if no picture has an orientation tag.
    """
    codes: dict[str, int] = {}
    by_size: dict[str, bool] = {}
    for view in poses.views:
        stored = pictures.stored(view)
        if stored.orientation == 1:
            continue
        codes[view] = stored.orientation
        if stored.size is not None and stored.orientation in QUARTER_TURNS:
            width, height = stored.size
            camera = poses.stated_size(view)
            if camera is not None and width != height and camera[0] != camera[1]:
                by_size[view] = (width > height) == (camera[0] > camera[1])
    if not codes:
        return ""
    if frame_given == "auto":
        default = set(by_size.values()) != {False}
        reason = "according to the sizes of the cameras" if by_size else CONVENTION
    else:
        default = frame_given == "stored"
        by_size.clear()
        reason = "according to --poses-of"
    as_stored = frozenset(view for view in codes if by_size.get(view, default))
    pictures.as_stored = as_stored
    turns = listed([f"{count} {TURNS[code]}" for code, count in sorted(Counter(codes.values()).items())])
    other = "displayed" if as_stored else "stored"
    text = f"the poses refer to the {'stored' if as_stored else 'displayed'} pixels, {reason}"
    if 0 < len(as_stored) < len(codes):
        text = (
            f"{len(as_stored)} poses refer to the stored pixels, {reason}, the others to the displayed pixels"
        )
    used = "These views, their angles and masks are used as stored. " if as_stored else ""
    return (
        f"EXIF orientation of {len(codes)} of {len(poses.views)} views ({turns}): {text}. {used}"
        f"If the poses refer to the {other} pixels, use --poses-of {other}."
    )
