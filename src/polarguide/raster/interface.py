"""The interface of the rasterizers.

``rasterize(splats, camera)`` splats N Gaussians with D feature channels each into one picture. It takes tensors, never
a scene, and knows nothing of colors: base color, normal, strength or depth are channels like any other.

Definition, the same in every backend up to the differences that the backend's module names: EWA projection of the
covariance (Zwicker et al. 2001; Kerbl et al. 2023, Eq. 5) with 0.1 px^2 added (there 0.3), alpha = min(0.99, opacity *
exp(-d^T conic d / 2)), contributions with alpha < 1/255 dropped, a pixel ends before the Gaussian that would bring
its transmittance below 1e-4, front to back in order of camera depth (ties: by index). Behind the last Gaussian is 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from polarguide.core.errors import PolarguideError
from polarguide.geometry.camera import Camera

NEAR_PLANE = 0.01
BLUR = 0.1
MINIMUM_ALPHA = 1.0 / 255.0
MAXIMUM_ALPHA = 0.99
MINIMUM_TRANSMITTANCE = 1e-4
# The Jacobian is taken at most this share of the picture's size outside the picture, where the affine
# approximation of the projection breaks down.
JACOBIAN_MARGIN = 0.15


class Splats(NamedTuple):
    """Gaussians as a rasterizer takes them.

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
    """A splatted picture.

    Attributes:
        features: [H, W, D], the blended channels.
        alpha: [H, W] in [0, 1], 1 - transmittance.
        radii: [N] pixels, three standard deviations of the wider axis of each projected Gaussian, or what the
            backend's module says; 0 where culled.
        still: [H, W, S] the channels that were asked for once more, with a gradient on the Gaussians' features alone:
            it changes what they show, and neither moves nor fades them. None: none was asked for.
    """

    features: Tensor
    alpha: Tensor
    radii: Tensor
    still: Tensor | None = None


@dataclass
class ScreenStatistic:
    """Asks for the gradient of the loss with respect to the projected means, through some channels alone.

    Densification needs the positional gradient of the colors alone: normals and strengths do not count (Ye et al.
    2024). The backward pass of the ``rasterize`` call that it is given to fills it.

    Attributes:
        channels: which feature channels count.
        gradient: [N, 2] in loss per pixel after the backward pass, None before.
    """

    channels: tuple[int, ...]
    gradient: Tensor | None = None


class Rasterize(Protocol):
    """The signature of a backend.

    Args:
        splats: the Gaussians.
        camera: the view.
        statistic: filled by the backward pass, if given.
        still: channels that the result has once more, see ``Rasterized``.

    Raises:
        PolarguideError: shapes that do not fit, or values that are not finite (checked only where that does not mean
            waiting for the device).
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
    """Check that the shapes fit each other, and that the channels of the statistic and the still ones exist.

    Raises:
        PolarguideError: a shape does not fit, or a channel does not exist.
    """
    count = splats.means.shape[0] if splats.means.ndim else 0
    channels = splats.features.shape[-1]
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, channels))
    for name, tensor, shape in zip(Splats._fields, splats, shapes, strict=True):
        if tuple(tensor.shape) != shape:
            remedy = "Give every tensor one entry for each Gaussian."
            raise refusal(name, f"shape {list(shape)}", str(list(tensor.shape)), remedy)
    if not 1 <= channels <= 32:
        raise refusal("features", "1 to 32 channels", str(channels), "Split the channels.")
    for name, chosen in (("statistic", statistic.channels if statistic else ()), ("still", still)):
        if len(set(chosen)) < len(chosen) or not all(0 <= channel < channels for channel in chosen):
            remedy = "Name channels that exist, each once."
            raise refusal(name, f"different channels below {channels}", str(chosen), remedy)


def not_finite(name: str, index: int) -> PolarguideError:
    """The error for a NaN or an infinity in the tensor ``name`` of the Gaussian ``index``."""
    remedy = "A diverged optimization: lower the learning rate or resume from an earlier checkpoint."
    return refusal(name, "finite numbers", f"NaN or infinity in Gaussian {index}", remedy)


def refusal(name: str, expected: str, found: str, remedy: str) -> PolarguideError:
    """The error for the argument ``name`` of a rasterizer."""
    return PolarguideError(f"rasterize({name})", expected=expected, found=found, remedy=remedy)
