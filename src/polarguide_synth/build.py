"""Build Mitsuba scenes from scene data: one scene for all wavelengths, or three scenes for red, green and blue.

Procedural shapes are centered at the origin or stand on it, with z up. docs/reference/scene-files.md describes the
fields of each ``shape``.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polarguide.core.errors import PolarguideError, require
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
from polarguide_synth.settings import mi
from polarguide_synth.textures import fractal_noise, make_environment, make_texture
from polarguide_synth.transport import VISIBLE


def sphere(radius: float = 1.0, detail: int = 96) -> Mesh:
    """Create the mesh of a ball, with exact normals."""
    polar = np.linspace(0, np.pi, detail // 2 + 1)
    ball = lathe([[np.sin(a), -np.cos(a)] for a in polar], segments=detail, smooth=0)
    return Mesh(radius * ball.points, ball.faces, ball.uv, unit(ball.points))


def plane(size: tuple[float, float] = (1.0, 1.0), tile: float = 0.0) -> Mesh:
    """Create the mesh of a horizontal rectangle that faces up.

    Args:
        size: lengths along x and y.
        tile: length of one repeat of the texture. If 0, the texture covers the rectangle once.
    """
    corners = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    points = np.column_stack(((2 * corners - 1) * size, np.zeros(4))) / 2
    uv = points[:, :2] / tile if tile else corners
    return Mesh(points, np.array([[0, 1, 2], [0, 2, 3]]), uv, np.tile([0.0, 0, 1], (4, 1)))


def box(size: tuple[float, float, float] = (1.0, 1.0, 1.0), bevel: float = 0.0, detail: int = 4) -> Mesh:
    """Create the mesh of a box with rounded edges. Each side shows the whole texture.

    Args:
        size: lengths of the sides.
        bevel: radius of the edges.
        detail: number of facets of an edge.

    Raises:
        ValueError: the bevel is larger than half of the shortest side.
    """
    half = np.array(size, float) / 2
    if not 0 <= bevel <= half.min():
        raise ValueError(f"a bevel of {bevel:g}, where half of the shortest side is {half.min():g}")
    radius = min(bevel, float(half.min()) * 0.999) or 1e-5
    corner = np.tan(np.linspace(-np.pi / 4, np.pi / 4, detail + 1))
    bent = radius * (corner[: detail // 2 + 1] + 1)
    lines = [np.unique(np.round(np.concatenate([-h + bent, h - bent[::-1]]), 12)) for h in half]
    sides = []
    for axis, sign in itertools.product(range(3), (1.0, -1.0)):
        u, v = ((axis + 1) % 3, (axis + 2) % 3)[:: int(sign)]
        a, b = np.meshgrid(lines[u], lines[v], indexing="ij")
        points = np.zeros((*a.shape, 3))
        points[..., [u, v, axis]] = np.stack(np.broadcast_arrays(a, b, sign * half[axis]), -1)
        core = np.clip(points, -(half - radius), half - radius)
        normals = unit(points - core)
        uv = np.stack((a / (2 * half[u]) + 0.5, b / (2 * half[v]) + 0.5), -1)
        sides.append(_grid_mesh(core + radius * normals, uv, normals, facing=-1))
    return joined(sides)


def lathe(profile: list[list[float]], segments: int = 96, smooth: int = 8) -> Mesh:
    """Create the mesh of a surface of revolution about z.

    Args:
        profile: points (radius, height), from bottom to top on the outside.
        segments: number of segments around z.
        smooth: number of points of a Catmull-Rom curve between two points of the profile. If 0, the points are
            connected by straight lines.

    Raises:
        ValueError: the profile is invalid, or a radius is negative.
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
    return _grid_mesh(points, uv, normals)


