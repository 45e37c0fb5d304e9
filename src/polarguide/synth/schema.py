"""A scene as data: what a scene file may say, read from JSON with every mistake named.

The fields are described in docs/dataset.md. Lengths are in one unit of the author's choice, z is up, colors are linear
sRGB in [0, 1], radiance is linear and unbounded, angles are degrees.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from polarguide.errors import PolarguideError

Vector = tuple[float, float, float]
Data = dict[str, Any]
OLD_KEYS = {"colour": "color", "colours": "colors", "towards": "toward"}
"""Keys of scene files of earlier versions, and their present names."""


@dataclass(frozen=True)
class Material:
    """A surface.

    Attributes:
        type: "plastic" (a dielectric coat over a diffuse base: glaze, paint, polished wood, dark glass, water),
            "metal", or "matte" (depolarizing).
        color: diffuse color, or a texture (see ``textures``), or "own" for a shape that brings colors.
        roughness: GGX roughness of the coat or metal.
        index: refractive index of the coat.
        eta, k: complex index of a metal for red, green and blue.
    """

    type: str = "plastic"
    color: Any = (0.5, 0.5, 0.5)
    roughness: float = 0.05
    index: float = 1.5
    eta: Vector = (1.35, 0.97, 0.62)
    k: Vector = (7.5, 6.4, 5.3)


@dataclass(frozen=True)
class Thing:
    """An object.

    Attributes:
        name: unique.
        shape: its geometry (see ``shapes``).
        material: its surface.
        foreground: whether it belongs to the mask.
        position, rotation, scale: the shape is scaled, turned about x, then y, then z, and moved.
    """

    name: str
    shape: Data
    material: Material = field(default_factory=Material)
    foreground: bool = True
    position: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (0.0, 0.0, 0.0)
    scale: float = 1.0


@dataclass(frozen=True)
class CameraPath:
    """Where the cameras stand: rings about the target, or arcs of rings.

    Attributes:
        rings: of each ring ``radius``, ``height``, ``share`` of the views, and ``from`` and ``to`` in degrees about z.
        target: what all look at; ``wander`` is by how much single cameras look past it.
        fov: horizontal field of view.
        views: number of views.
        spacing: degrees between neighbors on a ring, about the middle of its arc; None fills the arc evenly.
    """

    rings: tuple[Data, ...]
    target: Vector = (0.0, 0.0, 0.0)
    wander: float = 0.0
    fov: float = 40.0
    views: int = 72
    spacing: float | None = None


@dataclass(frozen=True)
class SceneSpec:
    """A whole scene.

    Attributes:
        name, about: what it is.
        camera: the views.
        things: objects.
        environment: environment light (see ``environment``).
        lights: rectangular area lights, each with ``position``, ``toward``, ``size`` and ``radiance``.
        depth: largest number of surfaces on a light path.
        clamp: see ``transport.PathLimits``.
        exposure: display value of radiance 1; None takes one by which 1 % of S0 lies above 1.5.
        folder: where relative file names of meshes and pictures start.
    """

    name: str
    camera: CameraPath
    things: tuple[Thing, ...]
    environment: Data
    about: str = ""
    lights: tuple[Data, ...] = ()
    depth: int = 6
    clamp: float = 0.0
    exposure: float | None = None
    folder: Path = Path(".")

    def data(self) -> Data:
        """The scene as JSON data, without the folder."""
        values = dataclasses.asdict(self)
        del values["folder"]
        return values


Record = TypeVar("Record")


def read_scene_file(path: Path) -> SceneSpec:
    """Read a scene file.

    Raises:
        PolarguideError: it cannot be read, lacks a field, has an unknown one or a value out of range.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise PolarguideError(
            path,
            expected="a scene file in JSON",
            found=str(error),
            remedy="docs/dataset.md describes the fields.",
        ) from None
    return parse_scene(data, str(path), folder=path.parent)


def parse_scene(data: Any, where: str, *, folder: Path) -> SceneSpec:
    """A scene from JSON data; ``where`` names it in messages."""
    data = _with_current_keys(data)
    if not isinstance(data, dict):
        raise _wrong(where, "an object with name, camera, things and environment", type(data).__name__)
    values = dict(data, folder=folder)
    camera = _record(CameraPath, values.get("camera"), f"{where} (camera)")
    things = []
    for number, item in enumerate(values.get("things") or ()):
        place = f"{where} (things[{number}])"
        if not isinstance(item, dict):
            raise _wrong(place, "an object", type(item).__name__)
        material = _record(Material, item.get("material", {}), f"{place[:-1]}.material)")
        _check_material(material, place)
        things.append(_record(Thing, dict(item, material=material), place))
    names = [thing.name for thing in things]
    if not things or len(set(names)) < len(names) or len(things) > 254:
        raise _wrong(f"{where} (things)", "1 to 254 objects with different names", f"{len(things)}: {names}")
    values |= {"camera": camera, "things": tuple(things), "lights": tuple(values.get("lights") or ())}
    spec = _record(SceneSpec, values, where)
    if not camera.rings or camera.views < 1 or not 1 < camera.fov < 150:
        raise _wrong(
            f"{where} (camera)", "rings, 1 or more views, a field of view from 1 to 150 degrees", str(camera)
        )
    return spec


def _with_current_keys(data: Any) -> Any:
    """The data with the keys of earlier versions renamed."""
    if isinstance(data, dict):
        return {OLD_KEYS.get(key, key): _with_current_keys(value) for key, value in data.items()}
    return [_with_current_keys(item) for item in data] if isinstance(data, list) else data


def _check_material(material: Material, where: str) -> None:
    if material.type not in ("plastic", "metal", "matte"):
        raise _wrong(f"{where} material.type", "plastic, metal or matte", repr(material.type))
    if not 0.001 <= material.roughness <= 1:
        raise _wrong(f"{where} material.roughness", "0.001 to 1", str(material.roughness))
    if not 1 < material.index < 4:
        raise _wrong(f"{where} material.index", "more than 1 and less than 4", str(material.index))


def _record(kind: type[Record], data: Any, where: str) -> Record:
    """A dataclass from a dictionary, lists turned into tuples."""
    if not isinstance(data, dict):
        raise _wrong(where, "an object", "nothing" if data is None else type(data).__name__)
    fields = {item.name: item for item in dataclasses.fields(kind)}  # type: ignore[arg-type]
    unknown = sorted(data.keys() - fields.keys())
    if unknown:
        raise _wrong(where, f"only {', '.join(fields)}", ", ".join(unknown))
    missing = [
        name
        for name, item in fields.items()
        if name not in data
        and item.default is dataclasses.MISSING
        and item.default_factory is dataclasses.MISSING
    ]
    if missing:
        raise _wrong(where, f"the field{'s' if len(missing) > 1 else ''} {', '.join(missing)}", "none")
    return kind(**{name: _tuple(value) for name, value in data.items()})


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _wrong(where: str, expected: str, found: str) -> PolarguideError:
    return PolarguideError(
        where, expected=expected, found=found, remedy="docs/dataset.md describes the fields."
    )
