"""Detect the format of a folder, and the origin of its poses: whether they are of the pictures as stored, or as EXIF
turns them for display.
"""

from __future__ import annotations

import os
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from polarguide.capture.colmap.model import holds_model, view_of_name
from polarguide.capture.colmap.poses import Poses
from polarguide.capture.datasets.readers import PISR_SENSOR, detect_dataset, open_dataset
from polarguide.capture.exposures import TABLE, angles_of_names, folders_of_angles, parse_angle
from polarguide.capture.filter.camera_files import QUARTER_TURNS, TURNS
from polarguide.capture.filter.consecutive import (
    extract_frames,
    find_videos,
    numbered_like_angles,
    shots_of_one_place,
)
from polarguide.capture.filter.shots import SHOT_SUFFIXES, find_shots
from polarguide.capture.formats.pictures import SUFFIXES, decode_picture, read_picture
from polarguide.capture.layout import angle_folders, describe_contents, index_files, list_files
from polarguide.capture.pose_files import SUFFIXES as POSE_FILES
from polarguide.capture.pose_files import TEST, parts_of_poses, read_parts
from polarguide.capture.sensor.pattern import SENSOR_NAMES
from polarguide.capture.sensor.raw_file import RAW_SUFFIXES
from polarguide.capture.view import ANGLES, listed
from polarguide.core.errors import PolarguideError
from polarguide.core.files import require_folder
from polarguide.core.progress import Reporter
from polarguide.core.text import stem_of
from polarguide.preparation.filter_source import FilterSource, ShotsSource, SinglesSource
from polarguide.preparation.settings import (
    FilterSettings,
    MosaicSettings,
    PrepareSettings,
    SinglesSettings,
    settings_of_format,
)
from polarguide.preparation.source import MosaicSource, Source, StokesSource


