"""Find the files of a capture, and check that its pictures fit into memory.

The pictures are in the folder ``polar/``, or in one folder for each angle.

Several photographs of one shot at different exposures form a bracket. The end of a file name states the exposure in
stops relative to the normal exposure (``cup_045_ev0.jpg``, ``cup_045_ev-3.jpg``), or numbers the exposures
(``cup_045_bracket1.jpg``). The number follows ``bracket`` directly and has one or two digits, because objects have
names such as ``bracket_045``. The table ``exposures.csv`` in the folder of the files states both for files with other
names.

A *shot* is the light of one pose and one polarizer angle, or one mosaic. The file nearest to the normal exposure
represents the shot wherever one file is needed, for example to read headers.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from polarguide.capture.exposures import FOUR, TABLE, Exposure, Line, read_table
from polarguide.capture.formats.stored import SUFFIXES, stated_size
from polarguide.capture.view import ANGLES
from polarguide.core.errors import PolarguideError, require, unknown_view
from polarguide.core.files import read_rows, require_folder
from polarguide.core.options import LARGEST_STOPS
from polarguide.core.records import shortened
from polarguide.core.system import free_memory
from polarguide.core.text import canonical, listed, number_or_nan, stem_of

_PICTURE_STEM = re.compile(r"(?P<view>.+)_(?P<angle>000|045|090|135)")
_ANGLE_FOLDER = re.compile(r"(?:(?:i|pol|angle)[-_ ]?|[_ ])?(?P<angle>\d{1,3})(?:deg)?", re.IGNORECASE)
_READ_FOLDERS = ("polar", "masks", "materials", "invalid", "gt", "sparse")
_HINT = (
    "Convert camera files with polarguide prepare FOLDER --out SCENE. Otherwise use a folder with "
    "polar/<view>_000.png, _045.png, _090.png and _135.png, or with the four folders I-00, I-45, I-90 and I-135 "
    "(also 0, 45, 90, 135) with equally named pictures."
)


@dataclass(frozen=True)
class CaptureFiles:
    """Paths of the files of a capture by view.

    Attributes:
        root: folder of the capture.
        pictures: path of each picture by view and angle, for the views with pictures at 0, 45, 90 and 135 degrees.
            An angle may be missing; ``select_views`` refuses such a view.
        masks: foreground masks by view; some views may have no mask.
        invalid: masks of unusable pixels by view; some views may have no mask.
        ground_truth: files of the ground truth by view; some views may have no file.
        warnings: warnings about unused files.
        others: paths and exposures of the pictures by view, for the views with other angles in ``angles.csv``.
        table: path of ``angles.csv``, or None if the file does not exist.
        materials: label pictures of materials by view; some views may have no picture.
    """

    root: Path
    pictures: dict[str, dict[int, Path]]
    masks: dict[str, Path]
    invalid: dict[str, Path]
    ground_truth: dict[str, Path]
    warnings: tuple[str, ...]
    others: Mapping[str, tuple[tuple[Path, Exposure], ...]] = field(default_factory=dict)
    table: Path | None = None
    materials: Mapping[str, Path] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """All view names, sorted."""
        return sorted(self.pictures.keys() | self.others.keys())

    def files(self, name: str) -> list[Path]:
        """Return the paths of a view's pictures in the order of its exposures. No picture may be missing."""
        if name in self.others:
            return [path for path, _ in self.others[name]]
        return [self.pictures[name][angle] for angle in ANGLES]

    def exposures(self, name: str) -> tuple[Exposure, ...]:
        """Return polarizer angle and gain of each picture of a view."""
        return tuple(e for _, e in self.others[name]) if name in self.others else FOUR


