"""Flat surfaces that mirror: their normals from one view, without depth; nothing on curved ones."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from polarguide import optics
from polarguide.capture import View
from polarguide.capture.view import FULL_CODE
from polarguide.geometry.camera import Camera, look_at
from polarguide.geometry.polarizer import ANGLES
from polarguide.geometry.vectors import dot, unit
from polarguide.training.priors import FlatRules, flat_surface, flat_surfaces, view_priors
from polarguide.training.recipe import Priors

WIDTH, HEIGHT, INDEX = 80, 60, 1.5
UP = torch.tensor([0.0, 0.0, 1.0])


def camera(turn: float = 0.0, height: float = 1.5) -> Camera:
    eye = (3 * math.cos(turn), 3 * math.sin(turn), height)
    return Camera(WIDTH, HEIGHT, 70.0, 70.0, WIDTH / 2, HEIGHT / 2, *look_at(eye, (0, 0, 0), (0, 0, 1)))


def photographed(of: Camera, normals: Tensor, where: Tensor, *, mirrors: float = 1.0) -> View:
    """Four pictures of a surface of these normals [H, W, 3], camera axes, that mirrors a pattern."""
    light = 0.3 + 0.2 * torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(1))
    rays = of.rays()
    specular, diffuse = mirrors * light, (1 - mirrors) * light
    polarized = optics.predicted_stokes(specular, diffuse, normals, rays, INDEX)
    stokes = torch.where(where[..., None], polarized, torch.stack((light, 0 * light, 0 * light)))
    pictures = []
    for angle in ANGLES:
        double = 2 * math.radians(angle)
        pictures.append((stokes[0] + stokes[1] * math.cos(double) + stokes[2] * math.sin(double)) / 2)
    codes = (torch.stack(pictures).clamp(0, 1) * FULL_CODE).round().to(torch.int32).to(torch.uint16)
    no = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    return View("view", of, codes, no, no)


def floor(of: Camera, normal: Tensor = UP, **how: float) -> tuple[View, Tensor]:
    """The lower part of a picture shows a plane."""
    where = (torch.arange(HEIGHT) >= HEIGHT // 3)[:, None].expand(HEIGHT, WIDTH)
    return photographed(of, of.to_camera(normal.expand(HEIGHT, WIDTH, 3)), where, **how), where


def degrees(one: Tensor, other: Tensor) -> float:
    return math.degrees(math.acos(min(1.0, float(unit(one) @ unit(other)))))


@pytest.mark.parametrize("mirrors", [1.0, 0.8])
@pytest.mark.parametrize("tilt", [0.0, 0.4])
def test_a_plane_has_one_normal_on_its_true_side(tilt: float, mirrors: float) -> None:
    normal = torch.tensor([math.sin(tilt), 0.0, math.cos(tilt)])
    view, where = floor(camera(), normal, mirrors=mirrors)
    found = flat_surface(view, INDEX, FlatRules())
    assert degrees(found.normal, normal) < 0.2
    assert float((found.where & where).sum() / where.sum()) > 0.85
    assert float((found.where & ~where).float().mean()) < 0.03


def test_a_ball_is_not_flat() -> None:
    # Its planes of incidence meet, in the ray through its center.
    of = camera()
    rays, center = of.rays(), torch.tensor([0.0, 0.0, 2.0])
    along = dot(rays, center.expand_as(rays))
    square = along**2 - float(center @ center) + 0.95**2
    hit = square > 0
    normals = unit((along - square.clamp(min=0).sqrt())[..., None] * rays - center)
    assert float(hit.float().mean()) > 0.4
    assert flat_surface(photographed(of, normals, hit), INDEX, FlatRules()) is None


def test_what_is_not_polarized_and_what_is_noise_is_not_flat() -> None:
    of = camera()
    nothing = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    normals = of.to_camera(UP.expand(HEIGHT, WIDTH, 3))
    view = photographed(of, normals, nothing)
    assert flat_surface(view, INDEX, FlatRules()) is None
    noise = torch.rand(view.codes.shape, generator=torch.Generator().manual_seed(2)) * FULL_CODE
    assert (
        flat_surface(replace(view, pictures=noise.to(torch.int32).to(torch.uint16)), INDEX, FlatRules())
        is None
    )
    assert flat_surface(replace(floor(of)[0], invalid=~nothing), INDEX, FlatRules()) is None


def test_views_have_to_agree_and_then_have_their_mean() -> None:
    views = [replace(floor(camera(0.5 * k))[0], name=f"v{k}") for k in range(5)]
    aside = torch.tensor([math.sin(0.3), 0.0, math.cos(0.3)])
    views.append(replace(floor(camera(0.2), aside)[0], name="v5"))
    found = flat_surfaces(views, INDEX, FlatRules())
    assert sorted(found) == [f"v{k}" for k in range(5)]
    assert all(degrees(flat.normal, UP) < 0.1 for flat in found.values())
    assert flat_surfaces(views[:2], INDEX, FlatRules()) == {}
    # Two thirds of the views see nothing of it.
    blank = photographed(
        camera(), torch.zeros(HEIGHT, WIDTH, 3), torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    )
    others = [replace(blank, name=f"w{k}") for k in range(11)]
    assert flat_surfaces([*views[:5], *others], INDEX, FlatRules()) == {}


def test_it_takes_the_place_of_a_guide_that_is_the_mirror_image() -> None:
    of = camera()
    view, _ = floor(of)
    flat = flat_surface(view, INDEX, FlatRules())
    rays = of.rays()
    true = of.to_camera(UP.expand_as(rays))
    wrong = of.to_world(
        unit(2 * dot(true, rays)[..., None] * rays - true)
    )  # the same zenith, the other azimuth
    settings = Priors(chromatic=True, threshold=0.01, full_dolp=0.05)
    without, having = (view_priors(view, wrong, settings, INDEX, flat=f) for f in (None, flat))
    where = flat.where
    assert float(dot(without.normal, UP.expand_as(rays))[where].median()) < 0.7
    assert float(dot(having.normal, UP.expand_as(rays))[where].min()) > 0.999
    assert float(dot(having.chromatic, UP.expand_as(rays))[where].min()) > 0.999
    assert float(having.chromatic_weight[where].min()) == 1
    assert torch.equal(having.stokes, without.stokes)
    assert torch.equal(having.chromatic_weight[~where], without.chromatic_weight[~where])
