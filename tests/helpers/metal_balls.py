"""Balls of metals and of other materials in a room: what is measured of them, views, and Gaussians."""

import math

import torch
from glossy_ball import ball, camera_at
from torch import Tensor

from polarguide import optics
from polarguide.capture import View
from polarguide.geometry.polarizer import ANGLES
from polarguide.geometry.vectors import spread_directions

METALS = {"gold": (0.95, 0.78, 0.37), "aluminum": (0.91, 0.91, 0.92), "chromium": (0.55, 0.55, 0.54)}
BODIES = {
    "white": (0.6, 0.6, 0.6),
    "red": (0.5, 0.1, 0.05),
    "gray": (0.2, 0.2, 0.2),
    "black": (0.02, 0.02, 0.02),
}


def light(directions: Tensor) -> Tensor:
    """Radiance [..., 3] of a room: a window, a dark floor and something between."""
    x, _, z = directions.double().unbind(-1)
    window = torch.sigmoid(12 * (x - 0.5)) * torch.sigmoid(12 * (z + 0.2))
    gray = 0.15 + 0.35 * torch.sigmoid(4 * z) + 0.25 * torch.sin(5 * directions[..., 1].double())
    return (gray.clamp(min=0.03) + 1.2 * window)[..., None].expand(*directions.shape[:-1], 3) / 2


def measured(
    material: str, cosine: Tensor, light: Tensor, polarized: tuple[Tensor, Tensor] | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """S0, polarization across the plane of incidence and at 45 degrees to it [..., 3] of a smooth surface.

    Args:
        light: [..., 3]. polarized: its shares [..., 1] that are polarized across that plane and at 45 degrees to it.
    """
    c = cosine[..., None]
    sine2 = 1 - c * c
    body, under = torch.zeros_like(light), torch.zeros_like(c)
    if material in METALS:
        mean, slope = optics.conductor(c, torch.tensor(METALS[material], dtype=c.dtype))
        over = slope * sine2
    else:
        s, p = optics.reflectances_from_cosine(c)
        mean = 0.5 * (s + p)
        over, under = (slope * sine2 for slope in optics.dolp_slopes(c))
        body = torch.tensor(BODIES[material], dtype=c.dtype).expand_as(light) / 2
    across, oblique = (torch.zeros_like(c), torch.zeros_like(c)) if polarized is None else polarized
    mirrored = mean * light
    s0 = mirrored * (1 + over * across) + body
    return s0, mirrored * (over + across) - under * body, -mirrored * (1 - over**2).sqrt() * oblique


def polarized_light(coming_from: Tensor, normal: Tensor, degree: float) -> tuple[Tensor, Tensor]:
    """Light that vibrates as level as it can: across the plane of incidence and at 45 degrees to it [..., 1]."""
    up = torch.tensor([0.3, 0.1, 1.0]).expand_as(normal)
    vibration = torch.nn.functional.normalize(torch.linalg.cross(coming_from, up), dim=-1)
    across = torch.nn.functional.normalize(torch.linalg.cross(coming_from, normal), dim=-1)
    along = torch.linalg.cross(coming_from, across)
    s, p = (vibration * across).sum(-1, keepdim=True), (vibration * along).sum(-1, keepdim=True)
    return degree * (s * s - p * p), 2 * degree * s * p


def views_of(material: str, degree: float = 0.0, other: str | None = None) -> list[View]:
    """A ball in the room, from all around; the light has a degree of polarization.

    Args:
        other: material where x is negative; the same, if not given.
    """
    found = []
    for k in range(16):
        camera = camera_at(2 * math.pi * k / 16, (0.15, 0.5, 0.75)[k % 3], 0.0)
        normal, _, hit = ball(camera)
        rays = camera.rays()
        cosine = -(normal * rays).sum(dim=-1).clamp(-1, 0)
        mirrored = camera.to_world(rays + 2 * cosine[..., None] * normal)
        polarized = polarized_light(mirrored, camera.to_world(normal), degree)
        one, two = (
            measured(m, cosine.double(), light(mirrored), polarized) for m in (material, other or material)
        )
        here = camera.to_world(normal)[..., :1] > 0
        s0, across, oblique = (torch.where(here, a, b) for a, b in zip(one, two, strict=True))
        x_ref, up_ref = optics.lens_frame(rays)
        x, y = (normal * x_ref).sum(-1), (normal * up_ref).sum(-1)
        sine2 = (x * x + y * y).clamp(min=1e-9)
        cosine2, sine = ((x * x - y * y) / sine2)[..., None], (2 * x * y / sine2)[..., None]
        s1, s2 = -across * cosine2 - oblique * sine, -across * sine + oblique * cosine2
        stokes = torch.stack((s0, s1, s2)) * hit[..., None]
        codes = torch.stack([optics.intensity(stokes, math.radians(angle)) for angle in ANGLES])
        codes = (codes.clamp(0, 1) * 65535).round().to(torch.uint16)
        nowhere = torch.zeros(hit.shape, dtype=torch.bool)
        found.append(View(f"v{k:02d}", camera, codes, ~hit, nowhere))
    return found


def gaussians_of_the_ball(count: int = 900) -> dict[str, Tensor]:
    """Flat, opaque Gaussians on the unit ball."""
    normals = spread_directions(count).float()
    z = torch.tensor([0.0, 0.0, 1.0])
    # The rotation that takes z to the normal.
    quaternions = torch.cat((1 + normals[:, 2:], torch.linalg.cross(z.expand_as(normals), normals)), dim=1)
    return {
        "means": normals.clone(),
        "quaternions": torch.nn.functional.normalize(quaternions, dim=1),
        "log_scales": torch.tensor([0.07, 0.07, 0.003]).log().expand(count, 3).clone(),
        "opacity_logits": torch.full((count,), 3.0),
        "sh_dc": torch.zeros(count, 3),
        "sh_rest": torch.zeros(count, 15, 3),
    }
