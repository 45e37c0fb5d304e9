"""The narrow waist: what every rasterizer takes and gives.

``rasterize(means, quats, scales, opacities, features, camera)`` splats N Gaussians with D feature channels each into
one picture. It takes tensors, never a scene, and knows nothing of colors: base color, normal, strength or depth
are channels like any other.

Definition, the same in every backend up to the differences that a backend's page names: EWA projection of the
covariance (Zwicker et al. 2001; Kerbl et al. 2023, Eq. 5) with 0.3 px^2 added, alpha = min(0.99, opacity *
exp(-d^T conic d / 2)), contributions with alpha < 1/255 dropped, a pixel ends before the Gaussian that would bring
its transmittance below 1e-4, front to back in order of camera depth (ties: by index). Behind the last Gaussian is 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

from torch import Tensor

from polarguide.camera import Camera
from polarguide.errors import PolarguideError

NEAR_PLANE = 0.01
BLUR = 0.3
MINIMUM_ALPHA = 1.0 / 255.0
MAXIMUM_ALPHA = 0.99
MINIMUM_TRANSMITTANCE = 1e-4
# The Jacobian is taken at most this share of the picture's size outside the picture, where the affine
# approximation of the projection breaks down.
JACOBIAN_MARGIN = 0.15


class Rasterized(NamedTuple):
    """A splatted picture.

    Attributes:
        features: [H, W, D], the blended channels.
        alpha: [H, W] in [0, 1], 1 - transmittance.
        radii: [N] pixels, three standard deviations of the wider axis of each projected Gaussian, or what a backend's
            page says; 0 where culled.
    """

    features: Tensor
    alpha: Tensor
    radii: Tensor


@dataclass
class ScreenStatistic:
    """Asks for the gradient of the loss with respect to the projected means, through some channels alone.

    Densification wants to know how much the colors pull at a Gaussian's place in the picture, and normals or
    strengths must not count (Ye et al. 2024). Passed to ``rasterize``, it is filled by the backward pass.

    Attributes:
        channels: which feature channels count.
        gradient: [N, 2] in loss per pixel after the backward pass, None before.
    """

    channels: tuple[int, ...]
    gradient: Tensor | None = None


class Rasterize(Protocol):
    """The signature of a backend.

    Args:
        means: [N, 3] world positions.
        quats: [N, 4] rotations (w, x, y, z), not necessarily unit.
        scales: [N, 3] standard deviations along the Gaussians' own axes, world units, positive.
        opacities: [N] in (0, 1).
        features: [N, D], 1 <= D <= 32.
        camera: the view.
        statistic: filled by the backward pass, if given.

    Raises:
        PolarguideError: shapes that do not fit, or values that are not finite (these only where finding out does not
            mean waiting for the device).
    """

    def __call__(
        self,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        features: Tensor,
        camera: Camera,
        *,
        statistic: ScreenStatistic | None = None,
    ) -> Rasterized: ...


def check_shapes(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    statistic: ScreenStatistic | None,
) -> None:
    """Refuse inputs whose shapes do not fit each other, or a statistic over channels that do not exist."""
    count = means.shape[0] if means.ndim else 0
    channels = features.shape[-1]
    for name, tensor, shape in (
        ("means", means, (count, 3)),
        ("quats", quats, (count, 4)),
        ("scales", scales, (count, 3)),
        ("opacities", opacities, (count,)),
        ("features", features, (count, channels)),
    ):
        if tuple(tensor.shape) != shape:
            raise PolarguideError(
                f"rasterize({name})",
                expected=f"shape {list(shape)}",
                found=str(list(tensor.shape)),
                remedy="Give one row per Gaussian.",
            )
    if not 1 <= channels <= 32:
        raise PolarguideError(
            "rasterize(features)",
            expected="1 to 32 channels",
            found=str(channels),
            remedy="Split the channels.",
        )
    chosen = statistic.channels if statistic else ()
    if len(set(chosen)) < len(chosen) or not all(0 <= channel < channels for channel in chosen):
        raise PolarguideError(
            "rasterize(statistic)",
            expected=f"different channels below {channels}",
            found=str(chosen),
            remedy="Name channels that exist, each once.",
        )


def refuse_not_finite(name: str, row: int) -> PolarguideError:
    """The error for a NaN or an infinity in the inputs."""
    return PolarguideError(
        f"rasterize({name})",
        expected="finite numbers",
        found=f"NaN or infinity in row {row}",
        remedy="A diverged optimization: lower the learning rate or resume from an earlier checkpoint.",
    )
