"""The processes that share one training: who takes which views, and how their results become one.

A step looks at B views, its slots 0 to B - 1. Each rank takes a run of them. Sums over slots are made in the order of
the ranks, whatever the backend of the communication does, so two processes of one view each give the bits of one
process of two.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

import torch
import torch.distributed as dist
from torch import Tensor

if dist.is_available():
    # Its functions have the default group for a default value. Imported once there is a group, as torch's optimizers
    # import it, it would keep that for good, and the group's threads could abort the interpreter as it ends.
    import torch.distributed.nn


class LostRank(Exception):
    """Another rank does not take part any more."""


@contextlib.contextmanager
def _together() -> Iterator[None]:
    """Inside, a failed collective raises LostRank; every backend has an exception of its own kind."""
    try:
        yield
    except RuntimeError as error:
        raise LostRank(str(error)) from error


def _gather(into: Tensor, own: Tensor) -> None:
    """Everybody's ``own`` one after the other; newer versions of torch have a new name for it."""
    gather = getattr(dist, "all_gather_single", None) or dist.all_gather_into_tensor
    gather(into, own)


class Ranks:
    """One process alone; ``SeveralRanks`` overrides what needs company.

    Attributes:
        rank: number of this process. world: how many there are.
    """

    rank = 0
    world = 1

    def slots(self, views: int, rank: int | None = None) -> range:
        """The slots of a step's ``views`` that a rank takes; the first ranks take one more where it does not divide."""
        rank = self.rank if rank is None else rank
        base, more = divmod(views, self.world)
        begin = rank * base + min(rank, more)
        return range(begin, begin + base + (rank < more))

    def all_reduce(self, tensors: Sequence[Tensor]) -> None:
        """Replace each tensor by its sum over the ranks, in their order."""

    def exchange_slots(self, sums: Tensor) -> None:
        """Fill in the rows of [S, ...] that other ranks own."""

    def broadcast(self, tensor: Tensor) -> None:
        """Replace a tensor by that of rank 0."""

    def any(self, flag: bool) -> bool:
        """Whether the flag is up on any rank."""
        return flag

    def barrier(self) -> None:
        """Until all ranks are here."""


class SeveralRanks(Ranks):
    """The ranks of the default process group, which has a backend for CPU tensors (and one for the device's)."""

    def __init__(self) -> None:
        self.rank, self.world = dist.get_rank(), dist.get_world_size()

    def all_reduce(self, tensors: Sequence[Tensor]) -> None:
        """Each rank gets one part of everything from all, adds it up in the order of ranks, and gives it to all."""
        if not tensors:
            return
        flat = torch.cat([t.reshape(-1) for t in tensors])
        part = -(-flat.numel() // self.world)
        padded = torch.cat((flat, flat.new_zeros(part * self.world - flat.numel())))
        received = torch.empty_like(padded)
        with _together():
            dist.all_to_all_single(received, padded)
        total, *others = received.view(self.world, part)
        for other in others:
            total = total + other
        with _together():
            _gather(padded, total.contiguous())
        for t, values in zip(
            tensors, padded[: flat.numel()].split([t.numel() for t in tensors]), strict=True
        ):
            t.copy_(values.view_as(t))

    def exchange_slots(self, sums: Tensor) -> None:
        most = len(self.slots(len(sums), 0))
        own = sums.new_zeros(most, *sums.shape[1:])
        mine = self.slots(len(sums))
        own[: len(mine)] = sums[mine.start : mine.stop]
        gathered = sums.new_empty(self.world * most, *sums.shape[1:])
        with _together():
            _gather(gathered, own)
        for rank in range(self.world):
            theirs = self.slots(len(sums), rank)
            sums[theirs.start : theirs.stop] = gathered[rank * most : rank * most + len(theirs)]

    def broadcast(self, tensor: Tensor) -> None:
        with _together():
            dist.broadcast(tensor, 0)

    def any(self, flag: bool) -> bool:
        raised = torch.tensor([int(flag)])
        with _together():
            dist.all_reduce(raised, dist.ReduceOp.MAX)
        return bool(raised.item())

    def barrier(self) -> None:
        self.any(False)


ALONE = Ranks()