def _found_masks(folder: Path, views: Sequence[str]) -> dict[str, Path]:
    """Return the object masks of a folder by view.

    Masks are named like views, or as COLMAP and Metashape name them (``cup.jpg.png``, ``cup_mask.png``).

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
    files = sorted(folder.iterdir())
    masks: dict[str, Path] = {}
    for shorten in (str, view_of_name, lambda name: name.removesuffix("_mask")):
        for path in files:
            view = shorten(stem_of(path))
            if view in views and path.suffix.lower() in SUFFIXES:
                masks.setdefault(view, path)
    if not masks:
        raise PolarguideError(
            folder,
            expected=f"masks named like the views ({listed(list(views), 3)})",
            found=listed([path.name for path in files], 3) or "no file",
            remedy="Rename them; views without a mask are used whole.",
        )
    return masks


def open_source(root: Path, settings: PrepareSettings) -> Source:
    """Open the pictures in a folder, in the given or detected format.

    Raises:
        PolarguideError: there is no such folder, or nothing in it that can be read.
    """
    require_folder(
        root,
        expected="a folder of camera files",
        remedy="Give the folder that holds the raw mosaics, or the shots through the filter.",
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
            several = any(len(files) > 1 for files in shots.values())
            kind = "filter" if several else "mosaic"
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
        source.masks = _found_masks(settings.masks, source.views)
    return source


_ORDINARY = (
    "Nothing tells of a filter: the pictures are taken as ordinary photographs (--angles none). For shots through one: "
    "--angles unknown, or name their angles."
)
Shots = dict[str, dict[int, Path]]


def _consecutive(
    root: Path, settings: PrepareSettings
) -> tuple[PrepareSettings, Shots | None, tuple[str, ...]]:
    """Which consecutive pictures are one view, as ``--shots-per-view`` says or as they show.

    Returns:
        The settings, with the number of shots where it was found; where they are the usual four angles, the shots by
        view and angle; and what was taken for granted, for the user.

    Raises:
        PolarguideError: the pictures come in groups of another number than there are angles.
    """
    angles = settings.angles
    if angles is None or angles == "none" or angles.lower().endswith(".csv"):
        return settings, None, ()
    stated = [parse_angle(part) for part in angles.split(",")]
    files = list(index_files(root, SHOT_SUFFIXES).values())
    said: tuple[str, ...] = ()
    each = settings.shots_per_view
    if each is None and (each := shots_of_one_place(files)) is not None:
        if len(stated) not in (1, each):
            raise PolarguideError(
                "--angles",
                expected=f"{each} angles, because {each} pictures each in a row show one place",
                found=angles,
                remedy="Correct them, or give --shots-per-view 1 if every picture is a view of its own.",
            )
        alone = "--shots-per-view 1 takes every picture alone"
        said = (
            f"{each} pictures each in a row show one place and are one view, called like the first ({alone}).",
        )
        settings = replace(settings, shots_per_view=each)
    elif each is None and len(stated) > 1:
        said = (
            f"Every picture is a view of its own. If {len(stated)} in a row are one view: --shots-per-view "
            f"{len(stated)}.",
        )
    usual = each == len(ANGLES) and sorted(stated, key=str) == sorted(map(float, ANGLES), key=str)
    if not usual or len(files) % len(ANGLES):
        return settings, None, said
    shots: Shots = {}
    for number, path in enumerate(files):
        angle = stated[number % len(ANGLES)]
        assert isinstance(angle, float)
        shots.setdefault(files[number - number % len(ANGLES)].stem, {})[round(angle)] = path
    return settings, shots, said


def _require_photographs(root: Path) -> None:
    """Refuse pictures without angles in their names that may be something else than ordinary photographs.

    Raises:
        PolarguideError: there are raw mosaics, gray pictures (which may be mosaics) or none; or pictures are numbered
            like angles, or show one place in a row, as shots through a filter do.
    """
    files = list(index_files(root, SHOT_SUFFIXES).values())
    if not files or index_files(root, tuple(set(RAW_SUFFIXES) - set(SHOT_SUFFIXES))):
        raise _unknown_layout(root)
    # Raw mosaics are gray.
    gray = []
    for path in (files[0], files[-1]):
        if path.suffix.lower() in RAW_SUFFIXES:
            pixels = decode_picture(path, read_picture(path))
            if (pixels[..., 0] == pixels[..., 1]).all():
                gray.append(path.name)
    if gray:
        raise PolarguideError(
            root,
            expected="photographs in color, or an option that says what gray pictures are",
            found=f"{gray[0]}, which is gray",
            remedy=f"Raw mosaics: --sensor, one of {SENSOR_NAMES}. Ordinary photographs: --angles none. Shots through "
            "a filter: --angles unknown, or angles in their names.",
        )
    numbered = numbered_like_angles(files)
    if numbered:
        raise PolarguideError(
            root,
            expected="angles as in cup_45 or in folders 0, 45, 90 and 135",
            found=f"pictures that are numbered like angles otherwise ({listed([p.name for p in numbered])})",
            remedy="Rename them; or ordinary photographs, without a filter: --angles none.",
        )
    each = shots_of_one_place(files)
    if each is not None:
        angles = ",".join(f"{180 * k / each:g}" for k in range(each))
        raise PolarguideError(
            root,
            expected="the angles of shots through a filter",
            found=f"{len(files)} pictures of which {each} each in a row show one place",
            remedy=f"Give the angles in their order, such as --angles {angles} --shots-per-view {each}. Ordinary "
            "photographs, without a filter: --angles none.",
        )


def frames_of_video(
    root: Path, out: Path, settings: PrepareSettings, reporter: Reporter
) -> tuple[Path, PrepareSettings]:
    """The folder of pictures to prepare: of a video, or of a folder with nothing but one, that of its frames.

    Frames are written beside ``out``. They are photographs as displayed (sRGB) unless the settings say otherwise.

    Raises:
        PolarguideError: there are several videos, or one cannot be read.
    """
    videos = find_videos(root)
    if not videos:
        return root, settings
    names = listed([video.name for video in videos])
    if root.is_dir() and any(path.is_dir() or path.suffix.lower() in SHOT_SUFFIXES + RAW_SUFFIXES
                             for path in root.iterdir()):  # fmt: skip
        reporter.say(
            f"Not used: {names}. Frames of a video are taken with polarguide prepare VIDEO --out SCENE."
        )
        return root, settings
    if len(videos) > 1:
        raise PolarguideError(
            root, expected="one video", found=names, remedy="Give the path of one: polarguide prepare VIDEO."
        )
    folder = out.resolve().with_name(f"{out.resolve().name}-frames")
    count = extract_frames(videos[0], folder, reporter)
    reporter.say(f"{count} frames of {names} are in {folder}: the sharpest of equal spans of time.")
    return folder, replace(
        settings,
        angles=settings.angles or "none",
        transfer="srgb" if settings.transfer == "auto" else settings.transfer,
    )


def are_single_shots(root: Path, settings: PrepareSettings) -> bool:
    """Whether a folder holds photographs through a filter that are not four to a view, by what says their angles.

    That is a table or an option, an angle other than the four, or one angle a view. Four angles of which some are
    missing may be a mistake: ``--format singles`` takes what there is.
    """
    if settings.sensor is not None:
        return False
    if settings.angles is not None or (root / TABLE).exists():
        return True
    files = list_files(root, SHOT_SUFFIXES)
    if not files:
        return any(angle not in ANGLES for angle in folders_of_angles(root).values())
    named = angles_of_names([stem_of(path) for path in files])
    shots = [name for name in named if name is not None]
    if any(angle not in ANGLES for _, angle in shots):
        return True
    return len({view for view, _ in shots}) == len(files)


def _unknown_layout(root: Path) -> PolarguideError:
    """The error that files say nothing of what they are: what is there, and the commands."""
    mosaics = index_files(root, RAW_SUFFIXES)
    folders = sorted(path.name for path in root.iterdir() if path.is_dir() and not path.name.startswith("."))
    named = listed(sorted(path.name for path in mosaics.values()))
    found = f"{len(mosaics)} pictures without angles in their names ({named})" if named else ""
    found = " and ".join(part for part in (found, f"folders {listed(folders)}" if folders else "") if part)
    out = f"--out {shlex.quote(root.resolve().name + '-scene')}"
    source = shlex.quote(str(root))
    remedy = (
        "Four shots through a filter: name the folders 0, 45, 90 and 135, or the files <view>_0 to <view>_135, then "
        f"polarguide prepare {source} {out}."
    )
    if mosaics:
        command = f"polarguide prepare {source} {out} --sensor IMX250MYR"
        remedy = f"Raw mosaics: {command}, or yours of {SENSOR_NAMES}. {remedy}"
    suffixes = SHOT_SUFFIXES + RAW_SUFFIXES
    below = () if named else os.walk(root)
    inside = (folder for folder, _, names in below if any(name.lower().endswith(suffixes) for name in names))
    folder = next(inside, None)
    if folder is not None:
        remedy = f"Give the folder that the pictures are in, such as {Path(folder)}. {remedy}"
    return PolarguideError(
        root,
        expected="shots through a filter, raw mosaics with --sensor, or a published dataset",
        found=found or "nothing to read",
        remedy=remedy,
    )


POSES_BESIDE = (
    "sparse",
    "transforms.json",
    "transforms_train.json",
    "cameras.xml",
    "cameras.npz",
    "cameras_new.npz",
    "cameras_sphere.npz",
)
"""Names of files and folders of poses that may lie beside pictures."""


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
            dataset = open_dataset(root, kind, transfer=settings.transfer)
            sense = settings.calibration.sense or dataset.sense
            if dataset.mosaics is None or not isinstance(others, MosaicSettings):
                return StokesSource(dataset, others)
            mosaics = replace(
                others,
                sensor=settings.sensor or PISR_SENSOR,
                calibration=replace(settings.calibration, sense=sense),
            )
            return MosaicSource(dataset.mosaics, mosaics, dataset)


def origin_of_poses(pictures: Source, origin: str) -> str:
    """The origin of the poses: "dataset", "sfm", "none" or a path."""
    if origin == "auto":
        return "sfm" if pictures.cameras is None else "dataset"
    if origin == "dataset" and pictures.cameras is None:
        raise PolarguideError(
            "--poses",
            expected=f"sfm, none or the path of a COLMAP model for the format {pictures.kind}",
            found="dataset",
            remedy="Only published datasets contain poses.",
        )
    return origin


def known_poses(root: Path, pictures: Source, origin: str, poses_of: str = "auto") -> Poses | None:
    """The poses of a dataset, or of a file or folder; None for other origins.

    ``poses_of`` says what they are of where EXIF turns pictures: cameras without a size get that of those pixels.
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
            sizes = stored.sizes
            if poses_of == "displayed" and stored.orientation in QUARTER_TURNS:
                sizes = (*sizes[1:2], *sizes[:1], *sizes[2:])  # turned, stored, developed
            return sizes

        cameras, tests = read_parts(parts, pictures.views, sizes)
        poses = Poses.of_cameras(cameras, path, pictures.views, list(parts.values()))
        poses.assumed_sizes = frozenset(assumed)
        poses.held_out = tuple(view for view in poses.views if view in tests)
        poses.notes = _notes_of_parts(path, parts, poses)
        return poses
    return Poses.read(path, pictures.views)