def find_layout(root: Path) -> CaptureFiles:
    """Find the files of a capture.

    Raises:
        PolarguideError: the folder is missing, has neither layout, or has two files for one view and angle.
    """
    require_folder(root, expected="a capture folder", remedy=_HINT)
    warnings: list[str] = []
    folders = angle_folders(root)
    pictures: dict[str, dict[int, Path]] = {}
    others: dict[str, tuple[tuple[Path, Exposure], ...]] = {}
    table = root / TABLE if os.path.lexists(root / TABLE) else None
    if (root / "polar").is_dir():
        pictures, others = _read_flat(root / "polar", warnings, table)
    elif folders:
        require_angle_folders(root, folders)
        for angle, folder in folders.items():
            for stem, path in index_files(folder, SUFFIXES).items():
                pictures.setdefault(stem, {})[angle] = path
    else:
        raise PolarguideError(root, expected="a capture folder", found=describe_contents(root), remedy=_HINT)
    names = pictures.keys() | others.keys()
    require(names, root, expected="pictures of at least one view", found="none", remedy=_HINT)
    optional: dict[str, dict[str, Path]] = {}
    kinds = (("masks", SUFFIXES), ("materials", SUFFIXES), ("invalid", SUFFIXES), ("gt", (".npz",)))
    for kind, suffixes in kinds:
        files = index_files(root / kind, suffixes)
        unused = sorted(path.name for stem, path in files.items() if stem not in names)
        if unused:
            warnings.append(
                f"{kind}/ has files without a view, which are ignored ({listed(unused)}): "
                "name each file like its view."
            )
        optional[kind] = files
    without = sorted(names - optional["masks"].keys())
    if optional["masks"] and without:
        warnings.append(f"masks/ has no file for {len(without)} of {len(names)} views ({listed(without)}).")
    return CaptureFiles(
        root,
        pictures,
        optional["masks"],
        optional["invalid"],
        optional["gt"],
        tuple(warnings),
        others,
        table,
        optional["materials"],
    )


def refuse_scene(out: Path) -> None:
    """Refuse an output folder that is a scene or a folder inside a scene.

    Raises:
        PolarguideError: the folder belongs to a scene.
    """
    real = Path(os.path.realpath(out))
    found = "a scene" if _is_scene(real) else ""
    for folder in (real, *real.parents):
        known = folder.name in _READ_FOLDERS or _ANGLE_FOLDER.fullmatch(folder.name)
        if known and _is_scene(folder.parent):
            found = f"{folder.name}/ of a scene"
    require(
        not found, out, expected="an output folder", found=found, remedy="Choose another folder with --out."
    )


def _is_scene(folder: Path) -> bool:
    with contextlib.suppress(PolarguideError, OSError):  # two folders of one angle, or missing permissions
        return folder.is_dir() and ((folder / "polar").is_dir() or len(angle_folders(folder)) == len(ANGLES))
    return False


def is_posed_scene(folder: Path) -> bool:
    """Return True if a folder is a scene with poses, which needs no preparation."""
    with contextlib.suppress(PolarguideError, OSError):
        return (folder / "sparse").is_dir() and bool(find_layout(folder))
    return False


def select_views(layout: CaptureFiles, views: Sequence[str] | None) -> list[str]:
    """Validate the requested view names and return them, sorted. By default, return the names of all views.

    Raises:
        PolarguideError: a name is unknown, the list is empty, or a view lacks the picture of an angle.
    """
    if views is None:
        names = layout.names
    else:
        wanted = [canonical(name) for name in views]
        for name in wanted:
            if name not in layout.names:
                raise unknown_view(f"{layout.root} (views)", name, layout.names)
        names = sorted(set(wanted))
        require(
            names,
            "views",
            expected="at least one view name",
            found="an empty list",
            remedy="Omit the argument to read all views.",
        )
    _require_complete(layout, names)
    return names


def _require_complete(layout: CaptureFiles, names: list[str]) -> None:
    incomplete = [n for n in names if n not in layout.others and len(layout.pictures[n]) < len(ANGLES)]
    if not incomplete:
        return
    name = incomplete[0]
    present = layout.pictures[name]
    missing = next(angle for angle in ANGLES if angle not in present)
    others = f" ({len(incomplete)} views are incomplete)" if len(incomplete) > 1 else ""
    path = next(iter(present.values()))
    if path.parent == layout.root / "polar":
        path = path.with_name(f"{path.stem[:-3]}{missing:03d}{path.suffix}")
    else:
        folders = {at: file.parent for files in layout.pictures.values() for at, file in files.items()}
        path = folders.get(missing, path.parent) / path.name
    raise PolarguideError(
        path,
        expected=f"the picture of view {name} at {missing} degrees",
        found=f"only {', '.join(str(angle) for angle in sorted(present))} degrees{others}",
        remedy="Add the file, remove the other pictures of the view, or list its pictures in angles.csv.",
    )