def tube(path: list[list[float]], radius: float = 0.1, segments: int = 24, smooth: int = 8) -> Mesh:
    """Create the mesh of a round bar along a path.

    Args:
        path: points of the path, [N, 3].
        radius: radius of the bar.
        segments: number of segments around the path.
        smooth: number of points of a Catmull-Rom curve between two points of the path, as in ``lathe``.

    Raises:
        ValueError: the path is invalid.
    """
    line = _curve(_corners(path, 3), smooth)
    tangent = unit(np.gradient(line, axis=0))
    side = np.empty_like(line)
    side[0] = unit(np.cross(tangent[0], [0.3, 0.5, 0.81]))
    for k in range(1, len(line)):  # transport with the smallest rotation
        side[k] = unit(side[k - 1] - tangent[k] * (side[k - 1] @ tangent[k]))
    angle = np.linspace(0, 2 * np.pi, segments + 1)[:, None]
    normals = np.cos(angle) * side[:, None] + np.sin(angle) * np.cross(tangent, side)[:, None]
    uv = np.stack(np.broadcast_arrays(angle[:, 0] / (2 * np.pi), np.linspace(0, 1, len(line))[:, None]), -1)
    return _grid_mesh(line[:, None] + radius * normals, uv, normals)


def waves(
    size: tuple[float, float] = (1.0, 1.0),
    detail: int = 300,
    height: float = 0.01,
    length: float = 0.5,
    seed: int = 0,
) -> Mesh:
    """Create the mesh of a horizontal rectangle that faces up, with smooth random waves.

    Args:
        size: lengths along x and y.
        detail: number of points along each side.
        height: height from trough to crest.
        length: wavelength.
        seed: seed of the waves.
    """
    x, y = (np.linspace(-s / 2, s / 2, detail) for s in size)
    a, b = np.meshgrid(x, y, indexing="ij")
    z = height * (fractal_noise(np.stack((a, b * 0.6), -1) / length, seed, octaves=2) - 0.5)
    slope_x, slope_y = np.gradient(z, x, y)
    normals = unit(np.stack((-slope_x, -slope_y, np.ones_like(z)), -1))
    uv = np.stack((a / size[0] + 0.5, b / size[1] + 0.5), -1)
    return _grid_mesh(np.stack((a, b, z), -1), uv, normals, facing=-1)


def rock(radius: float = 1.0, rough: float = 0.25, seed: int = 0, detail: int = 96) -> Mesh:
    """Create the mesh of a ball with random bumps, whose height is up to ``rough`` times the radius."""
    ball = sphere(1.0, detail)
    bumps = fractal_noise(ball.points * 1.3 + 10, seed, octaves=4) - 0.5
    points = radius * ball.points * (1 + 2 * rough * bumps[:, None])
    return Mesh(points, ball.faces, ball.uv, smooth_normals(points, ball.faces))


def _grid_mesh(points: Array, uv: Array, normals: Array, facing: int = 1) -> Mesh:
    """Create a mesh from points on a grid.

    Args:
        points: points [R, C, 3].
        uv: texture coordinates [R, C, 2].
        normals: normals [R, C, 3].
        facing: 1 if columns proceed counter-clockwise from rows as seen from outside, else -1.
    """
    faces = grid_faces(*points.shape[:2])
    faces = faces if facing == 1 else faces[:, [0, 2, 1]]
    return Mesh(points.reshape(-1, 3), faces, uv.reshape(-1, 2), normals.reshape(-1, 3))


def _corners(points: list[list[float]], axes: int) -> Array:
    """Return points as an array [N, axes].

    Raises:
        ValueError: there are fewer than two points, or a point has the wrong number of coordinates.
    """
    try:
        corners = np.array(points, float)
    except (TypeError, ValueError):
        raise ValueError(f"points that are not all {axes} numbers") from None
    if corners.ndim != 2 or corners.shape[1] != axes or len(corners) < 2:
        raise ValueError(f"an array of shape {list(corners.shape)} where points are [2 or more, {axes}]")
    return corners


