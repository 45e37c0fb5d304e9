"""A textured ball off the center of its cameras, before a sky: pictures and normals from formulas."""

import math
from pathlib import Path

import torch
from torch import Tensor

from polarguide import optics
from polarguide.capture import GroundTruth, Scene, View
from polarguide.geometry.camera import Camera, look_at
from polarguide.geometry.polarizer import ANGLES
from polarguide.geometry.vectors import unit
from polarguide.optics.color import srgb_decode
from polarguide_bench.gnerp.field import MARGIN

DISTANCE = 4.0
OFFSET = (0.3, -0.2, 0.25)


def cameras(count: int, width: int, height: int) -> list[Camera]:
    """Cameras on a sphere, spread evenly, that look at the origin."""
    made = []
    for k in range(count):
        z = 0.9 - 1.8 * (k + 0.5) / count
        turn, flat = k * math.pi * (3 - math.sqrt(5)), math.sqrt(1 - z * z)
        eye = [DISTANCE * flat * math.cos(turn), DISTANCE * flat * math.sin(turn), DISTANCE * z]
        made.append(
            Camera(
                width,
                height,
                0.9 * width,
                0.9 * width,
                width / 2,
                height / 2,
                *look_at(eye, (0, 0, 0), (0, 0, 1)),
            )
        )
    return made


def texture(directions: Tensor, frequency: float) -> Tensor:
    """Smooth shown colors in [0.1, 0.9] of directions [..., 3]."""
    phases = directions.new_tensor([[1.0, 2.1, 0.4], [0.3, 1.1, 2.9], [2.2, 0.7, 1.3]])
    return 0.5 + 0.4 * torch.sin(frequency * directions.flip(-1) + phases[0]) * torch.cos(
        frequency * directions + phases[1]
    )


def textured_ball(
    *, views: int, width: int, height: int, tests: int = 2, radius: float, polarized: float = 0.0
) -> Scene:
    """The scene; views from the side are held out.

    Args:
        radius: of the ball. polarized: DoLP of the ball's light, specular, in [0, 1].
    """
    made = []
    for k, camera in enumerate(cameras(views, width, height)):
        rays = camera.world_rays(dtype=torch.float64)
        away = camera.center - torch.tensor(OFFSET, dtype=torch.float64)
        along = -(rays @ away)
        under = along**2 - away @ away + radius**2
        hit = under > 0
        t = along - under.clamp(min=0).sqrt()
        normal = unit(away + t[..., None] * rays)
        picture = torch.where(hit[..., None], texture(normal, 5.0), texture(rays, 2.0))
        twice = 2 * (optics.azimuth(camera.to_camera(normal), camera.rays(dtype=torch.float64)) + math.pi / 2)
        share = torch.where(hit, polarized, 0.0)
        total = 2 * srgb_decode(picture)
        stokes = torch.stack(
            (
                total,
                total * (share * torch.cos(twice))[..., None],
                total * (share * torch.sin(twice))[..., None],
            )
        )
        values = torch.stack([optics.intensity(stokes, math.radians(angle)) for angle in ANGLES])
        codes = (values.clamp(0, 1) * 65535).round().to(torch.uint16)
        nothing = torch.zeros(height, width, dtype=torch.bool)
        truth = GroundTruth(normal=torch.where(hit[..., None], normal, 0.0).float(), mask=hit)
        made.append(View(f"v{k:02d}", camera, codes, nothing, nothing, truth=truth))
    middle = (views - tests) // 2
    held_out = tuple(view.name for view in made[middle : middle + tests])
    nowhere, black = torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8)
    return Scene(Path("ball"), "ball", tuple(made), held_out, nowhere, black, None, 1, "linear", "ball", ())


def ball_radius() -> float:
    """0.6 of the radius of the sphere that a field starts as, which is half of the cameras' here."""
    return 0.6 * 0.5 * MARGIN * DISTANCE
