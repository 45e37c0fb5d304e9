"""Several processes train what one process with as many views a step trains."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from tiny import make_busy_recipe
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
LONG = 120
FEW = 4
"""The density control comes after the last: its decisions are compared by the row counts."""
RESUMED, UNTIL = 30, 21


@pytest.fixture(scope="module")
def shared(tiny_scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[dict[str, Tensor]]]:
    """The states of two ranks at the end of each training, by its name; both start once for all trainings."""
    folder = tmp_path_factory.mktemp("ranks")
    begun = make_trainer(tiny_scene, make_busy_recipe(), RESUMED, views_per_step=2)
    run(begun, UNTIL)
    save_checkpoint(folder, begun.state)
    trainings = {
        "whole": (LONG, 2, LONG, ""),
        "two views each": (FEW, 4, FEW, ""),
        "one without a view": (FEW, 1, FEW, ""),
        "stopped": (RESUMED, 2, UNTIL, ""),
        "gone on with": (RESUMED, 2, RESUMED, str(folder)),
    }
    fields = ("steps", "views", "until", "begun")
    jobs = [
        {"out": str(folder / name)} | dict(zip(fields, values, strict=True))
        for name, values in trainings.items()
    ]
    (folder / "jobs.json").write_text(json.dumps(jobs))
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "--standalone"]
    command += [str(PROGRAM), str(folder / "jobs.json")]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert done.returncode == 0, done.stderr
    return {
        name: [load_file(folder / name / str(rank) / CHECKPOINT) for rank in range(2)] for name in trainings
    }


@pytest.mark.slow
def test_two_ranks_of_one_view_are_one_process_of_two_bit_by_bit(
    tiny_scene: Scene, busy_recipe: Recipe, shared: dict[str, list[dict[str, Tensor]]]
) -> None:
    alone = make_trainer(tiny_scene, busy_recipe, LONG, views_per_step=2)
    assert len({report.gaussians for report in run(alone)}) > 3, "the density control did nothing"
    first, second = shared["whole"]
    assert different(first, second) == []
    assert different(first, alone.state.tensors()) == []


@pytest.mark.slow
@pytest.mark.parametrize(("training", "views"), [("two views each", 4), ("one without a view", 1)])
def test_other_shares_agree_up_to_summation_order(
    tiny_scene: Scene,
    busy_recipe: Recipe,
    shared: dict[str, list[dict[str, Tensor]]],
    training: str,
    views: int,
) -> None:
    """The ranks decide the same, to the bit."""
    expected = trained(tiny_scene, busy_recipe, FEW, views_per_step=views)
    first, other = shared[training]
    assert different(first, other) == []
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
def test_another_number_of_ranks_goes_on_bit_by_bit(
    tiny_scene: Scene, busy_recipe: Recipe, tmp_path: Path, shared: dict[str, list[dict[str, Tensor]]]
) -> None:
    """Stopped between two rounds of the density control, when every rank has seen other views than the others."""
    whole = make_trainer(tiny_scene, busy_recipe, RESUMED, views_per_step=2)
    assert len({report.gaussians for report in run(whole)[UNTIL:]}) > 1, (
        "the density control did nothing after"
    )
    stopped = shared["stopped"][0]
    assert int(stopped["scalars"][0]) == UNTIL
    save_file(stopped, tmp_path / CHECKPOINT)
    state = load_checkpoint(tmp_path, busy_recipe)
    alone = trained(tiny_scene, busy_recipe, RESUMED, state=state, views_per_step=2)
    ends = [alone, *shared["gone on with"]]
    assert [different(end, whole.state.tensors()) for end in ends] == [[]] * 3


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
    trainings = []
    for views in (1, 4):
        trainer = make_trainer(tiny_scene, busy_recipe, 30, views_per_step=views)
        trainer.step()
        trainings.append(trainer.state.gaussians)
    one, four = trainings
    assert four.rates == pytest.approx({name: 2 * rate for name, rate in one.rates.items()})
    assert four.betas == pytest.approx((0.9**4, 0.999**4))


STEPS = 200


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
