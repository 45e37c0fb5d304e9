"""Scores of the mesh of a run against the true depths of the test views: accuracy, completeness and F-score."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree
from torch import Tensor

from polarguide.capture import View
from polarguide.core.errors import PolarguideError, require_package
from polarguide.core.options import EXPORT_PACKAGES
from polarguide.geometry.camera import seen_at
from polarguide.results.evaluation.table import MESH_LABEL
from polarguide.results.evaluation.target import jumps
from polarguide.results.rendering.mesh import NoSurfaceError, Surface, seen_points

THRESHOLDS = {"05": 0.005, "1": 0.01}
"""Distance up to which a point counts as correct, relative to the object's diagonal, by suffix of the score's key."""
BEHIND = 0.02
"""Distance behind the true surface above which a point counts as hidden, relative to the diagonal."""
SPACING = 0.002
"""Distance between sample points on the mesh, relative to the diagonal."""
MOST_POINTS = 1_000_000
"""Approximate maximum number of sample points on the mesh."""
TRUE_SPACING = 0.0025
"""Maximum distance between neighboring true points on surfaces that face the camera, relative to the diagonal."""
FINEST = 6
"""Maximum factor by which the sides of a true depth map are upsampled."""
Points = NDArray[np.float64]


def mesh_scores(surface: Callable[[], Surface], views: Sequence[View]) -> Mapping[str, float | str]:
    """Score the mesh that ``polarguide export --format mesh`` writes.

    Args:
        surface: computes the mesh in the same way as the export.
        views: the test views; views without a true depth are ignored.

    Returns:
        Scores in [0, 1] by key; empty without a true depth. All scores are 0 if fusion finds no surface. If a package
        is missing, the only entry is the text ``mesh_fscore_1_reason``.
    """
    measured = [
        view for view in views if view.ground_truth is not None and view.ground_truth.depth is not None
    ]
    if not any(bool(_true_depth(view)[1].any()) for view in measured):
        return {}
    reason = missing_package()
    if reason is not None:
        return {"mesh_fscore_1_reason": reason}
    try:
        mesh = surface()
    except NoSurfaceError:
        return {
            f"mesh_{name}_{end}": 0.0 for end in THRESHOLDS for name in ("accuracy", "completeness", "fscore")
        }
    return surface_scores(mesh, measured)


def missing_package() -> str | None:
    """Return a message about a missing package for meshes, or None if all packages are installed."""
    for module in EXPORT_PACKAGES["mesh"]:
        try:
            require_package(module, MESH_LABEL)
        except PolarguideError as error:
            return f"not installed: {error.expected}; polarguide doctor prints the command that installs it"
    return None


def surface_scores(surface: Surface, views: Sequence[View]) -> dict[str, float]:
    """Score a mesh against true depths. At least one view must show the foreground."""
    foreground = np.concatenate([true_points(view)[0] for view in views])
    low = foreground.min(axis=0)
    high = foreground.max(axis=0)
    steps = [depth[front] / view.camera.fx for view in views for depth, front, _ in [_true_depth(view)]]
    spacing = float(torch.cat(steps).median())
    diagonal = float(np.linalg.norm(high - low))
    reach = BEHIND * diagonal
    finer = int(np.clip(np.ceil(spacing / (TRUE_SPACING * diagonal)), 1, FINEST)) if diagonal > 0 else 1
    points = [true_points(view, finer) for view in views]
    front_points, all_points = (np.concatenate(parts) for parts in zip(*points, strict=True))
    inside = ((surface.vertices > low - reach) & (surface.vertices < high + reach)).all(axis=1)
    samples, areas = _sampled(surface, inside | judged(surface.vertices, views, reach), SPACING * diagonal)
    counted = judged(samples, views, reach)
    judged_area = float(areas[counted].sum())
    scores: dict[str, float] = {}
    farthest = 1.01 * max(THRESHOLDS.values()) * diagonal
    to_true = _distances(samples[counted], all_points, farthest)
    to_mesh = _distances(front_points, samples, farthest)
    for end, share in THRESHOLDS.items():
        correct = to_true <= share * diagonal
        accuracy = float(areas[counted][correct].sum()) / judged_area if judged_area else 0.0
        completeness = float((to_mesh <= share * diagonal).mean())
        both = accuracy + completeness
        scores[f"mesh_accuracy_{end}"] = accuracy
        scores[f"mesh_completeness_{end}"] = completeness
        scores[f"mesh_fscore_{end}"] = 2 * accuracy * completeness / both if both else 0.0
    return scores


def true_points(view: View, finer: int = 1) -> tuple[Points, Points]:
    """Convert the true depth of a view to world points [M, 3], for the foreground and for all pixels.

    Without a mask, the foreground is the whole picture.

    Args:
        finer: factor by which smooth parts of the foreground are upsampled per side. Inverse depth is interpolated
            between pixels, which is exact on planes.
    """
    depth, front, known = _true_depth(view)
    camera = view.camera
    points = seen_points(camera, depth, front)
    if finer > 1:
        smooth = _enlarged(_inner(depth, front).double(), finer, "nearest-exact") > 0
        fine_camera = camera.scaled(finer, finer * camera.width, finer * camera.height)
        inverse = torch.where(depth > 0, 1 / depth.clamp(min=1e-9), torch.zeros_like(depth))
        fine_depth = _enlarged(inverse, finer, "bilinear").clamp(min=1e-9).reciprocal()
        points = torch.cat((points, seen_points(fine_camera, fine_depth, smooth)))
    return points.numpy(), torch.cat((points, seen_points(camera, depth, known & ~front))).numpy()


def _inner(depth: Tensor, front: Tensor) -> Tensor:
    """Return a mask [H, W] of pixels whose neighbors all belong to the foreground and have similar depths."""
    inner = minimum_filter(front.numpy(), size=3, mode="nearest")
    return torch.from_numpy(inner & ~jumps(depth))


def _enlarged(values: Tensor, factor: int, mode: str) -> Tensor:
    return torch.nn.functional.interpolate(values[None, None], scale_factor=factor, mode=mode)[0, 0]


def judged(points: Points, views: Sequence[View], reach: float) -> NDArray[np.bool_]:
    """Return a mask [N] of the points [N, 3] that are visible in the foreground of at least one view.

    A point counts as visible if it is at most ``reach`` behind the true surface. Pixels next to the edge of the
    foreground or to a jump of the true depth are excluded. Surfaces are oblique there, so the true points are too
    sparse to measure a distance.
    """
    visible = torch.zeros(len(points), dtype=torch.bool)
    for view in views:
        depth, front, _ = _true_depth(view)
        pixel, z, within = seen_at(torch.from_numpy(points) - view.camera.center, view.camera)
        visible |= within & _inner(depth, front)[pixel] & (z <= depth[pixel] + reach)
    return visible.numpy()


def _true_depth(view: View) -> tuple[Tensor, Tensor, Tensor]:
    """Return the true depth [H, W], the foreground pixels with a depth, and all pixels with a depth.

    Without a mask, the foreground is the whole picture.
    """
    truth = view.ground_truth
    assert truth is not None
    assert truth.depth is not None
    known = (truth.depth > 0) & ~view.invalid
    return truth.depth.double(), known if truth.mask is None else known & truth.mask, known


def _sampled(surface: Surface, used: NDArray[np.bool_], spacing: float) -> tuple[Points, NDArray[np.float64]]:
    """Sample points [N, 3] on faces with a used vertex, and return the area [N] of each point.

    Each face is divided into equal triangles with sides of about ``spacing``. The points are the centers of these
    triangles. Faces are divided independently, so the rounding error of a vertex moves only points of its own faces.
    """
    corners = surface.vertices[surface.faces[used[surface.faces].any(axis=1)]]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1) / 2
    spacing = max(spacing, float(np.sqrt(area.sum() / MOST_POINTS)))
    divisions = np.maximum(np.rint(np.sqrt(area) / spacing), 1).astype(int)
    points = [np.zeros((0, 3))]
    areas = [np.zeros(0)]
    for n in np.unique(divisions):
        chosen = divisions == n
        centers = _centers(int(n))
        points.append((centers @ corners[chosen]).reshape(-1, 3))
        areas.append(np.repeat(area[chosen] / len(centers), len(centers)))
    return np.concatenate(points), np.concatenate(areas)


def _centers(n: int) -> Points:
    """Return the barycentric coordinates [n * n, 3] of the centers of n * n equal parts of a triangle."""
    first, second = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    upright = first + second < n
    turned = first + second < n - 1
    u = np.concatenate((first[upright] + 1 / 3, first[turned] + 2 / 3)) / n
    v = np.concatenate((second[upright] + 1 / 3, second[turned] + 2 / 3)) / n
    return np.stack((1 - u - v, u, v), axis=1)


def _distances(points: Points, others: Points, farthest: float) -> Points:
    """Return the distance from each point to the nearest point of ``others``, or infinity from ``farthest`` on."""
    if not len(others):
        return np.full(len(points), np.inf)
    return np.asarray(cKDTree(others).query(points, distance_upper_bound=farthest)[0], np.float64)
