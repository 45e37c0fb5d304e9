"""Adam's moments follow their rows through every edit; the state survives its tensors bit by bit."""

import pytest
import torch
from faults import Fault
from torch import Tensor

from polarguide.gaussians.gaussians import CORE_SHAPES, Gaussians
from polarguide.gaussians.geometry import quaternions_to_rotations, shortest_axis_normals

COUNT = 9
RATES = {name: 0.01 * (index + 1) for index, name in enumerate(CORE_SHAPES)} | {"side": 0.3}


def tensors(count: int = COUNT, seed: int = 0) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shapes = {**CORE_SHAPES, "side": (2,), "untrained": (4,)}
    return {name: torch.randn(count, *shape, generator=generator) for name, shape in shapes.items()}


def pull(rows: Gaussians, seed: int, index: Tensor | None = None) -> None:
    """One Adam step with random gradients; ``index`` selects rows of the gradients drawn for all of them."""
    generator = torch.Generator().manual_seed(seed)
    for name in rows.names:
        full = torch.randn(COUNT, *rows[name].shape[1:], generator=generator)
        rows[name].grad = full if index is None else full[index]
    rows.step()


def trained(steps: int = 3) -> Gaussians:
    rows = Gaussians(tensors(), RATES)
    for seed in range(steps):
        pull(rows, seed)
    return rows


def same(found: Tensor, expected: Tensor) -> None:
    """Equal up to the last bits, in which torch's fused Adam depends on where in memory a number lies."""
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-7)


def moments(rows: Gaussians) -> dict[str, Tensor]:
    return {
        name: t for name, t in rows.state().items() if name.startswith("adam.") and not name.endswith(".step")
    }


def test_a_step_moves_what_has_a_rate_and_drops_the_gradients() -> None:
    rows = Gaussians(tensors(), RATES)
    pull(rows, 0)
    for name, before in tensors().items():
        assert torch.equal(rows[name].detach(), before) == (name == "untrained")
    assert all(rows[name].grad is None for name in RATES)
    # The first step of Adam is the rate, against the gradient's sign.
    moved = (rows["side"].detach() - tensors()["side"]).abs()
    torch.testing.assert_close(moved, torch.full_like(moved, RATES["side"]), rtol=1e-4, atol=0)


@pytest.mark.parametrize(
    "index",
    [torch.arange(COUNT) % 3 != 1, torch.tensor([7, 2, 2, 0]), torch.zeros(COUNT, dtype=torch.bool)],
    ids=["mask", "indices", "none"],
)
def test_moments_follow_keep(index: Tensor) -> None:
    rows = trained()
    before = rows.state()
    rows.keep(index)
    for name, values in rows.state().items():
        expected = before[name] if name.endswith(".step") else before[name][index]
        assert torch.equal(values, expected), name


def test_a_step_after_keep_is_the_step_of_the_untouched_rows() -> None:
    index = torch.arange(COUNT) % 3 != 1
    kept, whole = trained(), trained()
    kept.keep(index)
    for seed in (10, 11):
        pull(kept, seed, index)
        pull(whole, seed)
    for name in kept.names:
        same(kept[name], whole[name][index])


def test_moments_of_appended_rows_are_zero_and_of_old_ones_unchanged() -> None:
    rows = trained()
    before = moments(rows)
    added = tensors(4, seed=5)
    rows.append(added)
    assert len(rows) == COUNT + 4
    for name in rows.names:
        assert torch.equal(rows[name].detach()[COUNT:], added[name])
    assert len(before) == 2 * len(RATES)
    for name, values in moments(rows).items():
        assert torch.equal(values[:COUNT], before[name])
        assert not values[COUNT:].any()


def test_a_step_after_append_is_the_step_of_the_untouched_rows() -> None:
    longer, whole = trained(), trained()
    longer.append(tensors(2, seed=5))
    index = torch.cat((torch.arange(COUNT), torch.tensor([0, 1])))
    pull(longer, 10, index)
    pull(whole, 10)
    for name in RATES:
        same(longer[name][:COUNT], whole[name])


def test_overwrite_zeroes_the_moments_of_that_tensor_alone() -> None:
    rows = trained()
    before = {name: tensor.clone() for name, tensor in rows.state().items()}
    values = torch.full((COUNT,), 2.5)
    rows.overwrite("opacity_logits", values)
    assert torch.equal(rows["opacity_logits"].detach(), values)
    for name, tensor in rows.state().items():
        if name in ("adam.opacity_logits.exp_avg", "adam.opacity_logits.exp_avg_sq"):
            assert not tensor.any()
        elif name != "gaussians.opacity_logits":
            assert torch.equal(tensor, before[name]), name


def test_overwrite_of_some_leaves_the_others() -> None:
    rows = trained()
    before = {name: tensor.clone() for name, tensor in rows.state().items()}
    chosen = torch.arange(COUNT) % 2 == 0
    rows.overwrite("means", torch.full((COUNT, 3), 2.5), chosen)
    after = rows.state()
    assert torch.equal(after["gaussians.means"][~chosen], before["gaussians.means"][~chosen])
    assert bool((after["gaussians.means"][chosen] == 2.5).all())
    for key in ("adam.means.exp_avg", "adam.means.exp_avg_sq"):
        assert torch.equal(after[key][~chosen], before[key][~chosen])
        assert not after[key][chosen].any()


