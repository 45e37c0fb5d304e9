"""The state of a training: the learned light in a checkpoint, and first values of a shading model."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from toy_shading import TOY, SkyShading

import polarguide
from polarguide.core.errors import PolarguideError
from polarguide.runs.defaults import resolve
from polarguide.training.settings import TrainSettings
from polarguide.training.state import Environment, first_state

RATES = {"texels": 0.1, "mlp_bias_0": 0.01}


def stepped(rates: dict[str, float], steps: int, environment: Environment | None = None) -> Environment:
    if environment is None:
        environment = Environment({name: torch.linspace(-1, 1, 6) for name in rates}, rates)
    for step in range(steps):
        total = torch.stack([(t - step).square().sum() for t in environment.parameters.values()]).sum()
        total.backward()
        environment.step()
    return environment


def test_texels_alone_keep_the_names_of_the_first_checkpoints() -> None:
    names = {"texels", "adam.step", "adam.exp_avg", "adam.exp_avg_sq"}
    assert set(stepped({"texels": 0.1}, 1).state()) == {f"environment.{name}" for name in names}


def test_names_do_not_collide() -> None:
    assert len(stepped(RATES, 1).state()) == 8


@pytest.mark.parametrize("rates", [{"texels": 0.1}, RATES])
def test_going_on_from_a_state_gives_the_same_bits(rates: dict[str, float]) -> None:
    whole = stepped(rates, 2)
    begun = Environment.from_state(whole.state(), rates)
    for environment in (whole, begun):
        stepped(rates, 3, environment)
    found, expected = begun.state(), whole.state()
    assert set(found) == set(expected)
    assert all(torch.equal(found[name], expected[name]) for name in expected)


def test_every_parameter_learns_at_its_own_rate() -> None:
    first = torch.linspace(-1, 1, 6)
    moved = stepped(RATES, 1)
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
    def initial_parameters(self, colors: torch.Tensor, generator: torch.Generator) -> dict[str, torch.Tensor]:
        return super().initial_parameters(colors, generator) | {"tint": torch.ones(len(colors))}


@dataclasses.dataclass(frozen=True)
class _Dark(SkyShading):
    def initial_light(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        return {}


@pytest.mark.parametrize(
    ("shading", "where", "values"),
    [(_Undeclared(), "_Undeclared, tint", "["), (_Dark(), "_Dark, sky", "no values")],
)
def test_first_values_have_the_declared_shapes(
    demo_scene: Path, shading: SkyShading, where: str, values: str
) -> None:
    scene = polarguide.load_scene(demo_scene, downscale=8)
    recipe = dataclasses.replace(TOY, shading=shading)
    with pytest.raises(PolarguideError) as refusal:
        first_state(scene, recipe, resolve(TrainSettings(4), scene, recipe))
    assert refusal.value.where == where
    assert refusal.value.found.startswith(values)
