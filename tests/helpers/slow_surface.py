"""The slow reference of ``raster.surface.surface_picture``."""

import torch

from polarguide._native import MAX_CHANNELS
from polarguide.geometry.camera import Camera
from polarguide.raster.interface import Rasterize, Splats
from polarguide.raster.surface import WIDTH, SurfacePicture


@torch.no_grad()
def surface_reference(splats: Splats, camera: Camera, rasterize: Rasterize) -> SurfacePicture:
    """The reference implementation of ``surface_picture``: any dtype and device, a rendering for every 32 Gaussians.

    Args:
        splats, camera: as there. rasterize: tells the weights, as what is blended of a channel for each Gaussian.
    """
    pose = camera.pose(splats.means.dtype, splats.means.device)
    places = (splats.means - pose.center) @ pose.rotation[2]
    order = places.argsort(stable=True)
    whole = Splats(*(t[order] for t in splats))
    alone = torch.eye(len(order), dtype=places.dtype, device=places.device)
    parts = [
        rasterize(whole._replace(features=own), camera).features for own in alone.split(MAX_CHANNELS, dim=1)
    ]
    weights = torch.cat(parts, dim=-1)
    upto, depth = weights.cumsum(dim=-1), places[order]
    reached = (upto >= upto[..., -1:] / 2) & (weights > 0)
    median = depth[reached.to(torch.uint8).argmax(dim=-1)]
    near = weights * torch.exp(-0.5 * ((median[..., None] / depth - 1) / WIDTH).square())
    near = near / near.sum(dim=-1, keepdim=True).clamp(min=torch.finfo(near.dtype).tiny)
    return SurfacePicture(near @ whole.features, near @ depth)
