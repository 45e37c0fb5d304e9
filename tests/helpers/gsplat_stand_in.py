"""gsplat's four functions in plain torch, for machines without a GPU: what ``raster/cuda.py`` does around them.

Same arguments, shapes and refusals as 1.6.0 (which, unlike 1.5.3, pads no channels), same 0.999. Tiles are left out:
the "intersections" are the visible Gaussians by depth.
"""

import torch
from torch import Tensor

from polarguide.gaussians.geometry import quaternions_to_rotations

COMPILED = (1, 2, 3, 4, 5, 8, 9, 16, 17, 32, 33)
calls: list[int] = []
"""Channel counts of the pictures blended so far."""


def fully_fused_projection(
    means: Tensor,
    covars: None,
    quats: Tensor,
    scales: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    eps2d: float = 0.3,
    near_plane: float = 0.01,
    *,
    opacities: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, None]:
    axes = quaternions_to_rotations(quats) * scales[:, None, :]
    turn, shift = viewmats[0, :3, :3], viewmats[0, :3, 3]
    fx, fy, cx, cy = Ks[0, 0, 0], Ks[0, 1, 1], Ks[0, 0, 2], Ks[0, 1, 2]
    local = means @ turn.T + shift
    depth = local[:, 2]
    x, y = local[:, 0] / depth, local[:, 1] / depth
    means2d = torch.stack((fx * x + cx, fy * y + cy), dim=-1)
    x = x.clamp(-cx / fx - 0.15 * width / fx, (width - cx) / fx + 0.15 * width / fx)
    y = y.clamp(-cy / fy - 0.15 * height / fy, (height - cy) / fy + 0.15 * height / fy)
    zero = torch.zeros_like(depth)
    across = torch.stack((fx / depth, zero, -fx * x / depth), dim=-1)
    down = torch.stack((zero, fy / depth, -fy * y / depth), dim=-1)
    half = torch.stack((across, down), dim=-2) @ turn @ axes
    covariance = half @ half.mT + eps2d * torch.eye(2)
    inverse = torch.linalg.inv(covariance)
    conics = torch.stack((inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]), dim=-1)
    with torch.no_grad():
        extent = torch.sqrt(2 * torch.log((opacities * 255).clamp(min=1))).clamp(max=3.33)
        spread = torch.stack((covariance[:, 0, 0], covariance[:, 1, 1]), dim=-1).sqrt()
        radii = torch.ceil(extent[:, None] * spread)
        inside = (means2d + radii > 0) & (means2d - radii < torch.tensor([width, height]))
        seen = inside.all(dim=1) & (depth >= near_plane) & (opacities >= 1 / 255)
        radii = torch.where(seen[:, None], radii, torch.zeros_like(radii)).to(torch.int32)
    return radii[None], means2d[None], depth[None], conics[None], None


def isect_tiles(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    tile_size: int,
    tile_width: int,
    tile_height: int,
    *,
    n_images: int,
) -> tuple[None, Tensor, Tensor]:
    assert n_images == means2d.shape[0] == 1
    order = torch.argsort(depths[0], stable=True)
    order = order[radii[0, order].amin(dim=-1) > 0]
    return None, order, order.to(torch.int32)


def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    return torch.zeros(n_images, tile_height, tile_width, dtype=torch.int32)


def rasterize_to_pixels(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
) -> tuple[Tensor, Tensor]:
    if colors.shape[-1] not in COMPILED:
        raise ValueError(f"unsupported number of channels: {colors.shape[-1]}")
    rows, columns = isect_offsets.shape[1:]
    assert (rows - 1) * tile_size < image_height <= rows * tile_size
    assert (columns - 1) * tile_size < image_width <= columns * tile_size
    calls.append(colors.shape[-1])
    order = flatten_ids.long()
    y, x = torch.meshgrid(torch.arange(image_height) + 0.5, torch.arange(image_width) + 0.5, indexing="ij")
    dx = means2d[0, order, 0, None] - x.flatten()
    dy = means2d[0, order, 1, None] - y.flatten()
    a, b, c = conics[0, order, :, None].unbind(1)
    alpha = opacities[0, order, None] * torch.exp(-(0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy))
    alpha = alpha.clamp(max=0.999)
    alpha = torch.where(alpha >= 1 / 255, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1 - alpha, dim=0)
    alpha = torch.where((after <= 1e-4).cummax(dim=0).values, torch.zeros_like(alpha), alpha)
    after = torch.cumprod(1 - alpha, dim=0)
    before = torch.cat((torch.ones_like(after[:1]), after[:-1]))
    picture = (alpha * before).mT @ colors[0, order]
    shape = (1, image_height, image_width)
    return picture.reshape(*shape, -1), (1 - after[-1]).reshape(*shape, 1)
