"""Metals are found by what all views measured."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from polarguide.raster.cpu import rasterize_cpu
from polarguide.training.metals.evidence import Evidence, evidence, residuals
from polarguide.training.metals.observations import ViewSamples
from polarguide.training.metals.search import decide
from polarguide.training.rules import MetalRules
from tests.helpers.metal_balls import BODIES, METALS, gaussians_of_the_ball, measured, views_of

RULES = MetalRules()


@pytest.mark.parametrize("material", [*METALS, *BODIES])
def test_the_right_explanation_leaves_less(material: str) -> None:
    generator = torch.Generator().manual_seed(0)
    cosine = 0.35 + 0.6 * torch.rand(24, 40, generator=generator)
    seen = 0.1 + torch.rand(24, 40, 1, generator=generator).expand(24, 40, 3)
    s0, across, _ = measured(material, cosine, seen)
    found = residuals(ViewSamples(torch.ones(24, 40), s0, across, torch.zeros_like(s0), cosine), 1.5, RULES)
    dielectric, metal, reflectance = found
    if material in METALS:
        assert bool((metal < 0.1 * dielectric).all())
        assert float((reflectance - torch.tensor(METALS[material])).abs().max()) < 0.2
    else:
        assert float(dielectric.max()) < 1e-6
        assert bool((metal > dielectric).all())


@pytest.mark.parametrize(
    ("material", "least", "most"), [(m, 0.8, 1.0) for m in METALS] + [(b, 0, 0) for b in BODIES]
)
def test_balls_of_metal_are_found_and_no_others(material: str, least: float, most: float) -> None:
    views = views_of(material)
    found = evidence(gaussians_of_the_ball(), views, rasterize_cpu, 1.5, RULES)
    nothing = torch.zeros(900, dtype=torch.bool)
    metal = decide(found, nothing, ~nothing, RULES)
    seen = gaussians_of_the_ball()["means"][:, 2] > 0.1  # enough cameras look from above
    assert least <= float(metal[seen].float().mean()) <= most
    assert not bool(decide(found, nothing, nothing, RULES).any())


@pytest.mark.parametrize("degree", [0.2, 0.4, 0.6])
@pytest.mark.parametrize(
    ("material", "least", "most"), [(m, 0.5, 1.0) for m in METALS] + [(b, 0, 0) for b in BODIES]
)
def test_polarized_light_shows_metals_and_makes_none(
    material: str, least: float, most: float, degree: float
) -> None:
    found = evidence(gaussians_of_the_ball(), views_of(material, degree), rasterize_cpu, 1.5, RULES)
    nothing = torch.zeros(900, dtype=torch.bool)
    metal = decide(found, nothing, ~nothing, RULES)
    seen = gaussians_of_the_ball()["means"][:, 2] > 0.1
    assert least <= float(metal[seen].float().mean()) <= most


@pytest.mark.parametrize(
    ("material", "other", "most"), [("aluminum", "black", 0.02), ("chromium", "red", 0.005)]
)
def test_a_neighbor_of_a_metal_is_none(material: str, other: str, most: float) -> None:
    """The two halves of a ball meet; what is near the seam is judged by neighbors of like brightness and tint."""
    ball_of_two = gaussians_of_the_ball()
    found = evidence(ball_of_two, views_of(material, other=other), rasterize_cpu, 1.5, RULES)
    nothing = torch.zeros(900, dtype=torch.bool)
    metal = decide(found, nothing, ~nothing, RULES)
    x, _, z = ball_of_two["means"].unbind(1)
    assert float(metal[(z > 0.1) & (x > 0.1)].float().mean()) > 0.8
    assert float(metal[(z > 0.1) & (x < -0.1)].float().mean()) < most


def test_oblique_polarization_has_to_be_much_and_to_explain_the_misfit() -> None:
    oblique, misfit, brightness, ratio = (torch.full((120,), v) for v in (0.01, 0.1, 1.0, 0.2))
    for begin in (5, 35, 65, 95):
        oblique[begin : begin + 20] = 0.09
    misfit[35:55] = 0.25
    brightness[65:85] = 0.3  # a dark body, of a light that is bright elsewhere
    ratio[95:115] = -0.2  # a dielectric fits better
    nothing = torch.zeros(120, dtype=torch.bool)
    found = said(120, oblique=oblique, metal_misfit=misfit, brightness=brightness, ratio=ratio)
    assert decide(found, nothing, ~nothing, RULES).nonzero()[:, 0].tolist() == list(range(5, 25))


def said(count: int, **values: Tensor) -> Evidence:
    """Evidence along a line of Gaussians that says nothing but what is given."""
    near = (torch.arange(count)[:, None] + torch.tensor([0, 1, -1, 2, -2])).clamp(0, count - 1)
    given = Evidence(
        ratio=torch.zeros(count),
        misfit=torch.full((count,), 0.1),
        reflectance=torch.full((count, 3), 0.6),
        near=near,
        alike=torch.ones(count, 5),
        brightness=torch.ones(count),
        tint=torch.ones(count),
        metal_misfit=torch.full((count,), 0.1),
        oblique=torch.zeros(count),
        support=torch.ones(count),
        labels=torch.zeros(count, 2),
    )
    return given._replace(**values)


def test_what_is_too_deeply_colored_is_no_metal_unless_the_user_says_so() -> None:
    ratio, tint, words = torch.full((60,), 3.0), torch.full((60,), 0.3), torch.zeros(60, 2)
    tint[20:] = 0.2
    words[50:, 1] = 5.0
    found = said(60, ratio=ratio, tint=tint, labels=words)
    nothing = torch.zeros(60, dtype=torch.bool)
    assert decide(found, nothing, ~nothing, RULES).nonzero()[:, 0].tolist() == [*range(20), *range(50, 60)]
    assert not bool(decide(found, ~nothing, ~nothing, RULES)[20:50].any())


@pytest.mark.parametrize(("material", "least", "most"), [("gold", 0.4, 0.75), ("red", 0.0, 0.4)])
def test_the_tint_is_that_of_the_material(material: str, least: float, most: float) -> None:
    """Half of the ball is gray, and so in part is the mean: by itself gold has 0.39, red paint 0.1 under its gloss."""
    half = gaussians_of_the_ball()
    found = evidence(half, views_of(material, other="aluminum"), rasterize_cpu, 1.5, RULES)
    x, _, z = half["means"].unbind(1)
    assert least < float(found.tint[(z > 0.1) & (x > 0.1)].median()) < most
    assert float(found.tint[(z > 0.1) & (x < -0.1)].median()) > 0.55


def test_metal_grows_where_it_is_likely_and_stays_where_it_was() -> None:
    ratio = torch.zeros(80)
    ratio[5:19], ratio[19:25], ratio[40:44], ratio[44:60], ratio[70] = 3.0, 1.0, 1.0, 3.0, 3.0
    nothing, all_ = torch.zeros(80, dtype=torch.bool), torch.ones(80, dtype=torch.bool)
    metal = decide(said(80, ratio=ratio), nothing, all_, RULES)
    assert metal.nonzero()[:, 0].tolist() == [*range(5, 25), *range(40, 60)]  # one alone is none
    ratio[30:40], was = 0.35, nothing.clone()  # less than is likely
    was[30:40] = True
    again = decide(said(80, ratio=ratio), was, all_, RULES)
    assert again.nonzero()[:, 0].tolist() == [*range(5, 25), *range(40, 60)]
    other_way = torch.ones(80, 5)
    other_way[19:, 1:] = 0
    metal = decide(said(80, ratio=ratio, alike=other_way), nothing, all_, RULES)
    assert metal.nonzero()[:, 0].tolist()[:14] == list(range(5, 19))
    assert not bool(metal[19:25].any())


@pytest.mark.parametrize(("evidence_left", "stays"), [(1.4, True), (1.0, False)])
def test_where_growth_does_not_reach_metal_stays_only_with_much_evidence(
    evidence_left: float, stays: bool
) -> None:
    """Each of a patch has one sure Gaussian among its 16 nearest: too few to join, enough to be of one piece."""
    ratio, was = torch.zeros(80), torch.zeros(80, dtype=torch.bool)
    ratio[:20], ratio[30:40], was[30:40] = 3.0, evidence_left, True
    own = torch.arange(80)[:, None]
    near = torch.cat((own, own + torch.tensor([1, -1, 2, -2]), torch.full((80, 11), 70)), dim=1).clamp(0, 79)
    near[30:40, 1:4] = torch.tensor([[5, 33, 36]])
    alike = torch.ones(80, 16)
    alike[:30, 5:] = alike[40:, 5:] = 0
    near[:, 4] = torch.where(torch.arange(80) // 10 == 3, 70, near[:, 4])
    found = said(80, ratio=ratio, near=near, alike=alike)
    expected = [*range(20), *(range(30, 40) if stays else ())]
    assert decide(found, was, ~torch.zeros(80, dtype=torch.bool), RULES).nonzero()[:, 0].tolist() == expected


def test_what_lies_among_metal_joins_unless_a_dielectric_is_clearly_better() -> None:
    ratio, tint = torch.full((90,), -1.0), torch.ones(90)
    ratio[5:80] = 3.0
    ratio[20:22], ratio[40:42], ratio[60:62], tint[60:62] = -0.5, -0.9, -0.5, 0.1
    nothing = torch.zeros(90, dtype=torch.bool)
    metal = decide(said(90, ratio=ratio, tint=tint), nothing, ~nothing, RULES).nonzero()[:, 0].tolist()
    assert metal == [*range(5, 40), *range(42, 60), *range(62, 80)]


def test_pieces_of_which_little_is_sure_are_none() -> None:
    """As a plate in polarized light looks: a few Gaussians just beyond the limit, and many that are likely."""
    ratio = torch.zeros(300)
    ratio[10:22], ratio[22:100] = 2.3, 1.4
    ratio[150:170], ratio[170:220] = 2.3, 1.4
    ratio[250:256] = 4.0  # too few to be told
    nothing, all_ = torch.zeros(300, dtype=torch.bool), torch.ones(300, dtype=torch.bool)
    found, was = said(300, ratio=ratio), nothing.clone()
    was[10:100] = was[150:220] = True
    metal = decide(found, was, all_, RULES)
    assert not bool(metal[:140].any())
    assert bool(metal[150:170].all())
    assert not bool(metal[240:].any())


def test_what_the_user_says_counts() -> None:
    ratio, words = torch.zeros(60), torch.zeros(60, 2)
    ratio[5:35] = 3.0
    words[18:60, 0] = 5.0
    words[50:53] = torch.tensor([1.0, 5.0])
    found = said(60, ratio=ratio, labels=words)
    nothing = torch.zeros(60, dtype=torch.bool)
    assert decide(found, nothing, ~nothing, RULES).nonzero()[:, 0].tolist() == [*range(5, 18), 50, 51, 52]
