"""A scene as data: what a scene file may say, read from JSON with every mistake named.

docs/reference/scene-files.md describes the fields. Lengths are in one unit of the author's choice, z is up, colors are
linear sRGB in [0, 1], radiance is linear and unbounded, angles are degrees.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from polarguide.core.errors import PolarguideError
from polarguide.core.records import decode, read_record

REMEDY = "docs/reference/scene-files.md describes the fields."
LARGEST = 1e6
"""Of any number in a scene; lengths beyond it are lost in single precision."""
LONGEST = 1000
"""Of any list: points of a profile or a path, parts of a solid."""
FINEST = {"detail": 512, "segments": 512, "smooth": 64}
"""Of numbers that decide how many triangles there are."""
LONGEST_NAME = 100


def check_numbers(data: Any, where: str, field: str) -> None:
    """Refuse numbers and lists in data of a shape, a texture, a light or an environment that are out of bounds.

    Raises:
        PolarguideError: one is; ``where`` is the file, ``field`` where the data stand in it.
    """
    if isinstance(data, dict):
        for key, value in data.items():
            most = FINEST.get(key, LARGEST)
            if isinstance(value, int | float) and value > most:
                raise _fault(f"{where} ({field}.{key})", f"up to {most:g}", value)
            check_numbers(value, where, f"{field}.{key}")
    elif isinstance(data, list | tuple):
        if len(data) > LONGEST:
            raise _fault(f"{where} ({field})", f"up to {LONGEST} items", len(data))
        for number, value in enumerate(data):
            check_numbers(value, where, f"{field}[{number}]")
    elif isinstance(data, int | float) and not abs(data) <= LARGEST:
        raise _fault(f"{where} ({field})", f"a number from {-LARGEST:g} to {LARGEST:g}", data)


def check_file_name(name: str, where: str) -> None:
    """Refuse a name that is no name of a file: its mesh is written under it.

    Raises:
        PolarguideError: the name leads to another folder, or no file can have it.
    """
    plain = name.isprintable() and not set(name) & set('/\\:*?"<>|') and not name.startswith(".")
    if not (plain and 0 < len(name) <= LONGEST_NAME):
        raise _fault(
            where, f"a name of 1 to {LONGEST_NAME} characters that a file can have", repr(name)[:LONGEST_NAME]
        )


def require_unicode(path: Path) -> None:
    """Refuse a name of a file whose bytes are no UTF-8: the renderer ends the process over one.

    Raises:
        PolarguideError: the name is no UTF-8.
    """
    try:
        os.fspath(path).encode("utf-8")
    except UnicodeEncodeError:
        raise PolarguideError(
            path, expected="a name in UTF-8", found="other bytes", remedy="Rename the file or its folder."
        ) from None


def check_color(color: Any, where: str) -> None:
    """Refuse what is no color: three numbers from 0 to 1, "own", or a texture, which is checked where it is made.

    Raises:
        PolarguideError: the value is no color.
    """
    if color == "own" or isinstance(color, dict):
        return
    try:
        msgspec.convert(color, tuple[Share, Share, Share])
    except msgspec.ValidationError:
        expected = 'three numbers from 0 to 1, "own", or a texture {"type": ...}'
        raise _fault(where, expected, repr(color)[:LONGEST_NAME]) from None


def require_light(panorama: NDArray[Any], where: str) -> None:
    """Refuse an environment that is no light.

    Raises:
        PolarguideError: the environment has values that are negative or not finite.
    """
    if panorama.ndim != 3 or not np.isfinite(panorama).all() or panorama.min() < 0:
        raise _fault(where, "finite radiance of 0 or more in three channels", "something else")


def require_solid(points: NDArray[Any], where: str) -> None:
    """Refuse the vertices [V, 3] of an object that is not there.

    Raises:
        PolarguideError: the vertices are not finite, or all in one place.
    """
    if not (len(points) and np.isfinite(points).all() and np.ptp(points, axis=0).max() > 0):
        raise _fault(f"{where} shape", "an object with an extent", "one without, or one that is not finite")


def _fault(where: str, expected: str, found: object) -> PolarguideError:
    return PolarguideError(where, expected=expected, found=str(found), remedy=REMEDY)


T = TypeVar("T")


def make(makers: Mapping[str, Callable[..., T]], data: Mapping[str, Any], where: str, expected: str) -> T:
    """Call the function that the type names with the other fields.

    Args:
        makers: functions by type. data: the type and the fields.
        where: what is made, for messages. expected: what messages ask for if the type is unknown.

    Raises:
        PolarguideError: the type or a field is unknown, or a value makes no sense.
    """
    fields = dict(data)
    kind = fields.pop("type", None)
    maker = makers.get(kind) if isinstance(kind, str) else None
    if maker is None:
        raise PolarguideError(where, expected=expected, found=f"the type {kind!r}", remedy=REMEDY)
    try:
        return maker(**fields)
    except (TypeError, ValueError, IndexError, KeyError) as error:
        raise PolarguideError(
            where, expected=f"the fields of a {kind}", found=str(error), remedy=REMEDY
        ) from error


Share = Annotated[float, Meta(ge=0, le=1)]
Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
Vector = tuple[Number, Number, Number]
Refraction = Annotated[float, Meta(gt=0, le=100)]
Extinction = Annotated[float, Meta(ge=0, le=100)]
Data = dict[str, Any]
MOST_VIEWS = 10_000
MOST_SURFACES = 1000
OLD_KEYS = {"colour": "color", "colours": "colors", "towards": "toward", "truth": "ground_truth"}
"""Names that fields had in earlier scene files and requests."""


class Ball(Struct, frozen=True, forbid_unknown_fields=True, tag_field="type", tag="ball"):
    """A shape that Mitsuba itself has, without triangles."""

    radius: Annotated[float, Meta(gt=0, le=LARGEST)] = 1.0


class MeshFile(Struct, frozen=True, forbid_unknown_fields=True, tag_field="type", tag="mesh"):
    """The shape in a PLY or OBJ file, whose name starts at the folder of the scene file."""

    file: str


class Material(Struct, frozen=True, forbid_unknown_fields=True):
    """A surface.

    Attributes:
        type: "plastic" (a dielectric coat over a diffuse base: glaze, paint, polished wood, dark glass, water),
            "metal", or "matte" (depolarizing).
        color: diffuse color, or a texture (see ``textures``), or "own" for a shape that brings colors.
        roughness: GGX roughness of the coat or metal.
        index: refractive index of the coat.
        eta, k: complex index of a metal for red, green and blue.
    """

    type: Literal["plastic", "metal", "matte"] = "plastic"
    color: Any = (0.5, 0.5, 0.5)
    roughness: Annotated[float, Meta(ge=0.001, le=1)] = 0.05
    index: Annotated[float, Meta(gt=1, lt=4)] = 1.5
    eta: tuple[Refraction, Refraction, Refraction] = (1.35, 0.97, 0.62)
    k: tuple[Extinction, Extinction, Extinction] = (7.5, 6.4, 5.3)

    def record(self) -> Data:
        """The surface as ``scene.json`` has it."""
        fields = {
            "plastic": {"diffuse": self.color, "alpha": self.roughness, "ior": self.index},
            "metal": {"alpha": self.roughness, "eta": self.eta, "k": self.k},
            "matte": {"diffuse": self.color},
        }
        return {"type": self.type, **fields[self.type]}


class Thing(Struct, frozen=True, forbid_unknown_fields=True):
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
    material: Material = Material()
    foreground: bool = True
    position: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (0.0, 0.0, 0.0)
    scale: Annotated[float, Meta(gt=0, le=LARGEST)] = 1.0


class Ring(Struct, frozen=True, rename={"start": "from", "stop": "to"}):
    """Of cameras: radius, height over the ground, share of the views, and the arc in degrees about z."""

    radius: Annotated[float, Meta(gt=0, le=LARGEST)]
    height: Number
    share: Annotated[float, Meta(ge=0, le=LARGEST)] = 1.0
    start: Number = 0.0
    stop: Number = 360.0


Positive = Annotated[float, Meta(gt=0, le=LARGEST)]
Radiance = Annotated[float, Meta(ge=0, le=LARGEST)]


class Light(Struct, frozen=True):
    """A rectangular area light: its center, the point that it faces, width and height, and radiance."""

    position: Vector
    toward: Vector
    size: tuple[Positive, Positive]
    radiance: tuple[Radiance, Radiance, Radiance]


class CameraPath(Struct, frozen=True, forbid_unknown_fields=True):
    """Where the cameras stand: rings about the target, or arcs of rings.

    Attributes:
        rings: of each ring ``radius``, ``height``, ``share`` of the views, and ``from`` and ``to`` in degrees about z.
        target: the point that the cameras look at; ``wander``: largest random offset of a camera's target from it.
        fov: horizontal field of view.
        views: number of views.
        spacing: degrees between neighbors on a ring, about the middle of its arc; None fills the arc evenly.
    """

    rings: Annotated[tuple[Data, ...], Meta(min_length=1)]
    target: Vector = (0.0, 0.0, 0.0)
    wander: Number = 0.0
    fov: Annotated[float, Meta(gt=1, lt=150)] = 40.0
    views: Annotated[int, Meta(ge=1, le=MOST_VIEWS)] = 72
    spacing: Annotated[float, Meta(gt=0, le=360)] | None = None


class SceneSpec(Struct, frozen=True, forbid_unknown_fields=True):
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
        object_only: whether only things of the foreground are in the pictures; all else is black to the camera, but
            still lights them, is mirrored in them and hides what is behind it.
        folder: where relative file names of meshes and pictures start.
    """

    name: str
    camera: CameraPath
    things: Annotated[tuple[Thing, ...], Meta(min_length=1, max_length=254)]
    environment: Data
    about: str = ""
    lights: tuple[Data, ...] = ()
    depth: Annotated[int, Meta(ge=1, le=MOST_SURFACES)] = 6
    clamp: Annotated[float, Meta(ge=0, le=LARGEST)] = 0.0
    exposure: Annotated[float, Meta(ge=1 / LARGEST, le=LARGEST)] | None = None
    object_only: bool = False
    folder: Path = Path(".")

    @property
    def shown(self) -> tuple[bool, ...]:
        """Of each thing, whether the camera sees it."""
        return tuple(thing.foreground or not self.object_only for thing in self.things)

    def data(self) -> Data:
        """The scene as JSON data, without the folder."""
        values: Data = msgspec.to_builtins(self, enc_hook=str)
        del values["folder"]
        if not self.object_only:  # folders of versions without this field go on
            del values["object_only"]
        return values