def test_overwrite_before_the_first_step() -> None:
    rows = Gaussians(tensors(), RATES)
    rows.overwrite("means", torch.zeros(COUNT, 3))
    assert not rows["means"].any()


def test_a_rate_of_zero_rests_a_tensor() -> None:
    rows = trained()
    rows.set_rate("means", 0.0)
    before = rows["means"].detach().clone()
    pull(rows, 5)
    assert torch.equal(rows["means"].detach(), before)


@pytest.mark.parametrize("steps", [0, 3])
def test_state_round_trip_is_bitwise_and_goes_on_alike(steps: int) -> None:
    rows = trained(steps)
    loaded = Gaussians.from_state({k: t.clone() for k, t in rows.state().items()}, RATES)
    pull(rows, 20)
    pull(loaded, 20)
    state, other = rows.state(), loaded.state()
    assert list(state) == list(other)
    assert all(torch.equal(state[name], other[name]) for name in state)


def test_a_snapshot_does_not_follow_the_training() -> None:
    rows = trained()
    snapshot = rows.snapshot()
    before = {name: t.clone() for name, t in snapshot.items()}
    pull(rows, 6)
    assert all(torch.equal(snapshot[name], before[name]) for name in before)
    assert not any(t.requires_grad for t in snapshot.values())


def test_rows_stay_leaves_that_train_after_every_edit() -> None:
    rows = trained()
    rows.keep(torch.arange(COUNT) < 5)
    rows.append(tensors(2, seed=1))
    for name in rows.names:
        assert rows[name].is_leaf
        assert rows[name].requires_grad
        assert rows[name].is_contiguous()


def test_tensors_of_different_length_are_refused() -> None:
    uneven = {**tensors(), "side": torch.zeros(COUNT - 1, 2)}
    Fault("Gaussians", "same number").raised_by(Gaussians, uneven, RATES)


ELLIPSOIDS = 50


def shapes(dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    means, quaternions, log_scales = (
        torch.randn(ELLIPSOIDS, size, generator=generator, dtype=dtype) for size in (3, 4, 3)
    )
    return means, quaternions, log_scales, torch.tensor([0.3, -2.0, 1.0], dtype=dtype)


def test_the_normal_is_the_shortest_axis() -> None:
    means, quaternions, log_scales, center = shapes()
    normals = shortest_axis_normals(means, quaternions, log_scales, center)
    axes = quaternions_to_rotations(quaternions)
    shortest = axes[torch.arange(ELLIPSOIDS), :, log_scales.argmin(dim=1)]
    torch.testing.assert_close((normals * shortest).sum(dim=1).abs(), torch.ones(ELLIPSOIDS))
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(ELLIPSOIDS))
    assert set(log_scales.argmin(dim=1).tolist()) == {0, 1, 2}


def test_the_normal_faces_the_camera() -> None:
    means, quaternions, log_scales, center = shapes()
    normals = shortest_axis_normals(means, quaternions, log_scales, center)
    toward = torch.nn.functional.normalize(center - means, dim=1)
    assert float((normals * toward).sum(dim=1).min()) >= -1e-6
    opposite = shortest_axis_normals(means, quaternions, log_scales, 2 * means.mean(dim=0) - center)
    assert float((opposite * normals).sum(dim=1).min()) == pytest.approx(-1.0, abs=1e-5), "some turn over"


@pytest.mark.parametrize("factor", [0.01, -3.0])
def test_length_and_sign_of_the_quaternion_do_not_matter(factor: float) -> None:
    means, quaternions, log_scales, center = shapes()
    torch.testing.assert_close(
        shortest_axis_normals(means, factor * quaternions, log_scales, center),
        shortest_axis_normals(means, quaternions, log_scales, center),
    )


def test_gradient_in_the_quaternions_against_finite_differences() -> None:
    means, quaternions, log_scales, center = shapes(torch.float64)
    facing = torch.randn(ELLIPSOIDS, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    away = ((center - means) * shortest_axis_normals(means, quaternions, log_scales, center)).sum(1) > 0.1
    few = away.nonzero()[:6, 0]
    assert len(few) == 6

    def normals(q: Tensor) -> Tensor:
        return shortest_axis_normals(means[few], q, log_scales[few], center) * facing[few]

    assert torch.autograd.gradcheck(normals, (quaternions[few].clone().requires_grad_(),), atol=1e-7)


def test_means_and_scales_get_no_gradient() -> None:
    means, quaternions, log_scales, center = shapes()
    inputs = [t.clone().requires_grad_() for t in (means, quaternions, log_scales)]
    shortest_axis_normals(*inputs, center).sum().backward()
    assert inputs[0].grad is None
    assert inputs[1].grad is not None
    assert inputs[2].grad is None
