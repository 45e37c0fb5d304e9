"""Conversion of a run to a textured mesh: surface, charts, baked textures, and base color without shading."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polarguide.capture.presentation import Presentation, colored, colored_reflectance
from polarguide.core.errors import PolarguideError, require_package
from polarguide.core.options import BaseColor, ModelOptions
from polarguide.core.progress import Reporter
from polarguide.core.system import free_memory
from polarguide.results.export.model.bake import (
    WHAT,
    Baked,
    ColorSource,
    Surroundings,
    arriving_light,
    bake,
    delit,
    irradiance,
)
from polarguide.results.export.model.gltf import Textured, color_pixels, linear_pixels
from polarguide.results.export.model.topology import SurfaceView, subject_surface
from polarguide.results.export.model.unwrap import Texels, Unwrapped, rasterized_texels, unwrap
from polarguide.results.export.placement import Placement
from polarguide.results.rendering.mesh import ColoredMesh, Inside, Surface, fused_surface, painted
from polarguide.results.rendering.relight import mirrored_light, needs_radiance
from polarguide.runs.opened import OpenedRun
from polarguide.shading.cubemap import cubemap_lookup
from polarguide.shading.deferred import DeferredShading

SOURCES: dict[BaseColor, ColorSource] = {
    "delit": "diffuse",
    "diffuse": "diffuse",
    "photographs": "photograph",
    "picture": "final",
}
BASE_COLORS: dict[BaseColor, str] = {
    "delit": "highlights removed, shading divided by the learned light, up to one brightness factor",
    "diffuse": "highlights removed, shading baked in",
    "photographs": "mean of the photographs, highlights and shading baked in",
    "picture": "mean of the rendered pictures, highlights and shading baked in",
}
"""Description of each kind of base color, for exported files."""
WHITEST = 0.9
"""Reflectance of the whitest common surfaces, such as white paint and porcelain."""
BRIGHT_SHARE = 0.01
"""Share of the surface, such as highlights, that may exceed ``WHITEST`` before all colors are scaled down."""
SURROUNDINGS_RESOLUTION = 128
"""Number of voxels along the longest side of the scene outside the crop box. It only casts soft shadows."""
_BATCH = 1 << 18  # texels per batch of the irradiance, about 100 MB
BYTES_PER_TEXEL = 190
"""Peak memory per texel during baking and filling of textures."""


def require_room(texture: int) -> None:
    """Check that a square texture fits into memory.

    Args:
        texture: number of texels along its side.

    Raises:
        PolarguideError: the texture does not fit.
    """
    needed = BYTES_PER_TEXEL * texture**2
    free = free_memory()
    if needed > free:
        raise PolarguideError(
            "--texture",
            expected=f"a texture that fits into {free / 1e9:.1f} GB of free memory",
            found=f"{texture} x {texture} texels, which take {needed / 1e9:.1f} GB",
            remedy="Choose a smaller texture.",
        )


@dataclass(frozen=True, eq=False)
class Charted:
    """Subject of a run as a mesh with texture coordinates.

    Attributes:
        mesh: the mesh, with colors of the diffuse layer.
        inside: function that selects points of the subject, or None for the whole scene.
        voxel: side of a voxel of the fusion.
        unwrapped: the mesh, split along the borders of its charts. A chart is a connected part of the texture.
        texels: texels that lie on a triangle of the mesh.
    """

    mesh: ColoredMesh
    inside: Inside | None
    voxel: float
    unwrapped: Unwrapped
    texels: Texels


def charted_subject(
    run: OpenedRun,
    surface_view: SurfaceView,
    inside: Inside | None,
    options: ModelOptions,
    resolution: int,
    folder: Path,
    reporter: Reporter,
) -> Charted:
    """Return the surface of the subject with texture coordinates.

    Args:
        run: the run; its scene is read.
        surface_view: renders a view of the subject's Gaussians.
        inside: function that selects points of the subject, or None for the whole scene.
        options: options of the model.
        resolution: number of voxels along its longest side.
        folder: folder for temporary files.
        reporter: receives progress, counts and warnings.

    Raises:
        PolarguideError: a package is missing, the texture does not fit into memory, there is no surface, or the recipe
            does not learn the radiance that delighting needs.
    """
    require_room(options.texture)
    if options.resolved_base_color == "delit":
        needs_radiance(run.model.shading, what=WHAT)
        require_package("embreex", WHAT)
    with reporter.track("fusing the surface"):
        surface, views, box = subject_surface(run, surface_view, inside, options, resolution, reporter)
        mesh = painted(surface, views, box)
    unwrapped = unwrap(mesh.surface.vertices, mesh.surface.faces, options.texture, folder, reporter)
    return Charted(mesh, inside, box.size, unwrapped, rasterized_texels(unwrapped, options.texture))


def textured_model(
    run: OpenedRun,
    subject: Charted,
    presentation: Presentation,
    placement: Placement,
    options: ModelOptions,
    reporter: Reporter,
) -> Textured:
    """Return the subject of a run as a textured mesh, +y up.

    Args:
        run: the run; its scene is read.
        subject: surface of the subject.
        presentation, placement: color and scale of the file.
        options: options of the model.
        reporter: receives progress and counts.
    """
    mesh = subject.mesh
    unwrapped = subject.unwrapped
    texels = subject.texels
    kind = options.resolved_base_color
    vertices, normals = (values[unwrapped.source] for values in (mesh.surface.vertices, mesh.surface.normals))
    facing = texels.interpolated(unwrapped.faces, normals)
    facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-9)
    places = texels.interpolated(unwrapped.faces, vertices)
    baked = bake(run, run.scene.train_views, places, facing, SOURCES[kind], subject.voxel, reporter)
    reporter.say(
        f"{unwrapped.charts:,} charts, {len(texels.index) / options.texture**2:.0%} of the texture used; "
        f"{1 - baked.seen.mean():.1%} of the surface is not visible in any view and has the nearest color"
    )
    light = None
    if kind == "delit":
        arriving = _arriving(run, mesh, subject.inside, reporter)[unwrapped.source]
        light = _irradiance(texels, unwrapped.faces, arriving, _learned(baked.normal, facing), _index(run))
    color, baked = _presented(baked, light, presentation.color, _index(run), reporter)
    axes = run.frame.panorama_axes().numpy()
    textures = _textures(run, baked, texels, options.albedo_scale * color, lit=not options.unlit)
    added = [
        (place, linear_pixels(texels.texture(np.broadcast_to(values, (len(values), 3)))))
        for place, values in baked.added
    ]
    return Textured(
        placement.scale * vertices @ axes,
        _unit(normals @ axes),
        unwrapped.uv,
        _drawn(unwrapped),
        *textures,
        _index(run),
        [] if options.unlit else added,
    )


def _presented(
    baked: Baked, light: NDArray[np.float32] | None, color: Tensor | None, index: float, reporter: Reporter
) -> tuple[NDArray[np.float32], Baked]:
    """Apply the color of the presentation, and divide radiance by the irradiance ``light`` [M, 3] if it is specified.

    The color of the presentation is applied to radiance and irradiance before the division.

    Returns:
        The base color [M, 3] in linear sRGB, and the texels with the reflectance of metals in the same color.
    """
    metal = colored_reflectance(torch.from_numpy(baked.reflectance), color).numpy()
    colors = colored(torch.from_numpy(baked.color), color).numpy()
    if light is not None:
        colors = delit(colors, colored(torch.from_numpy(light), color).numpy(), index)
        colors = _within_white(baked.filled(colors), baked, reporter)
    return colors, replace(baked, reflectance=metal)


def _within_white(color: NDArray[np.float32], baked: Baked, reporter: Reporter) -> NDArray[np.float32]:
    """Scale base colors [M, 3] without shading to at most ``WHITEST``, and clip outliers without a change of hue.

    The common factor of these colors is unknown. Brighter texels contain light that the environment lacks.
    """
    dielectric = color[baked.seen & (baked.metalness < 0.5)]
    brightest = float(np.quantile(dielectric.max(axis=1), 1 - BRIGHT_SHARE)) if len(dielectric) else 0.0
    if brightest > WHITEST:
        factor = WHITEST / brightest
        reporter.say(f"base color times {factor:.2f}, so that surfaces reflect at most {WHITEST:.0%}")
        color = color * np.float32(factor)
    limit = np.minimum(1, WHITEST / np.maximum(color.max(axis=1, keepdims=True), 1e-6))
    return color * limit.astype(np.float32)


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normalize vectors [V, 3]. A zero vector becomes +y."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 1e-9, vectors / np.maximum(length, 1e-9), [[0.0, 1.0, 0.0]])


def _drawn(mesh: Unwrapped) -> NDArray[np.int64]:
    a, b, c = mesh.faces.T
    return mesh.faces[(a != b) & (b != c) & (c != a)]


def _index(run: OpenedRun) -> float:
    return float(run.model.shading.refractive_index)


def _learned(normals: NDArray[np.float32], facing: NDArray[np.float32]) -> NDArray[np.float32]:
    """Normalize learned normals [M, 3]. Missing or inward normals are replaced by normals of the mesh."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    agrees = (length > 1e-3) & ((normals * facing).sum(axis=1, keepdims=True) > 0)
    return np.where(agrees, normals / np.maximum(length, np.float32(1e-3)), facing)


