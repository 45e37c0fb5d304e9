"""Clone, split and prune; no threshold of a recipe appears here."""

import math

import pytest
import torch
from torch import Tensor

from polarguide.gaussians.densify import Densification, DensityStatistics, FreeSpace, densify
from polarguide.gaussians.gaussians import CORE_SHAPES, Gaussians
from polarguide.gaussians.geometry import quaternions_to_rotations

SETTINGS = Densification(
    gradient=1.0, dense_share=0.1, minimum_opacity=0.05, maximum_scale_share=0.5, far_scale_share=0.3
)
EXTENT = 2.0
SMALL, LARGE = 0.05, 0.5  # the border is dense_share * extent = 0.2
RATES = dict.fromkeys(CORE_SHAPES, 0.01)


def rows_of(sizes: list[float], opacities: list[float] | None = None) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    count = len(sizes)
    tensors = {name: torch.randn(count, *shape, generator=generator) for name, shape in CORE_SHAPES.items()}
    shape = torch.tensor([1.0, 0.5, 0.1])
    tensors["log_scales"] = (torch.tensor(sizes)[:, None] * shape).log()
    tensors["opacity_logits"] = torch.logit(torch.tensor(opacities or [0.5] * count))
    return Gaussians(tensors, RATES)


def pulled(gradients: list[float]) -> DensityStatistics:
    statistics = DensityStatistics(len(gradients))
    statistics.gradient = torch.tensor(gradients)
    statistics.seen = torch.ones(len(gradients))
    return statistics


def round_of(
    rows: Gaussians,
    statistics: DensityStatistics,
    settings: Densification = SETTINGS,
    *,
    prune_large: bool = False,
    limit: int = 100_000,
    empty: FreeSpace | None = None,
    seed: int = 1,
) -> None:
    densify(
        rows,
        statistics,
        settings,
        extent=EXTENT,
        middle=torch.zeros(3),
        prune_large=prune_large,
        limit=limit,
        empty=empty,
        generator=torch.Generator().manual_seed(seed),
    )


def counted(rows: Gaussians, before: dict[str, Tensor], name: str = "sh_rest") -> list[int]:
    """How many rows there are now of each row before, told by a tensor that neither edit changes."""
    return [int((rows[name].detach() == row).flatten(1).all(dim=1).sum()) for row in before[name]]


def test_a_small_one_that_pulls_is_cloned_as_it_is() -> None:
    rows = rows_of([SMALL, SMALL])
    before = rows.snapshot()
    round_of(rows, pulled([2.0, 0.5]))
    assert counted(rows, before) == [2, 1]
    for name in rows.names:
        assert torch.equal(rows[name].detach()[:2], before[name])
        assert torch.equal(rows[name].detach()[2], before[name][0])


def test_a_large_one_that_pulls_is_split_in_two_children_1_6_times_smaller() -> None:
    rows = rows_of([LARGE, LARGE])
    before = rows.snapshot()
    round_of(rows, pulled([2.0, 0.5]))
    assert counted(rows, before) == [2, 1]
    children = rows["log_scales"].detach()[1:]
    assert torch.equal(rows["log_scales"].detach()[0], before["log_scales"][1]), "the parent is gone"
    torch.testing.assert_close(children.exp(), (before["log_scales"][:1].exp() / 1.6).expand(2, 3))
    places = rows["means"].detach()[1:]
    assert not torch.equal(places[0], places[1])
    for name in ("quaternions", "opacity_logits", "sh_dc", "sh_rest"):
        assert torch.equal(rows[name].detach()[1:], before[name][:1].expand(2, *before[name].shape[1:]))


def test_children_are_drawn_from_the_parent() -> None:
    """Many children of one Gaussian have its mean and its covariance."""
    count = 4000
    rows = rows_of([LARGE])
    rows.keep(torch.zeros(count, dtype=torch.long))
    before = rows.snapshot()
    round_of(rows, pulled([2.0] * count), Densification(gradient=1.0, dense_share=0.1))
    offsets = rows["means"].detach() - before["means"][0]
    assert len(offsets) == 2 * count
    axes = quaternions_to_rotations(before["quaternions"][:1])[0] * before["log_scales"][0].exp()
    expected = axes @ axes.T
    size = float(expected.diagonal().max())
    torch.testing.assert_close(offsets.mean(dim=0), torch.zeros(3), atol=0.05 * math.sqrt(size), rtol=0)
    torch.testing.assert_close(offsets.T @ offsets / len(offsets), expected, atol=0.08 * size, rtol=0)


