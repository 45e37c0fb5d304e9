"""Workers of dask.distributed: on this machine, behind a scheduler that runs already, or as jobs of SLURM or PBS.

dask is imported where workers are needed, since importing it takes a while.
"""

from __future__ import annotations

import contextlib
import logging
import math
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from polarguide.core.errors import PolarguideError, optional_import
from polarguide.core.options import LOOPBACK
from polarguide.core.progress import Reporter
from polarguide.core.system import MEBIBYTE
from polarguide_bench.options import ClusterOptions

if TYPE_CHECKING:
    from distributed import Client

NOWHERE = f"{LOOPBACK[0]}:0"
"""Where dask's web servers listen, which cannot be turned off: on the loopback alone, at any free port."""
WORKER_BYTES = 300_000_000
"""Memory of a worker of dask and its nanny, beside the process that it starts."""
CONNECT_SECONDS = 30.0
"""How long a scheduler that somebody else runs may take to answer."""
SETTINGS = {
    # Whoever loses a worker is to hear of it: run_jobs decides whether the job goes on.
    "distributed.scheduler.allowed-failures": 0,
    "distributed.deploy.lost-worker-timeout": "2s",
    "distributed.worker.memory.terminate": False,
    "distributed.worker.memory.pause": False,
    # Nobody measures, and nothing is reported to anyone.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "10s",
}


@dataclass
class Workers:
    """Worker processes, of which lost ones are replaced.

    Attributes:
        client: connection to their scheduler.
        most: largest number of jobs at a time. Lost workers are replaced up to it.
        gpus: GPUs of this machine that each worker in turn sees; empty: every worker sees all.
    """

    client: Client
    most: int
    gpus: tuple[str, ...] = ()
    _cluster: Any = field(default=None, repr=False)

    def slots(self) -> int:
        """How many jobs have room now."""
        return sum(self.client.nthreads().values())

    def replace_lost(self) -> None:
        """Ask for as many workers as at the beginning, where some were lost."""
        if self._cluster is not None:
            self._cluster.scale(self.most)


@contextlib.contextmanager
def workers(
    options: ClusterOptions, *, count: int, threads: int, memory: int, gpus: Sequence[str], reporter: Reporter
) -> Iterator[Workers]:
    """Workers as the options say, for as long as the context is open.

    Args:
        options: where.
        count: how many jobs work at a time. threads: threads of each. memory: bytes that each takes at most.
        gpus: GPUs of this machine, for local workers.
        reporter: is told where workers are.

    Raises:
        PolarguideError: there is no such scheduler, or dask-jobqueue or the commands of its manager are missing.
    """
    import dask
    from distributed import Client, LocalCluster

    # What matters, run_jobs says. Each of them has a level of its own.
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with dask.config.set(SETTINGS), contextlib.ExitStack() as stack:
        if options.scheduler is not None:
            client = stack.enter_context(_connected(options.scheduler))
            reporter.say(f"scheduler: {options.scheduler}, workers: {len(client.nthreads())}")
            yield Workers(client, count)
            return
        if options.manager is not None:
            cluster = stack.enter_context(_queued(options.manager, count, threads, memory))
            client = stack.enter_context(Client(cluster))
            reporter.say(
                f"{options.manager}: asked for {count} jobs of {threads} cores and {_mib(memory)} MiB"
            )
            yield Workers(client, count, _cluster=cluster)
            return
        # In this process, since each job has one of its own: nothing listens, and nothing has to be started.
        cluster = stack.enter_context(
            LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                processes=False,
                dashboard_address=NOWHERE,
                worker_dashboard_address=NOWHERE,
                memory_limit=0,
                silence_logs=logging.CRITICAL,
            )
        )
        yield Workers(stack.enter_context(Client(cluster)), count, tuple(gpus))


def _connected(address: str) -> Client:
    """A client of a scheduler that runs already."""
    from distributed import Client

    try:
        return Client(address, timeout=CONNECT_SECONDS)
    except (OSError, ValueError, TypeError, ImportError) as error:
        raise PolarguideError(
            "scheduler",
            expected="the address of a scheduler of dask.distributed, such as tcp://10.0.0.5:8786",
            found=f"{address}: {str(error).splitlines()[0] if str(error) else type(error).__name__}",
            remedy="Start one (dask scheduler) and workers (dask worker ADDRESS --nthreads 1), or correct the address.",
        ) from None


def _queued(manager: str, count: int, threads: int, memory: int) -> Any:
    """Workers as jobs of SLURM or PBS, replaced by others when they end.

    Queue, account, time and whatever else a site wants are read from dask's own configuration (jobqueue.yaml).
    """
    import dask

    of = f"jobqueue.{manager}"
    submit, kind, extra = {
        "slurm": ("sbatch", "SLURMCluster", {"job_cpu": threads}),
        "pbs": ("qsub", "PBSCluster", {"resource_spec": f"select=1:ncpus={threads}:mem={_mib(memory)}MB"}),
    }[manager]
    if shutil.which(submit) is None:
        raise _no_cluster(manager, f"no command {submit}")
    jobqueue = optional_import("dask_jobqueue", f"--{manager}")
    try:
        return getattr(jobqueue, kind)(
            n_workers=count,  # waits until the jobs are accepted
            cores=1,
            processes=1,
            memory=f"{_mib(memory)} MiB",
            scheduler_options={
                "dashboard_address": NOWHERE,
                **(dask.config.get(f"{of}.scheduler-options", None) or {}),
            },
            worker_extra_args=[
                *(dask.config.get(f"{of}.worker-extra-args", None) or []),
                "--dashboard-address",
                NOWHERE,
            ],
            silence_logs=logging.CRITICAL,
            **extra,
        )
    except (OSError, ValueError, RuntimeError, AssertionError) as error:
        reasons = [line for line in str(error.__context__ or error).splitlines() if line.strip()]
        raise _no_cluster(manager, reasons[-1] if reasons else type(error).__name__) from None


def _no_cluster(manager: str, found: str) -> PolarguideError:
    return PolarguideError(
        f"--{manager}",
        expected="a cluster that takes jobs from this machine",
        found=found,
        remedy="Run it where jobs are submitted; docs/how-to/cluster.md says what to configure.",
    )


def _mib(memory: int) -> int:
    """Of a job: a worker and the process that it starts."""
    return math.ceil((memory + WORKER_BYTES) / MEBIBYTE)
