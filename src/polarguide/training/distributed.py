"""Processes of one training, started by torchrun: shares of views, sums of results, and loss of a process.

A step renders B views in its slots 0 to B - 1. Each rank takes a range of them. Sums over slots are computed in the
order of the ranks, for every communication backend, so that two processes of one view each give the bits of one process
of two.
"""

from __future__ import annotations

import contextlib
import os
import socket
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from datetime import timedelta
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor

from polarguide.core.errors import PolarguideError
from polarguide.core.options import DeviceName
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.system import process_count, process_is_alive
from polarguide.raster import Backend, choose_backend

if dist.is_available():
    # Imported here, before a process group exists. Its functions have the default group as default values: a later
    # import, such as by torch's optimizers, keeps the group alive, and its threads may abort the exiting interpreter.
    import torch.distributed.nn


POLL_SECONDS = 1.0
"""Seconds between two checks of the other processes."""
PATIENCE_SECONDS = 15.0
"""Seconds that a rank with a failed collective waits for the monitor to find the lost process."""
TIMEOUT = timedelta(minutes=30)
"""Timeout of a collective."""


class LostRank(Exception):
    """Another rank does not take part any more."""


@contextlib.contextmanager
def _collective() -> Iterator[None]:
    """Convert a failed collective to LostRank; every backend raises another exception."""
    try:
        yield
    except RuntimeError as error:
        raise LostRank(str(error)) from error


def _gather(into: Tensor, own: Tensor) -> None:
    """Gather the tensors ``own`` of all ranks; newer versions of torch have a new name for it."""
    gather = getattr(dist, "all_gather_single", None) or dist.all_gather_into_tensor
    gather(into, own)


class Ranks:
    """One process alone; ``SeveralRanks`` overrides the methods that involve other processes.

    Attributes:
        rank: number of this process.
        world: number of processes.
    """

    rank = 0
    world = 1

    def slots(self, views: int, rank: int | None = None) -> range:
        """Return the slots of a step's ``views`` of a rank; the first ranks take the remainder."""
        rank = self.rank if rank is None else rank
        base, remainder = divmod(views, self.world)
        begin = rank * base + min(rank, remainder)
        return range(begin, begin + base + (rank < remainder))

    def all_reduce(self, tensors: Sequence[Tensor]) -> None:
        """Replace each tensor by its sum over the ranks, in their order."""

    def average(self, gradients: list[Tensor], views: int) -> None:
        """Replace sums over the views of this rank by the mean over all ``views`` of a step."""
        if views == 1 and self.world == 1:
            return
        if not self.slots(views):
            torch._foreach_zero_(gradients)
        self.all_reduce(gradients)
        if views > 1:
            torch._foreach_div_(gradients, float(views))

    def exchange_slots(self, sums: Tensor) -> None:
        """Fill in the rows of [S, ...] of other ranks."""

    def broadcast(self, tensor: Tensor) -> None:
        """Replace a tensor by that of rank 0."""

    def any(self, flag: bool) -> bool:
        """Return True if the flag is True on any rank."""
        return flag

    def barrier(self) -> None:
        """Wait for all ranks."""


