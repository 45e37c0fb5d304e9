"""Write a scene folder view by view, so that an interrupted rendering can be resumed."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide import __version__
from polarguide.capture.write import picture_name
from polarguide.core.errors import PolarguideError
from polarguide.core.files import holds_files, make_folder, read_file, write_whole
from polarguide.core.records import read_record, shortened
from polarguide.geometry.polarizer import ANGLES, malus
from polarguide.optics.color import srgb_encode_array
from polarguide_synth.mesh import Array
from polarguide_synth.schema import SceneSpec, with_current_keys
from polarguide_synth.settings import SynthSettings, Variant

State = Literal["new", "begun", "finished"]
REQUEST = "request.json"
STEP = 16
"""Pictures have 12 bits in 16, as cameras give them: 0, 16, 32, ..."""
TOP = 65535 // STEP


def scene_request(spec: SceneSpec, settings: SynthSettings) -> dict[str, Any]:
    """The content of ``request.json``: the requested rendering."""
    return {"scene": spec.data(), "settings": settings.data()}


def folder_state(out: Path, request: dict[str, Any]) -> State:
    """How far the rendering of a request in a folder is. Nothing is written.

    Raises:
        PolarguideError: the folder holds something else, or the same scene with other settings.
    """
    path = out / REQUEST
    remedy = "Give another --out, or remove the folder."
    if not out.exists() or (out.is_dir() and not holds_files(out)):
        return "new"
    if not path.is_file():
        raise PolarguideError(
            out,
            expected="a new or an empty folder",
            found="a folder with other files",
            remedy="Give another --out.",
        )
    before = with_current_keys(read_record(path, dict[str, Any], remedy=remedy))
    now = json.loads(json.dumps(request))
    if before != now:
        raise PolarguideError(
            out,
            expected="a scene that was begun with the same settings",
            found=f"a scene with other settings ({_difference(before, now)})",
            remedy=remedy,
        )
    return "finished" if (out / "scene.json").exists() else "begun"


def _difference(before: Any, now: Any, place: str = "") -> str:
    """The first difference of two JSON values, as text."""
    if isinstance(before, dict) and isinstance(now, dict):
        none = "nothing"
        pairs = [(f"{place}.{key}", before.get(key, none), now.get(key, none)) for key in {**now, **before}]
    elif isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        pairs = [(f"{place}[{k}]", *both) for k, both in enumerate(zip(before, now, strict=True))]
    else:
        return f"{place.lstrip('.')}: {shortened(before)} in place of {shortened(now)}"
    return next(_difference(old, new, at) for at, old, new in pairs if old != new)


def write_file(path: Path, data: bytes) -> None:
    """Write a file completely or not at all, and its folder if it is missing.

    Raises:
        PolarguideError: the file cannot be written.
    """
    make_folder(path.parent)
    write_whole(path, data)


def sensor_codes(stokes: Array, change: Callable[[Array], Array]) -> NDArray[np.uint16]:
    """The four pictures behind a polarizer as a 12-bit sensor stores them, [4, H, W, 3].

    Args:
        stokes: [3, H, W, 3], full scale 1.
        change: applied to the intensities [4, H, W, 3] before they are stored (noise).
    """
    light = np.stack([malus(stokes, np.radians(angle)) for angle in ANGLES])
    return np.clip(np.round(change(light) * (65535 / STEP)), 0, TOP).astype(np.uint16) * STEP


def clipped_share(out: Path, names: Sequence[str]) -> float:
    """Share of the samples of these views' pictures that are at full scale."""
    files = [file for name in names for file in view_files(out, name, ground_truth=False, raw=False)]
    return float(np.mean([(_picture(file) == TOP * STEP).mean() for file in files]))


def view_files(out: Path, name: str, *, ground_truth: bool, raw: bool) -> list[Path]:
    """All files of a view; the view is finished when they exist."""
    files = [out / picture_name(name, angle) for angle in ANGLES]
    files += [out / "gt" / f"{name}.npz"] if ground_truth else []
    return files + ([out / "raw" / f"{name}.png"] if raw else [])


def photograph(out: Path, name: str) -> NDArray[np.uint8]:
    """The mean of a view's four pictures as 8-bit sRGB, [H, W, 3]."""
    files = view_files(out, name, ground_truth=False, raw=False)
    mean = np.mean([_picture(file) for file in files], axis=0) / 65535
    colors = mean[..., ::-1] if mean.ndim == 3 else np.repeat(mean[..., None], 3, axis=2)
    return np.asarray(np.round(255 * srgb_encode_array(np.clip(colors, 0, 1))), np.uint8)


def _picture(file: Path) -> Array:
    return np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), np.float64)


