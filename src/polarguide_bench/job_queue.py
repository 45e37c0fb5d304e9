"""Jobs on workers of dask.distributed. Jobs report progress, resume after a loss, and save their states when stopped.

Workers run on this machine, connect to a running scheduler, or are jobs of SLURM or PBS. Only the functions that need
dask import it, because the import is slow.
"""

from __future__ import annotations

import contextlib
import logging
import math
import shutil
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from polarguide.core.errors import PolarguideError, optional_import, require
from polarguide.core.options import LOOPBACK
from polarguide.core.progress import Advance, Reporter
from polarguide.core.system import MEBIBYTE
from polarguide.results.evaluation.evaluate import code_digest
from polarguide.runs.folder import CHECKPOINT, RunLog
from polarguide_bench.children import (
    POLL_SECONDS,
    STDERR,
    Message,
    Outcome,
    Task,
    count_running,
    files_digest,
    kill,
    perform,
)
from polarguide_bench.objects import packed_definitions
from polarguide_bench.options import ClusterOptions

if TYPE_CHECKING:
    from distributed import Client, Future

NOWHERE = f"{LOOPBACK[0]}:0"
"""Address for dask's web servers, which cannot be disabled. It is a free port of the loopback interface."""
WORKER_BYTES = 300_000_000
"""Memory of a dask worker and its supervising process (nanny), without the child process, in bytes."""
CONNECT_SECONDS = 30.0
"""Timeout for the connection to a running scheduler, in seconds."""
SETTINGS = {
    # The scheduler reports a lost worker at once, and run_jobs decides if the job resumes.
    "distributed.scheduler.allowed-failures": 0,
    "distributed.deploy.lost-worker-timeout": "2s",
    "distributed.worker.memory.terminate": False,
    "distributed.worker.memory.pause": False,
    # Profiling is disabled, and monitoring is reduced.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "10s",
}
"""Settings that are passed to dask."""


@dataclass
class Workers:
    """Worker processes of a comparison or batch. Lost workers are replaced.

    Attributes:
        client: connection to the scheduler.
        most: largest number of workers, each of which runs one job at a time.
        gpus: GPUs of this machine, which are distributed over its workers. If empty, each worker uses all GPUs.
    """

    client: Client
    most: int
    gpus: tuple[str, ...] = ()
    _cluster: Any = field(default=None, repr=False)

    def slots(self) -> int:
        """Return the number of jobs that the connected workers can run at the same time."""
        return sum(self.client.nthreads().values())

    def replace_lost(self) -> None:
        """Request new workers to replace lost ones."""
        if self._cluster is not None:
            self._cluster.scale(self.most)


@contextlib.contextmanager
def workers(
    options: ClusterOptions, *, count: int, threads: int, memory: int, gpus: Sequence[str], reporter: Reporter
) -> Iterator[Workers]:
    """Start workers or connect to running ones, and stop the started workers at the end of the context.

    Args:
        options: options that select where workers run.
        count: number of simultaneous jobs.
        threads: threads of each job.
        memory: upper bound of the memory of each job in bytes.
        gpus: GPUs of this machine, for local workers.
        reporter: receives a message about the workers.

    Raises:
        PolarguideError: the scheduler does not answer, dask-jobqueue is missing, or a command of the cluster manager is
            missing.
    """
    import dask
    from distributed import Client, LocalCluster

    # run_jobs reports failures itself. Each logger has its own level.
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
                f"{options.manager}: {count} jobs of {threads} cores and {_mib(memory)} MiB requested"
            )
            yield Workers(client, count, _cluster=cluster)
            return
        # Local workers are threads of this process, since each job has its own process. They open no port. They cannot
        # be lost, and a scheduler that waits for signs of life would remove them after a suspension of this machine.
        stack.enter_context(dask.config.set({"distributed.scheduler.worker-ttl": None}))
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
    """Return a client of a running scheduler."""
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
    """Return a cluster whose workers are jobs of SLURM or PBS.

    dask reads queue, account, time limit and other settings of the cluster from its configuration (jobqueue.yaml).
    """
    import dask

    managers: dict[str, tuple[str, str, dict[str, Any]]] = {
        "slurm": ("sbatch", "SLURMCluster", {"job_cpu": threads}),
        "pbs": ("qsub", "PBSCluster", {"resource_spec": f"select=1:ncpus={threads}:mem={_mib(memory)}MB"}),
    }
    submit, kind, resources = managers[manager]
    if shutil.which(submit) is None:
        raise _no_cluster(manager, f"no command {submit}")
    jobqueue = optional_import("dask_jobqueue", f"--{manager}")
    site = f"jobqueue.{manager}"
    try:
        return getattr(jobqueue, kind)(
            n_workers=count,  # waits until the manager accepts the jobs
            cores=1,
            processes=1,
            memory=f"{_mib(memory)} MiB",
            scheduler_options={
                "dashboard_address": NOWHERE,
                **(dask.config.get(f"{site}.scheduler-options", None) or {}),
            },
            worker_extra_args=[
                *(dask.config.get(f"{site}.worker-extra-args", None) or []),
                "--dashboard-address",
                NOWHERE,
            ],
            silence_logs=logging.CRITICAL,
            **resources,
        )
    except (OSError, ValueError, RuntimeError, AssertionError) as error:
        reasons = [line for line in str(error.__context__ or error).splitlines() if line.strip()]
        raise _no_cluster(manager, reasons[-1] if reasons else type(error).__name__) from None


