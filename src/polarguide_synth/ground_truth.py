"""Ray casting against the surfaces of a scene: normals, depth, object masks and materials without light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from polarguide import optics
from polarguide.geometry.camera import Camera
from polarguide.visualization import figures
from polarguide.visualization.figures import Picture, contact_sheet
from polarguide_synth.build import BuiltScene
from polarguide_synth.folder import write_file
from polarguide_synth.mesh import Array
from polarguide_synth.schema import SceneSpec
from polarguide_synth.settings import dr, mi


@dataclass(frozen=True, eq=False)
class Intersections:
    """The first intersections of rays with surfaces.

    Attributes:
        distance: [N] along the ray, 0 without intersection.
        normal: [N, 3] unit shading normal that faces the ray's origin, 0 without intersection.
        thing: [N] number of the object, counted from 1; 0 for a light source or no intersection.
        uv: [N, 2] texture coordinates.
    """

    distance: Array
    normal: Array
    thing: NDArray[np.uint8]
    uv: Array


def intersect(built: BuiltScene, origins: Array, toward: Array) -> Intersections:
    """Intersect rays with origins [N, 3] and unit directions [N, 3] with the scene."""
    if mi.variant().startswith("scalar"):
        pairs = zip(origins.tolist(), toward.tolist(), strict=True)
        rows = [_intersect(built, mi.Point3f(*o), mi.Vector3f(*d)) for o, d in pairs]
        distance, normal, thing, uv = (np.array(column, float) for column in zip(*rows, strict=True))
    else:
        origin = mi.Point3f(np.ascontiguousarray(origins.T, np.float32))
        direction = mi.Vector3f(np.ascontiguousarray(toward.T, np.float32))
        distance, normal, thing, uv = (
            np.array(value, float) for value in _intersect(built, origin, direction)
        )
        normal = normal.T
        uv = uv.T
    hit = thing > 0
    normal = np.where((normal * toward).sum(-1, keepdims=True) > 0, -normal, normal) * hit[:, None]
    return Intersections(distance * hit, normal, thing.astype(np.uint8), uv)


def _intersect(built: BuiltScene, origin: Any, direction: Any) -> tuple[Any, Any, Any, Any]:
    si = built.scenes[0].ray_intersect(mi.Ray3f(origin, direction))
    if mi.variant().startswith("scalar"):
        number = next((k + 1 for k, shape in enumerate(built.shapes) if shape == si.shape), 0)
        return (si.t if number else 0.0), list(si.sh_frame.n), number, list(si.uv)
    number = mi.UInt32(0)
    for k, shape in enumerate(built.shapes):
        number = dr.select(si.shape == mi.ShapePtr(shape), k + 1, number)
    return dr.select(si.is_valid(), si.t, 0.0), si.sh_frame.n, number, si.uv


def ground_truth_maps(built: BuiltScene, camera: Camera) -> dict[str, NDArray[Any]]:
    """Normals, depth, mask, object numbers and materials at pixel centers, and base color as the mean of each pixel,
    with the keys of a ground-truth file; nothing of what is black to the camera."""
    rays = camera.world_rays().numpy().astype(np.float64).reshape(-1, 3)
    hits = intersect(built, np.broadcast_to(camera.center.numpy(), rays.shape), rays)
    shape = (camera.height, camera.width)
    front = np.array([False] + [thing.foreground for thing in built.spec.things])
    drawn = built.drawn[hits.thing]
    depth = drawn * hits.distance * (rays @ camera.rotation[2].numpy())
    return {
        "normal": (drawn[:, None] * hits.normal).reshape(*shape, 3).astype(np.float16),
        "depth": depth.reshape(shape).astype(np.float16),
        "mask": front[hits.thing].reshape(shape),
        "objid": (drawn * hits.thing).reshape(shape),
        "albedo": _pixel_albedo(built, camera).astype(np.float16),
        **_materials(built.spec, (drawn * hits.thing).reshape(shape)),
    }


SUBPIXELS = 4
"""Rays along a pixel's side for base color. One ray at the center differs from the mean by 1.5 to 3.5 dB at edges of
textures."""


def base_colors(built: BuiltScene, hits: Intersections) -> Array:
    """Base color [N, 3] at intersections as glTF defines it: the reflectance of the diffuse base of plastic and matte
    objects, the reflectance at normal incidence of metals; 0 without an object."""
    colors = np.zeros((len(hits.thing), 3))
    for number, (thing, texture) in enumerate(zip(built.spec.things, built.textures, strict=True), 1):
        here = hits.thing == number
        material = thing.material
        if material.type == "metal":
            eta = np.array(material.eta)
            k = np.array(material.k)
            colors[here] = ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)
        elif texture is None:
            colors[here] = material.color
        else:
            colors[here] = _texture_values(texture, hits.uv[here])
    return colors


def _texture_values(texture: Array, uv: Array) -> Array:
    """Values [N, 3] of a texture [H, W, 3], bilinear and repeated, as Mitsuba blends it; nearest in a palette."""
    height, width = texture.shape[:2]
    column = uv[:, 0] * width
    row = (1 - uv[:, 1]) * height
    if height == 1:
        return texture[0, np.floor(column).astype(int) % width]
    column = column - 0.5
    row = row - 0.5
    left = np.floor(column).astype(int)
    top = np.floor(row).astype(int)
    across = (column - left)[:, None]
    down = (row - top)[:, None]
    upper, lower = (
        (1 - across) * texture[y % height, left % width] + across * texture[y % height, (left + 1) % width]
        for y in (top, top + 1)
    )
    return np.asarray((1 - down) * upper + down * lower)


def _pixel_albedo(built: BuiltScene, camera: Camera) -> Array:
    """Base color [H, W, 3], the mean over the part of each pixel that shows an object; 0 without an object."""
    fine = camera.scaled(SUBPIXELS, SUBPIXELS * camera.width, SUBPIXELS * camera.height)
    rays = fine.world_rays().numpy().astype(np.float64).reshape(-1, 3)
    hits = intersect(built, np.broadcast_to(fine.center.numpy(), rays.shape), rays)
    drawn = built.drawn[hits.thing]
    boxes = (camera.height, SUBPIXELS, camera.width, SUBPIXELS, -1)
    colors = (drawn[:, None] * base_colors(built, hits)).reshape(boxes).sum((1, 3))
    return np.asarray(colors / np.maximum(drawn.reshape(boxes).sum((1, 3)), 1))


def _materials(spec: SceneSpec, thing: NDArray[np.uint8]) -> dict[str, NDArray[np.float16]]:
    """Maps of the objects' GGX alpha (1 for matte), metalness (0 or 1) and refractive index (0: no dielectric)."""
    values = {"roughness": [0.0], "metalness": [0.0], "index": [0.0]}
    for material in (each.material for each in spec.things):
        values["roughness"].append(1.0 if material.type == "matte" else material.roughness)
        values["metalness"].append(float(material.type == "metal"))
        values["index"].append(material.index if material.type == "plastic" else 0.0)
    return {name: np.array(column, np.float16)[thing] for name, column in values.items()}