def _notes_of_parts(path: Path, parts: Mapping[str, Path], poses: Poses) -> tuple[str, ...]:
    """Which parts of a capture the poses are of."""
    if path.is_dir() and len(parts) > 1:
        held = (
            f"{len(poses.held_out)} views of {parts[TEST].name} are held out for tests."
            if TEST in parts
            else ""
        )
        return (f"Poses of {listed([file.name for file in parts.values()])}. {held}".strip(),)
    beside = parts_of_poses(path.parent) if path.is_file() else {}
    if path in beside.values() and len(beside) > 1 and poses.missing:
        others = listed([file.name for file in beside.values() if file != path])
        return (f"{others} beside {path.name}: --poses {shlex.quote(str(path.parent))} reads all of them.",)
    return ()


def settle_pose_frames(pictures: Source, poses: Poses, frame_given: str) -> str:
    """Decide which views are used as stored, because the poses are of the stored pixels, and tell the source.

    COLMAP, Metashape and nerfstudio read pixels as stored and leave the orientation tag alone; other programs turn the
    pictures first. Where a quarter turn exchanges width and height, the size of the pose's camera tells. Views whose
    sizes tell nothing (half a turn, a mirror image, a square) are as those that do; where none does, as stored.

    Args:
        pictures: the source, which has not developed a view yet.
        poses: from outside; their cameras have sizes.
        frame_given: what the user says; ``auto`` decides as above.

    Returns:
        One line for the user; empty where no picture has an orientation tag.
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
    alike = set(by_size.values())
    others = frame_given == "stored" if frame_given != "auto" else alike != {False}
    as_stored = {view: others if frame_given != "auto" else by_size.get(view, others) for view in codes}
    unturned = [view for view, keep in as_stored.items() if keep]
    pictures.use_stored(unturned)
    reason = "as --poses-of says" if frame_given != "auto" else "as the sizes of the cameras tell"
    if frame_given == "auto" and not alike:
        reason = "as COLMAP, Metashape and nerfstudio read pictures; sizes do not tell"
    counts = Counter(codes.values())
    turns = listed([f"{count} {TURNS[code]}" for code, count in sorted(counts.items())])
    if len(unturned) in (0, len(codes)):
        frame, other = ("stored", "displayed") if unturned else ("displayed", "stored")
        text = f"their poses are taken to be of the {frame} pixels, {reason}"
    else:
        frame = "stored"
        other = "displayed"
        kind = f"the poses of {len(unturned)} are taken to be of the stored pixels"
        text = f"{kind}, {reason}, those of the others of the displayed ones"
    used = "Those views, their angles and masks are used as stored. " if unturned else ""
    return (
        f"EXIF orientation of {len(codes)} of {len(poses.views)} views ({turns}): {text}. {used}"
        f"If the poses are of the {other} pixels: --poses-of {other}."
    )
