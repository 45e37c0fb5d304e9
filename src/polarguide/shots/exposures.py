"""Find the exposure sets behind paths: mosaics, four shots through a filter, views of a scene."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from polarguide.capture.filter import shots as filter_shots
from polarguide.capture.layout import (
    angle_folders,
    angle_of_folder,
    describe_contents,
    find_layout,
    index_files,
)
from polarguide.capture.sensor.raw_file import RAW_SUFFIXES
from polarguide.capture.view import ANGLES, listed
from polarguide.errors import PolarguideError
from polarguide.shots.options import ShotOptions

Kind = Literal["mosaic", "filter", "scene"]
_REMEDY = (
    "Raw mosaics need --sensor (IMX250MYR is color, IMX250MZR monochrome); four shots need their angles in the names, "
    "<shot>_0, _45, _90 and _135, or folders 0, 45, 90 and 135."
)


@dataclass(frozen=True)
class ExposureSet:
    """The files of one shot.

    Attributes:
        name: unique among the sets that were found together; usable in a file name.
        kind: mosaic (one file), filter (one file an angle) or scene (a view of a scene folder).
        files: by angle; a mosaic's under 0. Angles may be missing: ``read_shot`` says so.
        root: folder of the scene; else None.
        view: its name in the scene.
    """

    name: str
    kind: Kind
    files: dict[int, Path]
    root: Path | None = None
    view: str = ""

    @property
    def paths(self) -> tuple[Path, ...]:
        """The files, by angle."""
        return tuple(path for _, path in sorted(self.files.items()))


def find_shots(
    paths: Sequence[str | os.PathLike[str]], options: ShotOptions | None = None
) -> list[ExposureSet]:
    """The exposure sets behind files and folders, in the order of the paths, sorted within a folder.

    A file is a mosaic if the options name a sensor; else its name tells shot and angle (``cup_0.png``, ``cup_45.png``;
    ``I0.png`` ... in one folder; ``0/cup.png`` ...). A folder is a scene (``polar/``, or four folders of angles with a
    ``sparse``), or holds mosaics or shots; one without any is looked for in its folders, one level down.

    Raises:
        PolarguideError: a path does not exist or holds nothing that can be read, or two sets have one name.
    """
    options = options or ShotOptions()
    found: list[ExposureSet] = []
    files: list[Path] = []
    for path in map(Path, paths):
        if path.is_dir():
            found += _in_folder(path, options)
        elif path.is_file():
            files.append(path)
        else:
            raise PolarguideError(
                path, expected="a file or folder of shots", found="none", remedy="Check the path."
            )
    return _named_apart(_of_files(files, options) + found)


def _of_files(files: list[Path], options: ShotOptions) -> list[ExposureSet]:
    if options.sensor is not None:
        return [_mosaic(path) for path in files]
    grouped: dict[str, dict[int, Path]] = {}
    for path in files:
        angle = angle_of_folder(path.resolve().parent)
        if angle is not None and angle not in grouped.setdefault(path.stem, {}):
            grouped[path.stem][angle] = path
    if any(len(shot) == 1 for shot in grouped.values()):  # folders that are called so by chance
        grouped = {}
    grouped = grouped or filter_shots.group_shots(files)
    strangers = [path.name for path in files if not any(path in shot.values() for shot in grouped.values())]
    if strangers:
        raise PolarguideError(
            files[0].parent,
            expected="raw mosaics with --sensor, or shots with angles in their names",
            found=listed(sorted(strangers)),
            remedy=_REMEDY,
        )
    return [ExposureSet(name, "filter", shot) for name, shot in grouped.items()]


def _mosaic(path: Path) -> ExposureSet:
    return ExposureSet(path.stem, "mosaic", {0: path})


def _in_folder(root: Path, options: ShotOptions) -> list[ExposureSet]:
    found = _directly_in(root, options)
    if not found:
        folders = sorted(path for path in root.iterdir() if path.is_dir() and not path.name.startswith("."))
        for folder in folders:
            inside = _directly_in(folder, options)
            alone = len(inside) == 1 and inside[0].name == folder.resolve().name
            found += inside if alone else [replace(s, name=f"{folder.name}_{s.name}") for s in inside]
    if not found:
        raise PolarguideError(root, expected="shots", found=describe_contents(root), remedy=_REMEDY)
    return found


def _directly_in(root: Path, options: ShotOptions) -> list[ExposureSet]:
    folders = angle_folders(root)
    if (root / "polar").is_dir() or (len(folders) == len(ANGLES) and (root / "sparse").is_dir()):
        layout = find_layout(root)
        return [ExposureSet(name, "scene", layout.pictures[name], root, name) for name in layout.names]
    if options.sensor is not None and not folders:
        files = index_files(root, RAW_SUFFIXES)
        dark = None if options.dark_frame is None else os.path.realpath(options.dark_frame)
        return [_mosaic(path) for _, path in sorted(files.items()) if os.path.realpath(path) != dark]
    shots = filter_shots.find_shots(root)
    if not shots and index_files(root, filter_shots.SHOT_SUFFIXES):
        raise PolarguideError(
            root,
            expected="raw mosaics with --sensor, or shots with angles in their names",
            found=describe_contents(root),
            remedy=_REMEDY,
        )
    return [ExposureSet(name, "filter", shot) for name, shot in sorted(shots.items())]


def _named_apart(found: list[ExposureSet]) -> list[ExposureSet]:
    """Sets of one name are called by their folder, too.

    Raises:
        PolarguideError: that does not tell them apart.
    """
    names = [shot.name for shot in found]
    apart = [
        shot
        if names.count(shot.name) == 1
        else replace(shot, name=f"{(shot.root or shot.paths[0].resolve().parent).name}_{shot.name}")
        for shot in found
    ]
    first: dict[str, ExposureSet] = {}
    for shot in apart:
        if shot.name in first:
            raise PolarguideError(
                shot.paths[0],
                expected="one shot of each name",
                found=f"{shot.name} also at {first[shot.name].paths[0]}",
                remedy="Rename one of them, or give them in two calls.",
            )
        first[shot.name] = shot
    return apart