def _read_flat(
    folder: Path, warnings: list[str], table: Path | None
) -> tuple[dict[str, dict[int, Path]], dict[str, tuple[tuple[Path, Exposure], ...]]]:
    """Find the pictures ``<view>_<angle>.<suffix>`` in the folder ``polar/``, and those that a table lists.

    Returns:
        The attributes ``pictures`` and ``others`` of ``CaptureFiles``.
    """
    lines = read_table(table) if table is not None else []
    stored = {canonical(path.name): path for path in list_files(folder, SUFFIXES)}
    for item in lines:
        require(
            item.file in stored,
            f"{table} (line {item.number})",
            expected="a picture in polar/",
            found=f"no file {item.file}",
            remedy="Correct the file's name in the table, or remove its line.",
        )
    pictures: dict[str, dict[int, Path]] = {}
    unused = []
    listed_files = {item.file for item in lines}
    for stem, path in index_files(folder, SUFFIXES, listed_files).items():
        match = _PICTURE_STEM.fullmatch(stem)
        if match is None:
            unused.append(path.name)
        else:
            pictures.setdefault(match["view"], {})[int(match["angle"])] = path
    if unused:
        unlisted = "" if table is None else f" and which {TABLE} does not list"
        warnings.append(
            f"polar/ has pictures whose names do not end in _000, _045, _090 or _135{unlisted}, which "
            f"are ignored ({listed(unused)})."
        )
    return pictures, _take_listed(pictures, lines, stored)


def _take_listed(
    pictures: dict[str, dict[int, Path]], lines: Sequence[Line], stored: Mapping[str, Path]
) -> dict[str, tuple[tuple[Path, Exposure], ...]]:
    """Group the pictures of a table by view, and return the views with other angles than 0, 45, 90 and 135 degrees.

    A view with one picture at each of these four angles is added to ``pictures`` instead.
    """
    views: dict[str, list[tuple[Path, Exposure]]] = {}
    for item in lines:
        views.setdefault(item.view or stem_of(Path(item.file)), []).append((stored[item.file], item.exposure))
    others = {}
    for view, pairs in views.items():
        named = pictures.pop(view, {})
        pairs += [(path, FOUR[ANGLES.index(angle)]) for angle, path in sorted(named.items())]
        four = {FOUR.index(exposure): path for path, exposure in pairs if exposure in FOUR}
        if len(pairs) == len(four) == len(FOUR):
            pictures[view] = {angle: four[place] for place, angle in enumerate(ANGLES)}
        else:
            others[view] = tuple(pairs)
    return others


def require_angle_folders(root: Path, folders: Mapping[int, Path]) -> None:
    """Check that 0, 45, 90 and 135 degrees each have a folder.

    Raises:
        PolarguideError: a folder is missing.
    """
    missing = [angle for angle in ANGLES if angle not in folders]
    require(
        not missing,
        root,
        expected="four folders, for 0, 45, 90 and 135 degrees",
        found=f"only {', '.join(path.name for path in folders.values())}, none for {listed(list(map(str, missing)))}",
        remedy="Add the folder.",
    )


def angle_folders(root: Path) -> dict[int, Path]:
    """Return the folders of polarizer angles by angle in degrees; empty without such folders.

    Their names are angles, such as ``I-00``, ``I_45``, ``090`` or ``pol135``. Otherwise, four folders whose names
    differ in one number are accepted: ``image_0``, ``image_45``, ``image_90`` and ``image_135``.

    Raises:
        PolarguideError: two folders have the same angle.
    """
    folders: dict[int, Path] = {}
    children = [path for path in sorted(root.iterdir()) if path.is_dir()]
    for path in children:
        angle = angle_of_folder(path)
        if angle is None:
            continue
        if angle in folders:
            raise ambiguous(root, f"one folder for {angle} degrees", folders[angle], path)
        folders[angle] = path
    sets = [] if folders else numbered_like_angles(children)
    return dict(sorted((sets[0] if len(sets) == 1 else folders).items()))


