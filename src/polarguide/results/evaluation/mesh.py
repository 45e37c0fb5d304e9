"""The mesh of a run against the true depths of the test views: accuracy, completeness and F-score."""

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
"""Distances that count as right, as shares of the object's diagonal, by the end of their keys."""
BEHIND = 0.02
"""A point this share of the diagonal behind the true surface is hidden by it."""
SPACING = 0.002
"""Distance of the points that stand for the mesh, as a share of the diagonal."""
MOST_POINTS = 1_000_000
"""Faces are not divided further when this many points stand for the mesh."""
TRUE_SPACING = 0.0025
"""Largest distance of neighboring true points on surfaces that face the camera, as a share of the diagonal."""
FINEST = 6
Points = NDArray[np.float64]


def mesh_scores(surface: Callable[[], Surface], views: Sequence[View]) -> Mapping[str, float | str]:
    """The scores of the mesh that ``polarguide export --format mesh`` writes, by key.

    Args:
        surface: makes it, as the export does. views: the test views; those with a true depth count.

    Returns:
        Shares in [0, 1]; nothing where no depth is known. Where there is no surface to fuse, all are 0. Where a library
        is missing, ``mesh_fscore_1_reason`` alone, which names it.
    """
    measured = [
        view for view in views if view.ground_truth is not None and view.ground_truth.depth is not None
    ]
    if not any(bool(_known(view)[1].any()) for view in measured):
        return {}
    lacking = missing_package()
    if lacking is not None:
        return {"mesh_fscore_1_reason": lacking}
    try:
        mesh = surface()
    except NoSurfaceError:
        return {
            f"mesh_{name}_{end}": 0.0 for end in THRESHOLDS for name in ("accuracy", "completeness", "fscore")
        }
    return surface_scores(mesh, measured)


def missing_package() -> str | None:
    """Which package that makes a mesh is not installed; None where all are."""
    for module in EXPORT_PACKAGES["mesh"]:
        try:
            require_package(module, MESH_LABEL)
        except PolarguideError as error:
            return f"not installed: {error.expected}; polarguide doctor has the command that adds it"
    return None


def surface_scores(surface: Surface, views: Sequence[View]) -> dict[str, float]:
    """The scores of a mesh against views with true depths, of which some belong to the foreground."""
    foreground = np.concatenate([true_points(view)[0] for view in views])
    low = foreground.min(axis=0)
    high = foreground.max(axis=0)
    steps = [depth[front] / view.camera.fx for view in views for depth, front, _ in [_known(view)]]
    spacing = float(torch.cat(steps).median())
    diagonal = float(np.linalg.norm(high - low))
    reach = BEHIND * diagonal
    finer = int(np.clip(np.ceil(spacing / (TRUE_SPACING * diagonal)), 1, FINEST)) if diagonal > 0 else 1
    points = [true_points(view, finer) for view in views]
    front, whole = (np.concatenate(parts) for parts in zip(*points, strict=True))
    inside = ((surface.vertices > low - reach) & (surface.vertices < high + reach)).all(axis=1)
    samples, areas = _sampled(surface, inside | judged(surface.vertices, views, reach), SPACING * diagonal)
    counted = judged(samples, views, reach)
    judged_area = float(areas[counted].sum())
    scores: dict[str, float] = {}
    farthest = 1.01 * max(THRESHOLDS.values()) * diagonal
    to_true = _distances(samples[counted], whole, farthest)
    to_mesh = _distances(front, samples, farthest)
    for end, share in THRESHOLDS.items():
        right = to_true <= share * diagonal
        accuracy = float(areas[counted][right].sum()) / judged_area if judged_area else 0.0
        completeness = float((to_mesh <= share * diagonal).mean())
        both = accuracy + completeness
        scores[f"mesh_accuracy_{end}"] = accuracy
        scores[f"mesh_completeness_{end}"] = completeness
        scores[f"mesh_fscore_{end}"] = 2 * accuracy * completeness / both if both else 0.0
    return scores


