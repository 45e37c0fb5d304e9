"""Training a field: it finds a textured ball, resumes to the same bits, and its checkpoint is checked."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from faults import Fault
from heard import Heard
from safetensors import safe_open
from small_fields import small
from textured_ball import ball_radius, cameras, textured_ball

from polarguide import optics
from polarguide.capture import Scene
from polarguide.capture.variants import select_exposures
from polarguide.core.options import SceneOptions, SessionOptions
from polarguide.geometry.vectors import dot, unit
from polarguide.results.evaluation.evaluate import evaluate
from polarguide.runs import memory_plan
from polarguide.runs.callbacks import TrainingStopped
from polarguide.runs.folder import CHECKPOINT, save_checkpoint
from polarguide.training.settings import TrainSettings
from polarguide_bench.gnerp.loop import FieldLoop, aolp_loss, color_loss, eikonal_loss, guidance_loss
from polarguide_bench.gnerp.march import _strata
from polarguide_bench.gnerp.model import FieldModel
from polarguide_bench.gnerp.recipe import NeuralRecipe, Sampling
from polarguide_bench.gnerp.runs import (
    FieldRun,
    load_field,
    open_field,
    plan_field_memory,
    resolve_field,
    train_field,
)
from polarguide_bench.gnerp.state import FieldState
from polarguide_bench.plan import trained_steps
from polarguide_bench.recipes import ABLATIONS_GNERP, RECIPE_GNERP

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def ball() -> Scene:
    """Return a small ball in polarized light."""
    return textured_ball(views=6, width=20, height=16, tests=1, radius=1.2, polarized=0.5)


def trainer(scene: Scene, steps: int, recipe: NeuralRecipe | None = None) -> FieldLoop:
    recipe = recipe or small()
    return FieldLoop(scene, recipe, resolve_field(TrainSettings(steps=steps), scene, recipe), CPU)


def normal_error(model: FieldModel, scene: Scene) -> float:
    """Mean over the test views' masks, in degrees."""
    errors = []
    for view in scene.test_views:
        truth = view.ground_truth
        assert truth.normal is not None
        normal = model.render(view.camera).normal
        assert normal is not None
        cosine = dot(unit(normal), truth.normal).clamp(-1, 1)
        errors.append(torch.rad2deg(cosine.acos())[truth.mask].mean())
    return float(torch.stack(errors).mean())


@pytest.mark.slow
def test_it_finds_a_ball_beside_the_middle_and_smaller_than_it_starts() -> None:
    """Without the grid of 128 cells and with half the rays. 3,600 steps are more accurate."""
    recipe = replace(
        RECIPE_GNERP,
        shape=replace(RECIPE_GNERP.shape, resolutions=(16, 32, 64), background=(16, 32)),
        sampling=Sampling(rays=256, coarse=32, fine=24, background=8),
        weights=replace(RECIPE_GNERP.weights, aolp=0.0, guidance=0.0),
    )
    scene = textured_ball(views=34, width=64, height=48, radius=ball_radius())
    steps = 300
    made = trainer(scene, steps, recipe)
    assert normal_error(FieldModel(made.state, recipe, CPU), scene) > 15
    while made.state.step < steps:
        made.step()
    assert normal_error(FieldModel(made.state, recipe, CPU), scene) < 10


def test_polarization_alone_turns_normals(ball: Scene) -> None:
    """From a sphere about the middle, the angles lead to the ball's normals without a color."""
    made = trainer(ball, 150, small(color=0.0, guidance=0.0, aolp=1.0, eikonal=0.1, circular=True))
    losses = [float(made.step().measured[2]) for _ in range(150)]
    assert sum(losses[-20:]) < 0.7 * sum(losses[:20])


def bits(state: FieldState) -> dict[str, bytes]:
    return {name: values.contiguous().numpy().tobytes() for name, values in state.tensors().items()}


def test_resumed_is_uninterrupted(ball: Scene, tmp_path: Path) -> None:
    """Stopped where the map of distances is of an earlier step, and in the guided part again."""
    whole = trainer(ball, 40)
    while whole.state.step < 40:
        whole.step()
    parts = trainer(ball, 40)
    for stop in (7, 25, 40):
        while parts.state.step < stop:
            parts.step()
        save_checkpoint(tmp_path, parts.state)
        state = load_field(tmp_path, small())
        assert isinstance(state, FieldState)
        parts = FieldLoop(ball, small(), resolve_field(TrainSettings(steps=40), ball, small()), CPU, state)
        assert trained_steps(tmp_path) == stop
    assert bits(parts.state) == bits(whole.state)