def _curve(points: Array, between: int) -> Array:
    """Sample the Catmull-Rom curve through points, with ``between`` samples between two points.

    The curve is extrapolated linearly at its ends. If there are fewer than three points, they are returned unchanged.
    """
    if between == 0 or len(points) < 3:
        return points.copy()
    padded = np.concatenate([2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]])
    t = (np.arange(between + 1) / (between + 1))[:, None]
    pieces = [
        0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        for a, b, c, d in zip(padded, padded[1:], padded[2:], padded[3:], strict=False)
    ]
    return np.concatenate([*pieces, points[-1:]])


SHAPES: dict[str, Callable[..., Mesh]] = {
    "sphere": sphere, "plane": plane, "box": box, "lathe": lathe, "tube": tube, "waves": waves, "rock": rock,
    "solid": solid,
}  # fmt: skip


def make_mesh(shape: dict[str, Any], where: str) -> Mesh:
    """Create the mesh of a shape from its data.

    Raises:
        PolarguideError: the type, a field or a value is invalid.
    """
    return make(SHAPES, shape, f"{where} shape", f"a type of {', '.join([*SHAPES, 'mesh'])}")


def bsdf_dict(material: Material, texture: Array | None, channel: int) -> dict[str, Any]:
    """Return Mitsuba's dictionary for the BSDF of a material.

    Args:
        material: the material.
        texture: base color [H, W, 3]. If None, the color of the material is used.
        channel: 0 to 2 for red, green or blue.
    """
    base = _value(material.color, channel) if texture is None else _bitmap(texture, channel)
    if material.type == "metal":
        index = {name: _value(getattr(material, name), channel) for name in ("eta", "k")}
        inner = {"type": "roughconductor", "distribution": "ggx", "alpha": material.roughness, **index}
    elif material.type == "matte":
        inner = {"type": "diffuse", "reflectance": base}
    else:
        inner = {"type": "pplastic", "distribution": "ggx", "alpha": material.roughness, "diffuse_reflectance": base,
                 "int_ior": float(material.index), "ext_ior": 1.0}  # fmt: skip
    return {"type": "twosided", "inner": inner}


def _value(color: Any, channel: int) -> dict[str, Any]:
    """Return Mitsuba's dictionary for a reflectance, a radiance or an index of refraction."""
    return {"type": "uniform", "value": float(color[channel])}


def _bitmap(texture: Array, channel: int) -> dict[str, Any]:
    """Return Mitsuba's dictionary for a texture [H, W, 3].

    A texture of one row is a palette, whose colors are not interpolated.
    """
    # Rows of a picture go down, v goes up.
    bitmap = mi.Bitmap(np.ascontiguousarray(texture[::-1, :, channel : channel + 1], np.float32))
    blend = "nearest" if len(texture) == 1 else "bilinear"
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": blend}


def environment_dict(panorama: Array, channel: int) -> dict[str, Any]:
    """Return Mitsuba's dictionary for an environment light with a panorama [H, W, 3]."""
    part = np.repeat(panorama[..., channel : channel + 1], 3, -1)
    # The left edge of Mitsuba's panoramas is its -z; y is up and columns proceed to the right.
    axes = np.array([[0, 0, -1, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], float)
    return {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(part, np.float32)),
            "to_world": mi.ScalarTransform4f(axes)}  # fmt: skip


def visibility_dict(spec: SceneSpec, visible: bool) -> dict[str, Any]:
    """Return Mitsuba's attribute for the visibility of a shape. It is empty if the camera sees all shapes."""
    return {VISIBLE: _value((float(visible),), 0)} if spec.object_only else {}


def area_light_dict(light: dict[str, Any], channel: int, where: str) -> dict[str, Any]:
    """Return Mitsuba's dictionary for a rectangular area light.

    Args:
        light: data of the light.
        channel: see ``bsdf_dict``.
        where: name of the scene, for messages.

    Raises:
        PolarguideError: a field is missing or invalid.
    """
    lamp = decode(light, Light, f"{where} (lights)", remedy=REMEDY)
    way = np.subtract(lamp.toward, lamp.position)
    require(
        way.any(),
        f"{where} (lights)",
        expected="a light whose position differs from its target",
        found=str(light)[:200],
        remedy=REMEDY,
    )
    up = [0, 0, 1] if abs(way[2]) < 0.99 * np.linalg.norm(way) else [0, 1, 0]
    width, height = lamp.size
    place = mi.ScalarTransform4f().look_at(list(lamp.position), list(lamp.toward), up)
    place @= mi.ScalarTransform4f().scale([width / 2, height / 2, 1.0])
    return {"type": "rectangle", "to_world": place,
            "emitter": {"type": "area", "radiance": _value(lamp.radiance, channel)},
            "bsdf": {"type": "diffuse", "reflectance": _value((0.0, 0.0, 0.0), channel)}}  # fmt: skip


