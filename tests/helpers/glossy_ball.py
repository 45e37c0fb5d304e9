"""A glossy ball seen from all around: pictures, surfaces and points from formulas, for tests of the geometry."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from polarguide import optics
from polarguide.capture import ColmapModel
from polarguide.capture.calibration import Calibration, oriented
from polarguide.geometry.camera import Camera
from polarguide.geometry.polarizer import ANGLES
from polarguide.inspection.capture import InspectedView
from polarguide.inspection.evidence import ViewSurface

WIDTH, HEIGHT, INDEX = 72, 64, 1.5


@dataclasses.dataclass(frozen=True, eq=False)
class Sighted(ColmapModel):
    """A model whose points know what sees them without images."""

    seen: Tensor = dataclasses.field(default_factory=lambda: torch.zeros(0, 0, dtype=torch.bool))

    def observations(self, views: object) -> Tensor:
        return self.seen


def camera_at(turn: float, height: float, roll: float) -> Camera:
    """A camera at distance 4 that looks at the origin, rolled about its axis."""
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    flat = math.sqrt(1 - height * height)
    center = 4 * torch.tensor([flat * math.cos(turn), flat * math.sin(turn), height], dtype=torch.float64)
    ahead = -center / center.norm()
    right = torch.linalg.cross(ahead, up)
    right = right / right.norm()
    down = torch.linalg.cross(ahead, right)
    c, s = math.cos(roll), math.sin(roll)
    rotation = torch.stack((c * right + s * down, c * down - s * right, ahead))
    return Camera(WIDTH, HEIGHT, 110.0, 110.0, WIDTH / 2, HEIGHT / 2, rotation, -rotation @ center)


def ball(camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Normal in camera axes [H, W, 3], depth [H, W], and where the unit ball is [H, W]."""
    rays = camera.rays(dtype=torch.float64)
    center = camera.translation
    along = rays @ center
    under = along**2 - float(center @ center) + 1
    hit = under > 0
    distance = along - under.clamp(min=0).sqrt()
    normal = torch.where(hit[..., None], rays * distance[..., None] - center, -rays)
    return normal.float(), (distance * rays[..., 2]).float(), hit


def pictures_of(
    name: str, camera: Camera, specular: float, diffuse: float, noise: float = 0.0
) -> InspectedView:
    """The four pictures of the ball before an unpolarized gray wall."""
    normal, _, hit = ball(camera)
    gloss = torch.where(hit, specular, 0.0)[..., None].expand(HEIGHT, WIDTH, 3)
    body = torch.where(hit, diffuse, 0.4)[..., None].expand(HEIGHT, WIDTH, 3)
    normal = torch.where(hit[..., None], normal, -camera.rays())
    stokes = optics.predicted_stokes(gloss, body, normal, camera.rays(), INDEX)
    values = torch.stack([optics.intensity(stokes, math.radians(angle)) for angle in ANGLES])
    generator = torch.Generator().manual_seed(len(name) + ord(name[-1]))
    values = values + noise * torch.randn(values.shape, generator=generator)
    return with_intensities(
        InspectedView(
            name,
            torch.zeros(0, dtype=torch.uint16),
            torch.zeros(HEIGHT, WIDTH, dtype=torch.bool),
            torch.zeros(HEIGHT, WIDTH, dtype=torch.bool),
            torch.zeros(HEIGHT, WIDTH, dtype=torch.bool),
            camera,
            60000,
        ),
        values.numpy(),
    )


def with_intensities(view: InspectedView, values: np.ndarray) -> InspectedView:
    """A view with other pictures."""
    codes = np.rint(np.clip(values, 0, 1) * 65535).astype(np.uint16)
    return dataclasses.replace(view, codes=torch.from_numpy(codes))


def mistaken(view: InspectedView, *, files: tuple[int, ...] = ANGLES, zero: float = 0.0) -> InspectedView:
    """The view as an instrument with this zero and these file names would have stored it."""
    values = oriented(view.intensities().numpy(), Calibration(zero=-zero))
    return with_intensities(view, values[[ANGLES.index(angle) for angle in files]])


def surfaces(views: tuple[InspectedView, ...]) -> list[tuple[InspectedView, ViewSurface]]:
    """Views with the true surface."""
    pairs = []
    for view in views:
        assert view.camera is not None
        normal, depth, hit = ball(view.camera)
        pairs.append((view, ViewSurface(view.camera, normal, depth, hit)))
    return pairs


def views_around(
    specular: float = 0.3, diffuse: float = 0.03, noise: float = 0.001
) -> tuple[InspectedView, ...]:
    """Fourteen views from two heights, each with a roll of its own."""
    places = [(2 * math.pi * k / 14, 0.25 if k % 2 else 0.6, 0.2 * (k % 5 - 2)) for k in range(14)]
    return tuple(
        pictures_of(f"v{k:02d}", camera_at(*place), specular, diffuse, noise)
        for k, place in enumerate(places)
    )


def model_of(views: tuple[InspectedView, ...], count: int = 400) -> Sighted:
    """Points on the ball, seen by the views toward which they face."""
    generator = torch.Generator().manual_seed(1)
    places = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    seen = []
    for view in views:
        assert view.camera is not None
        toward = torch.nn.functional.normalize(view.camera.center.float() - places, dim=1)
        seen.append((toward * places).sum(dim=1) > 0.25)
    colors = torch.zeros(count, 3, dtype=torch.uint8)
    return Sighted(Path("sparse"), (), places, colors, (), {}, {}, seen=torch.stack(seen, dim=1))
