"""The processes that ``torchrun`` started for one training: meeting, watching each other, and ending together."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from types import FrameType

import torch
import torch.distributed as dist

from polarguide.cli.common import console
from polarguide.errors import PolarguideError
from polarguide.raster import Backend, DeviceName, choose_backend
from polarguide.training.distributed import ALONE, LostRank, Ranks, SeveralRanks

LOOK_SECONDS = 1.0
# A rank that found no other answers waits this long for the watch to find out whom it lost.
PATIENCE_SECONDS = 15.0
# torchrun ends the others when one is lost. Outside the loop, which stops by itself, they live this much longer.
LAST_WORDS_SECONDS = 5.0
TIMEOUT = timedelta(minutes=30)


def company_size() -> int:
    """Number of processes of this training, as torchrun says; 1 without it."""
    return int(os.environ.get("WORLD_SIZE", "1"))


@contextlib.contextmanager
def company(device: DeviceName, out: Path) -> Iterator[Ranks]:
    """Meet the other processes, and leave together. Only rank 0 talks.

    When one is lost, whatever the others do, each of this machine ends within seconds with status 1, and the first of
    them says so on stderr.

    Args:
        device: as given to ``--device``. out: the run's folder, named in that line.
    """
    if company_size() == 1:
        yield ALONE
        return
    backend = "cpu:gloo,cuda:nccl" if device != "cpu" and torch.cuda.is_available() else "gloo"
    dist.init_process_group(backend, timeout=TIMEOUT)
    ranks = SeveralRanks()
    console.quiet = ranks.rank > 0
    watch = _Watch(ranks, out)
    before = signal.signal(signal.SIGTERM, _end_soon)
    try:
        yield ranks
        ranks.barrier()
    except LostRank as error:
        watch.ended.wait(
            PATIENCE_SECONDS
        )  # the watch ends this process before that, if it can tell who it was
        raise _loss("one of them does not answer", ranks.world, out) from error
    finally:
        watch.stop()
        signal.signal(signal.SIGTERM, before)
        console.quiet = False
    dist.destroy_process_group()


def backend_of(ranks: Ranks, device: DeviceName) -> Backend:
    """The backend of this rank; the first rank of a machine compiles kernels while the others wait."""
    local = int(os.environ.get("LOCAL_RANK", "0")) if ranks.world > 1 else 0
    chosen = choose_backend(device, say=console.print) if local == 0 else None
    ranks.barrier()
    return chosen or choose_backend(device, local_rank=local, say=console.print)


def _end_soon(number: int, frame: FrameType | None) -> None:
    """Let the watch say why, then end."""
    timer = threading.Timer(LAST_WORDS_SECONDS, os._exit, (128 + number,))
    timer.daemon = True
    timer.start()


def _loss(found: str, world: int, out: Path) -> PolarguideError:
    return PolarguideError(
        "training",
        expected=f"{world} processes",
        found=found,
        remedy=f"The last checkpoint in {out} is whole; go on with --resume, on any number of processes.",
    )


class _Watch:
    """A thread that looks whether this machine's ranks are alive, and ends this process when one is not.

    A rank that waits for a lost one inside a collective cannot be reached by a signal handler, so a thread does it.
    """

    def __init__(self, ranks: SeveralRanks, out: Path) -> None:
        self._ranks, self._out = ranks, out
        self.ended = threading.Event()
        everyone: list[tuple[str, int]] = [("", 0)] * ranks.world
        here = socket.gethostname()
        dist.all_gather_object(everyone, (here, os.getpid()))
        self._pids = {rank: pid for rank, (host, pid) in enumerate(everyone) if host == here}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def _look(self) -> None:
        while not self._stop.wait(LOOK_SECONDS):
            lost = {rank: pid for rank, pid in self._pids.items() if not alive(pid)}
            if lost and not self._stop.is_set():
                if self._ranks.rank == min(set(self._pids) - set(lost)):
                    who = " and ".join(f"rank {rank} (process {pid})" for rank, pid in lost.items())
                    sys.stderr.write(
                        f"error: {_loss(f'that {who} was lost', self._ranks.world, self._out)}\n"
                    )
                    sys.stderr.flush()
                time.sleep(0.5)  # so that the others find the same loss, and not this process's end
                os._exit(1)

    def stop(self) -> None:
        """From now on others may end."""
        self._stop.set()


def alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and that nobody has asked about yet does not."""
    try:
        os.kill(pid, 0)
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except ProcessLookupError:
        return False
    except (OSError, IndexError):  # not ours to signal, or a system without /proc
        return True
    return state not in "ZX"
