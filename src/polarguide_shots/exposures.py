"""Find shots in files and folders: mosaics, pictures through a filter at any angles, and views of a scene."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from polarguide.capture.exposures import TABLE
from polarguide.capture.filter import shots as filter_shots
from polarguide.capture.filter.shots import VIDEO_SUFFIXES
from polarguide.capture.layout import (
    CaptureFiles,
    angle_folders,
    angle_of_folder,
    describe_contents,
    find_layout,
    list_files,
    list_shot_files,
    one_of_each_shot,
    shot_stem,
)
from polarguide.capture.sensor.mosaics import RAW_SUFFIXES
from polarguide.capture.sensor.pattern import SENSOR_NAMES
from polarguide.capture.view import ANGLES
from polarguide.core.errors import PolarguideError, require
from polarguide.core.text import canonical
from polarguide_shots import sets
from polarguide_shots.options import ShotOptions
from polarguide_shots.sets import ExposureSet, known_indices

_EXPECTED = "raw mosaics with --sensor, or shots with angles in their names"
_REMEDY = (
    f"Raw mosaics need --sensor: {SENSOR_NAMES}; shots need their angles in the names "
    "(<shot>_0, _45, _90 and _135; at other angles <shot>_a10, _a40, ...), folders 0, 45, 90 and 135, or angles.csv "
    "with the columns file,angle."
)


def find_shots(
    paths: Sequence[str | os.PathLike[str]], options: ShotOptions | None = None
) -> list[ExposureSet]:
    """Find the shots in files and folders. They are in the order of the paths, and sorted within a folder.

    A file is a mosaic if the options name a sensor. Otherwise the name of a file states its shot and angle
    (``cup_0.png``, ``cup_45.png``; ``I0.png`` ... in one folder; ``0/cup.png`` ...). Pictures of a shot at three or
    more other angles form a set. Their angles are in the names (``cup_a10.png``, ``cup_a40.png``, ...) or in a table
    ``angles.csv`` like that of ``prepare``. A video is also a set if a table ``frame,angle`` with the same name exists.
    A folder is a scene (``polar/``, or four folders of angles next to ``sparse``), or contains mosaics or shots. In a
    folder without shots, the subfolders are searched.

    An ambiguous file, or a file without an angle, is returned as a set with a ``fault``. The remaining shots are not
    affected.

    Args:
        paths: files and folders.
        options: options of the shots.

    Raises:
        PolarguideError: there are no paths, a path does not exist, no shot is valid, or an option does not apply to the
            kind of the shots.
    """
    options = options or ShotOptions()
    require(
        paths,
        "paths",
        expected="at least one file or folder of shots",
        found="none",
        remedy="Specify some paths.",
    )
    shots = list_shots(paths, options)
    faults = [shot.fault for shot in shots if shot.empty and shot.fault is not None]
    if len(faults) < len(shots):
        for kind, shot in {shot.kind: shot for shot in reversed(shots) if shot.fault is None}.items():
            options.require_kind(kind, shot.name)
        return shots
    if len(paths) == 1 and len(faults) > 1:
        contents = describe_contents(Path(paths[0]))
        raise PolarguideError(paths[0], expected=_EXPECTED, found=contents, remedy=_REMEDY)
    raise faults[0]


def list_shots(
    paths: Sequence[str | os.PathLike[str]], options: ShotOptions | None = None
) -> list[ExposureSet]:
    """Find shots like ``find_shots``, but do not raise an error if all of them have faults.

    Args:
        paths: files and folders.
        options: options of the shots.

    Raises:
        PolarguideError: a path does not exist, or the only path is a folder that is empty or lacks an angle.
    """
    options = options or ShotOptions()
    shots: list[ExposureSet] = []
    files: list[Path] = []
    for path in map(Path, dict.fromkeys(paths)):
        require(
            path.is_dir() or path.is_file(),
            path,
            expected="a file or folder of shots",
            found="none",
            remedy="Check the path.",
        )
        if path.is_file():
            files.append(path)
        else:
            shots += _in_folder(path, options) if len(paths) == 1 else _or_fault(path, options, _in_folder)
    return _unique_names(_of_files(files, options) + shots)


def mosaics(files: Sequence[Path]) -> list[ExposureSet]:
    """Create one ``ExposureSet`` for each raw mosaic.

    A set is named like its file without the suffix. If two files in a folder differ only in their suffixes, the names
    contain the suffixes.
    """
    files = one_of_each_shot(files)
    stems = Counter((path.parent, shot_stem(path)) for path in files)
    return [
        ExposureSet(
            shot_stem(path) if stems[path.parent, shot_stem(path)] == 1 else canonical(path.name),
            "mosaic",
            {0: path},
        )
        for path in files
    ]


def _of_files(files: list[Path], options: ShotOptions) -> list[ExposureSet]:
    """Find the shots in files.

    With a sensor, all files are mosaics. Otherwise the files are videos, pictures in a table, pictures in folders of
    angles, or pictures with angles in their names.
    """
    if options.sensor is not None:
        return mosaics(files)
    shots = sets.videos(files)
    files = [path for path in files if path.suffix.lower() not in VIDEO_SUFFIXES]
    for folder in dict.fromkeys(path.parent for path in files if (path.parent / TABLE).is_file()):
        inside = {path.resolve() for path in files if path.parent == folder}
        for shot in sets.by_table(folder)[0]:
            listed = {path.resolve() for path in shot.paths if path != shot.table}
            shots += [shot] if listed & inside else []
            inside -= listed
        files = [path for path in files if path.parent != folder or path.resolve() in inside]
    by_root: dict[Path, filter_shots.Candidates] = {}
    files = one_of_each_shot(files)
    for path in files:
        folder = path.resolve().parent
        angle = angle_of_folder(folder)
        if angle is not None:
            views = by_root.setdefault(folder.parent, {})
            views.setdefault(shot_stem(path), {}).setdefault(angle, []).append(path)
    for views in by_root.values():
        # A view with one angle means that the folder has the name of an angle by chance.
        if all(len(angles) > 1 for angles in views.values()):
            shots += _filter_sets(views)
            placed = {path for angles in views.values() for same in angles.values() for path in same}
            files = [path for path in files if path not in placed]
    return shots + _by_names(files)


def _by_names(files: Sequence[Path]) -> list[ExposureSet]:
    """Find shots by the names of files. A file without an angle in its name becomes a set with a fault."""
    named, rest = sets.by_name(files)
    by_name, others = filter_shots.group_files(rest)
    return [*named, *_filter_sets(by_name), *_without_angle(others)]


def _filter_sets(shots: filter_shots.Candidates) -> list[ExposureSet]:
    """Create the sets at the four usual angles. A set has a fault if two files have the same angle."""
    return [
        ExposureSet(
            view,
            "filter",
            {angle: first for angle, (first, *_) in files.items()},
            fault=filter_shots.ambiguity(view, files),
            others=tuple(path for _, *more in files.values() for path in more),
        )
        for view, files in sorted(shots.items())
    ]


def _without_angle(files: Sequence[Path]) -> list[ExposureSet]:
    """Create a set with a fault for each picture, because its name contains no angle."""
    return [
        ExposureSet(
            path.name,
            "filter",
            {},
            fault=PolarguideError(path, expected=_EXPECTED, found="no angle in its name", remedy=_REMEDY),
            others=(path,),
        )
        for path in files
    ]


def _or_fault(
    folder: Path, options: ShotOptions, look: Callable[[Path, ShotOptions], list[ExposureSet]]
) -> list[ExposureSet]:
    """Find the shots of a folder with ``look``. If that fails, return a set with the error as its fault."""
    try:
        return look(folder, options)
    except PolarguideError as error:
        fault = error
    except OSError as error:
        fault = PolarguideError(
            folder,
            expected="a readable folder",
            found=error.strerror or str(error),
            remedy="Check its permissions.",
        )
    return [ExposureSet(folder.resolve().name, "filter", {}, fault=fault, others=(folder,))]


def _in_folder(root: Path, options: ShotOptions) -> list[ExposureSet]:
    """Find the shots in a folder. If it has no valid shot, find the shots in its subfolders.

    Raises:
        PolarguideError: there are no shots.
    """
    shots = _directly_in(root, options)
    if all(shot.empty for shot in shots):
        folders = sorted(path for path in root.iterdir() if path.is_dir() and not path.name.startswith("."))
        for folder in folders:
            inside = _or_fault(folder, options, _directly_in)
            same_name = [shot.name for shot in inside] == [folder.resolve().name]
            shots += inside if same_name else [replace(s, name=f"{folder.name}_{s.name}") for s in inside]
    if not shots:
        raise PolarguideError(root, expected="shots", found=describe_contents(root), remedy=_REMEDY)
    return shots


def _directly_in(root: Path, options: ShotOptions) -> list[ExposureSet]:
    """Find the shots in a folder, without its subfolders.

    Raises:
        PolarguideError: the folder is an invalid scene, or its table cannot be read.
    """
    if (root / "polar").is_dir() or ((root / "sparse").is_dir() and len(angle_folders(root)) == len(ANGLES)):
        return _views(find_layout(root))
    if options.sensor is not None and not angle_folders(root):
        files = list_shot_files(root, RAW_SUFFIXES)
        dark = None if options.dark_frame is None else os.path.realpath(options.dark_frame)
        return mosaics([path for path in files if os.path.realpath(path) != dark])
    videos = sets.videos(list_files(root, VIDEO_SUFFIXES))
    if (root / TABLE).is_file():
        listed, others = sets.by_table(root)
        return [*videos, *listed, *_without_angle(others)]
    files = list_shot_files(root, filter_shots.SHOT_SUFFIXES)
    in_folders = [] if files else sets.by_folder(root)
    if in_folders:
        return [*videos, *in_folders]
    if not angle_folders(root):
        return videos + _by_names(files)
    return videos + _filter_sets(filter_shots.list_shots(root)[0])


def _views(layout: CaptureFiles) -> list[ExposureSet]:
    """Create the sets of the views of a scene. A set has a fault if its pictures do not determine Stokes vectors.

    Raises:
        PolarguideError: no view is valid.
    """
    shots = []
    for name in layout.names:
        others = layout.others.get(name, ())
        fault = None
        if others:
            try:
                known_indices(name, [exposure for _, exposure in others])
            except PolarguideError as error:
                fault = error
        files = layout.pictures.get(name, {})
        shots.append(
            ExposureSet(name, "scene", files, layout.root, name, fault, tuple(path for path, _ in others))
        )
    faults = [shot.fault for shot in shots if shot.fault is not None]
    if shots and len(faults) == len(shots):
        raise faults[0]
    return shots


def _unique_names(shots: list[ExposureSet]) -> list[ExposureSet]:
    """Make the names of shots unique by adding the name of the folder.

    A shot gets a fault if its name is still not unique, or is invalid as the name of a folder.
    """
    counts = Counter(shot.name for shot in shots)
    unique = [
        replace(
            shot,
            name=shot.name
            if counts[shot.name] == 1
            else f"{(shot.root or shot.paths[0].resolve().parent).name}_{shot.name}",
            fault=shot.fault or name_fault(shot),
        )
        for shot in shots
    ]
    by_name: dict[str, list[ExposureSet]] = {}
    for shot in unique:
        by_name.setdefault(shot.name, []).append(shot)
    for place, shot in enumerate(unique):
        others = [other for other in by_name[shot.name] if other is not shot]
        if others:
            fault = PolarguideError(
                shot.paths[0],
                expected="one shot of each name",
                found=f"{shot.name} also at {others[0].paths[0]}",
                remedy="Rename one of the shots, or read them in separate calls.",
            )
            unique[place] = replace(shot, fault=shot.fault or fault)
    return unique


def name_fault(shot: ExposureSet) -> PolarguideError | None:
    """Return an error if the name of a shot is invalid as the name of a folder, else None.

    With such a name, files would be written into a different folder.
    """
    name = shot.name
    if name not in ("", ".", "..") and os.sep not in name and not (os.altsep and os.altsep in name):
        return None
    return PolarguideError(
        shot.paths[0],
        expected="a name that is valid for a folder",
        found=repr(name),
        remedy="Rename the file.",
    )


def require_own_folder(shot: ExposureSet, folder: Path) -> None:
    """Check that the files of a shot are not in the folder of its maps, where a map may have the same name.

    Raises:
        PolarguideError: a file of the shot is in ``folder``.
    """
    for path in shot.paths:
        require(
            os.path.dirname(os.path.realpath(path)) != os.path.realpath(folder),
            path,
            expected=f"a shot outside of {folder}, the folder of its maps",
            found="a file inside",
            remedy="Give another --out.",
        )


def require_elsewhere(paths: Sequence[str | os.PathLike[str]], out: Path) -> None:
    """Check that the output folder is not searched for shots. Otherwise the next call would read its files as shots.

    Raises:
        PolarguideError: ``out`` is one of the searched folders.
    """
    for path in paths:
        require(
            not (os.path.isdir(path) and os.path.realpath(path) == os.path.realpath(out)),
            out,
            expected="a folder that is not searched for shots",
            found="the folder of the shots",
            remedy="Give another --out.",
        )