def numbered_like_angles(paths: Sequence[Path]) -> list[dict[int, Path]]:
    """Return sets of four files or folders by angle whose names differ in one number: 0, 45, 90 or 135.

    Examples are cup_P45.png, cup(45).png and 45_cup.png.
    """
    sets: dict[tuple[Path, str, str], dict[int, Path]] = {}
    for path in paths:
        for number in re.finditer(r"\d+", path.name):
            around = (path.parent, path.name[: number.start()], path.name[number.end() :])
            sets.setdefault(around, {})[int(number[0])] = path
    return [by_angle for by_angle in sets.values() if sorted(by_angle) == list(ANGLES)]


def angle_of_folder(path: Path) -> int | None:
    """Return the polarizer angle in degrees in a folder's name. Return None if the name is no angle."""
    match = _ANGLE_FOLDER.fullmatch(path.name)
    return int(match["angle"]) if match is not None and int(match["angle"]) in ANGLES else None


def index_files(folder: Path, suffixes: tuple[str, ...], ignored: Container[str] = ()) -> dict[str, Path]:
    """Return the files of a folder by stem. A missing folder has no files.

    Args:
        folder: the folder.
        suffixes: suffixes of the files to return.
        ignored: names of files to leave out, in the form of ``canonical``.

    Raises:
        PolarguideError: two files have the same stem.
    """
    paths = (path for path in list_files(folder, suffixes) if canonical(path.name) not in ignored)
    return _index(folder, paths, stem_of)


def _index(folder: Path, paths: Iterable[Path], name: Callable[[Path], str]) -> dict[str, Path]:
    """Return files by name.

    Raises:
        PolarguideError: two files have the same name.
    """
    files: dict[str, Path] = {}
    for path in paths:
        first = files.setdefault(name(path), path)
        if first is not path:
            raise ambiguous(folder, f"one file called {name(path)}", first, path)
    return files


def list_files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Return the files of a folder with one of the suffixes, sorted. A missing folder has no files.

    Raises:
        PolarguideError: ``folder`` is not a folder.
    """
    if not os.path.lexists(folder):
        return []
    require_folder(folder, expected="a folder of files named like the views", remedy="Remove or rename it.")
    return [
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in suffixes and not path.name.startswith(".")
    ]


def ambiguous(folder: Path, expected: str, first: Path, second: Path) -> PolarguideError:
    """Return the error for two files of which only one is expected, such as two pictures of one view and angle."""
    same = first.name == second.name
    names = [f"{path.parent.name}/{path.name}" if same else path.name for path in (first, second)]
    return PolarguideError(
        folder, expected=expected, found=" and ".join(names), remedy="Remove or rename one of them."
    )


def describe_contents(root: Path) -> str:
    """Describe a folder's contents for messages."""
    names = sorted(path.name for path in root.iterdir())
    return f"a folder with {listed(names)}" if names else "an empty folder"


GIBIBYTE = 1 << 30
SHARE = 0.8
"""Share of the free memory that pictures may take by default."""
MASKS = 2 + 4
"""Number of bytes per pixel of a view without its pictures, for peak, black, invalid, saturated and mask."""
KEPT = 4 * 3 * 2 + MASKS
"""Number of bytes per pixel that a view with four pictures of three channels takes."""
READ = 4 * 3 * 2 * 3
"""Number of bytes per pixel for reading a view, with decoded pictures, their linear codes, and single channels."""


