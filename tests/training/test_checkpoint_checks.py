"""Checkpoints of every recipe with one tensor spoiled: refused by name, before anything computes with them."""

import dataclasses
import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from faults import Fault
from safetensors.torch import load_file, save_file
from torch import Tensor
from toy_shading import TOY, SkyShading
from trainings import context_of

import polarguide
from polarguide.capture import Scene
from polarguide.core.options import SceneOptions, SessionOptions
from polarguide.methods import RECIPES
from polarguide.runs.folder import CHECKPOINT, load_checkpoint
from polarguide.training.checkpoint_checks import refuse_foreign
from polarguide.training.context import Environment, TrainingState, first_state
from polarguide.training.recipe import Recipe
from polarguide.training.settings import TrainSettings


def stepped(scene: Scene, recipe: Recipe) -> TrainingState:
    """A state with moments of everything, and the copy from which priors are computed."""
    state = first_state(context_of(scene, recipe, TrainSettings(10, 0)))
    for trained in (state.gaussians, state.environment):
        if trained is not None:
            for name in trained._adam.rates:
                trained._tensors[name].grad = torch.ones_like(trained._tensors[name])
            trained.step()
    state.extra = {f"frozen.{name}": values for name, values in state.gaussians.snapshot().items()}
    state.extra |= {
        name: torch.zeros(len(state.gaussians)) for name in ("statistics.gradient", "statistics.seen")
    }
    state.footprints = torch.ones(len(state.gaussians))
    return state


def filled(value: float) -> Callable[[Tensor], Tensor]:
    def change(values: Tensor) -> Tensor:
        spoiled = values.clone()
        spoiled.view(-1)[-1] = value
        return spoiled

    return change


SPOILED: dict[str, Callable[[Tensor], Tensor]] = {
    "not a number": filled(math.nan),
    "infinite": filled(math.inf),
    "longer": lambda t: torch.cat((t.reshape(t.shape or (1,)), t.reshape(t.shape or (1,)))),
    "shorter": lambda t: t.reshape(-1)[:-1].clone() if t.numel() > 1 else t.reshape(1, 1, 1),
    "wider": lambda t: torch.cat([t.reshape(t.shape or (1,))] * 2, dim=-1),
    "one axis more": lambda t: t[None].clone(),
    "flat": lambda t: t.reshape(-1).clone() if t.ndim > 1 else t.reshape(1, 1, -1).clone(),
    "halves": lambda t: t.to(torch.float16),
    "doubles": lambda t: t.to(torch.float64),
    "whole numbers": lambda t: t.to(torch.int32),
    "huge": filled(1e30),
}


# One recipe of each set of tensors: what is refused depends on nothing else.
OF_GAUSSIANS = {
    (*sorted(recipe.shapes.items()), *sorted(recipe.shading.light_parameters)): name
    for name, recipe in sorted(RECIPES.items())
    if isinstance(recipe, Recipe)
}.values()


@pytest.fixture(scope="module", params=OF_GAUSSIANS)
def whole(request: pytest.FixtureRequest, tiny_scene: Scene) -> tuple[Recipe, dict[str, Tensor]]:
    return RECIPES[request.param], stepped(tiny_scene, RECIPES[request.param]).tensors()


def test_the_state_itself_is_taken_back(whole: tuple[Recipe, dict[str, Tensor]]) -> None:
    recipe, tensors = whole
    assert TrainingState.from_tensors(tensors, recipe).tensors().keys() == tensors.keys()


@pytest.mark.parametrize("spoiled", SPOILED)
def test_every_spoiled_tensor_is_refused_by_name(
    whole: tuple[Recipe, dict[str, Tensor]], spoiled: str
) -> None:
    recipe, tensors = whole
    free = ("exp_avg", "exp_avg_sq", "step", "statistics")  # sums may be as large as they come
    for name, values in tensors.items():
        if values.dtype != torch.float32 and spoiled in ("not a number", "infinite", "huge", "whole numbers"):
            continue
        if spoiled == "huge" and any(part in name for part in free):
            continue
        named = (
            None if name.endswith(".means") else name.replace(".", r"\.")
        )  # means state the number of the others
        with pytest.raises(ValueError, match=named):
            refuse_foreign({**tensors, name: SPOILED[spoiled](values)}, recipe)


