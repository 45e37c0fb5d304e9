"""Several processes train what one process with as many views a step trains."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from polarguide.capture import Scene
from polarguide.raster import choose_backend
from polarguide.runs.defaults import resolve
from polarguide.runs.folder import CHECKPOINT, load_checkpoint, save_checkpoint
from polarguide.training.distributed import Ranks
from polarguide.training.recipe import Recipe
from polarguide.training.settings import TrainSettings
from polarguide.training.trainer import StepReport, Trainer

PROGRAM = Path(__file__).parents[1] / "helpers" / "ranks_program.py"
PATIENCE = 300.0


def shared(
    out: Path, *, ranks: int, steps: int, views: int, until: int | None = None, begun: Path | None = None
) -> list[dict[str, Tensor]]:
    """The state of every rank at the end, or before the step ``until``, from the beginning or a checkpoint on."""
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", str(ranks), "--standalone"]
    command += [str(PROGRAM), str(out), str(steps), str(views), str(until or steps), str(begun or "")]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert done.returncode == 0, done.stderr
    return [load_file(out / str(rank) / CHECKPOINT) for rank in range(ranks)]


def alone(
    scene: Scene, recipe: Recipe, *, steps: int, views: int, until: int | None = None
) -> tuple[Trainer, list[StepReport]]:
    settings = resolve(TrainSettings(steps, 3, views_per_step=views), scene, recipe)
    trainer, reports = Trainer(scene, recipe, settings, choose_backend("cpu")), list[StepReport]()
    trainer.run(reports.append, until=until)
    return trainer, reports


def different(a: dict[str, Tensor], b: dict[str, Tensor]) -> list[str]:
    assert set(a) == set(b)
    return [n for n in a if a[n].shape != b[n].shape or a[n].numpy().tobytes() != b[n].numpy().tobytes()]


@pytest.mark.slow
def test_two_ranks_of_one_view_are_one_process_of_two_bit_by_bit(
    tiny_scene: Scene, busy_recipe: Recipe, tmp_path: Path
) -> None:
    steps = 300
    trainer, reports = alone(tiny_scene, busy_recipe, steps=steps, views=2)
    assert len({report.gaussians for report in reports}) > 3, "the density control did nothing"
    first, second = shared(tmp_path, ranks=2, steps=steps, views=2)
    assert different(first, second) == []
    assert different(first, trainer.state.tensors()) == []


@pytest.mark.slow
@pytest.mark.parametrize(("ranks", "views"), [(2, 4), (2, 1)])
def test_other_shares_agree_up_to_summation_order(
    tiny_scene: Scene, busy_recipe: Recipe, tmp_path: Path, ranks: int, views: int
) -> None:
    """Two views each; and a rank without a view. The ranks decide the same, to the bit."""
    steps = 4  # the density control comes after the last: its decisions are compared by the row counts
    trainer, _ = alone(tiny_scene, busy_recipe, steps=steps, views=views)
    first, *others = shared(tmp_path, ranks=ranks, steps=steps, views=views)
    assert all(different(first, other) == [] for other in others)
    expected = trainer.state.tensors()
    assert {n: t.shape for n, t in first.items()} == {n: t.shape for n, t in expected.items()}
    for name in ("gaussians.means", "gaussians.sh_dc", "gaussians.log_scales", "gaussians.opacity_logits"):
        # Adam's first steps have the size of the rate, whatever the gradient: where one rounds to the other side of
        # zero the row goes the other way.
        close = torch.isclose(first[name], expected[name], rtol=1e-3, atol=1e-4).float().mean()
        assert close > 0.9, (name, float(close))


def test_several_views_a_step_are_resumed_bit_by_bit(
    tiny_scene: Scene, busy_recipe: Recipe, tmp_path: Path
) -> None:
    """Also between two rounds of the density control, when the statistics are under way."""
    backend = choose_backend("cpu")
    settings = resolve(TrainSettings(30, 3, views_per_step=3), tiny_scene, busy_recipe)
    whole, _ = alone(tiny_scene, busy_recipe, steps=30, views=3)
    begun = Trainer(tiny_scene, busy_recipe, settings, backend)
    begun.run(lambda _: None, until=21)
    save_checkpoint(tmp_path, begun.state)
    resumed = Trainer(tiny_scene, busy_recipe, settings, backend, load_checkpoint(tmp_path, busy_recipe))
    resumed.run(lambda _: None)
    assert different(resumed.state.tensors(), whole.state.tensors()) == []


@pytest.mark.slow
@pytest.mark.parametrize(("before", "after"), [(2, 1), (1, 2)])
def test_another_number_of_ranks_goes_on_bit_by_bit(
    tiny_scene: Scene, busy_recipe: Recipe, tmp_path: Path, before: int, after: int
) -> None:
    """Stopped between two rounds of the density control, when every rank has seen other views than the others."""
    steps, until, views = 30, 21, 2
    whole, reports = alone(tiny_scene, busy_recipe, steps=steps, views=views)
    assert len({report.gaussians for report in reports[until:]}) > 1, "the density control did nothing after"
    if before > 1:
        first = shared(tmp_path, ranks=before, steps=steps, views=views, until=until)
        assert int(first[0]["scalars"][0]) == until
        settings = resolve(TrainSettings(steps, 3, views_per_step=views), tiny_scene, busy_recipe)
        state = load_checkpoint(tmp_path / "0", busy_recipe)
        resumed = Trainer(tiny_scene, busy_recipe, settings, choose_backend("cpu"), state)
        resumed.run(lambda _: None)
        ends = [resumed.state.tensors()]
    else:
        begun, _ = alone(tiny_scene, busy_recipe, steps=steps, views=views, until=until)
        save_checkpoint(tmp_path, begun.state)
        ends = shared(tmp_path / "end", ranks=after, steps=steps, views=views, begun=tmp_path)
    assert [different(end, whole.state.tensors()) for end in ends] == [[]] * after


@pytest.mark.parametrize("world", [1, 2, 3, 5])
@pytest.mark.parametrize("views", [1, 2, 4, 7])
def test_slots_are_shared_out_once_each_and_the_first_rank_has_one(world: int, views: int) -> None:
    ranks = Ranks()
    ranks.world = world
    shares = [ranks.slots(views, rank) for rank in range(world)]
    assert [slot for share in shares for slot in share] == list(range(views))
    assert len(shares[0]) >= 1
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


def test_rates_follow_the_square_root_of_the_views(tiny_scene: Scene, busy_recipe: Recipe) -> None:
    one, four = (
        Trainer(
            tiny_scene,
            busy_recipe,
            resolve(TrainSettings(30, 3, views_per_step=views), tiny_scene, busy_recipe),
            choose_backend("cpu"),
        )
        for views in (1, 4)
    )
    for trainer in (one, four):
        trainer.step()
    groups = [trainer.state.gaussians._optimizer.param_groups for trainer in (one, four)]
    for a, b in zip(*groups, strict=True):
        assert b["lr"] == pytest.approx(2 * a["lr"])
        assert b["betas"] == pytest.approx((0.9**4, 0.999**4))
