"""Adaptive density control (Kerbl et al. 2023, Sec. 5.2): clone, split and prune, and their statistics.

The space just in front of each camera is assumed to be free of surfaces. A Gaussian in this space would explain one
picture and occlude all new views nearby. The SfM points that a camera sees limit the distance of its nearest surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.gaussians.gaussians import Gaussians
from polarguide.gaussians.geometry import quaternions_to_rotations
from polarguide.geometry.camera import Camera, seen_at


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """Balls around the cameras that contain no surface.

    Attributes:
        centers: [V, 3] camera centers.
        radii: [V] radii of the balls; 0 for a camera that sees no point.
    """

    centers: Tensor
    radii: Tensor

    def to(self, device: torch.device) -> FreeSpace:
        """Return the free space on a device."""
        return FreeSpace(self.centers.to(device), self.radii.to(device))

    def contains(self, means: Tensor) -> Tensor:
        """Return a mask [N], True for positions [N, 3] inside a ball."""
        return (torch.cdist(means, self.centers) < self.radii).any(dim=1)


def free_space(points: Tensor, cameras: Sequence[Camera], share: float, quantile: float) -> FreeSpace:
    """Compute the free space around each camera from the SfM points that it sees.

    Args:
        points: [M, 3] SfM points.
        cameras: the cameras.
        share: radius of the free space, as a share of the depth of the nearest points.
        quantile: quantile of the points' depths that is used as the depth of the nearest points.
    """
    radii = []
    for camera in cameras:
        _, depth, inside = seen_at(points.double() - camera.center, camera)
        depths = depth[inside]
        radii.append(share * float(torch.quantile(depths, quantile)) if len(depths) else 0.0)
    centers = torch.stack([camera.center for camera in cameras]).float()
    return FreeSpace(centers, torch.tensor(radii))


@dataclass(frozen=True)
class Densification:
    """Thresholds of the density control, which adds and removes Gaussians during a training.

    Attributes:
        every: number of steps between two rounds.
        gradient: mean gradient of the loss with respect to the projected center, in units of half a picture. Gaussians
            with a larger gradient are cloned or split.
        dense_share: share of the scene's extent. Larger Gaussians are split, and smaller Gaussians are cloned.
        minimum_opacity: opacity below which a Gaussian is pruned.
        maximum_scale_share: largest scale of Gaussians within the scene's extent, as a share of the extent. Larger
            Gaussians are pruned.
        far_scale_share: largest scale of Gaussians beyond the extent, as a share of their distance. It is a little more
            than the largest initial scale of distant Gaussians (``Initialization``).
        large_from: share of all steps after which huge Gaussians are pruned. The release begins at 3,000 of 30,000
            steps, which is the interval of its opacity resets.
        large_minimum: first step at which huge Gaussians may be pruned.
        pixels_each: least number of pixels of all training pictures for each Gaussian. A Gaussian has about sixty
            parameters, and a pixel has three values. With fewer than twenty pixels for each Gaussian, there are more
            unknowns than data.
        faint_pixels: least sum of the blending weights that a Gaussian must reach in at least one training picture.
            Fainter Gaussians are pruned at the end of the density control. About three in ten are fainter; they are
            invisible and take time. 0 disables this step.
        enough_views: number of training views from which on Gaussians in a single view are pruned, if the scene has no
            background.
        reset_opacity: opacity after a reset (Kerbl et al. 2023).
        free_share: ``share`` of ``free_space``.
        free_quantile: ``quantile`` of ``free_space``.
    """

    every: int = 100
    gradient: float = 2e-4
    dense_share: float = 0.01
    minimum_opacity: float = 0.005
    maximum_scale_share: float = 0.1
    far_scale_share: float = 0.25
    large_from: float = 0.1
    large_minimum: int = 700
    pixels_each: float = 20.0
    faint_pixels: float = 0.0
    enough_views: int = 12
    reset_opacity: float = 0.01
    free_share: float = 0.4
    free_quantile: float = 0.02

    def prunes_large(self, step: int, steps: int) -> bool:
        """Return True if the round after a step prunes huge Gaussians; ``steps`` is the number of all steps."""
        return step >= max(self.large_minimum, self.large_from * steps)


class DensityStatistics:
    """Gradient statistics of each Gaussian, from which the density control decides.

    The norms of the screen-space gradients are summed over the pictures in which the Gaussian was visible.

    Args:
        count: number N of Gaussians.
        device: device of the Gaussians.

    Attributes:
        gradient: sums of the gradient norms, [N].
        seen: numbers of pictures in which each Gaussian was visible, [N].
    """

    def __init__(self, count: int, device: torch.device | None = None) -> None:
        self._device = device
        self.clear(count)

    def add(self, screen_gradient: Tensor, radii: Tensor, width: int, height: int) -> None:
        """Add one picture.

        Args:
            screen_gradient: [N, 2] gradient per pixel, which is converted to units of half a picture.
            radii: [N] radii in pixels; 0 for invisible Gaussians.
            width, height: size of the picture.
        """
        x, y = screen_gradient.unbind(1)
        norm = torch.stack((x * (width / 2), y * (height / 2)), dim=1).norm(dim=1)
        self.gradient += norm
        self.seen += (radii > 0).to(self.seen)

    def mean(self) -> Tensor:
        """Return the mean gradient norm, [N]; 0 for invisible Gaussians."""
        return self.gradient / self.seen.clamp(min=1)

    def clear(self, count: int) -> None:
        """Reset the sums for ``count`` Gaussians."""
        self.gradient = torch.zeros(count, device=self._device)
        self.seen = torch.zeros(count, device=self._device)


@torch.no_grad()
def densify(
    gaussians: Gaussians,
    statistics: DensityStatistics,
    settings: Densification,
    *,
    extent: float,
    middle: Tensor,
    prune_large: bool,
    empty: FreeSpace | None = None,
    limit: int,
    generator: torch.Generator,
) -> None:
    """Run one round of the density control.

    Gaussians with a large gradient are cloned if they are small, and split if they are large. Transparent and huge
    Gaussians are pruned.

    Args:
        gaussians: the Gaussians.
        statistics: statistics since the previous round; they are reset.
        settings: thresholds.
        extent: the scene's extent (``scene_extent``).
        middle: [3], the cameras' mean position.
        prune_large: True to prune huge Gaussians (``Densification.prunes_large``).
        empty: free space. Gaussians inside it are pruned.
        limit: largest number of Gaussians.
        generator: random generator for the positions of new Gaussians.
    """
    pulled = statistics.mean() >= settings.gradient
    wide = gaussians["log_scales"].exp().amax(dim=1) > settings.dense_share * extent
    room = max(0, limit - len(gaussians))
    if int(pulled.sum()) > room:
        strongest = statistics.mean().argsort(descending=True, stable=True)[:room]
        pulled = torch.zeros_like(pulled)
        pulled[strongest] = True
    clone = pulled & ~wide
    split = pulled & wide
    children = _children(gaussians, split, generator)
    clones = {name: gaussians[name].detach()[clone] for name in gaussians.names}
    gaussians.append({name: torch.cat((clones[name], children[name])) for name in gaussians.names})
    added = len(gaussians) - len(split)
    gaussians.keep(torch.cat((~split, split.new_ones(added))))
    opacity = torch.sigmoid(gaussians["opacity_logits"])
    doomed = opacity < settings.minimum_opacity
    if empty is not None:
        doomed |= empty.contains(gaussians["means"].detach())
    if prune_large:
        distance = (gaussians["means"] - middle).norm(dim=1)
        far = settings.far_scale_share * distance
        allowed = torch.where(distance > extent, far, settings.maximum_scale_share * extent)
        doomed |= gaussians["log_scales"].exp().amax(dim=1) > allowed
    if bool(doomed.all()):
        doomed[opacity.argmax()] = False
    gaussians.keep(~doomed)
    statistics.clear(len(gaussians))


def _children(gaussians: Gaussians, split: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
    """Return two new Gaussians for each split Gaussian.

    Their positions are drawn from the split Gaussian, and they are 1.6 times smaller.
    """
    values = {
        name: gaussians[name].detach()[split].repeat(2, *[1] * (gaussians[name].ndim - 1))
        for name in gaussians.names
    }
    # Positions are drawn on the CPU, so that they are the same on every device.
    drawn = torch.randn(values["means"].shape, generator=generator).to(values["means"].device)
    offsets = drawn * values["log_scales"].exp()
    rotations = quaternions_to_rotations(values["quaternions"])
    values["means"] = values["means"] + (rotations @ offsets[..., None])[..., 0]
    values["log_scales"] = values["log_scales"] - torch.log(torch.tensor(1.6))
    return values
