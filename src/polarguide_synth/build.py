"""Build Mitsuba scenes from scene data: one for all wavelengths, or one each for red, green and blue.

Procedural shapes are centered at the origin or stand on it, with z up; docs/reference/scene-files.md describes the
fields of the types of ``shape``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.core.errors import PolarguideError
from polarguide.core.files import make_folder, write_whole
from polarguide.core.records import decode
from polarguide.geometry.vectors import unit_array as unit
from polarguide_synth.mesh import Array, Mesh, grid_faces, joined, rotation, smooth_normals, solid, write_ply
from polarguide_synth.schema import (
    REMEDY,
    Ball,
    Light,
    Material,
    MeshFile,
    SceneSpec,
    Thing,
    make,
    require_light,
    require_solid,
    require_unicode,
)
from polarguide_synth.settings import Variant, mi
from polarguide_synth.textures import fractal_noise, make_environment, make_texture
from polarguide_synth.transport import SHOWN


def sphere(radius: float = 1.0, detail: int = 96) -> Mesh:
    """A ball as triangles with exact normals."""
    polar = np.linspace(0, np.pi, detail // 2 + 1)
    turned = lathe([[np.sin(a), -np.cos(a)] for a in polar], segments=detail, smooth=0)
    return Mesh(radius * turned.points, turned.faces, turned.uv, unit(turned.points))


def plane(size: tuple[float, float] = (1.0, 1.0), tile: float = 0.0) -> Mesh:
    """A rectangle that looks up; ``tile`` is the length of one repeat of its texture, 0 for one over all."""
    x, y = size
    points = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]) / 2
    uv = points[:, :2] / tile if tile else np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    return Mesh(points, np.array([[0, 1, 2], [0, 2, 3]]), uv, np.tile([0.0, 0, 1], (4, 1)))


def box(size: tuple[float, float, float] = (1.0, 1.0, 1.0), bevel: float = 0.0, detail: int = 4) -> Mesh:
    """A box with rounded edges; each side shows the whole texture."""
    half = np.array(size, float) / 2
    if not 0 <= bevel <= half.min():
        raise ValueError(f"a bevel of {bevel:g}, where half of the shortest side is {half.min():g}")
    round_ = min(bevel, float(half.min()) * 0.999) or 1e-5
    corner = np.tan(np.linspace(-np.pi / 4, np.pi / 4, detail + 1))
    sides = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            u, v = ((axis + 1) % 3, (axis + 2) % 3) if sign > 0 else ((axis + 2) % 3, (axis + 1) % 3)
            grids = []
            for k in (u, v):
                bent = round_ * (corner[: detail // 2 + 1] + 1)
                line = np.concatenate([-half[k] + bent, half[k] - bent[::-1]])
                grids.append(np.unique(np.round(line, 12)))
            a, b = np.meshgrid(*grids, indexing="ij")
            points = np.zeros((*a.shape, 3))
            points[..., u], points[..., v], points[..., axis] = a, b, sign * half[axis]
            core = np.clip(points, -(half - round_), half - round_)
            normals = unit(points - core)
            uv = np.stack((a / (2 * half[u]) + 0.5, b / (2 * half[v]) + 0.5), -1)
            points = core + round_ * normals
            faces = grid_faces(*a.shape)[:, [0, 2, 1]]
            sides.append(Mesh(points.reshape(-1, 3), faces, uv.reshape(-1, 2), normals.reshape(-1, 3)))
    return joined(sides)


def lathe(profile: list[list[float]], segments: int = 96, smooth: int = 8) -> Mesh:
    """A profile of (radius, height), from bottom to top on the outside, turned about z.

    ``smooth`` points are put between two points of the profile, on a Catmull-Rom curve; 0 keeps them as they are.
    """
    corners = _corners(profile, 2)
    if (corners[:, 0] < 0).any():
        raise ValueError(f"a radius of {corners[:, 0].min():g} in the profile")
    line = _curve(corners, smooth)
    line[:, 0] = np.maximum(line[:, 0], 0)
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    direction = np.stack((np.cos(angle), np.sin(angle)), -1)
    points = np.empty((len(line), segments + 1, 3))
    points[..., :2] = line[:, None, :1] * direction
    points[..., 2] = line[:, None, 1]
    tangent = unit(np.gradient(line, axis=0))
    normals = np.empty_like(points)
    normals[..., :2] = tangent[:, None, 1:] * direction
    normals[..., 2] = -tangent[:, :1]
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    uv = np.stack(np.broadcast_arrays(angle / (2 * np.pi), (along / along[-1])[:, None]), -1)
    faces = grid_faces(len(line), segments + 1)
    return Mesh(points.reshape(-1, 3), faces, uv.reshape(-1, 2), normals.reshape(-1, 3))


def tube(path: list[list[float]], radius: float = 0.1, segments: int = 24, smooth: int = 8) -> Mesh:
    """A round bar along a path through points."""
    line = _curve(_corners(path, 3), smooth)
    tangent = unit(np.gradient(line, axis=0))
    side = np.empty_like(line)
    side[0] = unit(np.cross(tangent[0], [0.3, 0.5, 0.81]))
    for k in range(1, len(line)):  # carried along with the least turn
        side[k] = unit(side[k - 1] - tangent[k] * (side[k - 1] @ tangent[k]))
    up = np.cross(tangent, side)
    angle = np.linspace(0, 2 * np.pi, segments + 1)[:, None]
    normals = np.cos(angle) * side[:, None] + np.sin(angle) * up[:, None]
    points = line[:, None] + radius * normals
    uv = np.stack(np.broadcast_arrays(angle[:, 0] / (2 * np.pi), np.linspace(0, 1, len(line))[:, None]), -1)
    faces = grid_faces(len(line), segments + 1)
    return Mesh(points.reshape(-1, 3), faces, uv.reshape(-1, 2), normals.reshape(-1, 3))


def waves(
    size: tuple[float, float] = (1.0, 1.0),
    detail: int = 300,
    height: float = 0.01,
    length: float = 0.5,
    seed: int = 0,
) -> Mesh:
    """A rectangle that looks up with smooth random waves: ``height`` from crest to trough, ``length`` apart."""
    x, y = (np.linspace(-s / 2, s / 2, detail) for s in size)
    a, b = np.meshgrid(x, y, indexing="ij")
    z = height * (fractal_noise(np.stack((a, b * 0.6), -1) / length, seed, octaves=2) - 0.5)
    points = np.stack((a, b, z), -1)
    slope_x, slope_y = np.gradient(z, x, y)
    normals = unit(np.stack((-slope_x, -slope_y, np.ones_like(z)), -1))
    uv = np.stack((a / size[0] + 0.5, b / size[1] + 0.5), -1)
    faces = grid_faces(detail, detail)[:, [0, 2, 1]]
    return Mesh(points.reshape(-1, 3), faces, uv.reshape(-1, 2), normals.reshape(-1, 3))


def rock(radius: float = 1.0, rough: float = 0.25, seed: int = 0, detail: int = 96) -> Mesh:
    """A ball with random bumps of ``rough`` times its radius."""
    ball = sphere(1.0, detail)
    bumps = fractal_noise(ball.points * 1.3 + 10, seed, octaves=4) - 0.5
    points = radius * ball.points * (1 + 2 * rough * bumps[:, None])
    return Mesh(points, ball.faces, ball.uv, smooth_normals(points, ball.faces))


def _corners(points: list[list[float]], axes: int) -> Array:
    """Two or more points of so many numbers each, as an array."""
    try:
        corners = np.array(points, float)
    except (TypeError, ValueError):
        raise ValueError(f"points that are not all {axes} numbers") from None
    if corners.ndim != 2 or corners.shape[1] != axes or len(corners) < 2:
        raise ValueError(f"an array of shape {list(corners.shape)} where points are [2 or more, {axes}]")
    return corners


def _curve(points: Array, between: int) -> Array:
    """Points on the Catmull-Rom curve through points; its ends repeat the first and last point."""
    if between == 0 or len(points) < 3:
        return points.copy()
    padded = np.concatenate([2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]])
    t = (np.arange(between + 1) / (between + 1))[:, None]
    pieces = []
    for a, b, c, d in zip(padded, padded[1:], padded[2:], padded[3:], strict=False):
        pieces.append(
            0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        )
    return np.concatenate([*pieces, points[-1:]])


SHAPES: dict[str, Callable[..., Mesh]] = {
    "sphere": sphere, "plane": plane, "box": box, "lathe": lathe, "tube": tube, "waves": waves, "rock": rock,
    "solid": solid,
}  # fmt: skip


def make_mesh(shape: dict[str, Any], where: str) -> Mesh:
    """The mesh that the data of a shape describe.

    Raises:
        PolarguideError: the type or a field is unknown, or a value makes no sense.
    """
    return make(SHAPES, shape, f"{where} shape", f"a type of {', '.join([*SHAPES, 'mesh'])}")


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


def shown_dict(spec: SceneSpec, visible: bool) -> dict[str, Any]:
    """The attribute of a shape that says whether the camera sees it; nothing where it sees all."""
    return {SHOWN: {"type": "uniform", "value": float(visible)}} if spec.object_only else {}


def area_light_dict(light: dict[str, Any], channel: int | None, where: str) -> dict[str, Any]:
    """A rectangular area light.

    Raises:
        PolarguideError: a field is missing or has another type; ``where`` names the scene.
    """
    placed = decode(light, Light, f"{where} (lights)", remedy=REMEDY)
    way = np.subtract(placed.toward, placed.position)
    if not way.any():
        raise PolarguideError(
            f"{where} (lights)",
            expected="two different places of each light",
            found=str(light)[:200],
            remedy=REMEDY,
        )
    up = [0, 0, 1] if abs(way[2]) < 0.99 * np.linalg.norm(way) else [0, 1, 0]
    width, height = placed.size
    place = mi.ScalarTransform4f().look_at(list(placed.position), list(placed.toward), up)
    place @= mi.ScalarTransform4f().scale([width / 2, height / 2, 1.0])
    return {"type": "rectangle", "to_world": place,
            "emitter": {"type": "area", "radiance": _value(placed.radiance, channel)},
            "bsdf": {"type": "diffuse", "reflectance": _value((0.0, 0.0, 0.0), channel)}}  # fmt: skip


@dataclass(frozen=True, eq=False)
class BuiltScene:
    """A scene ready to be rendered.

    Attributes:
        spec: the scene data.
        scenes: Mitsuba's scenes, one or three (see ``film.render_lobes``).
        shapes: Mitsuba's shape of every object in the first scene, in the order of the data.
        panorama: the environment, [H, W, 3].
        textures: textures of every object, [H, W, 3] with rows from the top down, or None where it has one color.
    """

    spec: SceneSpec
    scenes: list[Any]
    shapes: list[Any]
    panorama: Array
    textures: list[Array | None]

    @property
    def drawn(self) -> NDArray[np.bool_]:
        """Visibility of the objects to the camera, by number; number 0 stands for no object."""
        return np.array([False, *self.spec.shown])


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
    shapes: list[list[Any]] = []
    for channel in range(3) if variant.channels == 3 else (None,):
        content: dict[str, Any] = {"type": "scene", "sky": environment_dict(panorama, channel)}
        for number, thing in enumerate(spec.things):
            place = folder / "mesh" / f"{thing.name}.ply"
            surface = {"bsdf": bsdf_dict(thing.material, pictures[number], channel)}
            surface |= shown_dict(spec, spec.shown[number])
            content[f"thing{number}"] = _shape(thing, meshes[number], place, surface)
        for number, light in enumerate(spec.lights):
            content[f"light{number}"] = area_light_dict(light, channel, spec.name) | shown_dict(spec, False)
        scenes.append(mi.load_dict(content))
        shapes.append([content[f"thing{number}"] for number in range(len(spec.things))])
    return BuiltScene(spec, scenes, shapes[0], panorama, pictures)


def _mesh(thing: Thing, spec: SceneSpec) -> Mesh:
    if thing.shape.get("type") == "ball":
        mesh = sphere(decode(thing.shape, Ball, f"{thing.name} shape", remedy=REMEDY).radius)
    elif thing.shape.get("type") == "mesh":
        file = decode(thing.shape, MeshFile, f"{thing.name} shape", remedy=REMEDY).file
        mesh = _user_mesh(spec.folder / file)
    else:
        mesh = make_mesh(thing.shape, thing.name)
    moved = mesh.moved(thing.scale, rotation(thing.rotation), np.array(thing.position, float))
    require_solid(moved.points, thing.name)
    return moved


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
        radius = decode(thing.shape, Ball, f"{thing.name} shape", remedy=REMEDY).radius * thing.scale
        return mi.load_dict({"type": "sphere", "center": list(thing.position), "radius": radius, **surface})
    flat = mesh.normals is None
    return mi.load_dict({"type": "ply", "filename": str(path), "face_normals": flat, **surface})
