"""What each view measured of each Gaussian: sums over its pixels, by what the Gaussian has in them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from polarguide import optics
from polarguide.camera import Camera
from polarguide.capture import View
from polarguide.raster import Rasterize
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.shading.metal import any_nonzero
from polarguide.shading.model import Parameters
from polarguide.shading.splatting import splats
from polarguide.training.metals.rules import MetalRules
from polarguide.training.priors import guide_normals
from polarguide.vectors import dot


class Seen(NamedTuple):
    """Means over what V views show of each Gaussian: weight [V, N], S0, P, the polarization at 45 degrees to both
    [V, N, 3], cosine of the zenith [V, N].
    """

    weight: Tensor
    s0: Tensor
    across: Tensor
    oblique: Tensor
    cosine: Tensor


def seen_by(
    gaussians: Parameters, views: Iterable[View], rasterize: Rasterize, rules: MetalRules
) -> list[Tensor]:
    """Sums [N, 11] over the pixels of each view, all of which determine the Stokes vector. ``seen_of`` tells what they
    say of some of the Gaussians.
    """
    return [_look(gaussians, view, rasterize, rules.least_normal) for view in views]


def evenly(views: Sequence[View], most: int) -> Sequence[View]:
    """At most so many of the views, every second, third or so."""
    return views[:: max(1, -(-len(views) // most))]


def shares(gaussians: Parameters, view: View, target: Tensor, rasterize: Rasterize) -> Tensor:
    """Sums [N, C] over the pixels of a picture [H, W, C], each by what the Gaussian has in it."""
    with torch.no_grad():
        fixed = splats(gaussians)
    features = target.new_zeros(len(fixed.means), target.shape[-1], requires_grad=True)
    with torch.enable_grad():
        (rasterize(fixed._replace(features=features), view.camera).features * target).sum().backward()
    assert features.grad is not None
    return features.grad


def _look(gaussians: Parameters, view: View, rasterize: Rasterize, least_normal: float) -> Tensor:
    """Sums [N, 11] over a view's pixels: 1, S0, P, the polarization at 45 degrees to it and the cosine."""
    device = gaussians["means"].device
    normal = render(gaussians, view.camera, rasterize, RenderRequest(sh_degree=0)).normal
    assert normal is not None
    view = view.to(device)
    rays = view.camera.rays(device=device)
    guide, known = guide_normals(view.camera.to_camera(normal), rays, least_normal)
    s0, s1, s2 = view.stokes()
    x_ref, up_ref = optics.lens_frame(rays)
    x, y = dot(guide, x_ref), dot(guide, up_ref)
    sine2 = (x * x + y * y).clamp(min=1e-6)
    cosine2, sine = ((x * x - y * y) / sine2)[..., None], (2 * x * y / sine2)[..., None]
    across, oblique = -(s1 * cosine2 + s2 * sine), s2 * cosine2 - s1 * sine
    one = torch.ones_like(x)[..., None]
    good = (known & ~(view.invalid | view.saturated))[..., None]
    target = torch.cat((one, s0, across, oblique, -dot(guide, rays)[..., None]), dim=-1) * good
    return shares(gaussians, view, target.contiguous(), rasterize)


def seen_of(looks: Sequence[Tensor], which: slice, rules: MetalRules) -> Seen:
    """Means of the sums of some Gaussians, with the weight of views that count."""
    sums = torch.stack([look[which] for look in looks])
    weight = sums[..., 0]
    means = sums[..., 1:] / weight.clamp(min=1e-6)[..., None]
    cosine = means[..., 9].clamp(0, 1)
    counts = weight > rules.least_share * weight.amax(dim=0)
    counts &= (cosine > rules.cosines[0]) & (cosine < rules.cosines[1])
    return Seen(weight * counts, means[..., :3], means[..., 3:6], means[..., 6:9], cosine)


def metalness_share(gaussians: Parameters, camera: Camera, rasterize: Rasterize) -> Tensor | None:
    """Blended metalness [H, W]; None where no Gaussian is a metal, or none can be."""
    metalness = gaussians.get("metalness")
    if metalness is None or not any_nonzero(metalness):
        return None
    with torch.no_grad():
        return rasterize(splats(gaussians, metalness[:, None]), camera).features[..., 0]
