"""Interface of the rasterizers.

``rasterize(splats, camera)`` splats N Gaussians with D feature channels each into one picture. Its inputs are tensors.
Base color, normal, strength and depth are channels like any other.

All backends compute the same picture, apart from differences that their modules list. Covariances are projected by EWA
splatting (Zwicker et al. 2001; Kerbl et al. 2023, Eq. 5). 0.1 px^2 is added to them, while Kerbl et al. add 0.3.
Gaussians are blended front to back in the order of their camera depth, and equal depths by index. Alpha is min(0.99,
opacity * exp(-d^T conic d / 2)), and contributions with alpha < 1/255 are dropped. The blending of a pixel ends before
the Gaussian that would reduce its transmittance below 1e-4. The background is 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from polarguide.core.errors import PolarguideError
from polarguide.geometry.camera import Camera

NEAR_PLANE = 0.01
"""Camera depth below which Gaussians are culled, in world units."""
BLUR = 0.1
"""Variance added to projected covariances, in squared pixels."""
MINIMUM_ALPHA = 1.0 / 255.0
"""Alpha below which a contribution is dropped."""
MAXIMUM_ALPHA = 0.99
"""Upper bound of the alpha of one Gaussian."""
MINIMUM_TRANSMITTANCE = 1e-4
"""Transmittance of a pixel below which blending ends."""
JACOBIAN_MARGIN = 0.15
"""Distance from the picture to which the points for the projection's Jacobian are clamped, as a share of its size.

The affine approximation of the projection fails farther outside.
"""


class Splats(NamedTuple):
    """Gaussians as input of a rasterizer.

    Attributes:
        means: [N, 3] world positions.
        rotations: [N, 4] quaternions (w, x, y, z), not necessarily unit.
        scales: [N, 3] standard deviations along the Gaussians' own axes, world units, positive.
        opacities: [N] in (0, 1).
        features: [N, D], 1 <= D <= 32.
    """

    means: Tensor
    rotations: Tensor
    scales: Tensor
    opacities: Tensor
    features: Tensor


class Rasterized(NamedTuple):
    """Splatted picture.

    Attributes:
        features: [H, W, D], the blended channels.
        alpha: [H, W] in [0, 1], 1 - transmittance.
        radii: [N] radii of the projected Gaussians in pixels, which are three standard deviations of the longer axis. 0
            for culled Gaussians. The modules of backends list differences.
        still: [H, W, S] second copy of the requested channels. Its gradient reaches only the features of Gaussians.
            None if no channel was requested.
    """

    features: Tensor
    alpha: Tensor
    radii: Tensor
    still: Tensor | None = None


@dataclass
class ScreenStatistic:
    """Gradient of the loss with respect to the projected means, limited to some channels.

    Densification needs the positional gradient of the colors, without the gradient of normals and strengths (Ye et al.
    2024). The backward pass of ``rasterize`` stores it in this object.

    Attributes:
        channels: feature channels through which the gradient passes.
        gradient: [N, 2] in loss per pixel after the backward pass. None before.
    """

    channels: tuple[int, ...]
    gradient: Tensor | None = None


class Rasterize(Protocol):
    """Signature of a backend.

    Args:
        splats: the Gaussians.
        camera: the view.
        statistic: object in which the backward pass stores the gradient of the projected means.
        still: channels for the second copy ``Rasterized.still``.

    Raises:
        PolarguideError: a shape does not fit, or a value is not finite. The CUDA backend does not check values, because
            it would wait for the device.
    """

    def __call__(
        self,
        splats: Splats,
        camera: Camera,
        *,
        statistic: ScreenStatistic | None = None,
        still: tuple[int, ...] = (),
    ) -> Rasterized: ...


class Backend(NamedTuple):
    """A device and the rasterizer that runs on it."""

    device: torch.device
    rasterize: Rasterize


def check_shapes(splats: Splats, statistic: ScreenStatistic | None, still: tuple[int, ...] = ()) -> None:
    """Check that the shapes fit each other, and that the channels of the statistic and of the copy exist.

    Raises:
        PolarguideError: a shape does not fit, or a channel does not exist.
    """
    count = splats.means.shape[0] if splats.means.ndim else 0
    channels = splats.features.shape[-1]
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, channels))
    for name, tensor, shape in zip(Splats._fields, splats, shapes, strict=True):
        if tuple(tensor.shape) != shape:
            raise refusal(
                name,
                f"shape {list(shape)}",
                str(list(tensor.shape)),
                "Pass tensors with one entry for each Gaussian.",
            )
    if not 1 <= channels <= 32:
        raise refusal("features", "1 to 32 channels", str(channels), "Split the channels.")
    for name, chosen in (("statistic", statistic.channels if statistic else ()), ("still", still)):
        if len(set(chosen)) < len(chosen) or not all(0 <= channel < channels for channel in chosen):
            raise refusal(
                name,
                f"different channels below {channels}",
                str(chosen),
                "Specify existing channels, each once.",
            )


def some_channels(values: Tensor, channels: Sequence[int]) -> Tensor:
    """Return selected channels of a tensor [..., D].

    A slice is used if possible, because an index would be copied to the device.
    """
    first = channels[0]
    end = first + len(channels)
    if list(channels) == list(range(first, end)):
        return values[..., first:end]
    return torch.stack([values[..., channel] for channel in channels], dim=-1)


def not_finite(name: str, index: int) -> PolarguideError:
    """Return the error for a NaN or an infinity in the tensor ``name`` of the Gaussian ``index``."""
    remedy = "The optimization diverged: lower the learning rate or resume from an earlier checkpoint."
    return refusal(name, "finite numbers", f"NaN or infinity in Gaussian {index}", remedy)


def refusal(name: str, expected: str, found: str, remedy: str) -> PolarguideError:
    """Return the error for the argument ``name`` of a rasterizer."""
    return PolarguideError(f"rasterize({name})", expected=expected, found=found, remedy=remedy)