@dataclass(frozen=True, eq=False)
class BuiltScene:
    """A scene that Mitsuba can render.

    Attributes:
        spec: the scene data.
        scenes: scenes of Mitsuba for red, green and blue.
        shapes: Mitsuba's shapes of the objects in the first scene, in the order of the data.
        textures: texture of each object, [H, W, 3] with rows from the top down. None for an object of one color.
    """

    spec: SceneSpec
    scenes: list[Any]
    shapes: list[Any]
    textures: list[Array | None]

    @property
    def visible(self) -> NDArray[np.bool_]:
        """True for each object that the camera sees, by the number of the object. Number 0 stands for no object."""
        return np.array([False, *self.spec.visible])


def build_scene(spec: SceneSpec, folder: Path) -> BuiltScene:
    """Generate the meshes, textures and environment of a scene, write them to files, and load them into Mitsuba.

    The files are ``mesh/<thing>.ply`` and ``environment.hdr``.

    Args:
        spec: the scene data.
        folder: folder to write.

    Raises:
        PolarguideError: a shape, a texture, a light or the environment is invalid.
    """
    make_folder(folder / "mesh")
    meshes = [_mesh(thing, spec) for thing in spec.things]
    for thing, mesh in zip(spec.things, meshes, strict=True):
        write_ply(folder / "mesh" / f"{thing.name}.ply", mesh)
    panorama = make_environment(spec.environment, spec.name, spec.folder)
    require_light(panorama, f"{spec.name} (environment)")
    _, encoded = cv2.imencode(".hdr", panorama[..., ::-1].astype(np.float32))
    write_whole(folder / "environment.hdr", encoded.tobytes())
    textures = [_texture(thing, mesh, spec.folder) for thing, mesh in zip(spec.things, meshes, strict=True)]
    contents: list[dict[str, Any]] = []
    for channel in range(3):
        content: dict[str, Any] = {"type": "scene", "sky": environment_dict(panorama, channel)}
        for number, thing in enumerate(spec.things):
            place = folder / "mesh" / f"{thing.name}.ply"
            surface = {"bsdf": bsdf_dict(thing.material, textures[number], channel)}
            surface |= visibility_dict(spec, spec.visible[number])
            content[f"thing{number}"] = _shape(thing, meshes[number], place, surface)
        for number, light in enumerate(spec.lights):
            content[f"light{number}"] = area_light_dict(light, channel, spec.name) | visibility_dict(
                spec, False
            )
        contents.append(content)
    shapes = [contents[0][f"thing{number}"] for number in range(len(spec.things))]
    return BuiltScene(spec, [mi.load_dict(content) for content in contents], shapes, textures)


def _mesh(thing: Thing, spec: SceneSpec) -> Mesh:
    """Create the mesh of an object at its place in the scene.

    Raises:
        PolarguideError: the shape is invalid, or has no extent.
    """
    if thing.shape.get("type") == "ball":
        mesh = sphere(decode(thing.shape, Ball, f"{thing.name} shape", remedy=REMEDY).radius)
    elif thing.shape.get("type") == "mesh":
        mesh = _user_mesh(
            spec.folder / decode(thing.shape, MeshFile, f"{thing.name} shape", remedy=REMEDY).file
        )
    else:
        mesh = make_mesh(thing.shape, thing.name)
    moved = mesh.moved(thing.scale, rotation(thing.rotation), np.array(thing.position, float))
    require_solid(moved.points, thing.name)
    return moved