def test_every_missing_tensor_is_named(whole: tuple[Recipe, dict[str, Tensor]]) -> None:
    recipe, tensors = whole
    for name in tensors.keys() - {"footprints"}:  # of trainings that have ended
        some = {key: values for key, values in tensors.items() if key != name}
        with pytest.raises(ValueError, match=name.replace(".", r"\.")):
            refuse_foreign(some, recipe)


@pytest.mark.parametrize(
    ("name", "values"),
    [("stranger", torch.zeros(2)), ("scalars", torch.tensor([-1, 0, 0])), ("scalars", torch.tensor([1, 0, 2])),
     ("scalars", torch.tensor([2**62, 0])), ("scalars", torch.tensor([1, 0, 0, 0])), ("scalars", torch.tensor([1])),
     ("gaussians.means", torch.zeros(0, 3)), ("gaussians.quaternions", 0), ("statistics.seen", -1), ("footprints", -1),
     ("adam.means.exp_avg_sq", -1), ("adam.means.step", -1)],
)  # fmt: skip
def test_what_no_training_leaves_is_refused(
    tiny_scene: Scene, busy_recipe: Recipe, name: str, values: Tensor | int
) -> None:
    """A number stands for as many of it as the tensor has values."""
    tensors = stepped(tiny_scene, busy_recipe).tensors()
    if isinstance(values, int):
        values = torch.full_like(tensors[name], values)
    with pytest.raises(ValueError, match=name):
        refuse_foreign({**tensors, name: values}, busy_recipe)


def test_a_third_scalar_is_refused(tiny_scene: Scene, busy_recipe: Recipe) -> None:
    """As in checkpoints of versions before 0.2."""
    tensors = stepped(tiny_scene, busy_recipe).tensors()
    older = {**tensors, "scalars": torch.cat((tensors["scalars"], torch.tensor([0])))}
    with pytest.raises(ValueError, match="scalars of shape"):
        refuse_foreign(older, busy_recipe)


SETTINGS, READING = TrainSettings(2), SceneOptions(downscale=8)


