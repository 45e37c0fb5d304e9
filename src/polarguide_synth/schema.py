"""Data types of a scene, and validation of scene files in JSON.

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
"""Largest number in a scene. Single precision is too coarse for larger lengths."""
LONGEST = 1000
"""Largest number of elements in a list, such as the points of a path or the parts of a solid."""
FINEST = {"detail": 512, "segments": 512, "smooth": 64}
"""Largest values of the fields that determine the number of triangles."""
LONGEST_NAME = 100
"""Largest number of characters in an object's name."""


def check_numbers(data: Any, where: str, field: str) -> None:
    """Validate the numbers and the lengths of lists in the data of a shape, a texture, a light or an environment.

    Args:
        data: the data.
        where: the file, for messages.
        field: place of the data in the file, for messages.

    Raises:
        PolarguideError: a number or a length is out of bounds.
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
    """Validate the name of an object, which is also the name of its mesh file.

    Raises:
        PolarguideError: the name is invalid as a file name, or leads to another folder.
    """
    plain = name.isprintable() and not set(name) & set('/\\:*?"<>|') and not name.startswith(".")
    if not (plain and 0 < len(name) <= LONGEST_NAME):
        expected = f"a name of 1 to {LONGEST_NAME} characters that is valid for a file"
        raise _fault(where, expected, repr(name)[:LONGEST_NAME])


def require_unicode(path: Path) -> None:
    """Check that a file name is UTF-8. Otherwise the renderer would end the process.

    Raises:
        PolarguideError: the name is not UTF-8.
    """
    try:
        os.fspath(path).encode("utf-8")
    except UnicodeEncodeError:
        raise PolarguideError(
            path, expected="a name in UTF-8", found="other bytes", remedy="Rename the file or its folder."
        ) from None


def check_color(color: Any, where: str) -> None:
    """Validate a color: three numbers from 0 to 1, "own", or a texture.

    The data of a texture is validated later by ``textures.make_texture``.

    Raises:
        PolarguideError: the value is not a color.
    """
    if color == "own" or isinstance(color, dict):
        return
    try:
        msgspec.convert(color, tuple[Share, Share, Share])
    except msgspec.ValidationError:
        expected = 'three numbers from 0 to 1, "own", or a texture {"type": ...}'
        raise _fault(where, expected, repr(color)[:LONGEST_NAME]) from None


def require_light(panorama: NDArray[Any], where: str) -> None:
    """Validate the panorama [H, W, 3] of an environment light.

    Raises:
        PolarguideError: a value is negative or not finite, or the shape is wrong.
    """
    if panorama.ndim != 3 or not np.isfinite(panorama).all() or panorama.min() < 0:
        raise _fault(where, "finite radiance of 0 or more in three channels", "other values or channels")


def require_solid(points: NDArray[Any], where: str) -> None:
    """Validate the vertices [V, 3] of an object.

    Raises:
        PolarguideError: a vertex is not finite, or all vertices are at one position.
    """
    if not (len(points) and np.isfinite(points).all() and np.ptp(points, axis=0).max() > 0):
        raise _fault(f"{where} shape", "an object with an extent", "no extent, or one that is not finite")


def _fault(where: str, expected: str, found: object) -> PolarguideError:
    return PolarguideError(where, expected=expected, found=str(found), remedy=REMEDY)


T = TypeVar("T")


def make(makers: Mapping[str, Callable[..., T]], data: Mapping[str, Any], where: str, expected: str) -> T:
    """Select a function by the type in ``data``, and call it with the remaining fields as arguments.

    Args:
        makers: functions by type.
        data: the type and the fields.
        where: the field in the scene, for messages.
        expected: description of the valid types, for messages.

    Raises:
        PolarguideError: the type, a field or a value is invalid.
    """
    fields = dict(data)
    kind = fields.pop("type", None)
    maker = makers.get(kind) if isinstance(kind, str) else None
    if maker is None:
        raise _fault(where, expected, f"the type {kind!r}")
    try:
        return maker(**fields)
    except (TypeError, ValueError, IndexError, KeyError) as error:
        raise _fault(where, f"the fields of a {kind}", error) from error


Share = Annotated[float, Meta(ge=0, le=1)]
Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
Vector = tuple[Number, Number, Number]
Refraction = Annotated[float, Meta(gt=0, le=100)]
Extinction = Annotated[float, Meta(ge=0, le=100)]
Data = dict[str, Any]
OLD_KEYS = {"colour": "color", "colours": "colors", "towards": "toward", "truth": "ground_truth"}
"""Current names of fields, by their names in scene files and requests of earlier versions."""


class Ball(Struct, frozen=True, forbid_unknown_fields=True, tag_field="type", tag="ball"):
    """A perfect sphere, which Mitsuba renders without triangles."""

    radius: Annotated[float, Meta(gt=0, le=LARGEST)] = 1.0


class MeshFile(Struct, frozen=True, forbid_unknown_fields=True, tag_field="type", tag="mesh"):
    """A mesh in a PLY or OBJ file. The file name is relative to the folder of the scene file."""

    file: str


class Material(Struct, frozen=True, forbid_unknown_fields=True):
    """Material of a surface.

    Attributes:
        type: "plastic" is a dielectric coat over a diffuse base (glaze, paint, polished wood, dark glass, water).
            "metal" is a metal. "matte" is a diffuse surface that depolarizes light.
        color: diffuse color, a texture (see ``textures``), or "own" for a shape with its own colors.
        roughness: GGX roughness of the coat or metal.
        index: refractive index of the coat.
        eta: real part of the refractive index of a metal for red, green and blue.
        k: imaginary part of the refractive index of a metal for red, green and blue.
    """

    type: Literal["plastic", "metal", "matte"] = "plastic"
    color: Any = (0.5, 0.5, 0.5)
    roughness: Annotated[float, Meta(ge=0.001, le=1)] = 0.05
    index: Annotated[float, Meta(gt=1, lt=4)] = 1.5
    eta: tuple[Refraction, Refraction, Refraction] = (1.35, 0.97, 0.62)
    k: tuple[Extinction, Extinction, Extinction] = (7.5, 6.4, 5.3)

    def record(self) -> Data:
        """Return the description of the material for ``scene.json``."""
        fields = {
            "plastic": {"diffuse": self.color, "alpha": self.roughness, "ior": self.index},
            "metal": {"alpha": self.roughness, "eta": self.eta, "k": self.k},
            "matte": {"diffuse": self.color},
        }
        return {"type": self.type, **fields[self.type]}


class Thing(Struct, frozen=True, forbid_unknown_fields=True):
    """An object of a scene.

    Attributes:
        name: unique name.
        shape: data of the geometry (see ``build``).
        material: material of the surface.
        foreground: True if the object is part of the mask.
        position: translation of the shape, applied last.
        rotation: angles of the rotation about x, then y, then z, applied after the scale.
        scale: scale factor of the shape, applied first.
    """

    name: str
    shape: Data
    material: Material = Material()
    foreground: bool = True
    position: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (0.0, 0.0, 0.0)
    scale: Annotated[float, Meta(gt=0, le=LARGEST)] = 1.0


class Ring(Struct, frozen=True, rename={"start": "from", "stop": "to"}):
    """A ring of cameras: radius, height above the ground, share of the views, and the arc in degrees about z."""

    radius: Annotated[float, Meta(gt=0, le=LARGEST)]
    height: Number
    share: Annotated[float, Meta(ge=0, le=LARGEST)] = 1.0
    start: Number = 0.0
    stop: Number = 360.0


Positive = Annotated[float, Meta(gt=0, le=LARGEST)]
Radiance = Annotated[float, Meta(ge=0, le=LARGEST)]


class Light(Struct, frozen=True):
    """A rectangular area light: center, target, width and height, and radiance."""

    position: Vector
    toward: Vector
    size: tuple[Positive, Positive]
    radiance: tuple[Radiance, Radiance, Radiance]


class CameraPath(Struct, frozen=True, forbid_unknown_fields=True):
    """Positions of the cameras, which are on rings about the target or on arcs of rings.

    Attributes:
        rings: data of the rings, see ``Ring``.
        target: point that the cameras face.
        wander: largest random distance between ``target`` and the point that a camera faces.
        fov: horizontal field of view in degrees.
        views: number of views.
        spacing: angle in degrees between two neighboring cameras on a ring, around the middle of its arc. If None, the
            cameras fill the arc evenly.
    """

    rings: Annotated[tuple[Data, ...], Meta(min_length=1)]
    target: Vector = (0.0, 0.0, 0.0)
    wander: Number = 0.0
    fov: Annotated[float, Meta(gt=1, lt=150)] = 40.0
    views: Annotated[int, Meta(ge=1, le=10_000)] = 72
    spacing: Annotated[float, Meta(gt=0, le=360)] | None = None


class SceneSpec(Struct, frozen=True, forbid_unknown_fields=True):
    """Complete description of a scene.

    Attributes:
        name: name of the scene.
        about: description for users.
        camera: positions of the cameras.
        things: objects.
        environment: data of the environment light (see ``textures``).
        lights: data of the area lights, see ``Light``.
        depth: largest number of surfaces on a light path.
        clamp: largest radiance of a path, see ``transport.PathLimits``.
        exposure: factor from radiance to display values. If None, it is chosen so that 1 % of S0 exceeds 1.5.
        object_only: True to show only objects of the foreground. All other objects are black to the camera, but still
            illuminate, are reflected and occlude.
        folder: folder that file names of meshes and pictures are relative to.
    """

    name: str
    camera: CameraPath
    things: Annotated[tuple[Thing, ...], Meta(min_length=1, max_length=254)]
    environment: Data
    about: str = ""
    lights: tuple[Data, ...] = ()
    depth: Annotated[int, Meta(ge=1, le=1000)] = 6
    clamp: Annotated[float, Meta(ge=0, le=LARGEST)] = 0.0
    exposure: Annotated[float, Meta(ge=1 / LARGEST, le=LARGEST)] | None = None
    object_only: bool = False
    folder: Path = Path(".")

    @property
    def visible(self) -> tuple[bool, ...]:
        """True for each object that the camera sees, in the order of the objects."""
        return tuple(thing.foreground or not self.object_only for thing in self.things)

    def data(self) -> Data:
        """Return the scene as JSON data, without the folder."""
        values: Data = msgspec.to_builtins(self, enc_hook=str)
        del values["folder"]
        if not self.object_only:  # requests of earlier versions lack this field
            del values["object_only"]
        return values


def read_scene_file(path: Path) -> SceneSpec:
    """Read a scene file.

    Raises:
        PolarguideError: the file cannot be read, lacks a field, has an unknown field, or has a value out of range.
    """
    return parse_scene(read_record(path, Data, remedy=REMEDY), str(path), folder=path.parent)


def parse_scene(data: Any, where: str, *, folder: Path) -> SceneSpec:
    """Parse the JSON data of a scene.

    Args:
        data: the data.
        where: name of the scene, for messages.
        folder: folder that file names are relative to.

    Raises:
        PolarguideError: the scene lacks a field, has an unknown field, or has a value out of range.
    """
    spec = decode(with_current_keys(data), SceneSpec, where, remedy=REMEDY)
    for number, ring in enumerate(spec.camera.rings):
        decode(ring, Ring, f"{where} (camera.rings[{number}])", remedy=REMEDY)
    names = [thing.name for thing in spec.things]
    if len(set(names)) < len(names):
        raise _fault(f"{where} (things)", "objects with different names", names)
    for number, thing in enumerate(spec.things):
        check_file_name(thing.name, f"{where} (things[{number}].name)")
        check_numbers(thing.shape, where, f"things[{number}].shape")
        check_numbers(thing.material.color, where, f"things[{number}].material.color")
        check_color(thing.material.color, f"{where} (things[{number}].material.color)")
    for key in ("environment", "lights"):
        check_numbers(getattr(spec, key), where, key)
    if not sum(ring.get("share", 1.0) for ring in spec.camera.rings) > 0:
        raise _fault(f"{where} (camera.rings)", "a ring with a share of the views above 0", "no such ring")
    return msgspec.structs.replace(spec, folder=folder)


def with_current_keys(data: Any) -> Any:
    """Replace the names of fields in earlier versions by their current names in JSON data."""
    if isinstance(data, dict):
        return {OLD_KEYS.get(key, key): with_current_keys(value) for key, value in data.items()}
    return [with_current_keys(value) for value in data] if isinstance(data, list) else data
