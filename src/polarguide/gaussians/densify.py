"""Adaptive density control (Kerbl et al. 2023, Sec. 5.2): clone, split and prune, and their statistics.

Free space, just in front of the cameras, has no surface. A Gaussian close to one camera explains that one picture and
occludes every new view nearby. The SfM points bound the distance of the nearest surface of a view, in front of which
space is free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.gaussians.gaussians import Gaussians
from polarguide.gaussians.geometry import quaternions_to_rotations
from polarguide.geometry.camera import Camera


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """Balls about the cameras.

    Attributes:
        centers: [V, 3] camera centers.
        radii: [V], 0 for a camera that sees no point.
    """

    centers: Tensor
    radii: Tensor

    def to(self, device: torch.device) -> FreeSpace:
        """Return the free space on a device."""
        return FreeSpace(self.centers.to(device), self.radii.to(device))

    def contains(self, means: Tensor) -> Tensor:
        """Return a mask [N] of the positions [N, 3] inside."""
        return (torch.cdist(means, self.centers) < self.radii).any(dim=1)


def free_space(points: Tensor, cameras: Sequence[Camera], share: float, quantile: float) -> FreeSpace:
    """Return the free space in front of cameras that see SfM points [M, 3].

    Args:
        points: [M, 3] SfM points.
        cameras: the cameras.
        share: free share of the depth of a view's nearest points.
        quantile: quantile of the depths that counts as the nearest.
    """
    radii = []
    for camera in cameras:
        x, y, z = camera.to_camera(points.double() - camera.center).unbind(-1)
        column = camera.fx * x / z + camera.cx
        row = camera.fy * y / z + camera.cy
        inside = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        depths = z[inside]
        radii.append(share * float(torch.quantile(depths, quantile)) if len(depths) else 0.0)
    centers = torch.stack([camera.center for camera in cameras]).float()
    return FreeSpace(centers, torch.tensor(radii))


@dataclass(frozen=True)
class Densification:
    """Thresholds of the density control.

    Attributes:
        every: steps between two rounds.
        gradient: mean gradient of the loss with respect to the projected mean, in units of half a picture, above which
            a Gaussian is cloned or split.
        dense_share: share of the scene's extent above which a Gaussian is split; smaller ones are cloned.
        minimum_opacity: opacity below which a Gaussian is pruned.
        maximum_scale_share: share of the extent above which Gaussians within it are pruned.
        far_scale_share: share of the distance above which Gaussians beyond the extent are pruned; a little more than
            the widest of the initial shell of the surroundings (``Initialization``).
        large_from: share of all steps after which huge Gaussians are pruned: 3,000 of 30,000 in the release, which is
            the interval of its opacity resets.
        large_minimum: least step at which they are pruned.
        pixels_each: least number of pixels, of all training pictures, for each Gaussian. A Gaussian has about sixty
            parameters and a pixel three values: with fewer than twenty pixels each, unknowns outnumber data.
        faint_pixels: least sum of the blending weights of a Gaussian in some training picture, at the end of the
            density control. Others are pruned: three in ten, which take time and are invisible. 0: none is pruned.
        enough_views: number of training views above which Gaussians in only one view are pruned, without a background.
        reset_opacity: opacity after a reset (Kerbl et al. 2023).
        free_share: free share of the depth of a view's nearest points (``gaussians.densify``).
        free_quantile: quantile of the points' depths that counts as the nearest.
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
        """Return True if the round after a step, of ``steps`` in all, prunes huge Gaussians."""
        return step >= max(self.large_minimum, self.large_from * steps)


class DensityStatistics:
    """Sums of the screen-space gradient norms over the pictures in which each Gaussian was visible.

    With several views per step, each view of a step has its own sums, which are added in order for the mean. Processes
    that share the views of a step therefore exchange sums only for the mean, and the result does not depend on the
    number of processes.

    Args:
        count: number N of Gaussians.
        slots: number S of views per step.
        device: device of the Gaussians.

    Attributes:
        gradient, seen: sums, [N], or [S, N] for more than one slot.
    """

    def __init__(self, count: int, slots: int = 1, device: torch.device | None = None) -> None:
        self._slots = slots
        self._device = device
        self.clear(count)

    @classmethod
    def of(cls, gradient: Tensor, counts: Tensor) -> DensityStatistics:
        """Return statistics with these sums."""
        statistics = cls(0, gradient.shape[0] if gradient.ndim == 2 else 1, gradient.device)
        statistics.gradient = gradient
        statistics.seen = counts
        return statistics

    def add(self, screen_gradient: Tensor, radii: Tensor, width: int, height: int, slot: int = 0) -> None:
        """Add one picture.

        Args:
            screen_gradient: [N, 2] per pixel; converted to units of half a picture.
            radii: [N], 0 for invisible Gaussians.
            width, height: size of the picture.
            slot: slot of the view.
        """
        x, y = screen_gradient.unbind(1)
        norm = torch.stack((x * (width / 2), y * (height / 2)), dim=1).norm(dim=1)
        gradient, counts = (t[slot] if t.ndim == 2 else t for t in (self.gradient, self.seen))
        gradient += norm
        counts += (radii > 0).to(counts)

    def mean(self) -> Tensor:
        """Return the mean gradient norm, [N]; 0 for invisible Gaussians."""
        gradient, counts = (_in_order(t) for t in (self.gradient, self.seen))
        return gradient / counts.clamp(min=1)

    def clear(self, count: int) -> None:
        """Reset the sums for ``count`` Gaussians."""
        shape = (count,) if self._slots == 1 else (self._slots, count)
        self.gradient, self.seen = (torch.zeros(shape, device=self._device) for _ in range(2))


def _in_order(sums: Tensor) -> Tensor:
    """Add sums [S, N] in order; return [N] unchanged."""
    if sums.ndim == 1:
        return sums
    total = sums[0]
    for further in sums[1:]:
        total = total + further
    return total


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
    """Do one round: clone small Gaussians with a large gradient, split large ones, prune transparent and huge ones.

    Args:
        gaussians: the Gaussians.
        statistics: sums since the previous round; reset.
        settings: thresholds.
        extent: the scene's extent (``scene_extent``).
        middle: [3], the cameras' mean position.
        prune_large: prune huge Gaussians (``Densification.prunes_large``).
        empty: space in which Gaussians are pruned.
        limit: largest number of Gaussians.
        generator: draws the positions of the children.
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
    """Return two children for each split Gaussian: drawn from it, 1.6 times smaller."""
    values = {
        name: gaussians[name].detach()[split].repeat(2, *[1] * (gaussians[name].ndim - 1))
        for name in gaussians.names
    }
    # Drawn on the CPU: the children are the same on every device.
    drawn = torch.randn(values["means"].shape, generator=generator).to(values["means"].device)
    offsets = drawn * values["log_scales"].exp()
    rotations = quaternions_to_rotations(values["quaternions"])
    values["means"] = values["means"] + (rotations @ offsets[..., None])[..., 0]
    values["log_scales"] = values["log_scales"] - torch.log(torch.tensor(1.6))
    return values
