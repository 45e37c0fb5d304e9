"""Cache of what is computed of the training views, in memory up to a limit and beyond it in a file.

Targets are rounded to whole numbers of 1/32767 of the largest value of their picture, whatever the size of the scene,
so that a result does not depend on where they were stored. That is a hundredth of a degree of a normal, and an eighth
of a step of an 8-bit picture at full scale. Every entry can be computed again to the same bits.
"""

from __future__ import annotations

import contextlib
import tempfile
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, NamedTuple

import torch
from torch import Tensor

FULL = 32767


class Packed(NamedTuple):
    """A tensor as it is kept.

    Attributes:
        codes: int16, or of the tensor's own type where that was not coded.
        top: what the code 32767 stands for, a scalar; None: not coded.
    """

    codes: Tensor
    top: Tensor | None = None

    @property
    def bytes(self) -> int:
        """Size in bytes."""
        return self.codes.numel() * self.codes.element_size()


Entry = dict[str, Packed]
"""Cached tensors of a view by name."""


def packed(values: Tensor) -> Packed:
    """Finite float32 values as whole numbers of 1/32767 of the largest absolute one; 0 and the largest stay exact."""
    top = values.abs().amax()
    top = torch.where(top == 0, torch.ones_like(top), top)
    return Packed((values * (FULL / top)).round_().to(torch.int16), top)


def stored_values(entry: Packed) -> Tensor:
    """The values, float32 where they were coded."""
    if entry.top is None:
        return entry.codes
    # A division by 32767 gives back a 1 exactly, a product with its inverse does not.
    values = entry.codes.to(torch.float32).div_(FULL)
    return values if entry.top.device.type == "cpu" and float(entry.top) == 1 else values.mul_(entry.top)


ALIGNED = 64


@dataclass
class _FileSlot:
    """Where in the file an entry is: its offset, the room there, and what to make of the bytes."""

    offset: int
    room: int
    parts: dict[str, tuple[torch.dtype, tuple[int, ...], torch.Tensor | None]] | None = None


class ViewStore:
    """Keeps entries by kind and view.

    Which of them lie in memory is decided as they come, and stays so: views are visited in changing order, in which
    what was used last is not what is used next, so that exchanging them would only write more.

    Args:
        limit: bytes of entries in memory; None: all.
        folder: for the file of the others. It has no name there, and is gone with the process; None: entries over the
            limit are not kept but made again.
        warn: receives a message where the file cannot be written; entries over the limit are then computed again.
    """

    def __init__(
        self,
        limit: int | None = None,
        folder: Path | None = None,
        warn: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._limit = limit
        self._folder = folder
        self._warn = warn
        self._entries: dict[tuple[str, str], Entry] = {}
        self._places: dict[tuple[str, str], _FileSlot] = {}
        self._file: IO[bytes] | None = None
        self.in_memory = 0
        self.in_file = 0

    def get(self, kind: str, view: str, make: Callable[[], Entry], *, disposable: bool = False) -> Entry:
        """An entry; it is made where it is not kept.

        Args:
            kind, view: its name. make: makes it. disposable: over the limit it is made again, not put into the file.
        """
        key = (kind, view)
        entry = self._entries.get(key) or self._read(key)
        if entry is None:
            entry = make()
            self._keep(key, entry, disposable)
        return entry

    def drop(self, kind: str, view: str | None = None) -> None:
        """Forget the entries of a kind, or one of them.

        An entry that is made again takes its old place in the file if it still fits there. A larger one is put at the
        end, and its old place stays empty: entries only grow when a stage reads more than the one before.
        """
        for key in [key for key in self._entries if key[0] == kind and view in (None, key[1])]:
            self.in_memory -= _size(self._entries.pop(key))
        for key, place in self._places.items():
            if key[0] == kind and view in (None, key[1]):
                place.parts = None

    def close(self) -> None:
        """Forget everything."""
        self._entries.clear()
        self._places.clear()
        self.in_memory = self.in_file = 0
        if self._file is not None:
            self._file.close()
            self._file = None

    def _keep(self, key: tuple[str, str], entry: Entry, disposable: bool) -> None:
        size = _size(entry)
        if self._limit is None or self.in_memory + size <= self._limit:
            self._entries[key] = entry
            self.in_memory += size
        elif self._folder is not None and not disposable:
            try:
                self._write(key, entry, size)
            except OSError as error:
                self._places.pop(key, None)
                self._folder = None
                self._warn(
                    f"what a training keeps of its views cannot be put into a file ({error.strerror or error}): it is "
                    "computed again for every step, which is slow. Make room on the disk, or give more --memory."
                )

    def _write(self, key: tuple[str, str], entry: Entry, size: int) -> None:
        if self._file is None:
            self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115, until close
            weakref.finalize(self, self._file.close)
        place = self._places.get(key)
        if place is None or place.room < size:
            place = _FileSlot(self.in_file, size)
            self.in_file += -(-size // ALIGNED) * ALIGNED
            self._places[key] = place
        place.parts = None
        self._file.seek(place.offset)
        for part in entry.values():
            rest = memoryview(part.codes.contiguous().view(torch.uint8).numpy()).cast("B")
            while rest:
                rest = rest[self._file.write(rest) :]
        place.parts = {name: (p.codes.dtype, tuple(p.codes.shape), p.top) for name, p in entry.items()}

    def _read(self, key: tuple[str, str]) -> Entry | None:
        """An entry from the file; None where it is not there, or cannot be read."""
        place = self._places.get(key)
        if place is None or place.parts is None or self._file is None:
            return None
        entry = {}
        with contextlib.suppress(OSError):
            self._file.seek(place.offset)
            for name, (kind, shape, top) in place.parts.items():
                codes = torch.empty(shape, dtype=kind)
                rest = memoryview(codes.view(torch.uint8).numpy()).cast("B")
                while rest:
                    count = self._file.readinto(rest)  # type: ignore[attr-defined]
                    if not count:
                        return None
                    rest = rest[count:]
                entry[name] = Packed(codes, top)
            return entry
        return None


def _size(entry: Entry) -> int:
    return sum(part.bytes for part in entry.values())