def test_all_recipes_take_a_step(ball: Scene) -> None:
    for recipe in (RECIPE_GNERP, *ABLATIONS_GNERP):
        made = trainer(ball, 2, replace(recipe, sampling=replace(recipe.sampling, rays=8, fine=4)))
        reports = [made.step(), made.step()]
        assert all(bool(report.measured.isfinite().all()) for report in reports)
        assert [report.stage for report in reports] == ["color and angles", "guided"]


def test_views_whose_pictures_say_no_polarization_count_as_color(ball: Scene) -> None:
    made = trainer(select_exposures(ball, "none"), 3)
    assert all(bool(made.step().measured.isfinite().all()) for _ in range(3))


def test_layers_of_a_picture(ball: Scene) -> None:
    made = trainer(ball, 2)
    made.step()
    model = FieldModel(made.state, small(), CPU)
    camera = ball.test_views[0].camera
    result = model.render(camera, depth=True)
    assert result.final.shape == (camera.height, camera.width, 3)
    assert result.specular is result.diffuse is result.strength is None
    assert model.stokes(result, camera) is None
    middle = result.depth[camera.height // 2, camera.width // 2]
    # The sphere that it starts as.
    region = made.state.field.region
    assert float(middle) == pytest.approx(4 - 0.5 * region.radius * region.unit, abs=0.15)
    share = model.alpha_in_front(camera, torch.full(result.depth.shape, 0.1))
    assert float(share.max()) < 0.01
    share = model.alpha_in_front(camera, torch.full(result.depth.shape, 9.0))
    assert float(share[camera.height // 2, camera.width // 2]) > 0.99


def spoiled(
    tensors: dict[str, torch.Tensor], name: str, values: torch.Tensor | None
) -> dict[str, torch.Tensor]:
    others = {key: value for key, value in tensors.items() if key != name}
    return others if values is None else {**others, name: values}


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("region", None, "no region"),
        ("region", torch.tensor([0.0, 0, 0, -1, 2]).double(), "region"),
        ("scalars", torch.tensor([-3]), "scalars"),
        ("field.features.levels.0", torch.zeros(3, 2), "field.features.levels.0"),
        ("field.log_sharpness", torch.tensor(float("nan")), "field.log_sharpness"),
        ("adam.log_sharpness.exp_avg", None, "no adam.log_sharpness.exp_avg"),
        ("gaussians.means", torch.zeros(1, 3), "gaussians.means"),
    ],
)
def test_a_foreign_checkpoint_is_refused(
    ball: Scene, name: str, values: torch.Tensor | None, message: str
) -> None:
    made = trainer(ball, 2)
    made.step()
    with pytest.raises(ValueError, match=message):
        FieldState.from_tensors(spoiled(made.state.tensors(), name, values), small(), CPU)


READING = SceneOptions(downscale=8)


def field_trained(scene: Path, out: Path, steps: int | None = 6, **options: Any) -> FieldRun:
    """Train the small recipe on a scene folder with one thread."""
    settings = TrainSettings(steps=steps, **options.pop("settings", {}))
    session = SessionOptions(threads=1, device="cpu")
    return train_field(
        scene, out, recipe=small(), settings=settings, session=session, reading=READING, **options
    )


def test_a_run_folder_is_trained_and_scored(demo_scene: Path, tmp_path: Path) -> None:
    run = field_trained(demo_scene, tmp_path / "run")
    record = evaluate(run, surface=run.surface)
    assert record["gaussians"] is None
    assert record["steps"] == 6
    assert record["specular_psnr"] is None
    assert record["mesh_fscore_1"] is not None, "its surface is the zero set, not fused depths"
    again = open_field(tmp_path / "run", small(), device="cpu")
    camera = run.scene.test_views[0].camera
    torch.testing.assert_close(again.model.render(camera).final, run.model.render(camera).final)


def test_a_stopped_training_goes_on_to_the_same_bits(demo_scene: Path, tmp_path: Path) -> None:
    whole = field_trained(demo_scene, tmp_path / "whole")
    asked = iter([False, False, True])
    with pytest.raises(TrainingStopped):
        field_trained(demo_scene, tmp_path / "parts", should_stop=lambda: next(asked))
    assert trained_steps(tmp_path / "parts") == 2
    parts = field_trained(demo_scene, tmp_path / "parts", resume=True)
    assert bits(parts.model.state) == bits(whole.model.state)


def test_a_run_without_a_checkpoint_begins_anew_and_says_so(demo_scene: Path, tmp_path: Path) -> None:
    field_trained(demo_scene, tmp_path / "run", 2)
    (tmp_path / "run" / CHECKPOINT).unlink()
    heard = Heard()
    assert field_trained(demo_scene, tmp_path / "run", 2, resume=True, reporter=heard).steps == 2
    assert any("has no checkpoint: the training begins at step 0" in text for text in heard.said)


def test_a_run_with_other_steps_is_not_resumed(demo_scene: Path, tmp_path: Path) -> None:
    field_trained(demo_scene, tmp_path / "run", 2)
    Fault("steps", "2, the number", "3").raised_by(
        field_trained, demo_scene, tmp_path / "run", 3, resume=True
    )


def test_a_number_of_gaussians_is_refused(demo_scene: Path, tmp_path: Path) -> None:
    Fault("gaussians", "gnerp-small", "500").raised_by(
        field_trained, demo_scene, tmp_path / "run", settings={"gaussians": 500}
    )


def test_steps_are_the_recipes_where_nobody_says_how_many(demo_scene: Path, tmp_path: Path) -> None:
    run = train_field(
        demo_scene,
        tmp_path / "run",
        recipe=replace(small(), steps=3),
        settings=TrainSettings(),
        reading=READING,
    )
    assert run.steps == 3
    assert trained_steps(tmp_path / "run") == 3
    with safe_open(tmp_path / "run" / CHECKPOINT, framework="pt") as file:
        assert not any(name.startswith("adam.") for name in file.keys()), "finished runs have no moments"  # noqa: SIM118


def test_a_field_is_planned_for_by_its_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_plan, "resident_memory", lambda: 400_000_000)
    learned = 4 * RECIPE_GNERP.numbers
    state = FieldState.first(RECIPE_GNERP, cameras(4, 8, 6), 0)
    exact = 4 * sum(values.numel() for values in state.field.parameters())
    assert exact < learned * 1.02
    assert learned < exact * 1.1
    pixels = [100 * 100] * 10
    plan = plan_field_memory(pixels, RECIPE_GNERP, limit=4)
    assert plan.view_bytes is None
    assert plan.peak > 400_000_000 + 4 * learned
    error = Fault("memory").raised_by(plan_field_memory, pixels, RECIPE_GNERP, limit=0.01)
    assert "Gaussians" not in str(error)


