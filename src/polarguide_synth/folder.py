"""Read and write the files of a rendered scene: request, pictures, checksums and ``scene.json``.

The folder is written view by view. An interrupted rendering can therefore be resumed.
"""

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
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import holds_files, make_folder, read_file, write_whole
from polarguide.core.records import first_differing_value, read_record, shortened
from polarguide.geometry.polarizer import ANGLES, malus
from polarguide.optics.color import srgb_encode_array
from polarguide_synth.mesh import Array
from polarguide_synth.schema import SceneSpec, with_current_keys
from polarguide_synth.settings import VARIANT, SynthSettings

State = Literal["new", "begun", "finished"]
REQUEST = "request.json"
"""Name of the file that records the scene and the settings of a rendering."""
STEP = 16
"""Difference between two successive stored values. Pictures have 12 bits in 16, like those of cameras."""
TOP = 65535 // STEP
"""Largest 12-bit value."""


def scene_request(spec: SceneSpec, settings: SynthSettings) -> dict[str, Any]:
    """Return the content of ``request.json``: the scene and the settings of a rendering."""
    return {"scene": spec.data(), "settings": settings.data()}


def folder_state(out: Path, request: dict[str, Any]) -> State:
    """Return how far the rendering in a folder has progressed. Nothing is written.

    Raises:
        PolarguideError: the folder contains other files, or the same scene with other settings.
    """
    path = out / REQUEST
    remedy = "Give another --out, or remove the folder."
    if not out.exists() or (out.is_dir() and not holds_files(out)):
        return "new"
    require(
        path.is_file(),
        out,
        expected="a new or an empty folder",
        found="a folder with other files",
        remedy="Give another --out.",
    )
    before = with_current_keys(read_record(path, dict[str, Any], remedy=remedy))
    now = json.loads(json.dumps(request))
    if before != now:
        field, was, requested = first_differing_value("", before, now)
        raise PolarguideError(
            out,
            expected="a scene that was started with the same settings",
            found=f"other settings ({field[1:]}: {shortened(was)} in place of {shortened(requested)})",
            remedy=remedy,
        )
    return "finished" if (out / "scene.json").exists() else "begun"


def write_file(path: Path, data: bytes) -> None:
    """Write a file atomically. Its folder is created if it does not exist.

    Raises:
        PolarguideError: the file cannot be written.
    """
    make_folder(path.parent)
    write_whole(path, data)


def sensor_codes(stokes: Array, change: Callable[[Array], Array]) -> NDArray[np.uint16]:
    """Return the pictures behind polarizers at four angles as a 12-bit sensor stores them, [4, H, W, 3].

    Args:
        stokes: Stokes vectors [3, H, W, 3], full scale 1.
        change: function that changes the intensities [4, H, W, 3] before they are stored, for example to add noise.
    """
    light = np.stack([malus(stokes, np.radians(angle)) for angle in ANGLES])
    return np.clip(np.round(change(light) * (65535 / STEP)), 0, TOP).astype(np.uint16) * STEP


def clipped_share(out: Path, names: Sequence[str]) -> float:
    """Return the share of samples that are at full scale in the pictures of all views."""
    files = [file for name in names for file in view_files(out, name, ground_truth=False)]
    return float(np.mean([(_picture(file) == TOP * STEP).mean() for file in files]))


def view_files(out: Path, name: str, *, ground_truth: bool) -> list[Path]:
    """Return the paths of a view's files without those of a simulated sensor."""
    files = [out / picture_name(name, angle) for angle in ANGLES]
    return files + ([out / "gt" / f"{name}.npz"] if ground_truth else [])


def photograph(out: Path, name: str) -> NDArray[np.uint8]:
    """Return the mean of a view's four pictures as 8-bit sRGB, [H, W, 3]."""
    files = view_files(out, name, ground_truth=False)
    mean = np.mean([_picture(file) for file in files], axis=0) / 65535
    colors = mean[..., ::-1] if mean.ndim == 3 else np.repeat(mean[..., None], 3, axis=2)
    return np.asarray(np.round(255 * srgb_encode_array(np.clip(colors, 0, 1))), np.uint8)


