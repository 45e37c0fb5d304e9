"""Workers elsewhere: one that is killed changes nothing, and a cluster that cannot be reached is one line."""

import importlib.util
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from faults import Fault
from heard import Heard
from trainings import different

from polarguide.core.errors import optional_import
from polarguide.core.progress import SILENT
from polarguide.runs.folder import CHECKPOINT, LOG, RunConfiguration
from polarguide.training.settings import TrainSettings
from polarguide_bench import job_queue as clusters
from polarguide_bench.compare import compare
from polarguide_bench.job_queue import workers
from polarguide_bench.options import BatchOptions, ClusterOptions, CompareOptions
from polarguide_bench.plan import jobs_at_a_time


@pytest.fixture
def scheduler() -> Iterator[Any]:
    """Start a scheduler with two workers. Each is a process that restarts after a kill."""
    import dask
    from distributed import LocalCluster

    quiet = {"distributed.scheduler.allowed-failures": 0, "logging.distributed": "critical"}
    with (
        dask.config.set(quiet),
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=clusters.NOWHERE) as running,
    ):
        yield running


@pytest.mark.slow
def test_a_run_whose_worker_is_killed_goes_on_to_the_same_bits(
    scheduler: Any, trained: Path, demo_scene: Path, tmp_path: Path
) -> None:
    from distributed import Client

    killed: list[int] = []

    def kill() -> None:
        """Kill the worker at work as soon as the training has taken some steps."""
        give_up = time.monotonic() + 120
        with Client(scheduler) as client:
            while not list(tmp_path.rglob(LOG)) and time.monotonic() < give_up:
                time.sleep(0.05)
            pids = client.run(os.getpid)
            killed.extend(pids[address] for address, keys in client.processing().items() if keys)
        for pid in killed:
            os.kill(pid, signal.SIGKILL)

    thread = threading.Thread(target=kill)
    thread.start()
    heard = Heard()
    results = compare(
        [demo_scene],
        ["polarguide-stokes"],
        tmp_path,
        settings=TrainSettings(RunConfiguration.load(trained).settings.steps),
        options=CompareOptions(
            scheduler=scheduler.scheduler_address, downscale=4, report_views=0, device="cpu"
        ),
        reporter=heard,
    )
    thread.join()
    assert len(killed) == 1
    assert sum(line.startswith("lost") for line in heard.said) == 1
    (run,) = results.record.runs
    assert (run.state, run.error) == ("done", None)
    assert different(tmp_path / run.folder / CHECKPOINT, trained / CHECKPOINT) == []


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        (ClusterOptions(scheduler="tcp://127.0.0.1:1"), Fault("scheduler", found="127.0.0.1:1")),
        (ClusterOptions(scheduler="nonsense"), Fault("scheduler", found="nonsense")),
        (ClusterOptions(slurm=True), Fault("--slurm", found="sbatch")),
    ],
)
def test_a_cluster_that_is_not_there_is_one_line(
    options: ClusterOptions, fault: Fault, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clusters, "CONNECT_SECONDS", 0.5)
    monkeypatch.setenv("PATH", "/nowhere")

    def begin() -> None:
        with workers(options, count=1, threads=1, memory=10**9, gpus=(), reporter=SILENT):
            pass

    fault.raised_by(begin)


def test_the_script_of_a_job_asks_for_what_a_run_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    if importlib.util.find_spec("dask_jobqueue") is None:
        pytest.skip("no dask-jobqueue -> pip install '.[cluster]'")
    jobqueue = optional_import("dask_jobqueue", "--slurm")
    monkeypatch.setattr("shutil.which", str)
    made: list[dict[str, Any]] = []

    class Stop(Exception):
        pass

    for name in ("SLURMCluster", "PBSCluster"):
        kind = getattr(jobqueue, name)

        def instead(kind: Any = kind, **given: Any) -> None:
            given.pop("scheduler_options")
            kept = {key: value for key, value in given.items() if key not in ("silence_logs", "n_workers")}
            made.append({"script": kind.job_cls(scheduler="tcp://x:1", name="n", **kept).job_script()})
            raise Stop

        monkeypatch.setattr(jobqueue, name, instead)
    for options in (ClusterOptions(slurm=True), ClusterOptions(pbs=True)):
        with (
            pytest.raises(Stop),
            workers(options, count=2, threads=4, memory=1_000_000_000, gpus=(), reporter=SILENT),
        ):
            pass
    slurm, pbs = (each["script"] for each in made)
    assert "--cpus-per-task=4" in slurm
    assert "--mem=1240M" in slurm or "--mem=2G" in slurm
    assert "select=1:ncpus=4:mem=1240MB" in pbs
    for script in (slurm, pbs):
        assert "--nthreads 1 " in script
        assert f"--dashboard-address {clusters.NOWHERE}" in script


def test_how_many_work_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("polarguide_bench.plan.free_memory", lambda: 10**9)
    monkeypatch.setattr("os.cpu_count", lambda: 8)
    rows = [
        (ClusterOptions(), 20, 0, (), 8),
        (ClusterOptions(threads=4), 20, 0, (), 2),
        (ClusterOptions(), 3, 0, (), 3),
        (ClusterOptions(), 20, 390_000_000, (), 2),  # of the 80 % of what is free
        (ClusterOptions(), 20, 2 * 10**9, (), 1),
        (ClusterOptions(), 20, 0, ("0", "1"), 2),
        (ClusterOptions(jobs=5), 20, 2 * 10**9, ("0", "1"), 5),
        (ClusterOptions(slurm=True), 20, 2 * 10**9, (), 20),
        (ClusterOptions(slurm=True, jobs=4), 20, 2 * 10**9, (), 4),
    ]
    assert [jobs_at_a_time(*given) for *given, _ in rows] == [count for *_, count in rows]


def test_options_that_exclude_each_other() -> None:
    Fault("--pbs", found="--slurm and --pbs").raised_by(BatchOptions, slurm=True, pbs=True)
    Fault("speed", found="cluster").raised_by(CompareOptions, speed=True, scheduler="tcp://x:1")