def test_strata_are_even_and_apart() -> None:
    middle = _strata(2, 4, torch.zeros(1), None)
    torch.testing.assert_close(middle[0], torch.tensor([0.125, 0.375, 0.625, 0.875]))
    drawn = _strata(50, 4, torch.zeros(1), torch.Generator().manual_seed(0))
    assert bool(((drawn * 4).floor() == torch.arange(4)).all())


GENERATOR = torch.Generator().manual_seed(2)
COUNT = 12


def normals(*shape: int) -> torch.Tensor:
    return torch.nn.functional.normalize(
        torch.randn(*shape, 3, generator=GENERATOR, dtype=torch.float64), dim=-1
    )


def uniform(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=GENERATOR, dtype=torch.float64)


RAYS = torch.nn.functional.normalize(
    torch.cat((0.3 * torch.randn(COUNT, 2, generator=GENERATOR), torch.ones(COUNT, 1)), dim=1).double(), dim=1
)


def predicted(normal: torch.Tensor, ray: torch.Tensor) -> float:
    """Angle of the electric field ``ray x normal`` in the lens frame, in [0, pi)."""
    return float(optics.azimuth(torch.linalg.cross(ray, normal), ray)) % math.pi


def test_the_color_counts_where_nothing_is_polarized() -> None:
    found, wanted, dolp = uniform(COUNT, 3), uniform(COUNT, 3), uniform(COUNT)
    slow = sum(
        float((1 - dolp[n]) * (found[n, c] - wanted[n, c]).abs()) for n in range(COUNT) for c in range(3)
    )
    assert float(color_loss(found, wanted, dolp)) == pytest.approx(slow / (3 * COUNT))