MANIFEST = "checksums.txt"
_REMEDY = "Remove the folder to render the scene again, or give another --out."
_FOLDERS = ("gt", "mesh", "polar", "raw", "sparse")
_FILES = ("calibration.json", "environment.hdr", "request.json", "sheet.jpg", "split.json")


def write_manifest(out: Path) -> str:
    """Write the list of a scene that is complete except ``scene.json``; returns the SHA-256 of the list."""
    lines = [f"{_digest(path)}  {path.relative_to(out).as_posix()}\n" for path in sorted(_written(out))]
    data = "".join(lines).encode()
    write_file(out / MANIFEST, data)
    return hashlib.sha256(data).hexdigest()


def verify_scene(out: Path) -> str:
    """Compare a finished scene with its list; returns the SHA-256 of the list.

    Raises:
        PolarguideError: a file is missing or has changed, or the list has.
    """
    data = read_file(out / MANIFEST, remedy=_REMEDY)
    if hashlib.sha256(data).hexdigest() != scene_digest(out):
        raise _changed(out / MANIFEST, "the list of checksums whose digest scene.json names")
    for line in data.decode(errors="replace").splitlines():
        expected, _, name = line.partition("  ")
        path = out / name
        if not path.resolve().is_relative_to(out.resolve()):
            raise _changed(out / MANIFEST, "a list of files of this scene")
        if not path.is_file() or _digest(path) != expected:
            raise _changed(path, f"the file that {MANIFEST} lists")
    return scene_digest(out)


def scene_digest(out: Path) -> str:
    """The digest in ``scene.json``, or an empty string."""
    return str(read_record(out / "scene.json", dict[str, Any], remedy=_REMEDY).get("sha256", ""))


def _written(out: Path) -> Iterator[Path]:
    """The files that rendering writes; others in the folder are the user's."""
    for name in _FOLDERS:
        yield from (path for path in (out / name).rglob("*") if path.is_file() and path.name[0] != ".")
    yield from (out / name for name in _FILES if (out / name).is_file())


def _digest(path: Path) -> str:
    return hashlib.sha256(read_file(path, remedy=_REMEDY)).hexdigest()


def _changed(path: Path, expected: str) -> PolarguideError:
    return PolarguideError(
        path,
        expected=expected,
        found="another" if path.is_file() else "no file",
        remedy=_REMEDY,
    )


CONVENTION = {
    "intensity": "I_a = (S0 + S1 cos 2a + S2 sin 2a) / 2 is PNG value / 65535, linear",
    "aolp": "atan2(S2, S1) / 2 from the image's horizontal, counter-clockwise as displayed, in the lens frame of "
    "each ray (docs/explanation/conventions.md)",
    "camera": "OpenCV axes, world to camera x_cam = R x_world + t, pixel centers at 0.5",
    "truth": "gt/<view>.npz: stokes, specular and diffuse as S0 of the lobes of the first surface, exposed like "
    "the pictures, whose sum is S0 on surfaces; normal (world), depth (camera z), mask, objid, roughness (GGX alpha), "
    "metalness, index at pixel centers; albedo (linear, of metals their reflectance) as the mean of each pixel",
    "environment": "environment.hdr: rows from +z down, columns clockwise seen from above, from +x; scene units",
}


def scene_record(
    spec: SceneSpec,
    settings: SynthSettings,
    variant: Variant,
    names: list[str],
    tests: list[str],
    *,
    exposure: float,
    clipped: float,
) -> dict[str, Any]:
    """The content of ``scene.json``."""
    objects = [
        {"id": number, "name": thing.name, "mesh": f"mesh/{thing.name}.ply", "foreground": thing.foreground,
         "material": thing.material.record()}
        for number, thing in enumerate(spec.things, 1)
    ]  # fmt: skip
    return {
        "scene": spec.name,
        "about": spec.about,
        "width": settings.width,
        "height": settings.height,
        "fov_x_deg": spec.camera.fov,
        "views": names,
        "train": [name for name in names if name not in tests],
        "test": tests,
        "exposure": exposure,
        "exposure_note": "radiance * exposure = values in polar/ and gt/; I_a clips at 1",
        "clipped_share": round(clipped, 6),
        "noise": {"enabled": settings.noise > 0, "level": settings.noise},
        "stokes_frame": "lens",
        "stokes_convention": CONVENTION,
        "objects": objects,
        "world_up": "+z",
        "spp": settings.samples,
        "max_depth": spec.depth,
        "seed": settings.seed,
        "renderer": {
            "mitsuba": importlib.metadata.version("mitsuba"),
            "variant": variant.name,
            "polarguide": __version__,
        },
        "settings": settings.data(),
    }
