"""A collection of captures and how far each is, as the files of a batch say. Does not import torch."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import msgspec

from polarguide.core.errors import PolarguideError
from polarguide.core.files import write_whole
from polarguide.core.options import ComputeOptions, ExportFormat, SceneOptions
from polarguide.core.records import read_record, to_json
from polarguide.core.text import canonical
from polarguide.preparation.settings import PrepareSettings
from polarguide.training.settings import TrainSettings

FORMAT = 1
RECORD = "capture.json"
SCENE = "scene"
"""Scene folder, in the folder of each capture."""
INSPECTION = "inspection"
"""Folder of the inspection."""
RUN = "run"
"""Run folder."""
EXPORT = "export"
"""Folder of the exports."""
SHARE = "share.html"
"""File of the shared page."""
Step = Literal["prepare", "inspect", "train", "eval", "share", "export"]
STEPS: tuple[Step, ...] = ("prepare", "inspect", "train", "eval", "share", "export")
NO_FILES = (0, 0, 0)
"""The stamp of a folder that is empty, or not there."""


class Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The inputs that determine a capture's results.

    Attributes:
        source: absolute path of its folder. stamp: number, size and newest time of its files.
        digest: SHA-256 over their names and content, which tells whether they are the same where the stamp is another;
            empty in records of earlier versions.
        prepare: ``PrepareSettings.record()``; None: the source is a scene already.
        recipe, settings, reading: those of the training. formats: formats of the export.
    """

    source: str
    stamp: tuple[int, int, int]
    prepare: dict[str, Any] | None
    recipe: str
    settings: TrainSettings
    reading: SceneOptions
    formats: tuple[ExportFormat, ...]
    digest: str = ""


class Processing(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="process"):
    """Take a capture from its files to its exports, as far as that is still to do."""

    name: str
    folder: str
    request: Request
    compute: ComputeOptions


class CaptureRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How far a capture is.

    Attributes:
        done: the steps that are finished. at: the one that was begun last.
        verdict, findings: those of the inspection; all but those that are ok.
        pictures: pictures of one view, label and data URI each. files: exported, relative to the capture's folder.
    """

    format: int
    request: Request
    done: tuple[Step, ...] = ()
    at: Step | None = None
    verdict: str = ""
    findings: tuple[str, ...] = ()
    pictures: tuple[tuple[str, str], ...] = ()
    files: tuple[str, ...] = ()

    def save(self, folder: Path) -> None:
        """Write it in one step."""
        write_whole(folder / RECORD, to_json(msgspec.to_builtins(self)))

    @staticmethod
    def load(folder: Path) -> CaptureRecord | None:
        """The record in a folder; None where there is none yet.

        Raises:
            PolarguideError: the file is no such record.
        """
        if not os.path.lexists(folder / RECORD):
            return None
        return read_record(folder / RECORD, CaptureRecord, remedy="Remove the folder to begin again.")

    def require(self, request: Request, folder: Path) -> None:
        """Refuse to go on with another request than it was begun with; one that is done may lose its source.

        Raises:
            PolarguideError: the requests differ.
        """
        if request.stamp == NO_FILES and set(self.done) == set(STEPS):
            return
        alike = {"source", "digest"}  # files are known by their content, wherever they lie
        if self.request.digest == request.digest != "":
            alike.add("stamp")
        for name in Request.__struct_fields__:
            if name not in alike and getattr(self.request, name) != getattr(request, name):
                raise PolarguideError(
                    folder,
                    expected=f"the capture and options that it was begun with ({name})",
                    found="files that have changed since" if name == "stamp" else "others",
                    remedy="Remove this folder to begin again, or give another --out.",
                )


def prepare_settings(record: dict[str, Any]) -> PrepareSettings:
    """The settings of ``PrepareSettings.record()``."""
    return msgspec.convert(
        record,
        PrepareSettings,
        strict=False,
        dec_hook=lambda kind, value: kind(value) if kind is Path else value,
    )


def source_stamp(folder: Path) -> tuple[int, int, int]:
    """Number of files below a folder, their bytes, and when the newest was changed (ns); without hidden ones."""
    count = size = newest = 0
    for path in _files_below(folder):
        with contextlib.suppress(OSError, ValueError):  # it has gone, or has a name that no file can have
            state = os.stat(path)
            count += 1
            size += state.st_size
            newest = max(newest, state.st_mtime_ns)
    return count, size, newest


def source_digest(folder: Path, earlier: Request | None, stamp: tuple[int, int, int]) -> str:
    """SHA-256 over names and content of the files below a folder, without hidden ones; empty where there are none.

    Args:
        folder: of the capture. earlier: the request of an earlier call, whose digest is taken if the stamp is the same.
        stamp: of the folder now.
    """
    if earlier is not None and earlier.stamp == stamp and earlier.digest:
        return earlier.digest
    whole = hashlib.sha256()
    for path in sorted(_files_below(folder)):
        if not os.path.isfile(path):
            continue  # reading a pipe may never end
        with contextlib.suppress(OSError), open(path, "rb") as file:
            whole.update(f"{canonical(os.path.relpath(path, folder))}\0".encode("utf-8", "surrogateescape"))
            while block := file.read(1 << 20):
                whole.update(block)
    return "" if stamp == NO_FILES else whole.hexdigest()


def _files_below(folder: Path) -> Iterator[str]:
    """Paths of the files below a folder, without hidden ones."""
    for at, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        yield from (os.path.join(at, name) for name in names if not name.startswith("."))
