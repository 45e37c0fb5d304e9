"""Training in several processes that torchrun starts: distribution of views, sums of results, and lost processes.

A step renders B views in slots 0 to B - 1. Each rank renders a range of slots. Sums over slots are added in the order
of the ranks, with every communication backend. Two processes with one view each therefore compute exactly the same
result as one process with two views.
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
    """Error that is raised if another rank has ended."""


@contextlib.contextmanager
def _collective() -> Iterator[None]:
    """Raise LostRank if a collective fails; communication backends raise different exceptions."""
    try:
        yield
    except RuntimeError as error:
        raise LostRank(str(error)) from error


def _gather(into: Tensor, own: Tensor) -> None:
    """Gather the tensors ``own`` of all ranks into ``into``; torch's function has two names."""
    gather = getattr(dist, "all_gather_single", None) or dist.all_gather_into_tensor
    gather(into, own)


class Ranks:
    """Communication of a training in a single process, which has nobody to communicate with.

    ``SeveralRanks`` overrides the methods that involve other processes.

    Attributes:
        rank: number of this process.
        world: number of processes.
    """

    rank = 0
    world = 1

    def slots(self, views: int, rank: int | None = None) -> range:
        """Return the slots that a rank renders if a step has ``views`` views; the first ranks take the remainder."""
        rank = self.rank if rank is None else rank
        base, remainder = divmod(views, self.world)
        begin = rank * base + min(rank, remainder)
        return range(begin, begin + base + (rank < remainder))

    def all_reduce(self, tensors: Sequence[Tensor]) -> None:
        """Replace each tensor by its sum over the ranks, in their order."""

    def average(self, gradients: list[Tensor], views: int) -> None:
        """Replace gradients summed over the views of this rank by the mean over all ``views`` of the step."""
        if views == 1 and self.world == 1:
            return
        if not self.slots(views):
            torch._foreach_zero_(gradients)
        self.all_reduce(gradients)
        if views > 1:
            torch._foreach_div_(gradients, float(views))

    def exchange_slots(self, sums: Tensor) -> None:
        """Fill in the rows that other ranks have computed, in a tensor [S, ...] with one row per slot."""

    def broadcast(self, tensor: Tensor) -> None:
        """Replace a tensor by the tensor of rank 0."""

    def any(self, flag: bool) -> bool:
        """Return True if the flag is True on any rank."""
        return flag

    def barrier(self) -> None:
        """Wait for all ranks."""


class SeveralRanks(Ranks):
    """Communication of a training in several processes, by the default process group.

    The group has a backend for CPU tensors, and may have one for GPU tensors.
    """

    def __init__(self) -> None:
        self.rank = dist.get_rank()
        self.world = dist.get_world_size()

    def all_reduce(self, tensors: Sequence[Tensor]) -> None:
        """Replace each tensor by its sum over the ranks; each rank adds one part of the tensors and distributes it."""
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
    """Join the process group of torchrun, if there is one, and leave it at the end of the context.

    All processes leave the group together. If a process is lost, the other processes on its machine exit within seconds
    with status 1. The first of them reports the loss on stderr.

    Args:
        device: device of the computation.
        out: the run folder, which the message names.

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
    """Return the backend of this rank. The first rank of a machine compiles the kernels while the other ranks wait."""
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
    """Thread that checks the other ranks of this machine, and ends this process when a rank is lost.

    A thread is needed because a rank that waits for a lost rank inside a collective cannot run signal handlers.
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
        """Stop the checks before the processes end normally."""
        self._stop.set()
