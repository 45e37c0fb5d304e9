"""A trained scene as a triangle mesh with the normals and the diffuse colors that were learned."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polarguide.camera import Camera, seen_at
from polarguide.errors import PolarguideError, optional_import
from polarguide.rendering.fusion import TRUNCATION, Box, Surface, box_around, fuse, seen_points, surface_of
from polarguide.scene_frame import scene_frame
from polarguide.shading.result import RenderResult
from polarguide.vectors import dot, unit

RESOLUTION = 192
"""Voxels along the longest side, unless something else is asked for."""
OPAQUE = 0.8
COARSE = 64
"""Voxels along the sides of the box in which a field's surface is looked for."""
# Pixels whose surface is seen at a flatter angle than this cosine do not give depth.
_STEEPEST = 0.1


@dataclass(frozen=True, eq=False)
class ColoredMesh:
    """A mesh with linear diffuse colors [V, 3] in [0, 1]."""

    surface: Surface
    colors: NDArray[np.float64]

    def within(self, kept: NDArray[np.bool_]) -> ColoredMesh:
        """The faces all of whose vertices are kept, [V] bool.

        Raises:
            PolarguideError: there are none.
        """
        faces = self.surface.faces[kept[self.surface.faces].all(axis=1)]
        if not len(faces):
            raise PolarguideError(
                "the crop box", expected="a surface in it", found="none", remedy="Make it larger, or move it."
            )
        used, numbers = np.unique(faces, return_inverse=True)
        surface = Surface(
            self.surface.vertices[used], numbers.reshape(faces.shape), self.surface.normals[used]
        )
        return ColoredMesh(surface, self.colors[used])


@torch.no_grad()
def scene_mesh(
    cameras: Mapping[str, Camera], render: Callable[[Camera], RenderResult], *, resolution: int
) -> ColoredMesh:
    """Fuse the depth that a scene's cameras see.

    Args:
        cameras: at least two. render: gives a view with depth and normals.
        resolution: voxels along the longest side of what the cameras see.

    Raises:
        PolarguideError: there is no surface, or a library is missing.
    """
    surface, views, box = fused_surface(cameras, render, resolution=resolution)
    return painted(surface, views, box)


@torch.no_grad()
def fused_surface(
    cameras: Mapping[str, Camera], render: Callable[[Camera], RenderResult], *, resolution: int
) -> tuple[Surface, list[tuple[Camera, Seen]], Box]:
    """The surface of ``scene_mesh`` before it is painted, what each camera saw of it, and the grid it was fused in."""
    optional_import("skimage.measure", "a mesh")
    views = [(camera, _kept(render(camera).to("cpu"), camera)) for camera in cameras.values()]
    around = scene_frame(list(cameras.values()))
    points = [seen_points(camera, seen.depth, seen.mask) for camera, seen in views]
    box = box_around(points, around.center, around.distance, resolution)
    field, weight = fuse(box, ((camera, seen.depth, seen.mask) for camera, seen in views))
    return surface_of(box, field, weight), views, box


class ImplicitModel(Protocol):
    """A model whose surface is the zero set of a signed distance: see ``neural.model.FieldModel``."""

    def lattice(self, axes: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        """Distances [X, Y, Z] in world units, positive outside, at all combinations of world coordinates."""

    def surface(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Unit normals and linear colors, [N, 3] each, at places [N, 3] of the surface."""


def implicit_surface(cameras: Mapping[str, Camera], model: ImplicitModel, *, resolution: int) -> Surface:
    """The zero set of a model's distance, where at least two cameras may see it: nearer than their own distance.

    Args:
        cameras: at least two. model: of the run. resolution: voxels along the longest side.

    Raises:
        PolarguideError: there is no surface, or a library is missing.
    """
    optional_import("skimage.measure", "a mesh")
    around = scene_frame(list(cameras.values()))
    reach = around.distance
    coarse = 2 * reach / COARSE
    whole = Box(around.center - reach, coarse, (COARSE, COARSE, COARSE))
    places, distance = _sampled(whole, model)
    near = places[(distance.abs() < coarse) & (_in_pictures(cameras, places) >= 2)]
    box = box_around([near], around.center, reach, resolution)
    places, distance = _sampled(box, model)
    seen = _in_pictures(cameras, places)
    return surface_of(box, distance, seen)


def implicit_mesh(cameras: Mapping[str, Camera], model: ImplicitModel, *, resolution: int) -> ColoredMesh:
    """``implicit_surface`` with the model's own normals and colors; see there."""
    surface = implicit_surface(cameras, model, resolution=resolution)
    normals, colors = model.surface(torch.from_numpy(surface.vertices))
    return ColoredMesh(Surface(surface.vertices, surface.faces, normals.numpy()), colors.clamp(0, 1).numpy())


def _sampled(box: Box, model: ImplicitModel) -> tuple[Tensor, Tensor]:
    """Places [X, Y, Z, 3] of a box's voxels, and the distances [X, Y, Z] there."""
    x, y, z = (box.low[k] + box.size * (torch.arange(n) + 0.5) for k, n in enumerate(box.counts))
    return torch.stack(torch.meshgrid(x, y, z, indexing="ij"), dim=-1), model.lattice((x, y, z))


def _in_pictures(cameras: Mapping[str, Camera], places: Tensor) -> Tensor:
    """How many cameras have places [..., 3] in their pictures, hidden ones included: [...]."""
    counts = torch.zeros(places.shape[:-1])
    for camera in cameras.values():
        for part, count in zip(places, counts, strict=True):
            count += seen_at((part - camera.center).view(-1, 3), camera)[2].view(count.shape)
    return counts


@dataclass(frozen=True, eq=False)
class Seen:
    """Of one view: depth [H, W], where it counts [H, W], diffuse color and world normal [H, W, 3]."""

    depth: Tensor
    mask: Tensor
    diffuse: Tensor
    normal: Tensor


def _kept(result: RenderResult, camera: Camera) -> Seen:
    assert result.depth is not None
    assert result.normal is not None
    normal = unit(result.normal, 1e-3)
    cosine = -dot(camera.world_rays(), normal)
    diffuse = result.base if result.diffuse is None else result.diffuse
    return Seen(result.depth, (result.alpha > OPAQUE) & (cosine > _STEEPEST), diffuse, normal)


def painted(surface: Surface, views: list[tuple[Camera, Seen]], box: Box) -> ColoredMesh:
    """Colors and normals of the views that see each vertex, weighted by how squarely they do."""
    vertices = torch.from_numpy(surface.vertices)
    own = torch.from_numpy(surface.normals)
    color, normal = torch.zeros_like(vertices), torch.zeros_like(vertices)
    total = torch.zeros(len(vertices), dtype=torch.float64)
    for camera, seen in views:
        pixel, z, inside = seen_at(vertices - camera.center, camera)
        near = (seen.depth[pixel] - z).abs() < TRUNCATION * box.size
        squarely = dot(unit(camera.center - vertices), own).clamp(min=0)
        weight = (inside & near & seen.mask[pixel]) * squarely
        color += weight[:, None] * seen.diffuse[pixel]
        normal += weight[:, None] * seen.normal[pixel]
        total += weight
    # What no view sees squarely keeps the normal of its surface, and the color gray.
    learned = unit(normal, 1e-9)
    agrees = (total > 0) & (dot(learned, own) > 0)
    normals = torch.where(agrees[:, None], learned, own)
    colors = torch.where((total > 0)[:, None], color / total.clamp(min=1e-9)[:, None], 0.2)
    return ColoredMesh(Surface(surface.vertices, surface.faces, normals.numpy()), colors.clamp(0, 1).numpy())