def _irradiance(
    texels: Texels,
    faces: NDArray[np.int64],
    arriving: NDArray[np.float64],
    normals: NDArray[np.float32],
    index: float,
) -> NDArray[np.float32]:
    """Interpolate incident light [V, K, 3] from vertices to texels, and return the irradiance [M, 3] of the texels."""
    count = arriving.shape[1]
    light = np.empty_like(normals)
    for begin in range(0, len(normals), _BATCH):
        part = slice(begin, begin + _BATCH)
        batch = replace(
            texels, index=texels.index[part], face=texels.face[part], weights=texels.weights[part]
        )
        between = batch.interpolated(faces, arriving.reshape(len(arriving), -1)).reshape(-1, count, 3)
        light[part] = irradiance(between, normals[part], index)
    return light


def _arriving(
    run: OpenedRun, mesh: ColoredMesh, inside: Inside | None, reporter: Reporter
) -> NDArray[np.float64]:
    """Return harmonics [V, K, 3] of the incident light at the vertices of the subject."""
    cubemap = needs_radiance(run.model.shading, what=WHAT)
    with reporter.track("reflected light", len(run.scene.train_views)) as progress:
        texels = mirrored_light(run, cubemap, progress)

    def radiance(directions: NDArray[np.float64]) -> NDArray[np.float64]:
        light = cubemap.radiance(cubemap_lookup(texels, torch.from_numpy(directions).float()))
        return np.asarray(light.double().numpy())

    around = Surroundings(radiance, mesh if inside is None else _joined(mesh, _outside(run, inside)))
    surface = mesh.surface
    with reporter.track("light on the surface", len(surface.vertices)) as progress:
        return arriving_light(surface.vertices, surface.normals, around, progress)


