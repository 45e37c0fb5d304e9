"""Initial Gaussians: at the SfM points, and in a shell far around the capture for its surroundings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from polarguide.gaussians.harmonics import SH_C0


@dataclass(frozen=True)
class Initialization:
    """Settings of the initial Gaussians that are added to the SfM points.

    Attributes:
        shell: number of Gaussians in a shell far around the capture, for surroundings that SfM does not triangulate. No
            random Gaussians are added inside the shell, because they become haze in front of the cameras.
        shell_radii: inner and outer radius of the shell around the median of the points, in units of the cameras'
            distance. At these distances Gaussians have almost no parallax, like the sky and the horizon.
        near_radii: the same, used instead if any training view has too few polarizer angles to measure Stokes vectors,
            also in ordinary photographs. There, distant Gaussians behind a transparent surface could explain the
            reflection of a distant light.
        opacity: initial opacity of all Gaussians.
    """

    shell: int = 4000
    shell_radii: tuple[float, float] = (50.0, 200.0)
    near_radii: tuple[float, float] = (3.0, 12.0)
    opacity: float = 0.1


def scene_extent(centers: Tensor) -> float:
    """Return the extent of a scene: 1.1 times the largest distance of a camera from the cameras' mean.

    The definition is from Kerbl et al. 2023.

    Args:
        centers: [V, 3] camera centers.
    """
    return 1.1 * float((centers - centers.mean(dim=0)).norm(dim=1).max())


def neighbor_distance(points: np.ndarray) -> np.ndarray:
    """Return the root mean squared distance [M] of each point [M, 3] to its three nearest neighbors."""
    neighbors = min(4, len(points))
    distance, _ = cKDTree(points).query(points, k=neighbors)
    distance = np.asarray(distance).reshape(len(points), -1)[:, 1:]
    if distance.shape[1] == 0:
        return np.full(len(points), 0.01)
    return np.sqrt((distance**2).mean(axis=1)).clip(min=1e-7)


def camera_reach(points: np.ndarray, cameras: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the median of the points [M, 3], and a distance from it that 90 % of the cameras [V, 3] do not exceed."""
    middle = np.median(points, axis=0)
    return middle, float(np.quantile(np.linalg.norm(cameras - middle, axis=1), 0.9))


def stretch_steps(means: Tensor, before: Tensor, middle: Tensor, reach: float) -> None:
    """Lengthen, in place, the steps of Gaussians beyond the cameras in proportion to their distance.

    The step of a Gaussian then has the same size in a picture at every distance.

    Args:
        means: [N, 3] positions after the step.
        before: [N, 3] positions before the step.
        middle: [3] median of the points.
        reach: distance of the cameras from the median.
    """
    factor = ((before - middle).norm(dim=1, keepdim=True) / reach).clamp(min=1)
    means.copy_(torch.where(factor > 1, torch.lerp(before, means, factor), means))


def far_away(means: Tensor, points: Tensor, centers: Tensor, share: float = 1.0) -> Tensor:
    """Return a mask [N], True for positions [N, 3] that are far from the median of the points.

    The limit is ``share`` times the distance of the cameras.

    Args:
        means: [N, 3] positions.
        points: [M, 3] SfM points.
        centers: [V, 3] camera centers.
        share: share of ``camera_reach``.
    """
    middle, radius = camera_reach(points.double().numpy(), centers.double().numpy())
    return (means.double() - torch.from_numpy(middle)).norm(dim=1) > share * radius


def initial_parameters(
    points: Tensor, colors: Tensor, centers: Tensor, settings: Initialization, *, seed: int
) -> dict[str, Tensor]:
    """Return the parameters of the initial Gaussians.

    Args:
        points: [M, 3] SfM points.
        colors: [M, 3] linear colors in [0, 1].
        centers: [V, 3] camera centers.
        settings: number and place of added Gaussians, and the opacity.
        seed: seed of the random positions and orientations.

    Returns:
        The tensors of ``CORE_SHAPES`` by name, float32.
    """
    random = np.random.default_rng(seed)
    sfm = points.double().numpy()
    cameras = centers.double().numpy()
    middle, radius = camera_reach(sfm, cameras)
    directions = random.normal(size=(settings.shell, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    near, far = (radius * r for r in settings.shell_radii)
    # Evenly spaced in 1/distance, like parallax.
    away = 1 / (1 / near + (1 / far - 1 / near) * random.random(settings.shell))
    added = middle + directions * away[:, None]
    means = np.concatenate((sfm, added))
    gray = colors.double().mean(dim=0, keepdim=True).numpy() if len(sfm) else np.full((1, 3), 0.5)
    rgb = np.concatenate((colors.double().numpy(), np.repeat(gray, len(added), axis=0)))
    # The spacing is measured within each kind, so that dense SfM points do not shrink Gaussians of the shell.
    parts = (sfm, added)
    spacing = np.concatenate([neighbor_distance(part) for part in parts if len(part)])
    count = len(means)
    parameters = {
        "means": means,
        "quaternions": random.normal(size=(count, 4)),
        "log_scales": np.repeat(np.log(spacing)[:, None], 3, axis=1),
        "opacity_logits": np.full(count, np.log(settings.opacity / (1 - settings.opacity))),
        "sh_dc": (rgb - 0.5) / SH_C0,
        "sh_rest": np.zeros((count, 15, 3)),
    }
    return {name: torch.from_numpy(values).float() for name, values in parameters.items()}
