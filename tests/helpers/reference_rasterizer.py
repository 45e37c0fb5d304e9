"""Reference implementation of the rasterizer in plain PyTorch, for any dtype and device.

It evaluates each Gaussian at each pixel, so it needs memory in proportion to N x H x W. It is meant for tests with tiny
pictures.
"""

from __future__ import annotations

import torch
from torch import Tensor

from polarguide.gaussians.geometry import quaternions_to_rotations
from polarguide.geometry.camera import Camera
from polarguide.raster.interface import (
    BLUR,
    JACOBIAN_MARGIN,
    MAXIMUM_ALPHA,
    MINIMUM_ALPHA,
    MINIMUM_TRANSMITTANCE,
    NEAR_PLANE,
    Rasterized,
    ScreenStatistic,
    Splats,
    check_shapes,
    not_finite,
)


def _project(splats: Splats, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Return projected means [N, 2], covariances [N, 2, 2] with the blur, and camera depths [N]."""
    means = splats.means
    rotation = camera.rotation.to(means)
    local = means @ rotation.T + camera.translation.to(means)
    depth = local[:, 2]
    safe = torch.where(depth > NEAR_PLANE, depth, torch.ones_like(depth))
    x = local[:, 0] / safe
    y = local[:, 1] / safe
    means2d = torch.stack((camera.fx * x + camera.cx, camera.fy * y + camera.cy), dim=-1)
    margin_x = JACOBIAN_MARGIN * camera.width / camera.fx
    margin_y = JACOBIAN_MARGIN * camera.height / camera.fy
    x = x.clamp(-camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x)
    y = y.clamp(-camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y)
    zero = torch.zeros_like(depth)
    jacobian = torch.stack(
        (
            torch.stack((camera.fx / safe, zero, -camera.fx * x / safe), dim=-1),
            torch.stack((zero, camera.fy / safe, -camera.fy * y / safe), dim=-1),
        ),
        dim=-2,
    )
    half = jacobian @ rotation @ quaternions_to_rotations(splats.rotations) * splats.scales[:, None, :]
    return means2d, half @ half.mT + BLUR * torch.eye(2).to(means), depth


def rasterize_reference(
    splats: Splats,
    camera: Camera,
    *,
    statistic: ScreenStatistic | None = None,
    still: tuple[int, ...] = (),
) -> Rasterized:
    """Splat Gaussians exactly but slowly, differentiable by autograd; see ``Rasterize``."""
    check_shapes(splats, statistic, still)
    for name, tensor in splats._asdict().items():
        bad = (~torch.isfinite(tensor)).nonzero()
        if len(bad):
            raise not_finite(name, int(bad[0, 0]))
    means = splats.means
    opacities = splats.opacities
    features = splats.features
    means2d, covariances, depth = _project(splats, camera)
    determinant = torch.linalg.det(covariances)
    visible = (depth > NEAR_PLANE) & (opacities >= MINIMUM_ALPHA) & (determinant > 0)
    order = torch.argsort(depth.detach(), stable=True)
    order = order[visible[order]]
    centers = (torch.arange(max(camera.width, camera.height)).to(means)) + 0.5
    pixels = torch.cartesian_prod(centers[: camera.height], centers[: camera.width]).flip(-1)
    offset = pixels[None] - means2d[order][:, None]
    conics = torch.linalg.inv(covariances[order])
    quadratic = torch.einsum("npi,nij,npj->np", offset, conics, offset)
    alpha = (opacities[order][:, None] * torch.exp(-0.5 * quadratic)).clamp(max=MAXIMUM_ALPHA)
    alpha = torch.where(alpha >= MINIMUM_ALPHA, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1 - alpha, dim=0)
    ended = (after < MINIMUM_TRANSMITTANCE).cummax(dim=0).values if len(order) else after > 1
    alpha = torch.where(ended, torch.zeros_like(alpha), alpha)
    after = torch.cumprod(1 - alpha, dim=0)
    before = torch.cat((torch.ones_like(after[:1]), after[:-1]))
    weights = (alpha * before).mT
    blended = weights @ features[order]
    again = weights.detach() @ features[order][:, list(still)] if still else None
    coverage = 1 - after[-1] if len(order) else torch.zeros_like(pixels[:, 0])
    shape = (camera.height, camera.width)
    image = blended.reshape(*shape, features.shape[1])
    if statistic is not None and image.requires_grad:
        image = _with_statistic(image, means2d, statistic)
    with torch.no_grad():
        middle = 0.5 * (covariances[:, 0, 0] + covariances[:, 1, 1])
        radii = 3 * torch.sqrt(middle + torch.sqrt((middle**2 - determinant).clamp(min=0.1)))
        reach = 2 * torch.log(opacities.clamp(min=MINIMUM_ALPHA) / MINIMUM_ALPHA)
        half = torch.sqrt(reach[:, None] * torch.stack((covariances[:, 0, 0], covariances[:, 1, 1]), dim=-1))
        size = torch.tensor([camera.width, camera.height]).to(means)
        inside = visible & ((means2d + half > 0) & (means2d - half < size)).all(dim=1)
        radii = torch.where(inside, radii, torch.zeros_like(radii))
    detached = None if again is None else again.reshape(*shape, len(still))
    return Rasterized(image, coverage.reshape(shape), radii, detached)


def _with_statistic(image: Tensor, means2d: Tensor, statistic: ScreenStatistic) -> Tensor:
    """Return the same picture. Its backward pass stores the statistic."""

    def fill(gradient: Tensor) -> None:
        chosen = torch.zeros_like(gradient)
        chosen[..., list(statistic.channels)] = gradient[..., list(statistic.channels)]
        (statistic.gradient,) = torch.autograd.grad(image, means2d, chosen, retain_graph=True)

    result = image.clone()  # a separate node, so that the hook does not call itself
    result.register_hook(fill)
    return result
