"""Metals are found by what all views measured, and by what the user says of them."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from polarguide import optics
from polarguide.capture import Scene, View
from polarguide.polarizer import ANGLES
from polarguide.raster import choose_backend
from polarguide.raster.cpu import rasterize_cpu
from polarguide.recipes import RECIPES
from polarguide.runs.folder import load_checkpoint, save_checkpoint
from polarguide.shading.conversion import spread_directions
from polarguide.shading.metal import any_metal
from polarguide.training.metals.decision import decide
from polarguide.training.metals.evidence import Evidence, evidence
from polarguide.training.metals.explanations import residuals
from polarguide.training.metals.looks import Seen
from polarguide.training.metals.words import contradicted, said_by
from polarguide.training.trainer import Trainer, TrainSettings
from tests.helpers.glossy_ball import ball, camera_at

METALS = {"gold": (0.95, 0.78, 0.37), "aluminum": (0.91, 0.91, 0.92), "chromium": (0.55, 0.55, 0.54)}
BODIES = {
    "white": (0.6, 0.6, 0.6),
    "red": (0.5, 0.1, 0.05),
    "gray": (0.2, 0.2, 0.2),
    "black": (0.02, 0.02, 0.02),
}
RECIPE = RECIPES["polarguide-stokes"]


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


@pytest.mark.parametrize("material", [*METALS, *BODIES])
def test_the_right_explanation_leaves_less(material: str) -> None:
    generator = torch.Generator().manual_seed(0)
    cosine = 0.35 + 0.6 * torch.rand(24, 40, generator=generator)
    seen = 0.1 + torch.rand(24, 40, 1, generator=generator).expand(24, 40, 3)
    s0, across, _ = measured(material, cosine, seen)
    found = residuals(Seen(torch.ones(24, 40), s0, across, torch.zeros_like(s0), cosine), 1.5)
    dielectric, metal, reflectance = found
    if material in METALS:
        assert bool((metal < 0.1 * dielectric).all())
        assert float((reflectance - torch.tensor(METALS[material])).abs().max()) < 0.2
    else:
        assert float(dielectric.max()) < 1e-6
        assert bool((metal > dielectric).all())


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
    normals = spread_directions(count)
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


@pytest.mark.parametrize(
    ("material", "least", "most"), [(m, 0.8, 1.0) for m in METALS] + [(b, 0, 0) for b in BODIES]
)
def test_balls_of_metal_are_found_and_no_others(material: str, least: float, most: float) -> None:
    views = views_of(material)
    found = evidence(gaussians_of_the_ball(), views, rasterize_cpu, 1.5)
    nothing = torch.zeros(900, dtype=torch.bool)
    metal = decide(found, nothing, ~nothing)
    seen = gaussians_of_the_ball()["means"][:, 2] > 0.1  # enough cameras look from above
    assert least <= float(metal[seen].float().mean()) <= most
    assert not bool(decide(found, nothing, nothing).any())


@pytest.mark.parametrize("degree", [0.2, 0.4, 0.6])
@pytest.mark.parametrize(
    ("material", "least", "most"), [(m, 0.5, 1.0) for m in METALS] + [(b, 0, 0) for b in BODIES]
)
def test_polarized_light_shows_metals_and_makes_none(
    material: str, least: float, most: float, degree: float
) -> None:
    found = evidence(gaussians_of_the_ball(), views_of(material, degree), rasterize_cpu, 1.5)
    nothing = torch.zeros(900, dtype=torch.bool)
    metal = decide(found, nothing, ~nothing)
    seen = gaussians_of_the_ball()["means"][:, 2] > 0.1
    assert least <= float(metal[seen].float().mean()) <= most


@pytest.mark.parametrize(
    ("material", "other", "most"), [("aluminum", "black", 0.02), ("chromium", "red", 0.005)]
)
def test_a_neighbor_of_a_metal_is_none(material: str, other: str, most: float) -> None:
    """The two halves of a ball meet; what is near the seam is judged by neighbors of like brightness and tint."""
    ball_of_two = gaussians_of_the_ball()
    found = evidence(ball_of_two, views_of(material, other=other), rasterize_cpu, 1.5)
    nothing = torch.zeros(900, dtype=torch.bool)
    metal = decide(found, nothing, ~nothing)
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
    assert decide(found, nothing, ~nothing).nonzero()[:, 0].tolist() == list(range(5, 25))


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
        said=torch.zeros(count, 2),
    )
    return given._replace(**values)


def test_what_is_too_deeply_colored_is_no_metal_unless_the_user_says_so() -> None:
    ratio, tint, words = torch.full((60,), 3.0), torch.full((60,), 0.3), torch.zeros(60, 2)
    tint[20:] = 0.2
    words[50:, 1] = 5.0
    found = said(60, ratio=ratio, tint=tint, said=words)
    nothing = torch.zeros(60, dtype=torch.bool)
    assert decide(found, nothing, ~nothing).nonzero()[:, 0].tolist() == [*range(20), *range(50, 60)]
    assert not bool(decide(found, ~nothing, ~nothing)[20:50].any())


@pytest.mark.parametrize(("material", "least", "most"), [("gold", 0.4, 0.75), ("red", 0.0, 0.4)])
def test_the_tint_is_that_of_the_material(material: str, least: float, most: float) -> None:
    """Half of the ball is gray, and so in part is the mean: by itself gold has 0.39, red paint 0.1 under its gloss."""
    half = gaussians_of_the_ball()
    found = evidence(half, views_of(material, other="aluminum"), rasterize_cpu, 1.5)
    x, _, z = half["means"].unbind(1)
    assert least < float(found.tint[(z > 0.1) & (x > 0.1)].median()) < most
    assert float(found.tint[(z > 0.1) & (x < -0.1)].median()) > 0.55


def test_metal_grows_where_it_is_likely_and_stays_where_it_was() -> None:
    ratio = torch.zeros(80)
    ratio[5:19], ratio[19:25], ratio[40:44], ratio[44:60], ratio[70] = 3.0, 1.0, 1.0, 3.0, 3.0
    nothing, all_ = torch.zeros(80, dtype=torch.bool), torch.ones(80, dtype=torch.bool)
    metal = decide(said(80, ratio=ratio), nothing, all_)
    assert metal.nonzero()[:, 0].tolist() == [*range(5, 25), *range(40, 60)]  # one alone is none
    ratio[30:40], was = 0.35, nothing.clone()  # less than is likely
    was[30:40] = True
    again = decide(said(80, ratio=ratio), was, all_)
    assert again.nonzero()[:, 0].tolist() == [*range(5, 25), *range(40, 60)]
    other_way = torch.ones(80, 5)
    other_way[19:, 1:] = 0
    metal = decide(said(80, ratio=ratio, alike=other_way), nothing, all_)
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
    assert decide(found, was, ~torch.zeros(80, dtype=torch.bool)).nonzero()[:, 0].tolist() == expected


def test_what_lies_among_metal_joins_unless_a_dielectric_is_clearly_better() -> None:
    ratio, tint = torch.full((90,), -1.0), torch.ones(90)
    ratio[5:80] = 3.0
    ratio[20:22], ratio[40:42], ratio[60:62], tint[60:62] = -0.5, -0.9, -0.5, 0.1
    nothing = torch.zeros(90, dtype=torch.bool)
    metal = decide(said(90, ratio=ratio, tint=tint), nothing, ~nothing).nonzero()[:, 0].tolist()
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
    metal = decide(found, was, all_)
    assert not bool(metal[:140].any())
    assert bool(metal[150:170].all())
    assert not bool(metal[240:].any())


def test_what_the_user_says_counts() -> None:
    ratio, words = torch.zeros(60), torch.zeros(60, 2)
    ratio[5:35] = 3.0
    words[18:60, 0] = 5.0
    words[50:53] = torch.tensor([1.0, 5.0])
    found = said(60, ratio=ratio, said=words)
    nothing = torch.zeros(60, dtype=torch.bool)
    assert decide(found, nothing, ~nothing).nonzero()[:, 0].tolist() == [*range(5, 18), 50, 51, 52]


def with_materials(scene: Scene, kind: int) -> Scene:
    """The scene with everything of one material."""
    views = tuple(
        dataclasses.replace(view, materials=torch.full(view.invalid.shape, kind, dtype=torch.uint8))
        for view in scene.views
    )
    return dataclasses.replace(scene, views=views)


def trainer_of(scene: Scene, settings: TrainSettings, warn: list[str]) -> Trainer:
    repeats = tuple(
        dataclasses.replace(stage, repeats=tuple(dataclasses.replace(r, minimum=1) for r in stage.repeats))
        for stage in RECIPE.stages
    )
    recipe = dataclasses.replace(RECIPE, stages=repeats)
    return Trainer(scene, recipe, settings, choose_backend("cpu"), warn=warn.append)


@pytest.mark.parametrize("until", [32, 45])
def test_training_makes_metals_of_what_the_user_says(tiny_scene: Scene, tmp_path: Path, until: int) -> None:
    """And goes on from between two looks, or from after the last, with the same bits."""
    scene, heard = with_materials(tiny_scene, 2), []
    settings = TrainSettings(60, 3)
    whole = trainer_of(scene, settings, heard)
    whole.run(lambda _: None, until=until)
    assert any_metal(whole.state.gaussians["metalness"])
    assert not heard
    save_checkpoint(tmp_path, whole.state)
    whole.run(lambda _: None)
    state = load_checkpoint(tmp_path, RECIPE)
    resumed = trainer_of(scene, settings, heard)
    resumed.state = state
    resumed.run(lambda _: None)
    expected, found = whole.state.tensors(), resumed.state.tensors()
    assert expected.keys() == found.keys()
    assert [name for name in expected if not torch.equal(expected[name], found[name])] == []


def test_dielectric_turns_the_search_off(tiny_scene: Scene) -> None:
    trainer = trainer_of(with_materials(tiny_scene, 2), TrainSettings(60, 3, materials="dielectric"), [])
    trainer.run(lambda _: None)
    assert not any_metal(trainer.state.gaussians["metalness"])


@pytest.mark.parametrize("minimum", [1, 1000])
def test_too_few_steps_to_heed_materials_are_told_of(tiny_scene: Scene, minimum: int) -> None:
    heard: list[str] = []
    stages = tuple(
        dataclasses.replace(s, repeats=tuple(dataclasses.replace(r, minimum=minimum) for r in s.repeats))
        for s in RECIPE.stages
    )
    recipe, scene = dataclasses.replace(RECIPE, stages=stages), with_materials(tiny_scene, 2)
    for given in (scene, tiny_scene):
        Trainer(given, recipe, TrainSettings(60, 3), choose_backend("cpu"), warn=heard.append)
    if minimum == 1:
        assert not heard
    else:
        (words,) = heard
        assert words.startswith(
            "materials/ is heeded at refreshes of the priors between 40 and 72 % of the steps"
        )


def test_contradicting_files_are_named_once(tiny_scene: Scene) -> None:
    scene, heard = with_materials(tiny_scene, 2), []
    wrong = scene.train_views[1]
    views = tuple(
        dataclasses.replace(view, materials=torch.ones_like(view.materials))
        if view.name == wrong.name and view.materials is not None
        else view
        for view in scene.views
    )
    trainer = trainer_of(dataclasses.replace(scene, views=views), TrainSettings(60, 3), heard)
    trainer.run(lambda _: None)
    assert len(heard) == 1
    assert f"materials/{wrong.name}.png" in heard[0]
    assert "in one view, metal in another" in heard[0]


def test_who_contradicts_whom() -> None:
    """Of a ball that is metal in all files: one calls its right half dielectric, another says nothing."""
    views = [
        dataclasses.replace(view, materials=torch.where(view.invalid, 0, 2).to(torch.uint8))
        for view in views_of("gold")
    ]
    half = views[3].materials
    assert half is not None
    half[:, half.shape[1] // 2 :][half[:, half.shape[1] // 2 :] == 2] = 1
    views[4] = dataclasses.replace(views[4], materials=None)
    of_the_ball = gaussians_of_the_ball()
    found = contradicted(of_the_ball, views, rasterize_cpu, said_by(of_the_ball, views, rasterize_cpu))
    assert list(found) == ["v03"]
    assert 0.35 < found["v03"] < 0.65


def test_the_users_words_need_no_polarization(tiny_scene: Scene) -> None:
    """Single pictures do not determine the Stokes vector; what the user calls metal is one all the same."""
    views = [
        dataclasses.replace(
            view,
            codes=view.codes[:1],
            exposures=view.exposures[:1],
            materials=torch.where(view.invalid, 0, 2).to(torch.uint8),
        )
        for view in views_of("gold")[:6]
    ]
    assert not any(view.is_determined for view in views)
    found = evidence(gaussians_of_the_ball(), views, rasterize_cpu, 1.5)
    nothing = torch.zeros(900, dtype=torch.bool)
    metal = decide(found, nothing, ~nothing)
    assert float(metal[gaussians_of_the_ball()["means"][:, 2] > 0.3].float().mean()) > 0.9
    views = [dataclasses.replace(view, materials=None) for view in views]
    assert not bool(
        decide(evidence(gaussians_of_the_ball(), views, rasterize_cpu, 1.5), nothing, ~nothing).any()
    )