def _no_cluster(manager: str, found: str) -> PolarguideError:
    return PolarguideError(
        f"--{manager}",
        expected="a cluster that accepts jobs from this machine",
        found=found,
        remedy="Run the command on a machine that can submit jobs. docs/how-to/cluster.md describes the configuration.",
    )


def _mib(memory: int) -> int:
    """Return the memory of a job and its worker, in MiB."""
    return math.ceil((memory + WORKER_BYTES) / MEBIBYTE)


SLOTS_SECONDS = 1.0
"""Interval between queries to a scheduler, which may be remote, in seconds."""
MOST_LOSSES = 10
"""Largest number of losses of a job without a new checkpoint. After more losses, memory is probably insufficient."""


@dataclass(frozen=True)
class Job:
    """Sequence of tasks that one worker performs.

    Attributes:
        label: name in messages.
        folder: folder for the ``stderr.txt`` of the processes, created if missing.
        tasks: function that reads the folder and returns the remaining tasks. It is called at each start and resume.
        total: amount of work, in the unit of ``progress``.
        progress: function that returns the finished amount of work and a short note.
        saved: files that change whenever a state is saved.
    """

    label: str
    folder: Path
    tasks: Callable[[], Sequence[Task]]
    total: int
    progress: Callable[[], tuple[int, str]]
    saved: tuple[Path, ...]


def run_job(label: str, run: Path, tasks: Callable[[], Sequence[Task]], steps: int) -> Job:
    """Return the job that trains and scores a run; see ``Job``."""

    def progress() -> tuple[int, str]:
        step, note = training_progress(run, steps)
        return step, note if step < steps else "scoring"

    return Job(label, run, tasks, steps, progress, (run / CHECKPOINT,))


def training_progress(run: Path, steps: int) -> tuple[int, str]:
    """Return the number of finished training steps and a note about the last one, read from the log."""
    try:
        row = RunLog(run).rows()[-1]
    except (PolarguideError, IndexError):
        return 0, ""
    if row["psnr"] is None:
        return 0, ""
    count = "" if row["gaussians"] is None else f"  {row['gaussians']:,} Gaussians"
    return min(steps, row["step"] + 1), f"PSNR {row['psnr']:.1f} dB{count}"


@dataclass(frozen=True)
class _ActiveJob:
    """Job that runs on a worker. ``advance`` updates its progress bar, and ``bar`` closes it."""

    job: Job
    future: Future
    advance: Advance
    bar: contextlib.ExitStack


class _Progress:
    """Progress bars: one for all jobs together, and one for each active job."""

    def __init__(self, jobs: Sequence[Job], reporter: Reporter, stack: contextlib.ExitStack) -> None:
        self._done = {job.folder: job.progress()[0] for job in jobs}
        self._all = stack.enter_context(reporter.track("all", sum(job.total for job in jobs)))

    def report(self, active: Sequence[_ActiveJob], waiting: int, slots: int) -> None:
        """Update all progress bars."""
        for each in active:
            done, note = each.job.progress()
            each.advance(done, note=note)
            self._done[each.job.folder] = done
        ended = f"{len(self._done) - len(active) - waiting} of {len(self._done)} ended"
        self._all(sum(self._done.values()), note=ended if slots else f"{ended}  waiting for a worker")

    def end(self, job: Job) -> None:
        """Count a job as finished."""
        self._done[job.folder] = job.total