@pytest.fixture(scope="module")
def with_moments(demo_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run that has kept the optimizer's state."""
    out = tmp_path_factory.mktemp("moments") / "run"
    session = SessionOptions(threads=1, keep_optimizer=True)
    polarguide.train(demo_scene, out, settings=SETTINGS, reading=READING, session=session)
    return out


def shorter(values: Tensor) -> Tensor:
    return values[:-1].clone()


def of_three_views(values: Tensor) -> Tensor:
    return values.expand(3, -1).clone()


@pytest.mark.parametrize(
    ("resume", "change", "names", "found"),
    [
        (False, shorter, ["adam.means.exp_avg"], "adam.means.exp_avg"),
        (True, shorter, ["adam.means.exp_avg"], "adam.means.exp_avg"),
        (True, of_three_views, ["statistics.gradient", "statistics.seen"], "statistics.gradient of shape [3"),
    ],
)
def test_opening_and_going_on_check_alike(
    with_moments: Path, demo_scene: Path, tmp_path: Path,
    resume: bool, change: Callable[[Tensor], Tensor], names: list[str], found: str,
) -> None:  # fmt: skip
    """Moments that do not fit used to crash the optimizer, and only where a run was gone on with."""
    run, fault = Path(shutil.copytree(with_moments, tmp_path / "run")), Fault(CHECKPOINT, found=found)
    tensors = load_file(run / CHECKPOINT)
    save_file(tensors | {name: change(tensors[name]) for name in names}, run / CHECKPOINT)
    if resume:
        fault.raised_by(polarguide.train, demo_scene, run, settings=SETTINGS, reading=READING, resume=True)
    else:
        fault.raised_by(polarguide.open_run, run)


def test_a_checkpoint_that_is_no_file_is_refused(tmp_path: Path, busy_recipe: Recipe) -> None:
    os.mkfifo(tmp_path / CHECKPOINT)
    Fault(CHECKPOINT, found="pipe").raised_by(load_checkpoint, tmp_path, busy_recipe)


RATES = {"texels": 0.1, "mlp_bias_0": 0.01}


def stepped_light(rates: dict[str, float], steps: int, environment: Environment | None = None) -> Environment:
    if environment is None:
        environment = Environment({name: torch.linspace(-1, 1, 6) for name in rates}, rates)
    for step in range(steps):
        total = torch.stack([(t - step).square().sum() for t in environment.parameters.values()]).sum()
        total.backward()
        environment.step()
    return environment


def test_texels_alone_keep_the_names_of_the_first_checkpoints() -> None:
    names = {"texels", "adam.step", "adam.exp_avg", "adam.exp_avg_sq"}
    assert set(stepped_light({"texels": 0.1}, 1).state()) == {f"environment.{name}" for name in names}


def test_names_do_not_collide() -> None:
    assert len(stepped_light(RATES, 1).state()) == 8


@pytest.mark.parametrize("rates", [{"texels": 0.1}, RATES])
def test_going_on_from_a_state_gives_the_same_bits(rates: dict[str, float]) -> None:
    whole = stepped_light(rates, 2)
    begun = Environment.from_state(whole.state(), rates)
    for environment in (whole, begun):
        stepped_light(rates, 3, environment)
    found, expected = begun.state(), whole.state()
    assert set(found) == set(expected)
    assert all(torch.equal(found[name], expected[name]) for name in expected)


def test_every_parameter_learns_at_its_own_rate() -> None:
    first = torch.linspace(-1, 1, 6)
    moved = stepped_light(RATES, 1)
    for name, rate in RATES.items():
        step = (moved.parameters[name].detach() - first).abs()
        assert float(step.max()) == pytest.approx(rate, rel=1e-3)


def test_a_parameter_without_a_gradient_rests() -> None:
    environment = Environment({name: torch.ones(2) for name in RATES}, RATES)
    environment.step()
    environment.parameters["texels"].sum().backward()
    environment.step()
    assert torch.equal(environment.parameters["mlp_bias_0"].detach(), torch.ones(2))
    assert not torch.equal(environment.parameters["texels"].detach(), torch.ones(2))


def test_a_parameter_without_a_rate_is_refused() -> None:
    with pytest.raises(KeyError):
        Environment({"texels": torch.ones(2)}, {})


@dataclasses.dataclass(frozen=True)
class _Undeclared(SkyShading):
    def initialize(self, colors: torch.Tensor, far: torch.Tensor, generator: torch.Generator) -> Any:
        first, light = super().initialize(colors, far, generator)
        return first | {"tint": torch.ones(len(colors))}, light


@dataclasses.dataclass(frozen=True)
class _Dark(SkyShading):
    def initialize(self, colors: torch.Tensor, far: torch.Tensor, generator: torch.Generator) -> Any:
        return super().initialize(colors, far, generator)[0], {}


@pytest.mark.parametrize(
    ("shading", "where", "values"),
    [(_Undeclared(), "_Undeclared, tint", "["), (_Dark(), "_Dark, sky", "no values")],
)
def test_first_values_have_the_declared_shapes(
    demo_scene: Path, shading: SkyShading, where: str, values: str
) -> None:
    scene = polarguide.load_scene(demo_scene, downscale=8)
    recipe = dataclasses.replace(TOY, shading=shading)
    Fault(where, found=values).raised_by(first_state, context_of(scene, recipe, TrainSettings(4)))