class SeveralRanks(Ranks):
    """Ranks of the default process group, which has a backend for CPU tensors and may have one for a GPU."""

    def __init__(self) -> None:
        self.rank = dist.get_rank()
        self.world = dist.get_world_size()

    def all_reduce(self, tensors: Sequence[Tensor]) -> None:
        """Sum one part of all tensors on each rank in the order of ranks, and distribute the sums."""
        if not tensors:
            return
        flat = torch.cat([t.reshape(-1) for t in tensors])
        part = -(-flat.numel() // self.world)
        padded = torch.cat((flat, flat.new_zeros(part * self.world - flat.numel())))
        received = torch.empty_like(padded)
        with _collective():
            dist.all_to_all_single(received, padded)
        total, *others = received.view(self.world, part)
        for other in others:
            total = total + other
        with _collective():
            _gather(padded, total.contiguous())
        for t, values in zip(
            tensors, padded[: flat.numel()].split([t.numel() for t in tensors]), strict=True
        ):
            t.copy_(values.view_as(t))

    def exchange_slots(self, sums: Tensor) -> None:
        largest = len(self.slots(len(sums), 0))
        own = sums.new_zeros(largest, *sums.shape[1:])
        slots = self.slots(len(sums))
        own[: len(slots)] = sums[slots.start : slots.stop]
        gathered = sums.new_empty(self.world * largest, *sums.shape[1:])
        with _collective():
            _gather(gathered, own)
        for rank in range(self.world):
            slots = self.slots(len(sums), rank)
            sums[slots.start : slots.stop] = gathered[rank * largest : rank * largest + len(slots)]

    def broadcast(self, tensor: Tensor) -> None:
        with _collective():
            dist.broadcast(tensor, 0)

    def any(self, flag: bool) -> bool:
        raised = torch.tensor([int(flag)])
        with _collective():
            dist.all_reduce(raised, dist.ReduceOp.MAX)
        return bool(raised.item())

    def barrier(self) -> None:
        self.any(False)


ALONE = Ranks()


@contextlib.contextmanager
def process_group(device: DeviceName, out: Path) -> Iterator[Ranks]:
    """Join the process group of torchrun, if there is one, and leave it together.

    If a process is lost, the other processes of its machine end within seconds with status 1, and the first of them
    reports it on stderr.

    Args:
        device: device of the computation.
        out: the run folder, for that message.

    Raises:
        PolarguideError: a process is lost on another machine.
    """
    if process_count() == 1:
        yield ALONE
        return
    backend = "cpu:gloo,cuda:nccl" if device != "cpu" and torch.cuda.is_available() else "gloo"
    dist.init_process_group(backend, timeout=TIMEOUT)
    ranks = SeveralRanks()
    monitor = _Monitor(ranks, out)
    try:
        yield ranks
        ranks.barrier()
    except LostRank as error:
        # The monitor ends this process earlier if the lost one was on this machine.
        time.sleep(PATIENCE_SECONDS)
        raise _loss("one that does not respond", ranks.world, out) from error
    finally:
        monitor.stop()
    dist.destroy_process_group()


def backend_of(ranks: Ranks, device: DeviceName, reporter: Reporter = SILENT) -> Backend:
    """Return the backend of this rank; the first rank of a machine compiles kernels while the others wait."""
    local = int(os.environ.get("LOCAL_RANK", "0")) if ranks.world > 1 else 0
    chosen = choose_backend(device, say=reporter.say) if local == 0 else None
    ranks.barrier()
    return chosen or choose_backend(device, local_rank=local, say=reporter.say)


def _loss(found: str, world: int, out: Path) -> PolarguideError:
    return PolarguideError(
        "training",
        expected=f"{world} processes",
        found=found,
        remedy=f"Continue with --resume, on any number of processes; the last checkpoint in {out} is complete.",
    )


class _Monitor:
    """Thread that checks the ranks of this machine, and ends this process when one is lost.

    A rank that waits for a lost one inside a collective cannot run signal handlers, so that a thread is needed.
    """

    def __init__(self, ranks: SeveralRanks, out: Path) -> None:
        self._ranks = ranks
        self._out = out
        processes: list[tuple[str, int]] = [("", 0)] * ranks.world
        host_name = socket.gethostname()
        dist.all_gather_object(processes, (host_name, os.getpid()))
        self._pids = {rank: pid for rank, (host, pid) in enumerate(processes) if host == host_name}
        self._stop = threading.Event()
        threading.Thread(target=self._poll, daemon=True).start()

    def _poll(self) -> None:
        while not self._stop.wait(POLL_SECONDS):
            lost = {rank: pid for rank, pid in self._pids.items() if not process_is_alive(pid)}
            if lost and not self._stop.is_set():
                if self._ranks.rank == min(set(self._pids) - set(lost)):
                    names = " and ".join(f"rank {rank} (process {pid})" for rank, pid in lost.items())
                    loss = _loss(f"that {names} was lost", self._ranks.world, self._out)
                    sys.stderr.write(f"error: {loss}\n")
                    sys.stderr.flush()
                time.sleep(0.5)  # the others detect the same loss before they detect the end of this process
                os._exit(1)

    def stop(self) -> None:
        """Stop the checks, so that processes may end."""
        self._stop.set()
