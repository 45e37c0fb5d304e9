"""Priors of the demo scene, whose normals and layers are known, with the true normals as guide."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from polarguide import optics
from polarguide.capture import GroundTruth, View, load_scene
from polarguide.optics.color import srgb_decode, srgb_encode
from polarguide.training.losses import azimuth_loss
from polarguide.training.priors import ViewPriors, debiased_dolp, guide_normals, view_priors
from polarguide.training.recipe import Priors

INDEX = 1.5
PAPER = Priors(candidates="paper", separation="paper", azimuth_weight=0.0)
EXACT = Priors(candidates="physical", separation="exact")


@pytest.fixture(scope="module")
def view(demo_scene: Path) -> View:
    return load_scene(demo_scene, views=["v022"]).view("v022")


def ground_truth_of(view: View) -> GroundTruth:
    assert view.ground_truth is not None
    return view.ground_truth


def guide_of(view: View) -> Tensor:
    normal = ground_truth_of(view).normal
    assert normal is not None
    return normal


def psnr(found: Tensor, linear: Tensor, where: Tensor) -> float:
    error = (found - srgb_encode(linear.clamp(0, 1)))[where].square().mean()
    return float(-10 * torch.log10(error))


def layers_psnr(priors: ViewPriors, view: View) -> tuple[float, float]:
    ground_truth = ground_truth_of(view)
    where = ground_truth.mask & (priors.separated > 0)
    assert float(where.sum() / ground_truth.mask.sum()) > 0.5
    return psnr(priors.specular, ground_truth.specular / 2, where), psnr(
        priors.diffuse, ground_truth.diffuse / 2, where
    )


def test_exact_separation_is_near_the_truth_and_nearer_than_the_papers(view: View) -> None:
    exact = layers_psnr(view_priors(view, guide_of(view), EXACT, INDEX), view)
    paper = layers_psnr(view_priors(view, guide_of(view), PAPER, INDEX), view)
    assert min(exact) > 35
    assert exact[0] > paper[0] + 5
    assert exact[1] > paper[1] + 5


def test_exact_layers_add_up_to_the_photograph_and_the_papers_fall_short(view: View) -> None:
    for settings in (EXACT, PAPER):
        priors = view_priors(view, guide_of(view), settings, INDEX)
        inside = (priors.specular > 0.01) & (priors.diffuse > 0.01) & (view.photograph() < 0.99)
        assert float(inside.float().mean()) > 0.5
        total = srgb_decode(priors.specular) + srgb_decode(priors.diffuse)
        if settings is EXACT:
            torch.testing.assert_close(total[inside], view.photograph()[inside], atol=1e-5, rtol=1e-5)
        else:
            assert bool((total < 0.99 * view.photograph())[inside].all())


def test_settings_of_the_paper_give_other_priors(view: View) -> None:
    exact = view_priors(view, guide_of(view), EXACT, INDEX)
    paper = view_priors(view, guide_of(view), PAPER, INDEX)
    for name in ("specular", "diffuse", "normal", "separated"):
        assert not torch.allclose(getattr(exact, name), getattr(paper, name), atol=0.01), name


def test_the_true_normals_lie_near_the_planes_of_incidence(view: View) -> None:
    priors = view_priors(view, guide_of(view), EXACT, INDEX)
    assert float(priors.weight.sum()) > 500
    assert float(azimuth_loss(guide_of(view), priors)) < 0.07
    turned = view.camera.to_world(torch.tensor([1.0, 1.0, -1.0]).expand_as(guide_of(view)))
    assert float(azimuth_loss(turned, priors)) > 0.3


def test_color_differences_find_the_plane_that_a_wrong_guide_misses(view: View) -> None:
    """The guide is turned by a quarter about each ray, so that it prefers the other lobe everywhere."""
    rays = view.camera.world_rays()
    ground_truth = guide_of(view)
    along = (ground_truth * rays).sum(-1, keepdim=True) * rays
    turned = along + torch.linalg.cross(rays, ground_truth - along)
    distance = {}
    for chromatic in (False, True):
        priors = view_priors(view, turned, replace(EXACT, chromatic=chromatic), INDEX)
        distance[chromatic] = (priors.plane * ground_truth).sum(-1).abs()
        if chromatic:
            decided = priors.chromatic_weight > 0
            assert float(decided.sum()) > 1000
        else:
            assert not priors.chromatic_weight.any()
    assert float(distance[False][decided].mean()) > 0.5
    assert float(distance[True][decided].mean()) < 0.1
    assert torch.equal(distance[True][~decided], distance[False][~decided])


def test_color_differences_of_gray_bodies_count_near_the_guide_alone(view: View) -> None:
    rays, true = view.camera.world_rays(), guide_of(view)
    loose, strict = (
        replace(EXACT, chromatic=True, chromatic_within=within) for within in (None, (20.0, 40.0))
    )
    side = torch.nn.functional.normalize(torch.linalg.cross(rays, true), dim=-1)
    # At 60 degrees the mirrored side of some rays is nearer.
    for degrees, least, most in ((0, 0.9, 1.0), (30, 0.35, 0.65), (60, 0.0, 0.3)):
        turn = math.radians(degrees)
        guide = math.cos(turn) * true + math.sin(turn) * torch.linalg.cross(side, true)
        free, held = (view_priors(view, guide, settings, INDEX) for settings in (loose, strict))
        contrast = optics.chromatic_normals(view.stokes(), INDEX).contrast
        assert torch.equal(held.chromatic_weight[contrast > 0.3], free.chromatic_weight[contrast > 0.3])
        known = (contrast < 0.2) & (free.chromatic_weight > 0.5) & (true.norm(dim=-1) > 0.5)
        # Where the turned guide faces the camera still: others are brought to grazing.
        known &= (guide * rays).sum(-1) < -0.1
        assert int(known.sum()) > 60
        kept = float(held.chromatic_weight[known].sum() / free.chromatic_weight[known].sum())
        assert least <= kept <= most, degrees
        assert not bool((held.chromatic_weight > free.chromatic_weight).any())


def test_shapes_ranges_and_units(view: View) -> None:
    priors = view_priors(view, guide_of(view), EXACT, INDEX)
    size = (view.camera.height, view.camera.width)
    for name in ("specular", "diffuse"):
        layer = getattr(priors, name)
        assert layer.shape == (*size, 3)
        assert 0 <= float(layer.min()) <= float(layer.max()) <= 1
    assert priors.weight.shape == priors.separated.shape == size
    assert 0 <= float(priors.weight.min()) <= float(priors.weight.max()) <= 1
    assert set(priors.separated.unique().tolist()) <= {0.0, 1.0}
    counted = priors.weight > 0
    torch.testing.assert_close(priors.normal.norm(dim=-1)[counted], torch.ones(int(counted.sum())))
    rays = view.camera.world_rays()
    assert bool(((priors.normal * rays).sum(-1)[counted] < 1e-3).all()), "faces the camera"
    torch.testing.assert_close(
        (priors.normal * priors.plane).sum(-1)[counted], torch.zeros(int(counted.sum())), atol=1e-4, rtol=0
    )


def test_where_the_guide_knows_nothing_the_weights_are_zero(view: View) -> None:
    guide = guide_of(view).clone()
    guide[:40] = 0
    priors = view_priors(view, guide, EXACT, INDEX)
    assert not priors.weight[:40].any()
    assert not priors.separated[:40].any()
    assert bool(priors.weight[40:].any())


def test_guide_normals_face_the_camera_and_mixed_ones_are_not_known(view: View) -> None:
    rays = view.camera.rays()
    raw = torch.randn(rays.shape, generator=torch.Generator().manual_seed(0))
    unit, known = guide_normals(raw, rays, Priors.minimum_normal)
    assert float((unit * rays).sum(-1).max()) <= 1e-4
    torch.testing.assert_close(unit.norm(dim=-1), torch.ones(rays.shape[:2]))
    assert torch.equal(known, raw.norm(dim=-1) > 0.3)
    facing = (raw * rays).sum(-1) < -1e-3
    torch.testing.assert_close(unit[facing], normalize(raw, dim=-1)[facing])


KIND = replace(PAPER, candidates="azimuths", live=True, threshold=0.1, full_dolp=1e-6)


def test_kindly_read_candidates_face_the_camera_a_quarter_turn_apart(view: View) -> None:
    priors = view_priors(view, guide_of(view), KIND, INDEX)
    assert priors.candidates is not None
    candidates = view.camera.to_camera(priors.candidates)
    rays = view.camera.rays()[..., None, :]
    cosine = -(candidates * rays).sum(dim=-1)
    assert float(cosine.min()) > -1e-6
    torch.testing.assert_close(cosine, cosine[..., :1].expand_as(cosine), atol=1e-5, rtol=0)
    across = candidates + cosine[..., None] * rays
    for turn, expected in ((1, 0.0), (2, -1.0), (3, 0.0)):
        turned = (across * across.roll(turn, dims=-2)).sum(dim=-1) / across.square().sum(dim=-1).clamp(
            min=1e-9
        )
        tilted = across.norm(dim=-1) > 0.05
        torch.testing.assert_close(
            turned[tilted], torch.full_like(turned[tilted], expected), atol=1e-3, rtol=0
        )


def test_a_live_choice_counts_wherever_the_polarization_is_strong(view: View) -> None:
    nowhere = torch.zeros_like(guide_of(view))
    frozen = view_priors(view, nowhere, replace(KIND, live=False), INDEX)
    live = view_priors(view, nowhere, KIND, INDEX)
    assert frozen.candidates is None
    assert not frozen.weight.any()
    stokes = optics.luminance(optics.stokes(view.intensities()))
    strong = (optics.dolp(stokes) > 0.1) & ~view.invalid & ~view.saturated
    assert torch.equal(live.weight, strong.float())
    assert 0.01 < float(strong.float().mean()) < 0.9


def test_noise_does_not_make_a_weak_polarization_count_more() -> None:
    generator, sigma, true = torch.Generator().manual_seed(4), 0.01, 0.04
    clean = (1 + true * torch.tensor((1.0, 0.0, -1.0, 0.0))) / 2
    noisy = clean[:, None, None] + sigma * torch.randn(4, 200, 200, generator=generator)
    stokes = optics.stokes(noisy)
    raw = float(debiased_dolp(stokes, 0.0).mean())
    found = float(debiased_dolp(stokes, torch.full((200, 200), sigma)).mean())
    assert raw > true + 0.001
    assert abs(found - true) < (raw - true) / 3
