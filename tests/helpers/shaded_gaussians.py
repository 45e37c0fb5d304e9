"""Thirty Gaussians of the deferred shading model before a small camera, some of them metals."""

import torch
from torch import Tensor

from polarguide.geometry.camera import Camera

COUNT = 30


def camera() -> Camera:
    eye, back = torch.eye(3, dtype=torch.float64), torch.tensor([0.1, -0.2, 4.0], dtype=torch.float64)
    return Camera(24, 20, 30.0, 30.0, 12.0, 10.0, eye, back)


def gaussians(dtype: torch.dtype = torch.float32, *, metals: int = COUNT // 2) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64).to(dtype)

    return {
        "means": 0.7 * normal(COUNT, 3),
        "quaternions": normal(COUNT, 4),
        "log_scales": -1.5 + 0.5 * normal(COUNT, 3),
        "opacity_logits": 1 + normal(COUNT),
        "sh_dc": normal(COUNT, 3),
        "sh_rest": 0.1 * normal(COUNT, 15, 3),
        "strength_logits": normal(COUNT),
        "local_dc": 0.3 * normal(COUNT, 3),
        "local_rest": 0.1 * normal(COUNT, 15, 3),
        "metalness": (torch.arange(COUNT) < metals).to(dtype),
        "reflectance_logits": normal(COUNT, 3),
        "roughness_logits": normal(COUNT),
    }
