"""Training a field: it finds a textured ball, resumes to the same bits, and its checkpoint is checked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from small_fields import small
from textured_ball import ball_radius, textured_ball

import polarguide
from polarguide.capture import Scene
from polarguide.capture.variants import select_exposures
from polarguide.core.errors import PolarguideError
from polarguide.fields.field import NetworkField
from polarguide.fields.march import _strata
from polarguide.fields.model import FieldModel
from polarguide.fields.recipe import FieldShape, NeuralRecipe, Sampling
from polarguide.fields.state import FieldState
from polarguide.fields.trainer import FieldTrainer
from polarguide.geometry.vectors import dot, unit
from polarguide.recipes.gnerp import ABLATIONS_GNERP, RECIPE_GNERP
from polarguide.runs.defaults import resolve
from polarguide.runs.folder import CHECKPOINT, load_checkpoint, save_checkpoint, trained_steps
from polarguide.runs.train import train
from polarguide.training.settings import TrainSettings

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def ball() -> Scene:
    """A small one, its light polarized."""
    return textured_ball(views=6, width=20, height=16, tests=1, radius=1.2, polarized=0.5)


def trainer(scene: Scene, steps: int, recipe: NeuralRecipe | None = None) -> FieldTrainer:
    recipe = recipe or small()
    return FieldTrainer(scene, recipe, resolve(TrainSettings(steps=steps), scene, recipe), CPU)


def normal_error(model: FieldModel, scene: Scene) -> float:
    """Mean over the test views' masks, in degrees."""
    errors = []
    for view in scene.test_views:
        truth = view.ground_truth
        assert truth is not None
        assert truth.normal is not None
        normal = model.render(view.camera).normal
        assert normal is not None
        cosine = dot(unit(normal), truth.normal).clamp(-1, 1)
        errors.append(torch.rad2deg(cosine.acos())[truth.mask].mean())
    return float(torch.stack(errors).mean())


@pytest.mark.slow
def test_it_finds_a_ball_beside_the_middle_and_smaller_than_it_starts() -> None:
    """The test-sized version: no grid of 128 cells, and half the rays. (3,600 steps find it more exactly.)"""
    recipe = replace(
        RECIPE_GNERP,
        shape=replace(RECIPE_GNERP.shape, resolutions=(16, 32, 64), background=(16, 32)),
        sampling=Sampling(rays=256, coarse=32, fine=24, background=8),
        weights=replace(RECIPE_GNERP.weights, aolp=0.0, guidance=0.0),
    )
    scene = textured_ball(views=34, width=64, height=48, radius=ball_radius())
    made = trainer(scene, 600, recipe)
    assert normal_error(FieldModel(made.state, recipe, CPU), scene) > 15
    while made.state.step < 600:
        made.step()
    assert normal_error(FieldModel(made.state, recipe, CPU), scene) < 10


def test_polarization_alone_turns_normals(ball: Scene) -> None:
    """From a sphere about the middle, the angles lead to the ball's normals without a color."""
    recipe = small(color=0.0, guidance=0.0, aolp=1.0, eikonal=0.1, circular=True)
    made = trainer(ball, 150, recipe)
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
        state = load_checkpoint(tmp_path, small())
        assert isinstance(state, FieldState)
        parts = FieldTrainer(ball, small(), resolve(TrainSettings(steps=40), ball, small()), CPU, state)
        assert trained_steps(tmp_path) == stop
    assert bits(parts.state) == bits(whole.state)


def test_all_recipes_take_a_step(ball: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(NetworkField, "map_side", 5)
    for recipe in (RECIPE_GNERP, *ABLATIONS_GNERP):
        few = replace(recipe, sampling=replace(recipe.sampling, rays=8, fine=4))
        made = trainer(ball, 2, few)
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
    assert result.depth is not None
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
        ("field.features.levels.0", torch.zeros(3, 2), "of shape"),
        ("field.log_sharpness", torch.tensor(float("nan")), "not finite"),
        ("adam.log_sharpness.exp_avg", None, "no adam.log_sharpness.exp_avg"),
        ("gaussians.means", torch.zeros(1, 3), "not known"),
    ],
)
def test_a_foreign_checkpoint_is_refused(
    ball: Scene, name: str, values: torch.Tensor | None, message: str
) -> None:
    made = trainer(ball, 2)
    made.step()
    with pytest.raises(ValueError, match=message):
        FieldState.from_tensors(spoiled(made.state.tensors(), name, values), small(), CPU)


def test_a_run_folder_is_trained_scored_and_exported(ball: Scene, tmp_path: Path) -> None:
    run = polarguide.Run.of(train(ball, tmp_path / "run", recipe=small(), settings=TrainSettings(steps=12)))
    assert run.layers == ("final", "base", "normal", "depth", "alpha")
    assert "numbers" in repr(run)
    record = run.evaluate()
    assert record["gaussians"] is None
    assert record["steps"] == 12
    assert record["specular_psnr"] is None
    again = polarguide.open_run(tmp_path / "run", recipe=small(), scene=ball, device="cpu")
    camera = ball.test_views[0].camera
    torch.testing.assert_close(again.render(camera)["final"], run.render(camera)["final"])
    pytest.importorskip("skimage")
    pytest.importorskip("trimesh")
    assert [path.name for path in run.export("mesh", resolution=24)] == ["mesh.glb", "mesh.ply"]


@pytest.mark.parametrize("format", ["ply", "spz", "sog", "points"])
def test_splats_of_a_field_are_refused_in_one_line(ball: Scene, tmp_path: Path, format: str) -> None:
    run = polarguide.Run.of(train(ball, tmp_path / "run", recipe=small(), settings=TrainSettings(steps=1)))
    for refused in (lambda: run.export(format), run.share, lambda: run.gaussians):
        with pytest.raises(PolarguideError, match="signed-distance field") as caught:
            refused()
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "run" / "export").exists()


@pytest.mark.parametrize(("name", "value"), [("gaussians", 500), ("views_per_step", 2)])
def test_settings_that_mean_nothing_are_refused(ball: Scene, tmp_path: Path, name: str, value: int) -> None:
    with pytest.raises(PolarguideError, match=name):
        train(
            ball, tmp_path / "run", recipe=small(), settings=replace(TrainSettings(steps=5), **{name: value})
        )


def test_steps_are_the_recipes_where_nobody_says_how_many(ball: Scene, tmp_path: Path) -> None:
    recipe = replace(small(), steps=3)
    run = train(ball, tmp_path / "run", recipe=recipe, settings=TrainSettings())
    assert run.steps == 3
    assert trained_steps(tmp_path / "run") == 3
    with safe_open(tmp_path / "run" / CHECKPOINT, framework="pt") as file:
        assert not any(name.startswith("adam.") for name in file.keys()), "as of other runs"  # noqa: SIM118


def test_strata_are_even_and_apart() -> None:
    middle = _strata(2, 4, torch.zeros(1), None)
    torch.testing.assert_close(middle[0], torch.tensor([0.125, 0.375, 0.625, 0.875]))
    drawn = _strata(50, 4, torch.zeros(1), torch.Generator().manual_seed(0))
    assert bool(((drawn * 4).floor() == torch.arange(4)).all())


def test_published_sizes() -> None:
    published = ABLATIONS_GNERP[1]
    assert published.shape == FieldShape(kind="networks")
    assert (published.sampling.rays, published.sampling.coarse, published.sampling.fine) == (512, 64, 128)
