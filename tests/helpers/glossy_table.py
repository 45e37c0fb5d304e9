"""A dark glossy table under a bright ceiling, by formula: one picture of each view, behind a polarizer."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from polarguide import optics
from polarguide.capture import Scene, View
from polarguide.capture.exposures import Exposure
from polarguide.geometry.camera import Camera, look_at

WIDTH, HEIGHT, VIEWS, INDEX = 40, 30, 24, 1.5
ELEVATION = math.radians(34.0)
"""Of the cameras: the table is seen near Brewster's angle, at which an upright polarizer takes all reflections away."""


def glossy_table() -> Scene:
    """Cameras on a ring; every eighth view is held out."""
    views = tuple(_view(number) for number in range(VIEWS))
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(600, 3, generator=generator) * torch.tensor([5.0, 5.0, 0.0]) - torch.tensor(
        [2.5, 2.5, 0.0]
    )
    return Scene(
        root=Path("table"),
        name="table",
        views=views,
        test_names=tuple(view.name for view in views[::8]),
        points=points,
        point_colors=(body(points) * 510).round().to(torch.uint8),
        refractive_index=INDEX,
        downscale=1,
        transfer="linear",
        digest="table",
        warnings=(),
    )


def radiance(camera: Camera) -> tuple[Tensor, Tensor]:
    """Both layers of the table, S0/2, [H, W, 3]: what it mirrors, and its body."""
    rays = camera.rays(dtype=torch.float64) @ camera.rotation
    distance = camera.center[2] / -rays[..., 2:]
    places = (camera.center + distance * rays).float()
    mirrored = rays * torch.tensor([1.0, 1.0, -1.0])
    s, p = optics.reflectances_from_cosine(mirrored[..., 2:], INDEX)
    return ((s + p) / 2 * ceiling(mirrored)).float(), body(places)


def ceiling(directions: Tensor) -> Tensor:
    """Light from above, in windows."""
    x, y = 3 * directions[..., 0], 3 * directions[..., 1]
    windows = torch.sigmoid(8 * torch.sin(2 * x) * torch.sin(2 * y + 1))
    return (0.5 + 3.0 * windows)[..., None] * torch.tensor([1.0, 0.9, 0.8])


def body(places: Tensor) -> Tensor:
    """Dark wood with a grain, S0/2."""
    grain = 0.03 + 0.02 * torch.sin(4 * places[..., 0] + torch.sin(3 * places[..., 1]))
    return grain[..., None] * torch.tensor([1.0, 0.7, 0.5])


def _view(number: int) -> View:
    turn = 2 * math.pi * number / VIEWS
    center = (
        4 * math.cos(turn) * math.cos(ELEVATION),
        4 * math.sin(turn) * math.cos(ELEVATION),
        4 * math.sin(ELEVATION),
    )
    camera = Camera(
        WIDTH, HEIGHT, 50.0, 50.0, WIDTH / 2, HEIGHT / 2, *look_at(center, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    )
    specular, diffuse = radiance(camera)
    up = torch.tensor([0.0, 0.0, 1.0]).expand(HEIGHT, WIDTH, 3) @ camera.rotation.float().T
    stokes = optics.predicted_stokes(2 * specular, 2 * diffuse, up, camera.rays(), INDEX)
    angle = 15.0 * ((5 * number) % 12)
    light = optics.intensity(stokes, math.radians(angle))
    noise = (
        0.01
        * torch.randn(light.shape, generator=torch.Generator().manual_seed(number))
        * light.clamp(min=0).sqrt()
    )
    codes = ((light + noise).clamp(0, 1) * 65535).round().to(torch.int32).to(torch.uint16)[None]
    nowhere = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    return View(
        f"v{number:02d}", camera, codes, nowhere, (codes[0] == 65535).any(-1), exposures=(Exposure(angle),)
    )
