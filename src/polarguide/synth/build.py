"""Build Mitsuba scenes from scene data: one for all wavelengths, or one each for red, green and blue."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from polarguide.core.errors import PolarguideError
from polarguide.core.files import make_folder, write_whole
from polarguide.synth.mesh import Array, Mesh, rotation, write_ply
from polarguide.synth.schema import (
    REMEDY,
    Material,
    SceneSpec,
    Thing,
    only_fields,
    require_light,
    require_solid,
    require_unicode,
)
from polarguide.synth.settings import Variant, mi
from polarguide.synth.shapes import make_mesh, sphere
from polarguide.synth.textures import make_environment, make_texture
from polarguide.synth.transport import SHOWN

AIR = 1.0


def bsdf_dict(material: Material, picture: Array | None, channel: int | None) -> dict[str, Any]:
    """The BSDF of a material, with the texture ``picture`` [H, W, 3] if it has one."""
    base = _value(material.color, channel) if picture is None else _bitmap(picture, channel)
    if material.type == "metal":
        index = {name: _metal(getattr(material, name), channel) for name in ("eta", "k")}
        inner = {"type": "roughconductor", "distribution": "ggx", "alpha": material.roughness, **index}
    elif material.type == "matte":
        inner = {"type": "diffuse", "reflectance": base}
    else:
        inner = {"type": "pplastic", "distribution": "ggx", "alpha": material.roughness, "diffuse_reflectance": base,
                 "int_ior": float(material.index), "ext_ior": AIR}  # fmt: skip
    return {"type": "twosided", "inner": inner}


def _value(color: Any, channel: int | None) -> dict[str, Any]:
    """The dictionary of a reflectance or radiance."""
    if channel is None:
        return {"type": "rgb", "value": [float(c) for c in color]}
    return {"type": "uniform", "value": float(color[channel])}


def _metal(index: tuple[float, float, float], channel: int | None) -> dict[str, Any]:
    """The spectrum of an index that is given at red, green and blue."""
    if channel is not None:
        return {"type": "uniform", "value": float(index[channel])}
    red, green, blue = index
    values = f"{blue}, {blue}, {green}, {red}, {red}"
    return {"type": "irregular", "wavelengths": "360, 450, 545, 620, 830", "values": values}


def _bitmap(picture: Array, channel: int | None) -> dict[str, Any]:
    part = picture if channel is None else picture[..., channel : channel + 1]
    # Rows of a picture go down, v goes up.
    data = np.ascontiguousarray(part[::-1], np.float32)
    blend = "nearest" if len(data) == 1 else "bilinear"  # a palette has one row
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": channel is not None, "filter_type": blend}


def environment_dict(panorama: Array, channel: int | None) -> dict[str, Any]:
    """The environment emitter of a panorama [H, W, 3]."""
    part = panorama if channel is None else np.repeat(panorama[..., channel : channel + 1], 3, -1)
    # The left edge of Mitsuba's panoramas is its -z; y is up and columns proceed to the right.
    axes = np.array([[0, 0, -1, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], float)
    return {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(part, np.float32)),
            "to_world": mi.ScalarTransform4f(axes)}  # fmt: skip


def shown_dict(spec: SceneSpec, shown: bool) -> dict[str, Any]:
    """The attribute of a shape that says whether the camera sees it; nothing where it sees all."""
    return {SHOWN: {"type": "uniform", "value": float(shown)}} if spec.object_only else {}


def area_light_dict(light: dict[str, Any], channel: int | None, where: str) -> dict[str, Any]:
    """A rectangular area light.

    Raises:
        PolarguideError: a field is missing or has another type; ``where`` names the scene.
    """
    try:
        position, toward = list(light["position"]), list(light["toward"])
        half = [float(s) / 2 for s in light["size"]]
        radiance = [float(v) for v in light["radiance"]]
    except (KeyError, TypeError, ValueError) as error:
        raise PolarguideError(
            f"{where} (lights)",
            expected="position, toward, size and radiance of each light",
            found=repr(error),
            remedy="docs/reference/scene-files.md describes them.",
        ) from error
    plain = len(position) == len(toward) == len(radiance) == 3 and len(half) == 2
    if not plain or position == toward or min(half) <= 0 or min(radiance) < 0:
        raise PolarguideError(
            f"{where} (lights)",
            expected="two different places, a size above 0, and radiance of 0 or more, of each light",
            found=str(light)[:200],
            remedy="docs/reference/scene-files.md describes them.",
        )
    up = (
        [0, 0, 1]
        if abs(toward[2] - position[2]) < 0.99 * np.linalg.norm(np.subtract(toward, position))
        else [0, 1, 0]
    )
    place = mi.ScalarTransform4f().look_at(position, toward, up) @ mi.ScalarTransform4f().scale([*half, 1.0])
    return {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": _value(radiance, channel)},
            "bsdf": {"type": "diffuse", "reflectance": _value((0.0, 0.0, 0.0), channel)}}  # fmt: skip


@dataclass(frozen=True, eq=False)
class BuiltScene:
    """A scene ready to be rendered.

    Attributes:
        spec: the scene data.
        scenes: Mitsuba's scenes, one or three (see ``film.render_lobes``).
        shapes: Mitsuba's shape of every object in the first scene, in the order of the data.
        panorama: the environment, [H, W, 3].
        textures: of every object, [H, W, 3] with rows from the top down, or None where it has one color.
    """

    spec: SceneSpec
    scenes: list[Any]
    shapes: list[Any]
    panorama: Array
    textures: list[Array | None]


def build_scene(spec: SceneSpec, folder: Path, variant: Variant) -> BuiltScene:
    """Generate meshes, textures and the environment, write them to ``folder`` and load them.

    The files are ``mesh/<thing>.ply`` and ``environment.hdr``.
    """
    make_folder(folder / "mesh")
    meshes = [_mesh(thing, spec) for thing in spec.things]
    for thing, mesh in zip(spec.things, meshes, strict=True):
        write_ply(folder / "mesh" / f"{thing.name}.ply", mesh)
    panorama = make_environment(spec.environment, spec.name, spec.folder)
    require_light(panorama, f"{spec.name} (environment)")
    _, encoded = cv2.imencode(".hdr", panorama[..., ::-1].astype(np.float32))
    write_whole(folder / "environment.hdr", encoded.tobytes())
    pictures = [_texture(thing, mesh, spec.folder) for thing, mesh in zip(spec.things, meshes, strict=True)]
    scenes: list[Any] = []
    first: list[Any] = []
    for channel in range(3) if variant.channels == 3 else (None,):
        content: dict[str, Any] = {"type": "scene", "sky": environment_dict(panorama, channel)}
        for number, thing in enumerate(spec.things):
            place = folder / "mesh" / f"{thing.name}.ply"
            surface = {"bsdf": bsdf_dict(thing.material, pictures[number], channel)}
            surface |= shown_dict(spec, spec.shown[number])
            content[f"thing{number}"] = _shape(thing, meshes[number], place, surface)
        for number, light in enumerate(spec.lights):
            content[f"light{number}"] = area_light_dict(light, channel, spec.name) | shown_dict(spec, False)
        scene = mi.load_dict(content)
        scenes.append(scene)
        if not first:
            first = [content[f"thing{number}"] for number in range(len(spec.things))]
    return BuiltScene(spec, scenes, first, panorama, pictures)


def _mesh(thing: Thing, spec: SceneSpec) -> Mesh:
    turn, position = rotation(thing.rotation), np.array(thing.position, float)
    if thing.shape.get("type") == "ball":
        mesh = sphere(_radius(thing))
    elif thing.shape.get("type") == "mesh":
        only_fields(thing.shape, ("type", "file"), f"{thing.name} shape")
        mesh = _user_mesh(spec.folder / str(thing.shape.get("file")))
    else:
        mesh = make_mesh(thing.shape, thing.name)
    moved = mesh.moved(thing.scale, turn, position)
    require_solid(moved.points, thing.name)
    return moved


def _radius(thing: Thing) -> float:
    """Of a ball.

    Raises:
        PolarguideError: it is none, or the ball has other fields.
    """
    only_fields(thing.shape, ("type", "radius"), f"{thing.name} shape")
    radius = thing.shape.get("radius", 1.0)
    if isinstance(radius, bool) or not isinstance(radius, int | float) or not radius > 0:
        raise PolarguideError(
            f"{thing.name} shape.radius", expected="a number above 0", found=str(radius)[:100], remedy=REMEDY
        )
    return float(radius)


def _user_mesh(path: Path) -> Mesh:
    """The mesh in a user's PLY or OBJ file, read by Mitsuba."""
    kind = path.suffix.lower().lstrip(".")
    require_unicode(path)
    if kind not in ("ply", "obj") or not path.is_file():
        raise PolarguideError(
            path,
            expected="a mesh as .ply or .obj",
            found="nothing" if not path.is_file() else f"a name that ends in {path.suffix or 'nothing'}",
            remedy="File names of meshes are relative to the folder of the scene file.",
        )
    # flat first: Mitsuba makes normals before it compares corners with points, and writes where there are none
    params = _mesh_arrays(path, kind, flat=True)
    points = np.array(params["vertex_positions"], float).reshape(-1, 3)
    faces = np.array(params["faces"], np.int64).reshape(-1, 3)
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)  # Mitsuba takes a negative corner for the first
    if not whole.any() or faces.min() < 0 or faces.max() >= len(points):
        extent = f"corners {faces.min()} to {faces.max()} of {len(points)}" if whole.any() else "no triangle"
        raise PolarguideError(
            path, expected="triangles between its points", found=extent, remedy="Export it again."
        )
    params = _mesh_arrays(path, kind, flat=False)
    normals = np.array(params["vertex_normals"], float).reshape(-1, 3)
    uv = np.array(params["vertex_texcoords"], float).reshape(-1, 2)
    return Mesh(
        points, faces, uv if len(uv) else np.zeros((len(points), 2)), normals if len(normals) else None
    )


