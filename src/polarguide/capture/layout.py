"""Find the files of a capture, in our own layout or in a folder per polarizer angle, and the memory that they take."""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from polarguide.capture.exposures import FOUR, TABLE, Exposure, Line, read_table
from polarguide.capture.formats.pictures import SUFFIXES, stated_size
from polarguide.capture.view import ANGLES
from polarguide.core.errors import PolarguideError, require, unknown_view
from polarguide.core.files import require_folder
from polarguide.core.system import free_memory
from polarguide.core.text import canonical, listed, stem_of

_PICTURE_STEM = re.compile(r"(?P<view>.+)_(?P<angle>000|045|090|135)")
_ANGLE_FOLDER = re.compile(r"(?:(?:i|pol|angle)[-_ ]?|[_ ])?(?P<angle>\d{1,3})(?:deg)?", re.IGNORECASE)
_READ_FOLDERS = ("polar", "masks", "materials", "invalid", "gt", "sparse")
_NUMBER = re.compile(r"(?<!\d)\d{1,3}(?!\d)")
_HINT = (
    "Camera files become one by polarguide prepare FOLDER --out SCENE. Else give a folder that holds "
    "polar/<view>_000.png, _045.png, _090.png and _135.png, or the four folders I-00, I-45, I-90 and I-135 (also 0, "
    "45, 90, 135) with equally named pictures."
)


@dataclass(frozen=True)
class Layout:
    """The files of a capture.

    Attributes:
        root: the folder.
        pictures: view name -> angle in degrees -> file, of views with pictures at 0, 45, 90 and 135 degrees. Angles may
            be missing; ``select_views`` checks.
        masks, materials, invalid, ground_truth: view name -> file, for the views that have one.
        warnings: about files that are not used.
        others: view name -> its files and what they are, of views with other pictures, which ``angles.csv`` lists.
        table: ``angles.csv``, if there is one.
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
        """Files of a view with all its pictures, in the order of its exposures."""
        if name in self.others:
            return [path for path, _ in self.others[name]]
        return [self.pictures[name][angle] for angle in ANGLES]

    def exposures(self, name: str) -> tuple[Exposure, ...]:
        """The exposures of a view's pictures."""
        return tuple(e for _, e in self.others[name]) if name in self.others else FOUR


def find_layout(root: Path) -> Layout:
    """Find the files of a capture.

    Raises:
        PolarguideError: there is no such folder, it has neither layout, or two files have the same view and angle.
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
    sides: dict[str, dict[str, Path]] = {}
    kinds = (("masks", SUFFIXES), ("materials", SUFFIXES), ("invalid", SUFFIXES), ("gt", (".npz",)))
    for kind, suffixes in kinds:
        files = index_files(root / kind, suffixes)
        strangers = sorted(path.name for stem, path in files.items() if stem not in names)
        if strangers:
            warnings.append(
                f"{kind}/ has files without a view, which are not used ({listed(strangers)}): "
                "name each file like its view."
            )
        sides[kind] = files
    without = sorted(names - sides["masks"].keys())
    if sides["masks"] and without:
        warnings.append(f"masks/ has no file for {len(without)} of {len(names)} views ({listed(without)}).")
    by_view = sides["masks"], sides["invalid"], sides["gt"]
    return Layout(root, pictures, *by_view, tuple(warnings), others, table, sides["materials"])


def refuse_scene(out: Path) -> None:
    """Refuse to write into a scene, or into a folder that it is read from.

    Raises:
        PolarguideError: there is one.
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
    with contextlib.suppress(PolarguideError, OSError):  # two folders of one angle, or no right to look
        return folder.is_dir() and ((folder / "polar").is_dir() or len(angle_folders(folder)) == len(ANGLES))
    return False