def true_points(view: View, finer: int = 1) -> tuple[Points, Points]:
    """World points [M, 3] of a view's true depth: of the foreground (of all, without a mask), and of everything.

    Args:
        finer: how many times as many points as pixels there are each way on the smooth parts of the foreground.
            Between pixels inverse depth is interpolated, which is exact on planes.
    """
    depth, front, whole = _known(view)
    camera = view.camera
    near = depth
    places = [seen_points(camera, depth, front)]
    if finer > 1:
        smooth = _inner(depth, front)
        camera = camera.scaled(finer, finer * camera.width, finer * camera.height)
        inverse = torch.where(depth > 0, 1 / depth.clamp(min=1e-9), torch.zeros_like(depth))
        near = _enlarged(inverse, finer, "bilinear").clamp(min=1e-9).reciprocal()
        places.append(seen_points(camera, near, _enlarged(smooth.double(), finer, "nearest-exact") > 0))
    fine = torch.cat(places)
    return fine.numpy(), torch.cat((fine, seen_points(view.camera, depth, whole & ~front))).numpy()


def _inner(depth: Tensor, front: Tensor) -> Tensor:
    """Pixels [H, W] all of whose neighbors belong to the foreground, at similar depths."""
    inner = minimum_filter(front.numpy(), size=3, mode="nearest")
    return torch.from_numpy(inner & ~jumps(depth))


def _enlarged(values: Tensor, factor: int, mode: str) -> Tensor:
    return torch.nn.functional.interpolate(values[None, None], scale_factor=factor, mode=mode)[0, 0]


def judged(points: Points, views: Sequence[View], reach: float) -> NDArray[np.bool_]:
    """Whether some view sees a point [N, 3] inside its foreground, at most ``reach`` behind the true surface.

    Inside: not in a pixel beside the foreground's edge or a jump of the true depth. There surfaces are seen so flat
    that true points lie too far apart to measure a distance to them.
    """
    visible = torch.zeros(len(points), dtype=torch.bool)
    for view in views:
        depth, front, _ = _known(view)
        pixel, z, within = seen_at(torch.from_numpy(points) - view.camera.center, view.camera)
        visible |= within & _inner(depth, front)[pixel] & (z <= depth[pixel] + reach)
    return visible.numpy()


def _known(view: View) -> tuple[Tensor, Tensor, Tensor]:
    """True depth [H, W], and where it counts: in the foreground (everywhere, without a mask), and at all."""
    truth = view.ground_truth
    assert truth is not None
    assert truth.depth is not None
    whole = (truth.depth > 0) & ~view.invalid
    return truth.depth.double(), whole if truth.mask is None else whole & truth.mask, whole


def _sampled(surface: Surface, used: NDArray[np.bool_], spacing: float) -> tuple[Points, NDArray[np.float64]]:
    """Points [N, 3] on the faces of which some vertex is used, and the area [N] that each point stands for.

    Every face is divided on its own into equal triangles with sides of about ``spacing``, and the points are their
    centers. A rounding error of one vertex therefore moves the points of its own faces only.
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
    """Barycentric coordinates [n * n, 3] of the centers of the triangles that divide a side into ``n`` parts."""
    first, second = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    upright = first + second < n
    turned = first + second < n - 1
    u = np.concatenate((first[upright] + 1 / 3, first[turned] + 2 / 3)) / n
    v = np.concatenate((second[upright] + 1 / 3, second[turned] + 2 / 3)) / n
    return np.stack((1 - u - v, u, v), axis=1)


def _distances(points: Points, others: Points, farthest: float) -> Points:
    """From each point to the nearest of the others; infinite where that is ``farthest`` away or more."""
    if not len(others):
        return np.full(len(points), np.inf)
    return np.asarray(cKDTree(others).query(points, distance_upper_bound=farthest)[0], np.float64)
