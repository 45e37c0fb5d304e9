"""A scene as data -> Mitsuba's scenes: one for all wavelengths, or one for each of red, green and blue."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from polarguide.errors import PolarguideError
from polarguide.synth.environment import make_environment
from polarguide.synth.mesh import Array, Mesh, rotation, write_ply
from polarguide.synth.schema import Material, SceneSpec, Thing
from polarguide.synth.shapes import make_mesh, sphere
from polarguide.synth.textures import make_texture
from polarguide.synth.variant import Variant

AIR = 1.0


@dataclass(frozen=True, eq=False)
class Built:
    """A scene that can be rendered.

    Attributes:
        spec: as data.
        scenes: Mitsuba's scenes, one or three (see ``film.expose``).
        shapes: of the first scene, Mitsuba's shape of every thing, in their order.
        panorama: the environment, [H, W, 3].
    """

    spec: SceneSpec
    scenes: list[Any]
    shapes: list[Any]
    panorama: Array


def build_scene(spec: SceneSpec, folder: Path, variant: Variant) -> Built:
    """Make meshes, textures and the environment, write them to ``folder`` and load them.

    ``folder`` receives ``mesh/<thing>.ply`` and ``environment.hdr``.
    """
    import mitsuba as mi

    (folder / "mesh").mkdir(parents=True, exist_ok=True)
    meshes = [_mesh(thing, spec) for thing in spec.things]
    for thing, mesh in zip(spec.things, meshes, strict=True):
        write_ply(folder / "mesh" / f"{thing.name}.ply", mesh)
    panorama = make_environment(spec.environment, spec.name, spec.folder)
    cv2.imwrite(str(folder / "environment.hdr"), panorama[..., ::-1].astype(np.float32))
    pictures = [_picture(thing, mesh, spec.folder) for thing, mesh in zip(spec.things, meshes, strict=True)]
    scenes, first = [], []
    for channel in range(3) if variant.channels == 3 else (None,):
        content: dict[str, Any] = {"type": "scene", "sky": _sky(panorama, channel)}
        for number, thing in enumerate(spec.things):
            place = folder / "mesh" / f"{thing.name}.ply"
            shape = _shape(thing, meshes[number], place, _surface(thing.material, pictures[number], channel))
            content[f"thing{number}"] = shape
        for number, light in enumerate(spec.lights):
            content[f"light{number}"] = _lamp(light, channel, spec.name)
        scene = mi.load_dict(content)
        scenes.append(scene)
        if not first:
            first = [content[f"thing{number}"] for number in range(len(spec.things))]
    return Built(spec, scenes, first, panorama)


def _mesh(thing: Thing, spec: SceneSpec) -> Mesh:
    turn, position = rotation(thing.rotation), np.array(thing.position, float)
    if thing.shape.get("type") == "ball":
        mesh = sphere(float(thing.shape.get("radius", 1.0)))
    elif thing.shape.get("type") == "mesh":
        mesh = _own_mesh(spec.folder / str(thing.shape.get("file")))
    else:
        mesh = make_mesh(thing.shape, thing.name)
    return mesh.moved(thing.scale, turn, position)


def _own_mesh(path: Path) -> Mesh:
    """A PLY or OBJ file of the user's, by Mitsuba's readers."""
    import mitsuba as mi

    kind = path.suffix.lower().lstrip(".")
    if kind not in ("ply", "obj") or not path.is_file():
        raise PolarguideError(
            path,
            expected="a mesh as .ply or .obj",
            found="nothing" if not path.is_file() else f"a {path.suffix} file",
            remedy="File names of meshes start at the folder of the scene file.",
        )
    params = mi.traverse(mi.load_dict({"type": kind, "filename": str(path)}))
    points = np.array(params["vertex_positions"], float).reshape(-1, 3)
    faces = np.array(params["faces"], np.int64).reshape(-1, 3)
    normals = np.array(params["vertex_normals"], float).reshape(-1, 3)
    uv = np.array(params["vertex_texcoords"], float).reshape(-1, 2)
    return Mesh(
        points, faces, uv if len(uv) else np.zeros((len(points), 2)), normals if len(normals) else None
    )


def _picture(thing: Thing, mesh: Mesh, folder: Path) -> Array | None:
    """The texture of a thing, [H, W, 3], or None where it has one colour."""
    colour = thing.material.colour
    if colour != "own":
        return make_texture(colour, thing.name, folder) if isinstance(colour, dict) else None
    if mesh.palette is None:
        raise PolarguideError(
            f"{thing.name} material.colour",
            expected='a shape that brings colours, where the colour is "own"',
            found=f"a {thing.shape.get('type')} without",
            remedy="Give the parts of a solid a colour each, or the material one.",
        )
    return mesh.palette[None]


def _shape(thing: Thing, mesh: Mesh, path: Path, surface: dict[str, Any]) -> Any:
    """Mitsuba's shape with its surface."""
    import mitsuba as mi

    if thing.shape.get("type") == "ball":
        radius = float(thing.shape.get("radius", 1.0)) * thing.scale
        return mi.load_dict(
            {"type": "sphere", "center": list(thing.position), "radius": radius, "bsdf": surface}
        )
    flat = mesh.normals is None
    return mi.load_dict({"type": "ply", "filename": str(path), "face_normals": flat, "bsdf": surface})