def select_views(layout: Layout, views: Sequence[str] | None) -> list[str]:
    """The names to read, sorted: all, or those asked for.

    Raises:
        PolarguideError: a name is unknown, none is given, or a view lacks an angle.
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
            remedy="Leave it out to read all views.",
        )
    _require_complete(layout, names)
    return names


def _require_complete(layout: Layout, names: list[str]) -> None:
    incomplete = [n for n in names if n not in layout.others and len(layout.pictures[n]) < len(ANGLES)]
    if not incomplete:
        return
    name = incomplete[0]
    have = layout.pictures[name]
    missing = next(angle for angle in ANGLES if angle not in have)
    others = f" ({len(incomplete)} views are incomplete)" if len(incomplete) > 1 else ""
    path = next(iter(have.values()))
    if path.parent == layout.root / "polar":
        path = path.with_name(f"{path.stem[:-3]}{missing:03d}{path.suffix}")
    else:
        folders = {at: file.parent for files in layout.pictures.values() for at, file in files.items()}
        path = folders.get(missing, path.parent) / path.name
    raise PolarguideError(
        path,
        expected=f"the picture of view {name} at {missing} degrees",
        found=f"only {', '.join(str(angle) for angle in sorted(have))} degrees{others}",
        remedy="Add the file, remove the other pictures of the view, or list what there is in angles.csv.",
    )


def _read_flat(
    folder: Path, warnings: list[str], table: Path | None
) -> tuple[dict[str, dict[int, Path]], dict[str, tuple[tuple[Path, Exposure], ...]]]:
    """``polar/<view>_<angle>.<suffix>``, and what a table lists."""
    lines = read_table(table) if table is not None else []
    stored = {canonical(path.name): path for path in list_files(folder, SUFFIXES)}
    for item in lines:
        require(
            item.file in stored,
            f"{table} (line {item.number})",
            expected="a picture in polar/",
            found=f"none called {item.file}",
            remedy="Correct the file's name in the table, or remove its line.",
        )
    pictures: dict[str, dict[int, Path]] = {}
    strangers = []
    listed_files = {item.file for item in lines}
    for stem, path in index_files(folder, SUFFIXES, listed_files).items():
        match = _PICTURE_STEM.fullmatch(stem)
        if match is None:
            strangers.append(path.name)
        else:
            pictures.setdefault(match["view"], {})[int(match["angle"])] = path
    if strangers:
        beside = "" if table is None else f" and which {TABLE} does not list"
        warnings.append(
            f"polar/ has pictures whose names do not end in _000, _045, _090 or _135{beside}, which "
            f"are not used ({listed(strangers)})."
        )
    return pictures, _take_listed(pictures, lines, stored)


def _take_listed(
    pictures: dict[str, dict[int, Path]], lines: Sequence[Line], stored: Mapping[str, Path]
) -> dict[str, tuple[tuple[Path, Exposure], ...]]:
    """Add the views of a table: to ``pictures`` where they have one picture at each of the four angles."""
    views: dict[str, list[tuple[Path, Exposure]]] = {}
    for item in lines:
        views.setdefault(item.view or stem_of(Path(item.file)), []).append((stored[item.file], item.exposure))
    others = {}
    for view, pairs in views.items():
        named = pictures.pop(view, {})
        pairs += [(path, FOUR[ANGLES.index(angle)]) for angle, path in sorted(named.items())]
        of_four = {FOUR.index(exposure): path for path, exposure in pairs if exposure in FOUR}
        if len(pairs) == len(of_four) == len(FOUR):
            pictures[view] = {angle: of_four[place] for place, angle in enumerate(ANGLES)}
        else:
            others[view] = tuple(pairs)
    return others


def require_angle_folders(root: Path, folders: Mapping[int, Path]) -> None:
    """Check that there is one folder per angle.

    Raises:
        PolarguideError: one is missing.
    """
    missing = [angle for angle in ANGLES if angle not in folders]
    if missing:
        raise PolarguideError(
            root,
            expected="four folders, for 0, 45, 90 and 135 degrees",
            found=f"none for {missing[0]} degrees beside {', '.join(p.name for p in folders.values())}",
            remedy="Add the folder.",
        )


def angle_folders(root: Path) -> dict[int, Path]:
    """Folders named like a polarizer angle (I-00, I_45, 090, pol135), or four alike but for it (image_0, image_45).

    Raises:
        PolarguideError: two folders have the same angle.
    """
    folders: dict[int, Path] = {}
    inside = [path for path in sorted(root.iterdir()) if path.is_dir()]
    for path in inside:
        angle = angle_of_folder(path)
        if angle is None:
            continue
        if angle in folders:
            raise ambiguous(root, f"one folder for {angle} degrees", folders[angle], path)
        folders[angle] = path
    return dict(sorted((folders or _alike_but_for_the_angle(inside)).items()))


def _alike_but_for_the_angle(folders: Sequence[Path]) -> dict[int, Path]:
    """The only four folders whose names differ in one number, 0, 45, 90 and 135; nothing where there is no such set."""
    sets: dict[tuple[str, str], dict[int, Path]] = {}
    for path in folders:
        for match in _NUMBER.finditer(path.name):
            around = path.name[: match.start()], path.name[match.end() :]
            sets.setdefault(around, {})[int(match[0])] = path
    complete = [of_angle for of_angle in sets.values() if set(of_angle) == set(ANGLES)]
    return complete[0] if len(complete) == 1 else {}


def angle_of_folder(path: Path) -> int | None:
    """The polarizer angle that a folder is named after; None for other names."""
    match = _ANGLE_FOLDER.fullmatch(path.name)
    return int(match["angle"]) if match is not None and int(match["angle"]) in ANGLES else None


def index_files(folder: Path, suffixes: tuple[str, ...], besides: Container[str] = ()) -> dict[str, Path]:
    """Stem (``canonical``) -> file for the files of a folder with one of the suffixes, ``besides`` some; empty if there
    is no such folder.
    """
    files: dict[str, Path] = {}
    for path in list_files(folder, suffixes):
        if canonical(path.name) in besides:
            continue
        stem = stem_of(path)
        if stem in files:
            raise ambiguous(folder, f"one file called {stem}", files[stem], path)
        files[stem] = path
    return files


def list_files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """The files of a folder with one of the suffixes, sorted; none if there is no such folder.

    Raises:
        PolarguideError: ``folder`` is something else than a folder.
    """
    if not os.path.lexists(folder):
        return []
    require_folder(folder, expected="a folder of files called like the views", remedy="Remove or rename it.")
    return [
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in suffixes and not path.name.startswith(".")
    ]


def ambiguous(folder: Path, expected: str, first: Path, second: Path) -> PolarguideError:
    """The error that two files of a folder have the same meaning."""
    apart = first.name == second.name
    names = [f"{path.parent.name}/{path.name}" if apart else path.name for path in (first, second)]
    return PolarguideError(
        folder, expected=expected, found=" and ".join(names), remedy="Remove or rename one of them."
    )


def describe_contents(root: Path) -> str:
    """A description of a folder's contents, for messages."""
    names = sorted(path.name for path in root.iterdir())
    return f"a folder with {listed(names)}" if names else "an empty folder"


