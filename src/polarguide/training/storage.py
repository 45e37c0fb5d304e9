"""Cache of computed data of training views, in memory up to a limit and in a file beyond it.

Targets are always rounded to multiples of 1/32767 of the largest value of their picture, also if they stay in memory.
Results therefore do not depend on the place of storage. The rounding changes a normal by at most about a hundredth of a
degree. It corresponds to an eighth of a step of an 8-bit picture at full scale. Every entry can be recomputed to
exactly the same values.
"""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, NamedTuple

import torch
from safetensors.torch import load, save
from torch import Tensor

FULL = 32767
"""Largest code of a packed tensor."""


class Packed(NamedTuple):
    """A cached tensor.

    Attributes:
        codes: int16 codes, or the tensor itself if it was not coded.
        top: value of the code 32767, a scalar. None if the tensor was not coded.
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
    """Pack finite float32 values as whole numbers of 1/32767 of the largest absolute value.

    0 and the largest value stay exact.
    """
    top = values.abs().amax()
    top = torch.where(top == 0, torch.ones_like(top), top)
    return Packed((values * (FULL / top)).round_().to(torch.int16), top)


def stored_values(entry: Packed) -> Tensor:
    """Return the values of a packed tensor. Coded tensors become float32."""
    if entry.top is None:
        return entry.codes
    # Division by 32767 restores a 1 exactly; a product with its inverse does not.
    values = entry.codes.to(torch.float32).div_(FULL)
    return values if entry.top.device.type == "cpu" and float(entry.top) == 1 else values.mul_(entry.top)


@dataclass
class _FileSlot:
    """Slot of an entry in the file.

    Attributes:
        offset, size: position and size of the slot in bytes.
        length: size of the entry in bytes; 0 if the slot is free.
        tops: scales of the tensors by name.
    """

    offset: int
    size: int
    length: int = 0
    tops: dict[str, Tensor | None] = field(default_factory=dict)


class ViewStore:
    """Cache of computed data, with entries by kind and view.

    An entry stays where it was first stored, in memory or in the file. Entries are not exchanged, because views are
    visited in random order. Removing the least recently used entry from memory would only cause more writes.

    Args:
        limit: largest number of bytes in memory. None means no limit.
        folder: folder of the file. The file has no name and disappears with the process. With None, entries beyond the
            limit are recomputed at each use.
        warn: receives a message if the file cannot be written. Entries beyond the limit are then recomputed at each
            use.
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
        self._slots: dict[tuple[str, str], _FileSlot] = {}
        self._file: IO[bytes] | None = None
        self.in_memory = 0
        self.in_file = 0

    def get(self, kind: str, view: str) -> Entry | None:
        """Return the entry of a kind and a view, or None if it is missing."""
        key = (kind, view)
        return self._entries.get(key) or self._read(key)

    def drop(self, kind: str, view: str | None = None) -> None:
        """Drop all entries of a kind, or the entry of one view.

        A new entry reuses the slot of the dropped entry in the file if it fits. A larger entry is appended, and the old
        slot stays empty. Entries grow only if a stage needs more data than the previous stage.
        """
        for key in [key for key in self._entries if key[0] == kind and view in (None, key[1])]:
            self.in_memory -= sum(part.bytes for part in self._entries.pop(key).values())
        for key, slot in self._slots.items():
            if key[0] == kind and view in (None, key[1]):
                slot.length = 0

    def close(self) -> None:
        """Drop all entries."""
        self._entries.clear()
        self._slots.clear()
        self.in_memory = self.in_file = 0
        if self._file is not None:
            self._file.close()
            self._file = None

    def keep(self, kind: str, view: str, entry: Entry, *, disposable: bool = False) -> None:
        """Store an entry in place of an earlier one.

        Args:
            kind, view: key of the entry.
            entry: the entry.
            disposable: True to discard the entry if it is beyond the limit, instead of writing it to the file.
        """
        self.drop(kind, view)
        key = (kind, view)
        size = sum(part.bytes for part in entry.values())
        if self._limit is None or self.in_memory + size <= self._limit:
            self._entries[key] = entry
            self.in_memory += size
        elif self._folder is not None and not disposable:
            try:
                self._write(key, entry)
            except OSError as error:
                self._slots.pop(key, None)
                self._folder = None
                self._warn(
                    f"the cache of per-view data cannot be written to a file ({error.strerror or error}). The data are "
                    "computed again in every step, which is slow. Free space on the disk, or increase --memory."
                )

    def _write(self, key: tuple[str, str], entry: Entry) -> None:
        if self._file is None:
            self._file = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115, until close
            weakref.finalize(self, self._file.close)
        data = save({name: part.codes.contiguous() for name, part in entry.items()})
        slot = self._slots.get(key)
        if slot is None or slot.size < len(data):
            slot = _FileSlot(self.in_file, len(data))
            self.in_file += len(data)
            self._slots[key] = slot
        slot.length = 0
        self._file.seek(slot.offset)
        self._file.write(data)
        self._file.flush()
        slot.length = len(data)
        slot.tops = {name: part.top for name, part in entry.items()}

    def _read(self, key: tuple[str, str]) -> Entry | None:
        """Return an entry from the file; None if it is missing or cannot be read."""
        slot = self._slots.get(key)
        if slot is None or not slot.length or self._file is None:
            return None
        try:
            self._file.seek(slot.offset)
            data = self._file.read(slot.length)
        except OSError:
            return None
        if len(data) < slot.length:
            return None
        return {name: Packed(codes, slot.tops[name]) for name, codes in load(data).items()}
