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
"""Distances that count as correct, relative to the object's diagonal, by the suffix of their keys."""
BEHIND = 0.02
"""Distance behind the true surface, relative to the diagonal, above which a point is hidden."""
SPACING = 0.002
"""Distance of sample points on the mesh, relative to the diagonal."""
MOST_POINTS = 1_000_000
"""Approximate maximum number of sample points on the mesh."""
TRUE_SPACING = 0.0025
"""Maximum distance of true points on surfaces that face the camera, relative to the diagonal."""
FINEST = 6
"""Maximum upsampling of a true depth map."""
Points = NDArray[np.float64]


def mesh_scores(surface: Callable[[], Surface], views: Sequence[View]) -> Mapping[str, float | str]:
    """Score the mesh that ``polarguide export --format mesh`` writes.

    Args:
        surface: computes the mesh like the export. views: the test views; views without a true depth are
            ignored.

    Returns:
        Shares in [0, 1] by key; empty without a true depth. All are 0 if there is no surface to fuse. If a
        package is missing, the result is only ``mesh_fscore_1_reason``.
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
    """Return a message if a package for meshes is not installed, else None."""
    for module in EXPORT_PACKAGES["mesh"]:
        try:
            require_package(module, MESH_LABEL)
        except PolarguideError as error:
            return f"not installed: {error.expected}; polarguide doctor prints the command that installs it"
    return None


def surface_scores(surface: Surface, views: Sequence[View]) -> dict[str, float]:
    """Score a mesh against views with true depths. At least one view must show the foreground."""
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
    """Return world points [M, 3] of a view's true depth: those of the foreground, and those of all pixels.

    The foreground is the whole picture if there is no mask.

    Args:
        finer: factor on the number of points per side of the smooth parts of the foreground. Inverse depth is
            interpolated between pixels, which is exact on planes.
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
    """Return the pixels [H, W] whose neighbors all belong to the foreground and have similar depths."""
    inner = minimum_filter(front.numpy(), size=3, mode="nearest")
    return torch.from_numpy(inner & ~jumps(depth))


def _enlarged(values: Tensor, factor: int, mode: str) -> Tensor:
    return torch.nn.functional.interpolate(values[None, None], scale_factor=factor, mode=mode)[0, 0]


def judged(points: Points, views: Sequence[View], reach: float) -> NDArray[np.bool_]:
    """Return [N] bool: True for points [N, 3] that some view sees in its foreground and not behind the surface.

    A point up to ``reach`` behind the true surface is visible. Pixels next to the foreground's edge or to a
    jump of the true depth are excluded. Surfaces there are oblique, and the true points are too sparse for a
    distance.
    """
    visible = torch.zeros(len(points), dtype=torch.bool)
    for view in views:
        depth, front, _ = _true_depth(view)
        pixel, z, within = seen_at(torch.from_numpy(points) - view.camera.center, view.camera)
        visible |= within & _inner(depth, front)[pixel] & (z <= depth[pixel] + reach)
    return visible.numpy()


def _true_depth(view: View) -> tuple[Tensor, Tensor, Tensor]:
    """Return the true depth [H, W], the foreground pixels with a depth, and all pixels with a depth.

    The foreground is the whole picture if there is no mask.
    """
    truth = view.ground_truth
    assert truth is not None
    assert truth.depth is not None
    known = (truth.depth > 0) & ~view.invalid
    return truth.depth.double(), known if truth.mask is None else known & truth.mask, known


def _sampled(surface: Surface, used: NDArray[np.bool_], spacing: float) -> tuple[Points, NDArray[np.float64]]:
    """Sample points [N, 3] on faces with a used vertex, and return the area [N] of each point.

    Each face is divided separately into equal triangles with sides of about ``spacing``. The points are their
    centers. So the rounding error of a vertex moves only points of its own faces.
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
    """Return barycentric coordinates [n * n, 3] of the centers of triangles that divide each side into ``n`` parts."""
    first, second = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    upright = first + second < n
    turned = first + second < n - 1
    u = np.concatenate((first[upright] + 1 / 3, first[turned] + 2 / 3)) / n
    v = np.concatenate((second[upright] + 1 / 3, second[turned] + 2 / 3)) / n
    return np.stack((1 - u - v, u, v), axis=1)


def _distances(points: Points, others: Points, farthest: float) -> Points:
    """Return the distance from each point to the nearest other point; infinite at ``farthest`` or beyond."""
    if not len(others):
        return np.full(len(points), np.inf)
    return np.asarray(cKDTree(others).query(points, distance_upper_bound=farthest)[0], np.float64)
