"""Gaussians to rasterize in tests, and one call that gives all that a backend computes from them."""

from typing import NamedTuple

import torch
from reference_rasterizer import rasterize_reference
from torch import Tensor

from polarguide.gaussians.geometry import quaternions_to_rotations
from polarguide.geometry.camera import Camera
from polarguide.raster import Rasterize, ScreenStatistic, Splats
from polarguide.raster.interface import MINIMUM_ALPHA


class Outcome(NamedTuple):
    features: Tensor
    alpha: Tensor
    radii: Tensor
    gradients: Splats
    statistic: Tensor | None


def looking_ahead(width: int, height: int, focal: float = 0.0) -> Camera:
    """A camera at the origin that looks along +z; the focal length is the longer side unless given."""
    focal = focal or float(max(width, height))
    eye, zero = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    return Camera(width, height, focal, focal, width / 2, height / 2, eye, zero)


def round_gaussian(sigma: float, opacity: float, depth: float = 3.0) -> Splats:
    """One round Gaussian on the optical axis."""
    return Splats(
        torch.tensor([[0.0, 0.0, depth]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.full((1, 3), sigma),
        torch.tensor([opacity]),
        torch.ones(1, 2),
    )


def repeated(splats: Splats, count: int) -> Splats:
    return Splats(*(t.repeat(count, *[1] * (t.ndim - 1)) for t in splats))


def posed(width: int, height: int) -> Camera:
    """A camera with a general pose and general intrinsics."""
    quaternion = torch.tensor([0.9, 0.2, -0.3, 0.1], dtype=torch.float64)
    translation = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
    side = max(width, height)
    rotation = quaternions_to_rotations(quaternion)
    return Camera(width, height, 1.1 * side, 0.9 * side, 0.52 * width, 0.47 * height, rotation, translation)


def in_view(camera: Camera, count: int, channels: int, seed: int) -> Splats:
    """Float32 Gaussians of many shapes before a camera, none with a pixel near the cut-off 1/255."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    depth = 2 + 4 * uniform(count)
    across = (uniform(count, 2) * 1.3 - 0.15) * torch.tensor([camera.width, camera.height])
    x = (across[:, 0] - camera.cx) / camera.fx * depth
    y = (across[:, 1] - camera.cy) / camera.fy * depth
    local = torch.stack((x, y, depth), dim=1)
    side = max(camera.width, camera.height)
    pixels = torch.exp(torch.log(torch.tensor(side / 3 + 1.0)) * uniform(count, 3))
    inputs = (
        (local - camera.translation) @ camera.rotation,
        torch.randn(count, 4, generator=generator, dtype=torch.float64),
        pixels * (depth / side)[:, None],
        0.03 + 0.9 * uniform(count),
        torch.randn(count, channels, generator=generator, dtype=torch.float64),
    )
    return _away_from_cut_off(Splats(*(t.to(torch.float32) for t in inputs)), camera)


def _away_from_cut_off(splats: Splats, camera: Camera) -> Splats:
    """Raise opacities a little until no pixel lies within 0.05 % of the alpha at which it is dropped."""
    opacities = splats.opacities.clone()
    for index in range(len(opacities)):
        one = Splats(*(t[index : index + 1].double() for t in splats))
        for _ in range(30):
            raised = opacities[index : index + 1].double() * 1.0005
            alpha = rasterize_reference(one._replace(opacities=raised), camera).alpha / MINIMUM_ALPHA
            if not bool(((alpha > 0.99) & (alpha < 1.001)).any()):
                break
            opacities[index] *= 1.0021
    return splats._replace(opacities=opacities)


def outcome(
    rasterize: Rasterize,
    splats: Splats,
    camera: Camera,
    statistic: tuple[int, ...] | None = None,
    *,
    dtype: torch.dtype = torch.float32,
    seed: int = 7,
    still: tuple[int, ...] = (),
) -> Outcome:
    """Forward pass, and backward pass of random output gradients (the same for every dtype), to the still ones, too."""
    inputs = Splats(*(t.detach().to(dtype).requires_grad_() for t in splats))
    watched = ScreenStatistic(statistic) if statistic is not None else None
    picture = rasterize(inputs, camera, statistic=watched, still=still)
    generator = torch.Generator().manual_seed(seed)
    to_features = torch.randn(picture.features.shape, generator=generator)
    to_alpha = torch.randn(picture.alpha.shape, generator=generator)
    loss = (picture.features * to_features.to(picture.features)).sum()
    loss = loss + (picture.alpha * to_alpha.to(picture.alpha)).sum()
    if picture.still is not None:
        to_still = torch.randn(picture.still.shape, generator=generator)
        loss = loss + (picture.still * to_still.to(picture.still)).sum()
    loss.backward()
    gradients = Splats(*(t.grad if t.grad is not None else torch.zeros_like(t) for t in inputs))
    return Outcome(
        picture.features.detach(),
        picture.alpha.detach(),
        picture.radii.detach(),
        gradients,
        watched.gradient if watched is not None else None,
    )


def difference(found: Tensor, expected: Tensor) -> float:
    """Norm of the difference over the norm of what was expected (or, where that is 0, over 1)."""
    scale = float(expected.double().norm())
    return float((found.double() - expected.double()).norm()) / (scale or 1.0)


def differences(found: Outcome, expected: Outcome) -> dict[str, float]:
    """``difference`` of every result, by name."""
    named = {name: (getattr(found, name), getattr(expected, name)) for name in ("features", "alpha", "radii")}
    named |= {
        f"gradient of {name}": pair
        for name, pair in zip(
            Splats._fields, zip(found.gradients, expected.gradients, strict=True), strict=True
        )
    }
    if expected.statistic is not None:
        assert found.statistic is not None
        named["statistic"] = (found.statistic, expected.statistic)
    return {name: difference(a, b) for name, (a, b) in named.items()}


def same_bits(found: Outcome, expected: Outcome) -> bool:
    """Whether two float32 outcomes agree in every bit."""
    pairs = [
        (found.features, expected.features),
        (found.alpha, expected.alpha),
        (found.radii, expected.radii),
        *zip(found.gradients, expected.gradients, strict=True),
    ]
    if expected.statistic is not None and found.statistic is not None:
        pairs.append((found.statistic, expected.statistic))
    return all(torch.equal(a.view(torch.int32), b.view(torch.int32)) for a, b in pairs)