@pytest.mark.parametrize("circular", [False, True])
def test_angles_against_a_loop(circular: bool) -> None:
    normal, aolp, dolp = normals(COUNT) * uniform(COUNT, 1), math.pi * uniform(COUNT), uniform(COUNT)
    slow = 0.0
    for n in range(COUNT):
        difference = predicted(normal[n], RAYS[n]) - float(aolp[n])
        slow += float(dolp[n]) * (0.5 - 0.5 * math.cos(2 * difference) if circular else abs(difference))
    found = aolp_loss(normal, RAYS, aolp, dolp, circular=circular)
    assert float(found) == pytest.approx(slow / COUNT, rel=1e-6)


def test_the_published_difference_jumps_and_the_circular_one_does_not() -> None:
    """Angles of 179 and 1 degrees differ by 2, and by 178 as numbers."""
    ray, one = torch.tensor([[0.0, 0, 1]]).double(), torch.ones(1).double()
    normal = optics.normal_from_angles(one, torch.deg2rad(one * 89), ray)  # specular light of it: 179 degrees
    assert predicted(normal[0], ray[0]) == pytest.approx(math.radians(179))
    aolp = torch.deg2rad(one)
    published = aolp_loss(normal, ray, aolp, one, circular=False)
    assert float(published) == pytest.approx(math.radians(178))
    circular = aolp_loss(normal, ray, aolp, one, circular=True)
    assert float(circular) == pytest.approx(math.sin(math.radians(2)) ** 2)


@pytest.mark.parametrize("circular", [False, True])
def test_normals_toward_the_camera_keep_gradients_finite(circular: bool) -> None:
    normal = (-RAYS).clone().requires_grad_()
    loss = aolp_loss(normal, RAYS, uniform(COUNT), uniform(COUNT), circular=circular)
    loss.backward()
    assert bool(normal.grad.isfinite().all())


def test_slopes_of_length_one_cost_nothing() -> None:
    assert float(eikonal_loss(normals(COUNT))) < 1e-10
    assert float(eikonal_loss(3 * normals(COUNT, 2))) == pytest.approx(4.0)


def doubled(vector: torch.Tensor) -> torch.Tensor:
    """Double the angle of a vector by trigonometry."""
    angle = 2 * math.atan2(float(vector[1]), float(vector[0]))
    return float(vector.norm()) * torch.tensor([math.cos(angle), math.sin(angle)]).double()


@pytest.mark.parametrize("circular", [False, True])
def test_guidance_against_a_loop(circular: bool) -> None:
    samples = 3
    own, around, weights = normals(COUNT, samples), normals(COUNT, samples, 6), uniform(COUNT, samples)
    aolp, beside, dolp = math.pi * uniform(COUNT), math.pi * uniform(COUNT, 4), uniform(COUNT)
    turn = doubled if circular else lambda vector: vector
    slow = 0.0
    for n in range(COUNT):
        right, up = optics.lens_frame(RAYS[n])
        frame = torch.stack((right, up))
        cov = torch.zeros(2, 2).double()
        blended = torch.zeros(2).double()
        for k in range(samples):
            flat = frame @ own[n, k]
            blended += weights[n, k] * flat
            apart = [turn(frame @ around[n, k, m]) - turn(flat) for m in range(6)]
            cov += weights[n, k] * sum(torch.outer(a, a) for a in apart) / 5
        field = [turn(torch.tensor([math.sin(a), -math.cos(a)]).double()) for a in (aolp[n], *beside[n])]
        wanted = sum(torch.outer(f - field[0], f - field[0]) for f in field[1:]) / 3
        slow += float(dolp[n] * (cov - float(blended @ blended) * wanted).abs().sum()) / 4
    found = guidance_loss(own, around, weights, RAYS, aolp, beside, dolp, circular=circular)
    assert float(found) == pytest.approx(slow / COUNT, rel=1e-6)


def test_the_published_covariance_jumps_at_180_degrees() -> None:
    """Neighbors that differ by two degrees across the jump look as if they were opposite."""
    one = torch.ones(1).double()
    flat, weight = torch.tensor([[[1.0, 0, 0]]]).double(), torch.ones(1, 1).double()
    ray, around = torch.tensor([[0.0, 0, 1]]).double(), flat[:, :, None].expand(1, 1, 6, 3)
    angles = torch.deg2rad(one * 179), torch.deg2rad(one).expand(1, 4)
    jump = guidance_loss(flat, around, weight, ray, *angles, one, circular=False)
    smooth = guidance_loss(flat, around, weight, ray, *angles, one, circular=True)
    assert float(jump) > 1.0
    assert float(smooth) < 0.01
