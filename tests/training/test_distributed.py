"""Several processes train what one process with as many views a step trains."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor
from trainings import different, make_trainer, run, trained

import polarguide
from polarguide.capture import Scene
from polarguide.core.options import SceneOptions, SessionOptions
from polarguide.core.system import process_is_alive
from polarguide.runs.folder import CHECKPOINT, load_checkpoint, save_checkpoint
from polarguide.training.distributed import Ranks
from polarguide.training.recipe import Recipe

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


@pytest.mark.slow
def test_two_ranks_of_one_view_are_one_process_of_two_bit_by_bit(
    tiny_scene: Scene, busy_recipe: Recipe, tmp_path: Path
) -> None:
    steps = 300
    alone = make_trainer(tiny_scene, busy_recipe, steps, views_per_step=2)
    assert len({report.gaussians for report in run(alone)}) > 3, "the density control did nothing"
    first, second = shared(tmp_path, ranks=2, steps=steps, views=2)
    assert different(first, second) == []
    assert different(first, alone.state.tensors()) == []


@pytest.mark.slow
@pytest.mark.parametrize(("ranks", "views"), [(2, 4), (2, 1)])
def test_other_shares_agree_up_to_summation_order(
    tiny_scene: Scene, busy_recipe: Recipe, tmp_path: Path, ranks: int, views: int
) -> None:
    """Two views each; and a rank without a view. The ranks decide the same, to the bit."""
    steps = 4  # the density control comes after the last: its decisions are compared by the row counts
    expected = trained(tiny_scene, busy_recipe, steps, views_per_step=views)
    first, *others = shared(tmp_path, ranks=ranks, steps=steps, views=views)
    assert all(different(first, other) == [] for other in others)
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
    begun = make_trainer(tiny_scene, busy_recipe, 30, views_per_step=3)
    run(begun, until=21)
    save_checkpoint(tmp_path, begun.state)
    state = load_checkpoint(tmp_path, busy_recipe)
    resumed = trained(tiny_scene, busy_recipe, 30, state=state, views_per_step=3)
    assert different(resumed, trained(tiny_scene, busy_recipe, 30, views_per_step=3)) == []


@pytest.mark.slow
@pytest.mark.parametrize(("before", "after"), [(2, 1), (1, 2)])
def test_another_number_of_ranks_goes_on_bit_by_bit(
    tiny_scene: Scene, busy_recipe: Recipe, tmp_path: Path, before: int, after: int
) -> None:
    """Stopped between two rounds of the density control, when every rank has seen other views than the others."""
    steps, until, views = 30, 21, 2
    whole = make_trainer(tiny_scene, busy_recipe, steps, views_per_step=views)
    assert len({report.gaussians for report in run(whole)[until:]}) > 1, (
        "the density control did nothing after"
    )
    if before > 1:
        first = shared(tmp_path, ranks=before, steps=steps, views=views, until=until)
        assert int(first[0]["scalars"][0]) == until
        state = load_checkpoint(tmp_path / "0", busy_recipe)
        ends = [trained(tiny_scene, busy_recipe, steps, state=state, views_per_step=views)]
    else:
        begun = make_trainer(tiny_scene, busy_recipe, steps, views_per_step=views)
        run(begun, until)
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
    groups = []
    for views in (1, 4):
        trainer = make_trainer(tiny_scene, busy_recipe, 30, views_per_step=views)
        trainer.step()
        groups.append(trainer.state.gaussians._optimizer.param_groups)
    for a, b in zip(*groups, strict=True):
        assert b["lr"] == pytest.approx(2 * a["lr"])
        assert b["betas"] == pytest.approx((0.9**4, 0.999**4))


STEPS = 400


def flags(scene: Path, out: Path) -> list[str]:
    sizes = ["--downscale", "4", "--steps", str(STEPS), "--checkpoint-every", "20", "--threads", "1"]
    return ["train", str(scene), "--out", str(out), "--recipe", "3dgs", *sizes]


def launch(scene: Path, out: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "--standalone"]
    command += ["-m", "polarguide", *flags(scene, out)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )


def ranks_of(parent: int) -> dict[int, int]:
    """Process by rank."""
    found = {}
    for pid in Path(f"/proc/{parent}/task/{parent}/children").read_text().split():
        settings = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
        found |= {int(s[5:]): int(pid) for s in settings if s.startswith(b"RANK=")}
    return found


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="finds the ranks in /proc")
@pytest.mark.parametrize("victim", [0, 1])
def test_a_killed_rank_ends_all_and_the_run_goes_on_alone(
    demo_scene: Path, tmp_path: Path, victim: int
) -> None:
    out = tmp_path / "run"
    process = launch(demo_scene, out)
    give_up = time.monotonic() + PATIENCE
    while not (out / CHECKPOINT).exists() and time.monotonic() < give_up:
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    ranks = ranks_of(process.pid)
    assert set(ranks) == {0, 1}
    os.kill(ranks[victim], signal.SIGKILL)
    begin = time.monotonic()
    _, errors = process.communicate(timeout=60)
    assert time.monotonic() - begin < 60
    assert process.returncode != 0
    assert not any(process_is_alive(pid) for pid in ranks.values())
    told = [line for line in errors.splitlines() if line.startswith("error: training: expected 2 processes")]
    assert len(told) == 1, errors
    assert f"rank {victim} (process {ranks[victim]}) was lost" in told[0]
    assert "--resume" in told[0]
    assert 0 < int(load_file(out / CHECKPOINT)["scalars"][0]) < STEPS
    if victim == 0:
        polarguide.train(
            demo_scene,
            out,
            recipe="3dgs",
            settings=polarguide.TrainSettings(STEPS),
            session=SessionOptions(threads=1),
            reading=SceneOptions(downscale=4),
            resume=True,
        )
        assert int(load_file(out / CHECKPOINT)["scalars"][0]) == STEPS