def read_scene_file(path: Path) -> SceneSpec:
    """Read a scene file.

    Raises:
        PolarguideError: the file cannot be read, lacks a field, has an unknown one or a value out of range.
    """
    return parse_scene(read_record(path, Data, remedy=REMEDY), str(path), folder=path.parent)


def parse_scene(data: Any, where: str, *, folder: Path) -> SceneSpec:
    """A scene from JSON data; ``where`` names it in messages.

    Raises:
        PolarguideError: the scene lacks a field, has an unknown one or a value out of range.
    """
    spec = decode(with_current_keys(data), SceneSpec, where, remedy=REMEDY)
    for number, ring in enumerate(spec.camera.rings):
        decode(ring, Ring, f"{where} (camera.rings[{number}])", remedy=REMEDY)
    names = [thing.name for thing in spec.things]
    if len(set(names)) < len(names):
        raise PolarguideError(
            f"{where} (things)", expected="objects with different names", found=str(names), remedy=REMEDY
        )
    for number, thing in enumerate(spec.things):
        check_file_name(thing.name, f"{where} (things[{number}].name)")
        check_numbers(thing.shape, where, f"things[{number}].shape")
        check_numbers(thing.material.color, where, f"things[{number}].material.color")
        check_color(thing.material.color, f"{where} (things[{number}].material.color)")
    for key in ("environment", "lights"):
        check_numbers(getattr(spec, key), where, key)
    if not sum(ring.get("share", 1.0) for ring in spec.camera.rings) > 0:
        raise PolarguideError(
            f"{where} (camera.rings)",
            expected="a ring with a share of the views above 0",
            found="none",
            remedy=REMEDY,
        )
    return msgspec.structs.replace(spec, folder=folder)


def with_current_keys(data: Any) -> Any:
    """JSON data with today's names of fields."""
    if isinstance(data, dict):
        return {OLD_KEYS.get(key, key): with_current_keys(value) for key, value in data.items()}
    return [with_current_keys(value) for value in data] if isinstance(data, list) else data