def _surface(material: Material, picture: Array | None, channel: int | None) -> dict[str, Any]:
    """Mitsuba's description of a surface, of one channel or of all."""
    base: dict[str, Any]
    if picture is not None:
        base = _bitmap(picture, channel)
    else:
        base = _value(material.colour, channel)
    if material.type == "metal":
        index = {name: _metal(getattr(material, name), channel) for name in ("eta", "k")}
        inner = {"type": "roughconductor", "distribution": "ggx", "alpha": material.roughness, **index}
    elif material.type == "matte":
        inner = {"type": "diffuse", "reflectance": base}
    else:
        inner = {"type": "pplastic", "distribution": "ggx", "alpha": material.roughness, "diffuse_reflectance": base,
                 "int_ior": float(material.index), "ext_ior": AIR}  # fmt: skip
    return {"type": "twosided", "inner": inner}


def _value(colour: Any, channel: int | None) -> dict[str, Any]:
    """A reflectance or radiance."""
    if channel is None:
        return {"type": "rgb", "value": [float(c) for c in colour]}
    return {"type": "uniform", "value": float(colour[channel])}


def _metal(index: tuple[float, float, float], channel: int | None) -> dict[str, Any]:
    """A complex index given at red, green and blue."""
    if channel is not None:
        return {"type": "uniform", "value": float(index[channel])}
    red, green, blue = index
    values = f"{blue}, {blue}, {green}, {red}, {red}"
    return {"type": "irregular", "wavelengths": "360, 450, 545, 620, 830", "values": values}


def _bitmap(picture: Array, channel: int | None) -> dict[str, Any]:
    import mitsuba as mi

    part = picture if channel is None else picture[..., channel : channel + 1]
    # Rows of a picture go down, v goes up.
    data = np.ascontiguousarray(part[::-1], np.float32)
    blend = "nearest" if len(data) == 1 else "bilinear"  # a palette has one row
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": channel is not None, "filter_type": blend}


def _sky(panorama: Array, channel: int | None) -> dict[str, Any]:
    import mitsuba as mi

    part = panorama if channel is None else np.repeat(panorama[..., channel : channel + 1], 3, -1)
    # Mitsuba's panoramas look down its -z at their left edge, with y up and columns that turn to the right.
    axes = np.array([[0, 0, -1, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], float)
    return {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(part, np.float32)),
            "to_world": mi.ScalarTransform4f(axes)}  # fmt: skip


def _lamp(light: dict[str, Any], channel: int | None, where: str) -> dict[str, Any]:
    import mitsuba as mi

    try:
        position, towards = list(light["position"]), list(light["towards"])
        half = [float(s) / 2 for s in light["size"]]
        radiance = [float(v) for v in light["radiance"]]
    except (KeyError, TypeError, ValueError) as error:
        raise PolarguideError(
            f"{where} (lights)",
            expected="position, towards, size and radiance of each light",
            found=repr(error),
            remedy="docs/dataset.md describes them.",
        ) from error
    up = (
        [0, 0, 1]
        if abs(towards[2] - position[2]) < 0.99 * np.linalg.norm(np.subtract(towards, position))
        else [0, 1, 0]
    )
    place = mi.ScalarTransform4f().look_at(position, towards, up) @ mi.ScalarTransform4f().scale([*half, 1.0])
    return {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": _value(radiance, channel)},
            "bsdf": {"type": "diffuse", "reflectance": _value((0.0, 0.0, 0.0), channel)}}  # fmt: skip