def _picture(file: Path) -> Array:
    return np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), np.float64)


MANIFEST = "checksums.txt"
"""Name of the file with the checksums."""
_REMEDY = "Remove the folder to render the scene again, or give another --out."
_FOLDERS = ("gt", "mesh", "polar", "raw", "sparse")
_FILES = ("calibration.json", "environment.hdr", "request.json", "sheet.jpg", "split.json")


def write_manifest(out: Path) -> str:
    """Write the checksums of all files except ``scene.json``, and return the SHA-256 of the list."""
    lines = [f"{_digest(path)}  {path.relative_to(out).as_posix()}\n" for path in sorted(_written(out))]
    data = "".join(lines).encode()
    write_file(out / MANIFEST, data)
    return hashlib.sha256(data).hexdigest()


def verify_scene(out: Path) -> str:
    """Compare a finished scene with its checksums, and return the SHA-256 of their list.

    Raises:
        PolarguideError: a file or the list of checksums is missing or has changed.
    """
    digest = scene_digest(out)
    data = read_file(out / MANIFEST, remedy=_REMEDY)
    _require(
        hashlib.sha256(data).hexdigest() == digest, out / MANIFEST, "checksums with the digest in scene.json"
    )
    for line in data.decode(errors="replace").splitlines():
        expected, _, name = line.partition("  ")
        path = out / name
        inside = path.resolve().is_relative_to(out.resolve())
        _require(inside, out / MANIFEST, "a list of files of this scene")
        _require(path.is_file() and _digest(path) == expected, path, f"the file that {MANIFEST} lists")
    return digest


def scene_digest(out: Path) -> str:
    """Return the SHA-256 that ``scene.json`` states, or an empty string."""
    return str(read_record(out / "scene.json", dict[str, Any], remedy=_REMEDY).get("sha256", ""))


def _written(out: Path) -> Iterator[Path]:
    """List the files that a rendering writes. Any remaining file in the folder belongs to the user."""
    for name in _FOLDERS:
        yield from (path for path in (out / name).rglob("*") if path.is_file() and path.name[0] != ".")
    yield from (out / name for name in _FILES if (out / name).is_file())


def _digest(path: Path) -> str:
    return hashlib.sha256(read_file(path, remedy=_REMEDY)).hexdigest()


def _require(condition: bool, path: Path, expected: str) -> None:
    require(
        condition,
        path,
        expected=expected,
        found="a file with other contents" if path.is_file() else "no file",
        remedy=_REMEDY,
    )


CONVENTION = {
    "intensity": "I_a = (S0 + S1 cos 2a + S2 sin 2a) / 2 is PNG value / 65535, linear",
    "aolp": "atan2(S2, S1) / 2 from the image's horizontal, counter-clockwise as displayed, in the lens frame of "
    "each ray (docs/reference/conventions.md)",
    "camera": "OpenCV axes, world to camera x_cam = R x_world + t, pixel centers at 0.5",
    "truth": "; ".join(
        (
            "gt/<view>.npz: stokes, specular and diffuse as S0 of the lobes of the first surface, exposed like the "
            "pictures, whose sum is S0 on surfaces",
            "normal (world), depth (camera z), mask, objid, roughness (GGX alpha), metalness, index at pixel centers",
            "albedo (linear, of metals their reflectance) as the mean of each pixel",
        )
    ),
    "environment": "environment.hdr: rows from +z down, columns clockwise seen from above, from +x; scene units",
}
"""Description of the conventions of the files, which is stored in ``scene.json``."""


def scene_record(
    spec: SceneSpec,
    settings: SynthSettings,
    names: list[str],
    tests: list[str],
    *,
    exposure: float,
    clipped: float,
) -> dict[str, Any]:
    """Return the content of ``scene.json``.

    Args:
        spec: the scene.
        settings: settings of the rendering.
        names: names of the views.
        tests: names of the held-out views.
        exposure: factor from radiance to the values of the pictures.
        clipped: share of clipped samples.
    """
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
            "variant": VARIANT,
            "polarguide": __version__,
        },
        "settings": settings.data(),
    }
