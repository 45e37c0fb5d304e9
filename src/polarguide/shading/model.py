"""What every shading model of deferred reflection offers to rendering and to export."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol

from torch import Tensor

from polarguide.camera import Camera
from polarguide.vectors import dot

# Brightest light of an environment with the exponential scale: e^5, about 150 times display white.
MAXIMUM_LOG_LIGHT = 5.0


class Parameters(Protocol):
    """Named per-Gaussian tensors: the trainable rows, or a frozen copy of them."""

    def __getitem__(self, name: str, /) -> Tensor: ...
    def __contains__(self, name: str, /) -> bool: ...


class GBuffer(NamedTuple):
    """What was splatted for a picture that is shaded afterwards.

    Attributes:
        features: [H, W, 6 + K] blended color, normal (world axes) and channels of the shading model; others may
            follow.
        alpha: [H, W].
    """

    features: Tensor
    alpha: Tensor

    @property
    def color(self) -> Tensor:
        """[H, W, 3]."""
        return self.features[..., :3]

    @property
    def normal(self) -> Tensor:
        """[H, W, 3] blended, world axes, not normalized."""
        return self.features[..., 3:6]

    @property
    def further(self) -> Tensor:
        """[H, W, K] channels of the shading model."""
        return self.features[..., 6:]


class ShadingModel(Protocol):
    """What a recipe's reflection splats, and how it makes the picture of it.

    ``light`` is the learned environment: its parameters by name.
    """

    def channels(
        self, gaussians: Parameters, normals: Tensor, center: Tensor, sh_degree: int
    ) -> list[Tensor]:
        """Per Gaussian: colors [N, 3], then what is blended behind color and normal, each [N, C]."""

    def shade(self, splatted: GBuffer, light: Mapping[str, Tensor], camera: Camera) -> dict[str, Tensor]:
        """Layers of a picture by their names in ``RenderResult``; ``final`` at least."""

    def colors(
        self, gaussians: Parameters, light: Mapping[str, Tensor], rays: Tensor, normals: Tensor
    ) -> Tensor:
        """Linear colors [N, 3] of Gaussians shaded one by one, along unit rays [N, 3] at facing normals [N, 3]."""

    def fields(self, gaussians: Parameters) -> dict[str, Tensor]:
        """What a PLY of the Gaussians keeps besides display colors, [N, ...] by name."""


def mirrored(rays: Tensor, normals: Tensor) -> Tensor:
    """Directions of rays [..., 3] after reflection at unit normals [..., 3]."""
    return rays - 2 * dot(rays, normals)[..., None] * normals
