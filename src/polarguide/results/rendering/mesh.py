"""Triangle mesh of a scene with learned normals and diffuse colors.

Depth maps are fused to a truncated signed distance field (Curless and Levoy 1996). Its zero set is the
surface.

The subject of a run is the part of the scene that films, web pages and exported files show by default.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from polarguide.core.errors import PolarguideError, optional_import
from polarguide.core.progress import Reporter
from polarguide.core.text import command
from polarguide.geometry.camera import Camera, seen_at
from polarguide.geometry.scene_frame import scene_frame
from polarguide.geometry.vectors import dot, unit
from polarguide.runs.model import Within
from polarguide.runs.opened import OpenedRun
from polarguide.shading.result import RenderResult

TRUNCATION = 4.0
"""Truncation of the distance field, in voxels."""
_BATCH = 1 << 21  # voxels
_BOX_POINTS = 1 << 20
"""Approximate number of points, over all views, from which the bounding box is computed. It limits the memory."""


class NoSurfaceError(PolarguideError):
    """Error for a scene in which no surface is visible in several views."""


@dataclass(frozen=True, eq=False)
class Box:
    """Grid of voxels.

    Attributes:
        low: [3] corner.
        size: side of a voxel.
        counts: number of voxels per axis.
    """

    low: Tensor
    size: float
    counts: tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangle mesh: vertices [V, 3] (float64, world), faces [F, 3] and outward unit normals [V, 3]."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    normals: NDArray[np.float64]

    def with_faces(self, faces: NDArray[np.int64]) -> tuple[Surface, NDArray[np.int64]]:
        """Return the surface that consists of ``faces``, and the indices [K] of its vertices in this surface."""
        used, numbers = np.unique(faces, return_inverse=True)
        return Surface(self.vertices[used], numbers.reshape(faces.shape), self.normals[used]), used


def seen_points(camera: Camera, depth: Tensor, mask: Tensor) -> Tensor:
    """Convert the depths [H, W] of the pixels in ``mask`` [H, W] to world points [M, 3] float64."""
    rays = camera.rays()[mask].double()
    local = rays * (depth[mask].double() / rays[:, 2])[:, None]
    return camera.to_world(local) + camera.center


def box_around(points: Sequence[Tensor], center: Tensor, reach: float, resolution: int) -> Box:
    """Return a grid around the points that are nearer to the center than ``reach``.

    The outermost 0.5 % of the points are ignored as outliers.

    Raises:
        PolarguideError: there are too few points.
    """
    near = torch.cat([p[(p - center).norm(dim=1) < reach] for p in points])
    if len(near) < 100:
        raise NoSurfaceError(
            "mesh", expected="surfaces in front of the cameras", found="none", remedy="Train for more steps."
        )
    values = near.numpy()
    low = np.quantile(values, 0.005, axis=0)
    high = np.quantile(values, 0.995, axis=0)
    size = float((high - low).max()) / resolution
    low = low - 3 * size
    high = high + 3 * size
    nx, ny, nz = (int(n) for n in np.maximum(2, np.ceil((high - low) / size)))
    return Box(torch.from_numpy(low), size, (nx, ny, nz))


def fuse(box: Box, views: Iterable[tuple[Camera, Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Fuse depth maps to a truncated signed distance field.

    Args:
        box: the grid.
        views: camera, camera depth [H, W] and mask of valid pixels [H, W] of each view.

    Returns:
        Two float32 tensors of the shape of the grid. The first is the mean signed distance, divided by the truncation.
        It is in [-1, 1] and positive in front of the surface. The second is the number of views that contain each
        voxel.
    """
    total = torch.zeros(box.counts)
    weight = torch.zeros(box.counts)
    nx, ny, nz = box.counts
    step = max(1, _BATCH // (ny * nz))
    axes = [box.low[k] + box.size * (torch.arange(n) + 0.5) for k, n in enumerate(box.counts)]
    for camera, depth, mask in views:
        depths = torch.where(mask, depth, torch.zeros_like(depth)).flatten()
        turn = camera.rotation
        shift = camera.translation
        for begin in range(0, nx, step):
            part = slice(begin, min(begin + step, nx))
            local = [
                (turn[i, 0] * axes[0][part] + shift[i]).float()[:, None, None]
                + (turn[i, 1] * axes[1]).float()[None, :, None]
                + (turn[i, 2] * axes[2]).float()[None, None, :]
                for i in range(3)
            ]
            z = local[2].clamp(min=1e-6)
            column = (local[0] / z * camera.fx + camera.cx).floor()
            row = (local[1] / z * camera.fy + camera.cy).floor()
            inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            place = (
                row.clamp(0, camera.height - 1) * camera.width + column.clamp(0, camera.width - 1)
            ).long()
            surface = depths[place.flatten()].reshape(place.shape)
            distance = (surface - local[2]) / (TRUNCATION * box.size)
            counts = inside & (local[2] > 1e-6) & (surface > 0) & (distance > -1)
            total[part] += torch.where(counts, distance.clamp(max=1), 0.0)
            weight[part] += counts
    return total / weight.clamp(min=1), weight


LEAST_VIEWS = 2
"""Minimum number of views that must contain a voxel of the surface."""
SMALLEST_PIECE = 0.01
"""Minimum number of faces of a connected piece, relative to the largest piece. Smaller pieces are removed."""


def zero_surface(box: Box, field: Tensor, weight: Tensor) -> Surface:
    """Extract the surface of a distance field by marching cubes (Lewiner et al. 2003), and remove small pieces.

    Args:
        box: the grid.
        field, weight: results of ``fuse``.

    Raises:
        PolarguideError: scikit-image is not installed, or there is no surface.
    """
    marching_cubes: Callable[..., tuple[NDArray, NDArray, NDArray, NDArray]] = optional_import(
        "skimage.measure", "a mesh"
    ).marching_cubes
    certain = (weight >= LEAST_VIEWS).numpy()
    try:
        # The returned normals point to smaller values, into the surface; with "descent" the faces turn outward.
        vertices, faces, inward, _ = marching_cubes(
            field.numpy(), 0.0, mask=certain, gradient_direction="descent"
        )
    except (RuntimeError, ValueError):
        raise NoSurfaceError(
            "mesh", expected="a surface that several views see", found="none", remedy="Train for more steps."
        ) from None
    world = vertices.astype(np.float64) * box.size + box.low.numpy() + 0.5 * box.size
    return largest_pieces(Surface(world, faces.astype(np.int64), -inward.astype(np.float64)), SMALLEST_PIECE)


def largest_pieces(surface: Surface, smallest: float) -> Surface:
    """Remove connected pieces with fewer faces than ``smallest`` times the faces of the largest piece."""
    return surface.with_faces(large_faces(surface, smallest))[0]


def large_faces(surface: Surface, smallest: float) -> NDArray[np.int64]:
    """Return the faces [F, 3] that ``largest_pieces`` keeps."""
    piece = face_pieces(surface.faces)
    sizes = np.bincount(piece)
    return surface.faces[sizes[piece] >= smallest * sizes.max()]


def face_pieces(faces: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return the index [F] of the connected piece of each face [F, 3]."""
    ends = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    shape = (int(faces.max()) + 1,) * 2
    graph = coo_matrix((np.ones(len(ends), dtype=np.int8), (ends[:, 0], ends[:, 1])), shape=shape)
    return np.asarray(connected_components(graph, directed=False)[1][faces[:, 0]])


RESOLUTION = 192
"""Default number of voxels along the longest side."""
OPAQUE = 0.8
"""Minimum alpha of a pixel whose depth is used."""
COARSE = 64
"""Number of voxels along each side of the coarse grid in which the surface of a field is searched."""
# Least cosine of the viewing angle of pixels with a valid depth.
_STEEPEST = 0.1


@dataclass(frozen=True, eq=False)
class ColoredMesh:
    """A mesh with linear diffuse colors [V, 3] in [0, 1]."""

    surface: Surface
    colors: NDArray[np.float64]

    def within(self, vertices: NDArray[np.bool_]) -> ColoredMesh:
        """Return the part of the mesh inside a mask of vertices [V], without small pieces.

        A face is kept if the mask contains all of its vertices.

        Raises:
            PolarguideError: no face is left.
        """
        faces = self.surface.faces[vertices[self.surface.faces].all(axis=1)]
        if not len(faces):
            raise PolarguideError(
                "the crop box", expected="a surface inside", found="none", remedy="Enlarge or move the box."
            )
        surface, used = self.surface.with_faces(faces)
        large, kept = surface.with_faces(large_faces(surface, SMALLEST_PIECE))
        return ColoredMesh(large, self.colors[used[kept]])


@torch.no_grad()
def scene_mesh(
    cameras: Mapping[str, Camera], render: Callable[[Camera], RenderResult], *, resolution: int
) -> ColoredMesh:
    """Fuse depth maps of all cameras to a mesh with colors.

    Args:
        cameras: at least two cameras.
        render: renders depth and normals for a camera.
        resolution: number of voxels along the longest side of the box that the cameras see.

    Raises:
        PolarguideError: the depth maps have no surface, or a library for meshes is not installed.
    """
    surface, views, box = fused_surface(cameras, render, resolution=resolution)
    return painted(surface, views, box)


@torch.no_grad()
def fused_surface(
    cameras: Mapping[str, Camera], render: Callable[[Camera], RenderResult], *, resolution: int
) -> tuple[Surface, list[tuple[Camera, DepthSamples]], Box]:
    """Fuse depth maps to a surface without colors; return also the samples of each camera and the grid."""
    optional_import("skimage.measure", "a mesh")
    views = [(camera, _depth_samples(render(camera).to("cpu"), camera)) for camera in cameras.values()]
    around = scene_frame(list(cameras.values()))
    points = []
    for camera, samples in views:
        places = seen_points(camera, samples.depth, samples.mask)
        points.append(places[:: max(1, -(-len(places) // (_BOX_POINTS // len(views))))].clone())
    box = box_around(points, around.center, around.distance, resolution)
    field, weight = fuse(box, ((camera, samples.depth, samples.mask) for camera, samples in views))
    return zero_surface(box, field, weight), views, box


@dataclass(frozen=True, eq=False)
class DepthSamples:
    """Rendered depth [H, W], valid pixels [H, W], diffuse color and world normal [H, W, 3] of one view.

    Colors and normals have half precision, since all views are in memory together.
    """

    depth: Tensor
    mask: Tensor
    diffuse: Tensor
    normal: Tensor


def _depth_samples(result: RenderResult, camera: Camera) -> DepthSamples:
    normal = unit(result.normal, 1e-3)
    cosine = -dot(camera.world_rays(), normal)
    diffuse = result.layers.get("diffuse", result.base)
    return DepthSamples(
        result.depth, (result.alpha > OPAQUE) & (cosine > _STEEPEST), diffuse.half(), normal.half()
    )


def painted(surface: Surface, views: list[tuple[Camera, DepthSamples]], box: Box) -> ColoredMesh:
    """Color a surface by the mean color and normal of each vertex over the views that see it.

    The weight of a view is the cosine of its viewing angle.
    """
    vertices = torch.from_numpy(surface.vertices)
    own = torch.from_numpy(surface.normals)
    color = torch.zeros_like(vertices)
    normal = torch.zeros_like(vertices)
    total = torch.zeros(len(vertices), dtype=torch.float64)
    for camera, samples in views:
        pixel, z, inside = seen_at(vertices - camera.center, camera)
        near = (samples.depth[pixel] - z).abs() < TRUNCATION * box.size
        squarely = dot(unit(camera.center - vertices), own).clamp(min=0)
        weight = (inside & near & samples.mask[pixel]) * squarely
        color += weight[:, None] * samples.diffuse[pixel]
        normal += weight[:, None] * samples.normal[pixel]
        total += weight
    # Vertices without a view keep the normal of the surface, and are gray.
    learned = unit(normal, 1e-9)
    agrees = (total > 0) & (dot(learned, own) > 0)
    normals = torch.where(agrees[:, None], learned, own)
    colors = torch.where((total > 0)[:, None], color / total.clamp(min=1e-9)[:, None], 0.2)
    return ColoredMesh(Surface(surface.vertices, surface.faces, normals.numpy()), colors.clamp(0, 1).numpy())


Inside = Callable[[NDArray[Any]], NDArray[np.bool_]]
"""Function that maps points [N, 3] of the scene to a mask [N]: True for points of the subject."""


@dataclass(frozen=True, eq=False)
class Subject:
    """The part of a scene that is shown.

    Attributes:
        inside: function that selects the points of the part; None selects the whole scene.
        description: name of the part in messages.
    """

    inside: Inside | None
    description: str

    def holds(self, places: Tensor) -> Tensor:
        """Return a mask [N] on the device of the points [N, 3]: True for points of the subject."""
        if self.inside is None:
            return torch.ones(len(places), dtype=torch.bool, device=places.device)
        return torch.from_numpy(self.inside(places.detach().cpu().numpy())).to(places.device)

    def report_removed(self, inside: Tensor, run: OpenedRun, reporter: Reporter) -> None:
        """Report how many Gaussians belong to the part, and the commands that change the part.

        Without Gaussians outside the part, report no message.
        """
        count = int(inside.sum())
        if count < len(inside):
            reporter.say(
                f"{count:,} of {len(inside):,} Gaussians: {self.description}. "
                f"Everything: {command('present', run.folder, '--crop', 'all')}   "
                f"a box: {command('view', run.folder)}, Crop"
            )


def subject_of(run: OpenedRun, *, masked: bool = False) -> Subject:
    """Return the subject of a run.

    It is the crop box if the presentation has one. Otherwise it is the foreground of the masks, or without masks the
    region that the cameras see.

    A point belongs to the foreground if most of the pictures that contain it show it inside the mask. It belongs to the
    region of the cameras if most pictures contain it.

    Args:
        run: the run. If its scene has masks, the whole scene is read, otherwise only its poses.
        masked: restrict the subject to the foreground of the masks even if there is a crop box.

    Raises:
        PolarguideError: ``masked`` is set and the scene has no masks, or the scene is missing.
    """
    presentation = run.presentation
    if masked and not run.has_masks:
        raise PolarguideError(
            "--masked",
            expected="a scene with masks of the foreground (masks/)",
            found="none",
            remedy="Set a crop box instead: polarguide present RUN --crop.",
        )
    crop = presentation.crop
    if crop is not None:
        around = run.camera_frame

        def boxed(places: NDArray[Any]) -> NDArray[np.bool_]:
            return np.asarray(crop.inside(torch.from_numpy(places), around).numpy())

        if not masked:
            return Subject(boxed, "the content of the crop box")
        in_masks = _in_masks(run)
        return Subject(
            lambda places: boxed(places) & in_masks(places), "the content of the crop box and the masks"
        )
    if run.has_masks and (masked or not presentation.whole):
        return Subject(_in_masks(run), "the foreground in most of the scene's masks")
    if presentation.whole:
        return Subject(None, "everything")
    everywhere = [(camera, None) for camera in run.poses.values()]
    return Subject(_by_majority(everywhere), "the region in most of the pictures")


def part_shown(run: OpenedRun, reporter: Reporter) -> Within:
    """Return the function that restricts renderings of a film to the subject.

    Args:
        run: the run.
        reporter: receives a line about removed Gaussians.

    Raises:
        PolarguideError: the scene is missing.
    """
    subject = subject_of(run)
    inside = subject.holds(run.model.state.gaussians["means"])
    subject.report_removed(inside, run, reporter)
    return lambda _: inside


def _in_masks(run: OpenedRun) -> Inside:
    return _by_majority([(view.camera, view.mask.cpu()) for view in run.scene.views if view.mask is not None])


def _by_majority(views: Sequence[tuple[Camera, Tensor | None]]) -> Inside:
    """Return a function that selects each point with more votes for it than against it.

    Args:
        views: camera and mask [H, W] of each view. A view with a mask votes for points inside the mask and against
            points outside it. It has no vote on points outside its picture. A view without a mask votes against those.
    """

    def inside(places: NDArray[Any]) -> NDArray[np.bool_]:
        points = torch.from_numpy(places)
        votes = torch.zeros(len(points))
        for camera, mask in views:
            pixel, _, in_picture = seen_at(points - camera.center, camera)
            if mask is None:
                votes += torch.where(in_picture, 1.0, -1.0)
            else:
                votes += torch.where(mask[pixel], 1.0, -1.0) * in_picture
        return np.asarray((votes > 0).numpy())

    return inside