def test_transparent_ones_are_pruned() -> None:
    rows = rows_of([SMALL] * 3, [0.5, 0.04, 0.06])
    before = rows.snapshot()
    round_of(rows, pulled([0.0, 0.0, 0.0]))
    assert counted(rows, before) == [1, 0, 1]


def test_the_last_one_is_never_pruned() -> None:
    rows = rows_of([SMALL] * 3, [0.01, 0.03, 0.02])
    before = rows.snapshot()
    round_of(rows, pulled([0.0, 0.0, 0.0]))
    assert counted(rows, before) == [0, 1, 0]


def test_huge_ones_are_pruned_only_when_asked_and_far_ones_are_exempt() -> None:
    def scene() -> Gaussians:
        # The border is maximum_scale_share * extent = 1 near the middle, and far_scale_share * 10 = 3 far away.
        rows = rows_of([0.9, 1.1, 2.9, 3.1])
        rows.overwrite("means", torch.tensor([[0.1, 0, 0], [0.1, 0, 0], [0, 10.0, 0], [0, 10.0, 0]]))
        return rows

    for prune_large, expected in ((False, [1, 1, 1, 1]), (True, [1, 0, 1, 0])):
        rows = scene()
        before = rows.snapshot()
        round_of(rows, pulled([0.0] * 4), prune_large=prune_large)
        assert counted(rows, before) == expected


@pytest.mark.parametrize("size", [SMALL, LARGE])
def test_the_limit_is_kept_by_those_that_pull_hardest(size: float) -> None:
    rows = rows_of([size] * 6)
    before = rows.snapshot()
    settings = Densification(gradient=1.0, dense_share=0.1)
    round_of(rows, pulled([2.0, 5.0, 3.0, 9.0, 0.5, 4.0]), settings, limit=8)
    assert len(rows) == 8
    assert counted(rows, before) == [1, 2, 1, 2, 1, 1]


def test_what_lies_in_free_space_is_pruned() -> None:
    rows = rows_of([SMALL] * 4)
    before = rows.snapshot()
    near = before["means"][1:2] + 0.01
    round_of(rows, pulled([0.0] * 4), empty=FreeSpace(near, torch.tensor([0.1])))
    assert counted(rows, before) == [1, 0, 1, 1]


def test_at_the_limit_nothing_is_added() -> None:
    rows = rows_of([SMALL] * 6)
    round_of(rows, pulled([2.0] * 6), Densification(gradient=1.0), limit=4)
    assert len(rows) == 6


def test_statistics_start_again_with_the_new_count() -> None:
    rows, statistics = rows_of([SMALL, LARGE, SMALL]), pulled([2.0, 2.0, 0.0])
    round_of(rows, statistics)
    assert len(rows) == 5
    assert statistics.gradient.shape == statistics.seen.shape == (5,)
    assert not statistics.gradient.any()
    assert not statistics.seen.any()


def test_the_seed_decides() -> None:
    results = []
    for seed in (1, 1, 2):
        rows = rows_of([LARGE, SMALL, LARGE])
        round_of(rows, pulled([2.0, 2.0, 2.0]), seed=seed)
        results.append(rows["means"].detach())
    assert torch.equal(results[0], results[1])
    assert not torch.equal(results[0], results[2])


def test_nothing_pulls_nothing_happens() -> None:
    rows = rows_of([SMALL, LARGE])
    before = rows.snapshot()
    round_of(rows, pulled([0.9, 0.9]))
    assert all(torch.equal(rows[name].detach(), before[name]) for name in rows.names)


def test_the_mean_gradient_is_over_the_pictures_in_which_it_was_seen() -> None:
    statistics = DensityStatistics(3)
    seen, unseen = 5.0, 0.0
    statistics.add(
        torch.tensor([[3.0, 4.0], [1.0, 0.0], [0.0, 0.0]]), torch.tensor([seen, seen, unseen]), 20, 40
    )
    statistics.add(
        torch.tensor([[3.0, 4.0], [0.0, 0.0], [0.0, 0.0]]), torch.tensor([seen, unseen, unseen]), 20, 40
    )
    # In units of half a picture: x counts 10-fold and y 20-fold.
    torch.testing.assert_close(statistics.mean(), torch.tensor([math.hypot(30, 80), 10.0, 0.0]))


def test_huge_ones_are_pruned_from_a_share_of_the_steps_on_and_not_before_the_least() -> None:
    settings = Densification(large_from=0.2, large_minimum=30)
    assert [settings.prunes_large(step, 1000) for step in (199, 200, 999)] == [False, True, True]
    assert [settings.prunes_large(step, 100) for step in (20, 29, 30)] == [False, False, True]
