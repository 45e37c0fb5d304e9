"""Compute ground truth by ray casting: normals, depth, masks and materials of the surfaces of a scene."""

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
    """First intersections of rays with the surfaces of a scene.

    Attributes:
        distance: [N] distance along the ray, 0 without an intersection.
        normal: [N, 3] unit shading normal on the side of the ray's origin, 0 without an intersection.
        thing: [N] number of the object, counted from 1. 0 for a light source or no intersection.
        uv: [N, 2] texture coordinates.
    """

    distance: Array
    normal: Array
    thing: NDArray[np.uint8]
    uv: Array


def intersect(built: BuiltScene, origins: Array, toward: Array) -> Intersections:
    """Intersect rays with origins [N, 3] and unit directions [N, 3] with the scene."""
    origin = mi.Point3f(np.ascontiguousarray(origins.T, np.float32))
    direction = mi.Vector3f(np.ascontiguousarray(toward.T, np.float32))
    si = built.scenes[0].ray_intersect(mi.Ray3f(origin, direction))
    number = mi.UInt32(0)
    for k, shape in enumerate(built.shapes):
        number = dr.select(si.shape == mi.ShapePtr(shape), k + 1, number)
    values = (dr.select(si.is_valid(), si.t, 0.0), si.sh_frame.n, number, si.uv)
    distance, normal, thing, uv = (np.array(value, float).T for value in values)
    hit = thing > 0
    normal = np.where((normal * toward).sum(-1, keepdims=True) > 0, -normal, normal) * hit[:, None]
    return Intersections(distance * hit, normal, thing.astype(np.uint8), uv)


def ground_truth_maps(built: BuiltScene, camera: Camera) -> dict[str, NDArray[Any]]:
    """Compute the ground truth of a view, by the keys of a ground-truth file.

    Objects that are black to the camera are background. Base color is the mean over each pixel. All other maps contain
    values at pixel centers.

    Returns:
        Maps [H, W] or [H, W, 3] by key.
    """
    rays = camera.world_rays().numpy().astype(np.float64).reshape(-1, 3)
    hits = intersect(built, np.broadcast_to(camera.center.numpy(), rays.shape), rays)
    shape = (camera.height, camera.width)
    foreground = np.array([False] + [thing.foreground for thing in built.spec.things])
    visible = built.visible[hits.thing]
    thing = (visible * hits.thing).reshape(shape)
    depth = visible * hits.distance * (rays @ camera.rotation[2].numpy())
    return {
        "normal": (visible[:, None] * hits.normal).reshape(*shape, 3).astype(np.float16),
        "depth": depth.reshape(shape).astype(np.float16),
        "mask": foreground[hits.thing].reshape(shape),
        "objid": thing,
        "albedo": _pixel_albedo(built, camera).astype(np.float16),
        **_materials(built.spec, thing),
    }


SUBPIXELS = 4
"""Number of rays along each side of a pixel, over which its base color is averaged.

At edges of textures, one ray at the center differs from the mean by 1.5 to 3.5 dB.
"""


def base_colors(built: BuiltScene, hits: Intersections) -> Array:
    """Return the base color [N, 3] at intersections, in the sense of glTF. It is 0 without an object.

    For plastic and matte objects, the base color is the reflectance of the diffuse base. For metals, it is the
    reflectance at normal incidence.
    """
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
    """Sample a texture [H, W, 3] at coordinates [N, 2] like Mitsuba.

    The texture is repeated and interpolated bilinearly. A palette is not interpolated.

    Returns:
        Colors [N, 3].
    """
    height, width = texture.shape[:2]
    column = uv[:, 0] * width
    row = (1 - uv[:, 1]) * height
    if height == 1:
        return texture[0, np.floor(column).astype(int) % width]
    left = np.floor(column - 0.5).astype(int)
    top = np.floor(row - 0.5).astype(int)
    across = (column - 0.5 - left)[:, None]
    down = (row - 0.5 - top)[:, None]
    upper, lower = (
        (1 - across) * texture[y % height, left % width] + across * texture[y % height, (left + 1) % width]
        for y in (top, top + 1)
    )
    return np.asarray((1 - down) * upper + down * lower)


def _pixel_albedo(built: BuiltScene, camera: Camera) -> Array:
    """Return the base color [H, W, 3] of each pixel, averaged over its part that shows an object.

    It is 0 if the pixel shows no object.
    """
    fine = camera.scaled(SUBPIXELS, SUBPIXELS * camera.width, SUBPIXELS * camera.height)
    rays = fine.world_rays().numpy().astype(np.float64).reshape(-1, 3)
    hits = intersect(built, np.broadcast_to(fine.center.numpy(), rays.shape), rays)
    visible = built.visible[hits.thing]
    boxes = (camera.height, SUBPIXELS, camera.width, SUBPIXELS, -1)
    colors = (visible[:, None] * base_colors(built, hits)).reshape(boxes).sum((1, 3))
    return np.asarray(colors / np.maximum(visible.reshape(boxes).sum((1, 3)), 1))


def _materials(spec: SceneSpec, thing: NDArray[np.uint8]) -> dict[str, NDArray[np.float16]]:
    """Return maps of the material.

    The maps are GGX alpha (1 for matte), metalness (0 or 1), and refractive index (0 except for dielectrics).
    """
    materials = [each.material for each in spec.things]
    values = {
        "roughness": [1.0 if material.type == "matte" else material.roughness for material in materials],
        "metalness": [float(material.type == "metal") for material in materials],
        "index": [material.index if material.type == "plastic" else 0.0 for material in materials],
    }
    return {name: np.array([0.0, *column], np.float16)[thing] for name, column in values.items()}


COLUMNS = ("photograph", "DoLP", "AoLP", "specular", "diffuse", "normals", "depth")
"""Labels of the columns of the overview picture."""
ROWS = 3
"""Largest number of views in the overview picture."""
WIDEST = 320
"""Largest width of a single map in the overview picture, in pixels."""
QUALITY = 82
"""JPEG quality of the overview picture."""


def write_sheet(out: Path, names: Sequence[str], cameras: Sequence[Camera]) -> None:
    """Write the overview picture ``sheet.jpg`` with up to ``ROWS`` views. All views need ground truth."""
    chosen = sorted({round(k) for k in np.linspace(0, len(names) - 1, min(ROWS, len(names)))})
    rows = [_layers(out / "gt" / f"{names[k]}.npz", cameras[k]) for k in chosen]
    sheet = contact_sheet(rows, [names[k] for k in chosen], COLUMNS, maximum_width=WIDEST)
    _, data = cv2.imencode(".jpg", sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    write_file(out / "sheet.jpg", data.tobytes())


def _layers(path: Path, camera: Camera) -> list[Picture]:
    """Draw the maps of a view, [H, W, 3] each, in the order of ``COLUMNS``."""
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
