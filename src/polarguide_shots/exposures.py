"""Find the exposure sets behind paths: mosaics, shots through a filter at four or any angles, views of a scene."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from polarguide.capture.exposures import TABLE
from polarguide.capture.filter import shots as filter_shots
from polarguide.capture.filter.consecutive import VIDEO_SUFFIXES
from polarguide.capture.layout import (
    CaptureFiles,
    angle_folders,
    angle_of_folder,
    describe_contents,
    find_layout,
    list_files,
)
from polarguide.capture.sensor.pattern import SENSOR_NAMES
from polarguide.capture.sensor.raw_file import RAW_SUFFIXES
from polarguide.capture.view import ANGLES
from polarguide.core.errors import PolarguideError
from polarguide.core.text import canonical, stem_of
from polarguide_shots import sets
from polarguide_shots.options import ShotOptions
from polarguide_shots.sets import ExposureSet, known_places

_EXPECTED = "raw mosaics with --sensor, or shots with angles in their names"
_REMEDY = (
    f"Raw mosaics need --sensor: {SENSOR_NAMES}; shots need their angles in the names "
    "(<shot>_0, _45, _90 and _135; at others <shot>_a10, _a40, ...), folders 0, 45, 90 and 135, or angles.csv with the "
    "columns file,angle."
)


def find_shots(
    paths: Sequence[str | os.PathLike[str]], options: ShotOptions | None = None
) -> list[ExposureSet]:
    """The exposure sets behind files and folders, in the order of the paths, sorted within a folder.

    A file is a mosaic if the options name a sensor; else its name tells shot and angle (``cup_0.png``, ``cup_45.png``;
    ``I0.png`` ... in one folder; ``0/cup.png`` ...). Pictures of a shot at three or more other angles are a set:
    ``cup_a10.png``, ``cup_a40.png``, ... or as ``angles.csv`` beside them says, as ``prepare`` reads it; so is a video
    with a table ``frame,angle`` of its name. A folder is a scene (``polar/``, or four folders of angles with a
    ``sparse``), or holds mosaics or shots; one without any is looked for in its folders, one level down.

    What is ambiguous or tells no angle does not hide the shots beside it: it is a set with a ``fault``.

    Raises:
        PolarguideError: there are no paths, one does not exist, there is nothing but files and folders that are no
            shot, or an option means nothing for the kind of shots found.
    """
    options = options or ShotOptions()
    if not paths:
        raise PolarguideError(
            "paths", expected="at least one file or folder of shots", found="none", remedy="Name some."
        )
    shots = list_shots(paths, options)
    faults = [shot.fault for shot in shots if shot.nothing and shot.fault is not None]
    if len(faults) < len(shots):
        for kind, shot in {shot.kind: shot for shot in reversed(shots) if shot.fault is None}.items():
            options.require_kind(kind, shot.name)
        return shots
    root = Path(paths[0])
    if len(paths) == 1 and len(faults) > 1:
        raise PolarguideError(root, expected=_EXPECTED, found=describe_contents(root), remedy=_REMEDY)
    raise faults[0]


def list_shots(
    paths: Sequence[str | os.PathLike[str]], options: ShotOptions | None = None
) -> list[ExposureSet]:
    """As ``find_shots``, but where there are only faults, these are what is found.

    Raises:
        PolarguideError: a path does not exist, or the only one is an empty folder, or one that lacks those of angles.
    """
    options = options or ShotOptions()
    shots: list[ExposureSet] = []
    files: list[Path] = []
    for path in map(Path, dict.fromkeys(paths)):
        if path.is_dir():
            shots += _in_folder(path, options) if len(paths) == 1 else _or_fault(path, options, _in_folder)
        elif path.is_file():
            files.append(path)
        else:
            raise PolarguideError(
                path, expected="a file or folder of shots", found="none", remedy="Check the path."
            )
    return _named_apart(_of_files(files, options) + shots)


def mosaics(files: Sequence[Path]) -> list[ExposureSet]:
    """Raw mosaics as sets; two of one folder and stem are called by their suffix, too."""
    stems = Counter(path.with_suffix("") for path in files)
    return [
        ExposureSet(
            stem_of(path) if stems[path.with_suffix("")] == 1 else canonical(path.name), "mosaic", {0: path}
        )
        for path in files
    ]


def _of_files(files: list[Path], options: ShotOptions) -> list[ExposureSet]:
    if options.sensor is not None:
        return mosaics(files)
    of_videos = sets.videos(files)
    files = [path for path in files if path.suffix.lower() not in VIDEO_SUFFIXES]
    for folder in dict.fromkeys(path.parent for path in files if (path.parent / TABLE).is_file()):
        inside = {path.resolve() for path in files if path.parent == folder}
        for one in sets.by_table(folder)[0]:
            listed = {path.resolve() for path in one.paths if path != one.table}
            if listed & inside:
                of_videos.append(one)
            inside -= listed
        files = [path for path in files if path.parent != folder or path.resolve() in inside]
    by_root: dict[Path, filter_shots.Candidates] = {}
    for path in files:
        folder = path.resolve().parent
        angle = angle_of_folder(folder)
        if angle is not None:
            shots = by_root.setdefault(folder.parent, {})
            shots.setdefault(stem_of(path), {}).setdefault(angle, []).append(path)
    # Files of one angle are in folders that are called so by chance.
    in_folders = [c for c in by_root.values() if all(len(angles) > 1 for angles in c.values())]
    placed = {path for c in in_folders for angles in c.values() for same in angles.values() for path in same}
    of_videos += [shot for candidates in in_folders for shot in _filter_sets(candidates)]
    return of_videos + _by_names([path for path in files if path not in placed])


def _by_names(files: Sequence[Path]) -> list[ExposureSet]:
    """The sets, the shots of four and the strangers among files, by their names."""
    named, rest = sets.by_name(files)
    by_name, others = filter_shots.group_files(rest)
    return [*named, *_filter_sets(by_name), *_strangers(others)]


def _filter_sets(shots: filter_shots.Candidates) -> list[ExposureSet]:
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


def _strangers(files: Sequence[Path]) -> list[ExposureSet]:
    """A fault for each picture whose name tells no angle."""
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
    """The shots of a folder, or its fault."""
    try:
        return look(folder, options)
    except PolarguideError as error:
        fault = error
    except OSError as error:
        fault = PolarguideError(
            folder,
            expected="a folder that can be read",
            found=error.strerror or str(error),
            remedy="Check its permissions.",
        )
    return [ExposureSet(folder.resolve().name, "filter", {}, fault=fault, others=(folder,))]


def _in_folder(root: Path, options: ShotOptions) -> list[ExposureSet]:
    shots = _directly_in(root, options)
    if all(shot.nothing for shot in shots):
        folders = sorted(path for path in root.iterdir() if path.is_dir() and not path.name.startswith("."))
        for folder in folders:
            inside = _or_fault(folder, options, _directly_in)
            alone = len(inside) == 1 and inside[0].name == folder.resolve().name
            shots += inside if alone else [replace(s, name=f"{folder.name}_{s.name}") for s in inside]
    if not shots:
        raise PolarguideError(root, expected="shots", found=describe_contents(root), remedy=_REMEDY)
    return shots


def _directly_in(root: Path, options: ShotOptions) -> list[ExposureSet]:
    if (root / "polar").is_dir() or ((root / "sparse").is_dir() and len(angle_folders(root)) == len(ANGLES)):
        return _views(find_layout(root))
    if options.sensor is not None and not angle_folders(root):
        files = list_files(root, RAW_SUFFIXES)
        dark = None if options.dark_frame is None else os.path.realpath(options.dark_frame)
        return mosaics([path for path in files if os.path.realpath(path) != dark])
    videos = sets.videos(list_files(root, VIDEO_SUFFIXES))
    if (root / TABLE).is_file():
        listed, others = sets.by_table(root)
        return [*videos, *listed, *_strangers(others)]
    files = list_files(root, filter_shots.SHOT_SUFFIXES)
    in_folders = [] if files else sets.by_folder(root)
    if in_folders:
        return [*videos, *in_folders]
    if not angle_folders(root):
        return videos + _by_names(files)
    shots, _ = filter_shots.list_shots(root)
    return videos + _filter_sets(shots)


def _views(layout: CaptureFiles) -> list[ExposureSet]:
    """The views of a scene; a fault for each whose pictures do not determine Stokes vectors.

    Raises:
        PolarguideError: there is no other view.
    """
    shots = []
    for name in layout.names:
        others = layout.others.get(name, ())
        fault = None
        if others:
            try:
                known_places(name, [exposure for _, exposure in others])
            except PolarguideError as error:
                fault = error
        files = layout.pictures.get(name, {})
        more = tuple(path for path, _ in others)
        shots.append(ExposureSet(name, "scene", files, layout.root, name, fault, more))
    if shots and all(shot.fault is not None for shot in shots):
        assert shots[0].fault is not None
        raise shots[0].fault
    return shots


def _named_apart(shots: list[ExposureSet]) -> list[ExposureSet]:
    """Sets of one name are called by their folder, too; it is their fault where that does not tell them apart.

    So is a name that a folder cannot have.
    """
    shots = [replace(shot, fault=shot.fault or name_fault(shot)) for shot in shots]
    names = Counter(shot.name for shot in shots)
    apart = [
        shot
        if names[shot.name] == 1
        else replace(shot, name=f"{(shot.root or shot.paths[0].resolve().parent).name}_{shot.name}")
        for shot in shots
    ]
    named: dict[str, list[ExposureSet]] = {}
    for shot in apart:
        named.setdefault(shot.name, []).append(shot)
    for place, shot in enumerate(apart):
        others = [other for other in named[shot.name] if other is not shot]
        if others:
            fault = PolarguideError(
                shot.paths[0],
                expected="one shot of each name",
                found=f"{shot.name} also at {others[0].paths[0]}",
                remedy="Rename one of them, or give them in two calls.",
            )
            apart[place] = replace(shot, fault=shot.fault or fault)
    return apart


def name_fault(shot: ExposureSet) -> PolarguideError | None:
    """Return the error of a shot whose name cannot name a folder: its files would be written elsewhere."""
    name = shot.name
    if name not in ("", ".", "..") and os.sep not in name and not (os.altsep and os.altsep in name):
        return None
    return PolarguideError(
        shot.paths[0],
        expected="a name that a folder can have",
        found=repr(shot.name),
        remedy="Rename the file.",
    )


def require_own_folder(shot: ExposureSet, folder: Path) -> None:
    """Refuse to write the maps of a shot beside its files: one of them may have the name of a map.

    Raises:
        PolarguideError: a file of the shot lies in ``folder``.
    """
    written = os.path.realpath(folder)
    for path in shot.paths:
        if os.path.dirname(os.path.realpath(path)) == written:
            raise PolarguideError(
                path,
                expected=f"a shot outside of {folder}, where its maps go",
                found="that it lies there",
                remedy="Give another --out.",
            )


def require_elsewhere(paths: Sequence[str | os.PathLike[str]], out: Path) -> None:
    """Refuse to write among shots: the next call would take what was written for shots.

    Raises:
        PolarguideError: ``out`` is one of the folders that are looked through.
    """
    for path in paths:
        if os.path.isdir(path) and os.path.realpath(path) == os.path.realpath(out):
            raise PolarguideError(
                out,
                expected="a folder that is not searched for shots",
                found="that of the shots",
                remedy="Give another --out.",
            )