def check_memory(
    layout: CaptureFiles,
    names: Sequence[str],
    *,
    factor: int,
    at_once: int,
    limit: float | None,
    hold: bool = True,
) -> None:
    """Refuse pictures that do not fit into memory.

    Args:
        layout: files of the capture.
        names: names of the views to read.
        factor: side of the pixel boxes that are averaged.
        at_once: number of views that are read concurrently.
        limit: memory limit in GiB; default: 80 % of the free memory.
        hold: if True, the pictures stay in memory.

    Raises:
        PolarguideError: the required memory exceeds the limit.
    """
    pixels = stated_pixels(layout, names)
    stored = sum((KEPT if hold else MASKS) * count // factor**2 for count in pixels)
    needed = stored + sum(READ * count for count in sorted(pixels, reverse=True)[:at_once])
    require_memory(
        layout.root,
        needed,
        f"{len(names)} views",
        limit=limit,
        remedy="Use --downscale 2 or more, fewer views, or more --memory.",
    )


def require_memory_of_each(paths: Sequence[Path], pixel: int, what: str, *, remedy: str) -> None:
    """Refuse files that are processed one after the other if the largest does not fit into memory.

    Args:
        paths: paths of pictures and arrays. Files whose header states no size are ignored.
        pixel: number of bytes per pixel that the work takes.
        what: description of the files for the error message.
        remedy: remedy in the error message.

    Raises:
        PolarguideError: the largest file does not fit.
    """
    sizes = {path: stated_size(path) or (0, 0) for path in paths}
    if sizes:
        path = max(sizes, key=lambda path: math.prod(sizes[path]))
        width, height = sizes[path]
        require_memory(path, pixel * width * height, f"{what} of {width}x{height}", remedy=remedy)


def require_memory(where: Path, needed: int, what: str, *, remedy: str, limit: float | None = None) -> None:
    """Refuse work that takes more memory than the limit.

    Args:
        where: file or folder that the error message names.
        needed: number of bytes that the work takes.
        what: description of the pictures for the error message.
        remedy: remedy in the error message.
        limit: memory limit in GiB; default: 80 % of the free memory.

    Raises:
        PolarguideError: the work takes more memory than the limit.
    """
    allowed = int(SHARE * free_memory()) if limit is None else int(limit * GIBIBYTE)
    source = f"{SHARE:.0%} of the free memory" if limit is None else "the limit by --memory"
    require(
        needed <= allowed,
        where,
        expected=f"pictures that take up to {allowed / GIBIBYTE:.1f} GiB, {source}",
        found=f"{what} that take {needed / GIBIBYTE:.1f} GiB",
        remedy=remedy,
    )


def stated_pixels(layout: CaptureFiles, names: Sequence[str]) -> list[int]:
    """Return the number of pixels of each view, for estimates of memory.

    It is the number of pixels of the view's largest picture according to the header. For K > 4 pictures, it is
    multiplied by K / 4. It is 0 if the headers state no size.
    """
    counts = []
    for name in names:
        paths = layout.files(name)
        largest = max((math.prod(stated_size(path) or (0, 0)) for path in paths), default=0)
        counts.append(max(largest, largest * len(paths) // 4))
    return counts


EXPOSURE_TABLE = "exposures.csv"
"""Name of the table of exposures."""
_COLUMNS = ["file", "shot", "stops"]
_REMEDY = "Use the columns file, shot and stops; stops may be empty if EXIF data or the pictures state the exposure."
_LABEL = re.compile(r"(?P<shot>.+?)[-_ .](?:ev ?(?P<stops>[+-]?\d+(?:\.\d+)?)|bracket\d{1,2})", re.IGNORECASE)


@dataclass(frozen=True)
class ExposureName:
    """Shot and exposure of a file.

    Attributes:
        shot: name of the shot, which all of its exposures share.
        stops: exposure in stops relative to the normal exposure; None if it is not stated.
    """

    shot: str
    stops: float | None = None


def exposure_name(path: Path) -> ExposureName:
    """Return the shot and the exposure of a file, from the table of its folder or from its name.

    Raises:
        PolarguideError: the table cannot be read, a cell is invalid, or a listed file is missing.
    """
    table = path.parent / EXPOSURE_TABLE
    if os.path.lexists(table):
        status = table.stat()
        # The time of the folder changes if a file is added or removed.
        key = (status.st_mtime_ns, status.st_size, path.parent.stat().st_mtime_ns)
        entry = _read_table(table, *key).get(canonical(path.name))
        if entry is not None:
            return entry
    stem = stem_of(path)
    match = _LABEL.fullmatch(stem)
    if match is None:
        return ExposureName(stem)
    stops = match["stops"]
    return ExposureName(match["shot"], None if stops is None else float(stops))


@lru_cache(maxsize=16)
def _read_table(table: Path, *_: int) -> dict[str, ExposureName]:
    """Read the shot and the exposure of each file that a table lists."""
    rows = read_rows(table, _REMEDY)
    header = [cell.lower() for cell in rows[0][1]] if rows else []
    require(
        header == _COLUMNS,
        f"{table} (line 1)",
        expected=f"the header {','.join(_COLUMNS)}",
        found=shortened(",".join(header)) if header else "an empty file",
        remedy=_REMEDY,
    )
    existing = {canonical(path.name) for path in table.parent.iterdir()}
    entries: dict[str, ExposureName] = {}
    for number, row in rows[1:]:
        file, shot, text = (*row, "", "", "")[:3]
        stops = number_or_nan(text) if text else None
        valid = stops is None or abs(stops) <= LARGEST_STOPS
        require(
            len(row) in (2, 3) and file and shot and valid and canonical(file) not in entries,
            f"{table} (line {number})",
            expected=f"a file that is listed once, the name of its shot, and stops up to {LARGEST_STOPS:g}",
            found=shortened(",".join(row)),
            remedy=_REMEDY,
        )
        require(
            canonical(file) in existing,
            f"{table} (line {number})",
            expected=f"the file {table.parent / file}",
            found="nothing with this name",
            remedy="Correct the name, or remove the line.",
        )
        entries[canonical(file)] = ExposureName(canonical(shot), stops)
    return entries


def shot_stem(path: Path) -> str:
    """Return the name of a file without suffix and exposure, which is the name of its shot."""
    return exposure_name(path).shot


def list_shot_files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Return one file of each shot in a folder, sorted. A missing folder has no files."""
    return sorted(one_of_each_shot(list_files(folder, suffixes)))


def one_of_each_shot(files: Sequence[Path]) -> list[Path]:
    """Return one of the files of each shot: the file nearest to the normal exposure, or the first one.

    Files of one shot have the same folder and suffix. A file without a label is a shot of its own.
    """
    nearest: dict[object, tuple[float, Path]] = {}
    for path in files:
        name = exposure_name(path)
        stops = 0.0 if name.stops is None else abs(name.stops)
        key = (path.parent, name.shot, path.suffix.lower()) if _is_labeled(path) else path
        if key not in nearest or stops < nearest[key][0]:
            nearest[key] = stops, path
    return [path for _, path in nearest.values()]


def index_shot_files(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """Return one file of each shot in a folder by the name of the shot, like ``list_shot_files``.

    Raises:
        PolarguideError: files with two suffixes have the same name.
    """
    return _index(folder, list_shot_files(folder, suffixes), shot_stem)


def _is_labeled(path: Path) -> bool:
    """Return True if the name of a file, or the table, labels it as one exposure of a shot."""
    return exposure_name(path) != ExposureName(stem_of(path))


def exposure_files(path: Path) -> tuple[Path, ...]:
    """Return all files of the shot that a file represents, sorted by name. A file without a label is alone."""
    if not _is_labeled(path):
        return (path,)
    shot = shot_stem(path)
    others = list_files(path.parent, (path.suffix.lower(),))
    return tuple(other for other in others if shot_stem(other) == shot)


def is_lone_exposure(path: Path) -> bool:
    """Return True if a file is labeled as an exposure, and its shot has no other exposure."""
    return _is_labeled(path) and len(exposure_files(path)) == 1


def all_exposures(paths: Sequence[Path]) -> list[Path]:
    """Return the files of all exposures of some shots."""
    return [file for path in paths for file in exposure_files(path)]


def exposure_tables(paths: Sequence[Path]) -> list[Path]:
    """Return the tables of exposures that exist in the folders of some files."""
    tables = (folder / EXPOSURE_TABLE for folder in dict.fromkeys(path.parent for path in paths))
    return [table for table in tables if os.path.lexists(table)]


def numbered_views(stems: set[str]) -> dict[str, int]:
    """Return the number of each view by name, for the names that are numbers."""
    return {stem: int(stem) for stem in sorted(stems) if stem.isascii() and stem.isdigit() and len(stem) < 7}
