"""Jobs on workers of dask.distributed: handed out in order, watched, resumed after a loss, and stopped without loss.

Workers are on this machine, behind a scheduler that runs already, or jobs of SLURM or PBS. dask is imported where
workers are needed, since importing it takes a while.
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
from typing import TYPE_CHECKING, Annotated, Any

import msgspec

from polarguide.core.errors import PolarguideError, optional_import
from polarguide.core.options import LOOPBACK
from polarguide.core.progress import Advance, Reporter
from polarguide.core.system import MEBIBYTE
from polarguide.results.evaluation.record import code_digest
from polarguide.runs.folder import CHECKPOINT, LOG
from polarguide_bench.children import (
    POLL_SECONDS,
    STDERR,
    Message,
    Outcome,
    Task,
    count_at_work,
    files_digest,
    kill,
    perform,
)
from polarguide_bench.options import ClusterOptions

if TYPE_CHECKING:
    from distributed import Client, Future

NOWHERE = f"{LOOPBACK[0]}:0"
"""Where dask's web servers listen, which cannot be turned off: on the loopback alone, at any free port."""
WORKER_BYTES = 300_000_000
"""Memory of a worker of dask and its nanny, beside the process that it starts."""
CONNECT_SECONDS = 30.0
"""How long a scheduler that somebody else runs may take to answer."""
SETTINGS = {
    # A lost worker is reported at once: run_jobs decides whether the job goes on.
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

    # run_jobs reports what matters. Each logger has a level of its own.
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
    managers: dict[str, tuple[str, str, dict[str, Any]]] = {
        "slurm": ("sbatch", "SLURMCluster", {"job_cpu": threads}),
        "pbs": ("qsub", "PBSCluster", {"resource_spec": f"select=1:ncpus={threads}:mem={_mib(memory)}MB"}),
    }
    submit, kind, extra = managers[manager]
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
    """Return the memory of a job in MiB: that of its process and of its worker."""
    return math.ceil((memory + WORKER_BYTES) / MEBIBYTE)


ASK_SECONDS = 1.0
"""Between two questions to the scheduler, who may be far away."""
TAIL_BYTES = 4096
MOST_LOSSES = 10
"""Times in a row that a job may be lost without having saved anything: it takes more memory than there is, perhaps."""


@dataclass(frozen=True)
class Job:
    """Tasks to do one after the other, each in a process of its own.

    Attributes:
        label: what messages call it.
        folder: made if need be. Its ``stderr.txt`` takes what the processes write.
        tasks: what is still to do, by what the folder holds: called whenever the job is begun or gone on with.
        total: how much there is to do, as ``progress`` counts it.
        progress: how much is done, and a few words on that.
        saved: files that are written anew whenever there is something new to go on from.
    """

    label: str
    folder: Path
    tasks: Callable[[], Sequence[Task]]
    total: int
    progress: Callable[[], tuple[int, str]]
    saved: tuple[Path, ...]


def run_job(label: str, run: Path, tasks: Callable[[], Sequence[Task]], steps: int) -> Job:
    """The job that trains and scores a run of so many steps; see ``Job``."""

    def progress() -> tuple[int, str]:
        step, note = training_progress(run, steps)
        return step, note if step < steps else "scoring"

    return Job(label, run, tasks, steps, progress, (run / CHECKPOINT,))


def training_progress(run: Path, steps: int) -> tuple[int, str]:
    """How many steps of a training are done, as its log says, and what it says of the last."""
    row = last_row(run / LOG)
    if row is None or row.psnr is None:
        return 0, ""
    count = "" if row.gaussians is None else f"  {row.gaussians:,} Gaussians"
    return min(steps, row.step + 1), f"PSNR {row.psnr:.1f} dB{count}"


@dataclass(frozen=True)
class _Active:
    """A job that was handed to a worker. ``advance`` moves its bar, which ``bar`` closes."""

    job: Job
    future: Future
    advance: Advance
    bar: contextlib.ExitStack


class _Progress:
    """Progress of many jobs: one bar for all, and one for each running job."""

    def __init__(self, jobs: Sequence[Job], reporter: Reporter, stack: contextlib.ExitStack) -> None:
        self._jobs = {job.folder: job for job in jobs}
        self._done = {job.folder: job.progress()[0] for job in jobs}
        self._ended = 0
        self._all = stack.enter_context(reporter.track("all", sum(job.total for job in jobs)))

    def report(self, active: Sequence[_Active], slots: int) -> None:
        """How far all and each of them are."""
        for each in active:
            done, note = each.job.progress()
            each.advance(done, note=note)
            self._done[each.job.folder] = done
        waits = "" if slots else "  waiting for a worker"
        note = f"{self._ended} of {len(self._jobs)} ended{waits}"
        self._all(sum(self._done.values()), note=note)

    def end(self, job: Job) -> None:
        """Count a job that has ended."""
        self._ended += 1
        self._done[job.folder] = job.total


def run_jobs(
    jobs: Sequence[Job],
    workers: Workers,
    *,
    reporter: Reporter,
    on_end: Callable[[Job, str | None], None] = lambda job, error: None,
) -> None:
    """Work through jobs. One that fails takes no other down; one whose process or worker is lost goes on elsewhere.

    Args:
        jobs: what to do, in this order.
        workers: who does it, one job each at a time.
        reporter: receives progress, and a line at the end of each job.
        on_end: called after each job, with its error or None.

    Raises:
        KeyboardInterrupt: raised meanwhile, as by Ctrl-C; passed on when all children have stopped.
        PolarguideError: the scheduler has gone.
    """
    waiting = deque(jobs)
    active = list[_Active]()
    losses: dict[Path, tuple[int, int]] = {}
    with contextlib.ExitStack() as stack:
        progress = _Progress(jobs, reporter, stack)
        slots = workers.slots()
        asked_at = time.monotonic()
        try:
            while waiting or active:
                while waiting and len(active) < max(1, min(slots, workers.most)):
                    active.append(_handed_out(waiting.popleft(), workers, reporter, stack))
                for each in [each for each in active if each.future.done()]:
                    outcome = _outcome_of(each.future)
                    active.remove(each)
                    each.bar.close()
                    if outcome.state == "lost" and not _lost_too_often(each.job, losses):
                        reporter.say(
                            f"lost  {each.job.label}: {outcome.error}; it goes on from what it has saved"
                        )
                        waiting.appendleft(each.job)
                        continue
                    error = None if outcome.state == "done" else outcome.error
                    if error is None:
                        (each.job.folder / STDERR).unlink(missing_ok=True)
                    progress.end(each.job)
                    words = (
                        f"done  {each.job.label}" if error is None else f"failed  {each.job.label}: {error}"
                    )
                    reporter.say(words)
                    on_end(each.job, error)
                progress.report(active, slots)
                time.sleep(POLL_SECONDS)
                if time.monotonic() - asked_at > ASK_SECONDS:
                    slots = workers.slots()
                    asked_at = time.monotonic()
                    workers.replace_lost()
        except BaseException:  # whatever happens here, no child goes on unwatched
            _stop([each.future for each in active], workers.client)
            raise


def _handed_out(job: Job, workers: Workers, reporter: Reporter, stack: contextlib.ExitStack) -> _Active:
    future = workers.client.submit(
        perform,
        tuple(Message(task, files_digest(), code_digest()) for task in job.tasks()),
        str(job.folder.absolute()),
        gpus=workers.gpus,
        key=f"{job.label} {time.monotonic_ns()}",
        pure=False,
    )
    bar = stack.enter_context(contextlib.ExitStack())
    return _Active(job, future, bar.enter_context(reporter.track(job.label, job.total)), bar)


def _outcome_of(future: Future) -> Outcome:
    """The outcome of a job that has ended.

    Raises:
        PolarguideError: the scheduler has gone.
    """
    from distributed import KilledWorker

    if future.cancelled():
        raise PolarguideError(
            "scheduler",
            expected="a scheduler until the end",
            found="that the connection to it was lost",
            remedy="The same command goes on, once there is a scheduler.",
        )
    error = future.exception() if future.status == "error" else None
    if isinstance(error, KilledWorker):
        return Outcome("lost", "its worker has gone")
    if error is not None:
        return Outcome("failed", f"worker: {(str(error).splitlines() or [type(error).__name__])[0]}")
    outcome: Outcome = future.result()
    return outcome


def _lost_too_often(job: Job, losses: dict[Path, tuple[int, int]]) -> bool:
    """Count one more loss; whether it is the last.

    Args:
        losses: by the folder of a job, when anything was saved, and losses since.
    """
    saved = max((path.stat().st_mtime_ns for path in job.saved if path.exists()), default=0)
    before, count = losses.get(job.folder, (saved, 0))
    losses[job.folder] = saved, count + 1 if before == saved else 1
    return losses[job.folder][1] >= MOST_LOSSES


def _stop(futures: Sequence[Future], client: Client) -> None:
    """Cancel all, and wait until their processes have ended; a second Ctrl-C kills these."""
    keys = [future.key for future in futures]
    with contextlib.suppress(Exception):  # the scheduler may be what has gone
        client.cancel(futures, force=True)
        try:
            while any(client.run(count_at_work, keys).values()):
                time.sleep(POLL_SECONDS)
        except KeyboardInterrupt:
            client.run(kill, keys)


class LogRow(msgspec.Struct):
    """A line of a log, as far as progress shows it."""

    step: Annotated[int, msgspec.Meta(ge=0)]
    psnr: float | None = None
    gaussians: int | None = None


_ROWS = msgspec.json.Decoder(LogRow)


def last_row(log: Path) -> LogRow | None:
    """The last whole line of a log, or None where there is none yet."""
    try:
        if not log.is_file():  # a pipe would never end
            return None
        with open(log, "rb") as file:
            file.seek(max(0, log.stat().st_size - TAIL_BYTES))
            lines = file.read(TAIL_BYTES).split(b"\n")
    except OSError:
        return None
    for line in reversed(lines):
        with contextlib.suppress(ValueError, RecursionError):  # empty, half written, or cut by the seek
            return _ROWS.decode(line)
    return None