GIBIBYTE = 1 << 30
SHARE = 0.8
"""Of the free memory, that the pictures may take where nothing else was asked for."""
# Bytes for each pixel of a view: peak, black, invalid, saturated, mask; with codes of four pictures in three channels.
MASKS = 2 + 4
KEPT = 4 * 3 * 2 + MASKS
# While one view is read: what is decoded of it, its copy in linear codes, and channels apart.
READ = 4 * 3 * 2 * 3


def check_memory(
    layout: Layout, names: Sequence[str], *, factor: int, at_once: int, limit: float | None, hold: bool = True
) -> None:
    """Refuse pictures that do not fit into memory.

    Args:
        layout: the files. names: views to be read, with all their angles.
        factor: side of the boxes over which they are averaged. at_once: views that are read at a time.
        limit: GiB that may be taken; None: 80 % of what is free. hold: whether the pictures stay in memory.

    Raises:
        PolarguideError: the least that suffices is more.
    """
    pixels = stated_pixels(layout, names)
    stored = sum((KEPT if hold else MASKS) * count // factor**2 for count in pixels)
    needed = stored + sum(READ * count for count in sorted(pixels, reverse=True)[:at_once])
    remedy = "Give --downscale 2 or more, fewer views, or more --memory."
    require_memory(layout.root, needed, f"{len(names)} views", limit=limit, remedy=remedy)


def require_memory_of_each(paths: Sequence[Path], pixel: int, what: str, *, remedy: str) -> None:
    """Refuse files that are worked on one after the other, where the largest does not fit into memory.

    Args:
        paths: of pictures and arrays whose headers state a size; others are passed over.
        pixel: bytes that one of their pixels takes, at least. what, remedy: for messages.

    Raises:
        PolarguideError: the largest file does not fit.
    """
    sizes = {path: stated_size(path) or (0, 0) for path in paths}
    if sizes:
        path = max(sizes, key=lambda path: math.prod(sizes[path]))
        width, height = sizes[path]
        require_memory(path, pixel * width * height, f"{what} of {width}x{height}", remedy=remedy)


def require_memory(where: Path, needed: int, what: str, *, remedy: str, limit: float | None = None) -> None:
    """Refuse what takes more memory than there is.

    Args:
        where, what, remedy: for messages. needed: bytes, at least.
        limit: GiB that may be taken; None: 80 % of what is free.

    Raises:
        PolarguideError: that is less.
    """
    if limit is not None:
        allowed = int(limit * GIBIBYTE)
        whose = "as --memory allows"
    else:
        allowed = int(SHARE * free_memory())
        whose = f"{SHARE:.0%} of what is free"
    require(
        needed <= allowed,
        where,
        expected=f"pictures that take up to {allowed / GIBIBYTE:.1f} GiB, {whose}",
        found=f"{what} that take {needed / GIBIBYTE:.1f} GiB",
        remedy=remedy,
    )


def stated_pixels(layout: Layout, names: Sequence[str]) -> list[int]:
    """Pixels of the largest picture of each view, as the files state, with as much more for more than four pictures as
    these take; 0 where the files state nothing.
    """
    counts = []
    for name in names:
        paths = layout.files(name)
        largest = max((math.prod(stated_size(path) or (0, 0)) for path in paths), default=0)
        counts.append(max(largest, largest * len(paths) // 4))
    return counts