COLUMNS = ("photograph", "DoLP", "AoLP", "specular", "diffuse", "normals", "depth")
ROWS = 3
WIDEST = 320
"""Pixels of the width of one layer in the sheet, at most."""
QUALITY = 82


def write_sheet(out: Path, names: Sequence[str], cameras: Sequence[Camera]) -> None:
    """Write ``sheet.jpg`` with up to three of these views; all must have ground truth."""
    chosen = sorted({round(k) for k in np.linspace(0, len(names) - 1, min(ROWS, len(names)))})
    rows = [_layers(out / "gt" / f"{names[k]}.npz", cameras[k]) for k in chosen]
    sheet = contact_sheet(rows, [names[k] for k in chosen], COLUMNS, maximum_width=WIDEST)
    _, data = cv2.imencode(".jpg", sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    write_file(out / "sheet.jpg", data.tobytes())


def _layers(path: Path, camera: Camera) -> list[Picture]:
    """The pictures of one view, [H, W, 3] each, in the order of ``COLUMNS``."""
    with np.load(path) as ground_truth:
        stokes, specular, diffuse, normal, depth = (
            torch.from_numpy(ground_truth[name].astype(np.float32))
            for name in ("stokes", "specular", "diffuse", "normal", "depth")
        )
    mean = optics.luminance(stokes)
    degree = optics.dolp(mean)
    covered = depth > 0
    near, far = np.percentile(depth[covered].numpy(), (1, 99)) if covered.any() else (0.0, 1.0)
    return [
        figures.radiance_to_rgb(stokes[0] / 2),
        figures.dolp_to_rgb(degree),
        figures.aolp_to_rgb(optics.aolp(mean), degree * 4),
        figures.radiance_to_rgb(specular / 2),
        figures.radiance_to_rgb(diffuse / 2),
        figures.normal_to_rgb(normal, camera),
        figures.scalar_to_rgb(depth, near, max(far, near + 1e-6), "viridis"),
    ]