def _outside(run: OpenedRun, inside: Inside) -> ColoredMesh:
    """Return a mesh of the scene outside the subject. It casts shadows on the subject and reflects light to it."""
    surface, views, box = fused_surface(run.cameras, run.result, resolution=SURROUNDINGS_RESOLUTION)
    mesh = painted(surface, views, box)
    faces = surface.faces[~inside(surface.vertices)[surface.faces].any(axis=1)]
    outside, used = mesh.surface.with_faces(faces)
    return ColoredMesh(outside, mesh.colors[used])


def _joined(first: ColoredMesh, second: ColoredMesh) -> ColoredMesh:
    a = first.surface
    b = second.surface
    surface = Surface(
        np.concatenate([a.vertices, b.vertices]),
        np.concatenate([a.faces, b.faces + len(a.vertices)]),
        np.concatenate([a.normals, b.normals]),
    )
    return ColoredMesh(surface, np.concatenate([first.colors, second.colors]))


def _textures(
    run: OpenedRun, baked: Baked, texels: Texels, color: NDArray[np.float32], *, lit: bool
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None, NDArray[np.uint8] | None]:
    """Return the base color, surface and specular textures of ``Textured``."""
    if not lit:
        return color_pixels(texels.texture(color)), None, None
    metal = baked.metalness[:, None]
    mixed = (1 - metal) * color + metal * baked.reflectance
    surface = np.stack([np.zeros_like(baked.roughness), baked.roughness, baked.metalness], axis=1)
    shading = run.model.shading
    specular = None
    if isinstance(shading, DeferredShading) and shading.blend == "fresnel":
        # The file has one refractive index. A factor gives texels with another index the right reflectance.
        ratio = _normal_reflectance(baked.index) / _normal_reflectance(np.float32(_index(run)))
        specular = linear_pixels(texels.texture((baked.strength * ratio)[:, None]))[..., 0]
    return color_pixels(texels.texture(mixed)), linear_pixels(texels.texture(surface)), specular


def _normal_reflectance(index: NDArray[np.float32] | np.float32) -> NDArray[np.float32]:
    return np.asarray(((index - 1) / (index + 1)) ** 2, np.float32)