def _mesh_arrays(path: Path, kind: str, *, flat: bool) -> Any:
    """The arrays of a mesh as Mitsuba reads them; ``flat`` leaves normals at points out."""
    try:
        return mi.traverse(mi.load_dict({"type": kind, "filename": str(path), "face_normals": flat}))
    except (
        RuntimeError,
        UnicodeDecodeError,
    ) as error:  # what Mitsuba says ends in the reason, or quotes the file
        quoted = isinstance(error, UnicodeDecodeError)
        fault = "a line of its header that is no text" if quoted else str(error)
        reason = fault.rpartition("shape plugin of type")[2].partition(": ")[2] or fault
        raise PolarguideError(
            path,
            expected="a complete mesh of triangles",
            found=" ".join(reason.split())[:200],
            remedy="Export it again.",
        ) from None


def _texture(thing: Thing, mesh: Mesh, folder: Path) -> Array | None:
    """The texture of an object, [H, W, 3], or None if it has one color."""
    color = thing.material.color
    if color != "own":
        return make_texture(color, thing.name, folder) if isinstance(color, dict) else None
    if mesh.palette is None:
        raise PolarguideError(
            f"{thing.name} material.color",
            expected='a shape with colors of its own if the color is "own"',
            found=f"a {thing.shape.get('type')} without colors",
            remedy="Give the parts of a solid or the material a color.",
        )
    return mesh.palette[None]


def _shape(thing: Thing, mesh: Mesh, path: Path, surface: dict[str, Any]) -> Any:
    """Mitsuba's shape with its BSDF and attributes."""
    if thing.shape.get("type") == "ball":
        radius = _radius(thing) * thing.scale
        return mi.load_dict({"type": "sphere", "center": list(thing.position), "radius": radius, **surface})
    flat = mesh.normals is None
    return mi.load_dict({"type": "ply", "filename": str(path), "face_normals": flat, **surface})
