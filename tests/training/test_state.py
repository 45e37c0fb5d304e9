"""The learned environment in a checkpoint: names of one and of several parameters, and moments."""

from __future__ import annotations

import pytest
import torch

from polarguide.training.state import Environment

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
