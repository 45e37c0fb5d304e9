"""The small JSON files beside the pictures: ``split.json`` and ``scene.json``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from polarguide.capture.calibration import Calibration, Sense, combined
from polarguide.capture.formats.pictures import MOST_MATERIAL
from polarguide.core.errors import require, unknown_view
from polarguide.core.records import decode
from polarguide.core.text import canonical
from polarguide.geometry.polarizer import ANGLES
from polarguide.optics import Mount

LEAST_INDEX = 1.0
LARGEST_INDEX = 4.0
# Of the numbers in materials/, the first that the table of scene.json explains.
FIRST_LISTED = 3
Index = Annotated[float, msgspec.Meta(gt=LEAST_INDEX, lt=LARGEST_INDEX)]


class _Split(msgspec.Struct):
    """``split.json``; what else it says is passed over."""

    test: list[str]


class _Material(msgspec.Struct):
    ior: float | None = None


class _Object(msgspec.Struct):
    material: _Material | str | None = None


class _Dielectric(msgspec.Struct):
    """A dielectric that ``materials/`` names by a number."""

    refractive_index: Index


class _Materials(msgspec.Struct):
    """The table of materials in ``scene.json``."""

    materials: dict[str, _Dielectric] = {}


class _Scene(msgspec.Struct):
    """The fields of ``scene.json`` that are read; others are ignored."""

    refractive_index: Index | None = None
    objects: list[_Object] = []
    prepare: Any = None
    sensor: Any = None
    pair_sums: Any = None


class _Polarizer(msgspec.Struct):
    """Where ``scene.json`` says that the polarizer was."""

    polarizer: Mount = "sensor"


class _Angles(msgspec.Struct):
    """A calibration as ``scene.json`` notes it."""

    order: tuple[int, int, int, int] = ANGLES
    sense: Sense = "ccw"
    zero_degrees: float = 0.0

    def calibration(self) -> Calibration:
        return Calibration(order=self.order, sense=self.sense, zero=self.zero_degrees)


class _Prepared(msgspec.Struct):
    """Changes that ``prepare`` and ``inspect --fix`` have made to the angles."""

    calibration: _Angles | None = None
    corrections: list[_Angles] = []


def held_out(path: Path, data: bytes, names: list[str]) -> tuple[str, ...]:
    """The names of the test views that ``split.json`` lists, sorted.

    Args:
        path: ``split.json``, for messages.
        data: its content.
        names: all view names of the capture, sorted.

    Raises:
        PolarguideError: the split has another form, names an unknown view, or leaves nothing to train on.
    """
    remedy = 'List the names of the test views, {"test": ["<view>", ...]}, or remove the file.'
    test = [canonical(name) for name in decode(data, _Split, path, remedy=remedy).test]
    for name in test:
        if name not in names:
            raise unknown_view(f"{path} (test)", name, names)
    require(
        len(set(test)) < len(names),
        path,
        expected="at least one view to train on",
        found=f"all {len(names)} views in the test set",
        remedy="Name fewer test views in split.json, or add views.",
    )
    return tuple(sorted(set(test)))


def refractive_index_of(path: Path, data: bytes) -> float | None:
    """The one index in ``scene.json``, or None: ``refractive_index``, else the ``ior`` its objects agree on, between 1
    and 4.

    Args:
        path: ``scene.json``, for messages. data: its content.

    Raises:
        PolarguideError: the index is not a number between 1 and 4.
    """
    scene = decode(data, _Scene, path, remedy="Correct it, or remove it to use the default.")
    if scene.refractive_index is not None:
        return scene.refractive_index
    materials = [item.material for item in scene.objects]
    indices = {item.ior for item in materials if isinstance(item, _Material) and item.ior is not None}
    index = indices.pop() if len(indices) == 1 else None
    return index if index is not None and LEAST_INDEX < index < LARGEST_INDEX else None


def indices_of(path: Path, data: bytes) -> dict[int, float]:
    """Refractive indices of the dielectrics that ``materials/`` names by numbers from 3 on: ``materials`` in
    ``scene.json``, as ``{"3": {"refractive_index": 1.33}}``.

    Args:
        path: ``scene.json``, for messages. data: its content.

    Raises:
        PolarguideError: a number or an index is out of range.
    """
    remedy = 'Write {"materials": {"3": {"refractive_index": 1.33}}}, or remove materials.'
    table = decode(data, _Materials, path, remedy=remedy).materials
    numbers = {str(number) for number in range(FIRST_LISTED, MOST_MATERIAL + 1)}
    for key in table:
        require(
            key in numbers,
            f"{path} (materials)",
            expected=f"numbers from {FIRST_LISTED} to {MOST_MATERIAL}",
            found=repr(key),
            remedy=remedy,
        )
    return {int(key): item.refractive_index for key, item in table.items()}


def mount_of(path: Path, data: bytes) -> Mount:
    """Where the polarizer was: ``polarizer`` in ``scene.json``, "sensor" where it says nothing.

    Args:
        path: ``scene.json``, for messages. data: its content.

    Raises:
        PolarguideError: ``polarizer`` is something else than "sensor" or "filter".
    """
    return decode(
        data,
        _Polarizer,
        path,
        remedy='Write "sensor" for polarizers behind the lens, "filter" for a sheet before it.',
    ).polarizer


def keeps_gains(path: Path, data: bytes) -> bool:
    """True where the scene was prepared with ``--gains none``, which leaves exposures as they are.

    Args:
        path: ``scene.json``, for messages. data: its content.
    """
    prepared = decode(data, _Scene, path, remedy="Prepare the scene again.").prepare
    request = prepared.get("request") if isinstance(prepared, dict) else None
    settings = request.get("settings") if isinstance(request, dict) else None
    return isinstance(settings, dict) and settings.get("gains") == "none"


def applied_calibration(path: Path, data: bytes) -> Calibration | None:
    """Order, sense and zero that the pictures of a prepared scene were made with, corrections included.

    Args:
        path: ``scene.json``, for messages. data: its content.

    Returns:
        None for a scene that ``prepare`` did not write.

    Raises:
        PolarguideError: ``prepare`` wrote it, and its calibration is damaged.
    """
    if decode(data, _Scene, path, remedy="Prepare the scene again.").prepare is None:
        return None
    scene = decode(data, _Prepared, path, remedy="Prepare the scene again.")
    calibration: Calibration | None = (scene.calibration or _Angles()).calibration()
    for correction in scene.corrections:
        calibration = None if calibration is None else combined(calibration, correction.calibration())
    return calibration


Origin = Literal["mosaics", "stokes", "other"]


def origin_of(path: Path, data: bytes) -> Origin:
    """The files that ``prepare`` made a scene of: mosaics of a sensor, a dataset's Stokes vectors, or others.

    Args:
        path: ``scene.json``, for messages. data: its content.
    """
    scene = decode(data, _Scene, path, remedy="Prepare the scene again.")
    if scene.prepare is None:
        return "other"
    if scene.pair_sums is not None:  # noted where the four intensities were computed
        return "stokes"
    return "mosaics" if isinstance(scene.sensor, str) else "other"