def _user_mesh(path: Path) -> Mesh:
    """Read the mesh in a user's PLY or OBJ file with Mitsuba.

    Raises:
        PolarguideError: the file is missing, damaged or of another type.
    """
    kind = path.suffix.lower().lstrip(".")
    require_unicode(path)
    require(
        kind in ("ply", "obj") and path.is_file(),
        path,
        expected="a mesh as .ply or .obj",
        found=f"a name that ends in {path.suffix or 'nothing'}" if path.is_file() else "nothing",
        remedy="File names of meshes are relative to the folder of the scene file.",
    )
    # Read without normals first, because Mitsuba would compute normals before it validates the indices of corners.
    params = _mesh_arrays(path, kind, flat=True)
    points = np.array(params["vertex_positions"], float).reshape(-1, 3)
    faces = np.array(params["faces"], np.int64).reshape(-1, 3)
    # Mitsuba replaces a negative corner by the first one.
    triangles = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    if not triangles.any() or faces.min() < 0 or faces.max() >= len(points):
        found = (
            f"corners {faces.min()} to {faces.max()} of {len(points)}" if triangles.any() else "no triangle"
        )
        raise PolarguideError(
            path, expected="triangles between its points", found=found, remedy="Export it again."
        )
    params = _mesh_arrays(path, kind, flat=False)
    normals = np.array(params["vertex_normals"], float).reshape(-1, 3)
    uv = np.array(params["vertex_texcoords"], float).reshape(-1, 2)
    return Mesh(
        points, faces, uv if len(uv) else np.zeros((len(points), 2)), normals if len(normals) else None
    )


def _mesh_arrays(path: Path, kind: str, *, flat: bool) -> Any:
    """Return the arrays of a mesh as Mitsuba reads them.

    Args:
        path: path of the file.
        kind: "ply" or "obj".
        flat: True to omit vertex normals.

    Raises:
        PolarguideError: Mitsuba cannot read the file.
    """
    try:
        return mi.traverse(mi.load_dict({"type": kind, "filename": str(path), "face_normals": flat}))
    except (RuntimeError, UnicodeDecodeError) as error:
        # A decoding error quotes the header. Other messages of Mitsuba end with the reason.
        quoted = isinstance(error, UnicodeDecodeError)
        fault = "a line of its header that is not text" if quoted else str(error)
        reason = fault.rpartition("shape plugin of type")[2].partition(": ")[2] or fault
        raise PolarguideError(
            path,
            expected="a complete mesh of triangles",
            found=" ".join(reason.split())[:200],
            remedy="Export it again.",
        ) from None


def _texture(thing: Thing, mesh: Mesh, folder: Path) -> Array | None:
    """Return the texture [H, W, 3] of an object. Return None for an object of one color.

    Raises:
        PolarguideError: the texture is invalid, or the mesh has no colors for the color "own".
    """
    color = thing.material.color
    if color != "own":
        return make_texture(color, thing.name, folder) if isinstance(color, dict) else None
    if mesh.palette is None:
        raise PolarguideError(
            f"{thing.name} material.color",
            expected='a shape with its own colors for the color "own"',
            found=f"a {thing.shape.get('type')} without colors",
            remedy="Give the parts of a solid or the material a color.",
        )
    return mesh.palette[None]


def _shape(thing: Thing, mesh: Mesh, path: Path, surface: dict[str, Any]) -> Any:
    """Create Mitsuba's shape of an object.

    Args:
        thing: the object.
        mesh: mesh of the object.
        path: file of the mesh.
        surface: BSDF and attributes.
    """
    if thing.shape.get("type") == "ball":
        radius = decode(thing.shape, Ball, f"{thing.name} shape", remedy=REMEDY).radius * thing.scale
        return mi.load_dict({"type": "sphere", "center": list(thing.position), "radius": radius, **surface})
    flat = mesh.normals is None
    return mi.load_dict({"type": "ply", "filename": str(path), "face_normals": flat, **surface})