def run_jobs(
    jobs: Sequence[Job],
    workers: Workers,
    *,
    reporter: Reporter,
    on_end: Callable[[Job, str | None], None] = lambda job, error: None,
) -> None:
    """Run jobs on workers. A failed job does not affect other jobs. A lost job resumes on another worker.

    Args:
        jobs: jobs in the order in which they start.
        workers: workers, each of which runs one job at a time.
        reporter: receives progress, and a line at the end of each job.
        on_end: function that is called after each job with its error, or with None if it succeeded.

    Raises:
        KeyboardInterrupt: the user pressed Ctrl-C. It is raised after all children have stopped.
        PolarguideError: the connection to the scheduler was lost.
    """
    waiting = deque(jobs)
    active = list[_ActiveJob]()
    losses: dict[Path, tuple[int, int]] = {}
    with contextlib.ExitStack() as stack:
        progress = _Progress(jobs, reporter, stack)
        slots = workers.slots()
        queried = time.monotonic()
        try:
            while waiting or active:
                while waiting and len(active) < max(1, min(slots, workers.most)):
                    active.append(_submit(waiting.popleft(), workers, reporter, stack))
                for each in [each for each in active if each.future.done()]:
                    job = each.job
                    outcome = _outcome_of(each.future)
                    active.remove(each)
                    each.bar.close()
                    if outcome.state == "lost" and not _is_last_loss(job, losses):
                        reporter.say(f"lost  {job.label}: {outcome.error}; resuming from its last checkpoint")
                        waiting.appendleft(job)
                        continue
                    error = None if outcome.state == "done" else outcome.error
                    if error is None:
                        (job.folder / STDERR).unlink(missing_ok=True)
                    progress.end(job)
                    reporter.say(f"done  {job.label}" if error is None else f"failed  {job.label}: {error}")
                    on_end(job, error)
                progress.report(active, len(waiting), slots)
                time.sleep(POLL_SECONDS)
                if time.monotonic() - queried > SLOTS_SECONDS:
                    slots = workers.slots()
                    queried = time.monotonic()
                    workers.replace_lost()
        except BaseException:  # no child may continue without supervision
            _stop([each.future for each in active], workers.client)
            raise


def _submit(job: Job, workers: Workers, reporter: Reporter, stack: contextlib.ExitStack) -> _ActiveJob:
    definitions = packed_definitions()
    future = workers.client.submit(
        perform,
        tuple(Message(task, files_digest(), code_digest(), definitions) for task in job.tasks()),
        str(job.folder.absolute()),
        gpus=workers.gpus,
        key=f"{job.label} {time.monotonic_ns()}",
        pure=False,
    )
    bar = stack.enter_context(contextlib.ExitStack())
    return _ActiveJob(job, future, bar.enter_context(reporter.track(job.label, job.total)), bar)


def _outcome_of(future: Future) -> Outcome:
    """Return the result of a finished job.

    Raises:
        PolarguideError: the connection to the scheduler was lost.
    """
    from distributed import KilledWorker

    require(
        not future.cancelled(),
        "scheduler",
        expected="a connection to the scheduler until all jobs have ended",
        found="a lost connection",
        remedy="Start the scheduler, and repeat the command. It resumes.",
    )
    error = future.exception() if future.status == "error" else None
    if isinstance(error, KilledWorker):
        return Outcome("lost", "its worker has gone")
    if error is not None:
        return Outcome("failed", f"worker: {(str(error).splitlines() or [type(error).__name__])[0]}")
    outcome: Outcome = future.result()
    return outcome


def _is_last_loss(job: Job, losses: dict[Path, tuple[int, int]]) -> bool:
    """Count a loss of a job, and return True if the job may not be retried again.

    Args:
        job: the lost job.
        losses: for each job folder, the modification time of the last saved state, and the number of losses since then.
    """
    saved = max((path.stat().st_mtime_ns for path in job.saved if path.exists()), default=0)
    before, count = losses.get(job.folder, (saved, 0))
    losses[job.folder] = saved, count + 1 if before == saved else 1
    return losses[job.folder][1] >= MOST_LOSSES


def _stop(futures: Sequence[Future], client: Client) -> None:
    """Cancel jobs and wait until their processes have ended. A second Ctrl-C kills the processes."""
    keys = [future.key for future in futures]
    with contextlib.suppress(Exception):  # the scheduler may have failed itself
        client.cancel(futures, force=True)
        try:
            while any(client.run(count_running, keys).values()):
                time.sleep(POLL_SECONDS)
        except KeyboardInterrupt:
            client.run(kill, keys)
