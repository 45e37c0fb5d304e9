"""Runs command lines in forked children of this process, and says how each ended.

A fresh start of the program takes seconds, most of them for its imports; a fork has them already. The parent itself
computes nothing, so that no thread of it is lost in a fork.
"""

from __future__ import annotations

import hashlib
import os
import random
import re
import resource
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

CPU_SECONDS = 25
WALL_SECONDS = 240  # of a child that waits; a busy machine is no fault of it
LARGEST_MIB = 2560
TRACEBACK = 70
ERROR = re.compile(r"^error: (?P<where>.+?): expected .+, found .*\. .+\.$", re.MULTILINE | re.DOTALL)
USAGE = "─"  # the frame that the parser of the command line draws around what it does not understand

Make = Callable[[Path, random.Random], list[str]]
"""Spoils copies of the base in a new folder; returns the command line."""


@dataclass(frozen=True)
class Case:
    """One mutation.

    Attributes:
        name: what is spoiled, and how. seed: of its random choices.
        make: see ``Make``.
        accepted: why it may pass without a word; empty: it may not.
        says: a regular expression of what it has to print; empty: anything.
        check: raises where what was written is not as it should be; called with the folder, after the command.
    """

    name: str
    seed: int
    make: Make
    accepted: str = ""
    check: Callable[[Path], None] | None = None
    says: str = ""


@dataclass(frozen=True)
class Outcome:
    """How a case ended.

    Attributes:
        kind: "error" (one line that names what is wrong and what to do), "warning", "accepted" (as listed), or a fault:
            "silent", "traceback", "crash", "hang", "large", "outside", "unclear".
        said: the last of what it printed. seconds, mebibytes: processor time and peak memory.
    """

    case: Case
    kind: str
    said: str
    seconds: float
    mebibytes: float

    @property
    def is_fault(self) -> bool:
        """Whether it should not have ended so."""
        return self.kind not in ("error", "warning", "accepted")


def outcomes(cases: Iterable[Case], base: Path, work: Path, at_once: int = 2) -> Iterator[Outcome]:
    """Run cases, some at once; outcomes come in the order in which they end."""
    running: dict[int, tuple[Case, Path, float, str]] = {}
    waiting = iter(cases)
    number, exhausted = 0, False
    while running or not exhausted:
        while len(running) < at_once and not exhausted:
            case = next(waiting, None)
            if case is None:
                exhausted = True
                break
            number += 1
            folder = work / f"{number}"
            canary = _canary(folder)
            running[_fork(case, base, folder)] = (case, folder, time.monotonic(), canary)
        for pid in list(running):
            case, folder, began, canary = running[pid]
            ended, status, usage = os.wait4(pid, os.WNOHANG)
            late = not ended and time.monotonic() - began > WALL_SECONDS
            if late:
                os.kill(pid, signal.SIGKILL)
                ended, status, usage = os.wait4(pid, 0)
            if ended:
                del running[pid]
                yield _outcome(case, folder, status, usage, canary, late)
                shutil.rmtree(folder, ignore_errors=True)
        time.sleep(0.005)


def _canary(folder: Path) -> str:
    """A file beside what a case may write; returns the digest of all that is there."""
    (folder / "outside").mkdir(parents=True)
    (folder / "outside" / "victim.txt").write_text("mine")
    return _digest(folder)


def _digest(folder: Path) -> str:
    found = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if "case" not in path.relative_to(folder).parts[:1] and path.name != "said":
            found.update(str(path.relative_to(folder)).encode())
            found.update(path.read_bytes() if path.is_file() else b"")
    return found.hexdigest()


def _fork(case: Case, base: Path, folder: Path) -> int:
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid:
        return pid
    status = TRACEBACK
    try:
        status = _child(case, base, folder)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _child(case: Case, base: Path, folder: Path) -> int:
    from polarguide.cli.app import run

    said = os.open(folder / "said", os.O_CREAT | os.O_WRONLY)
    os.dup2(said, 1)
    os.dup2(said, 2)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    shutil.copytree(base, folder / "case", symlinks=True)
    for record in (folder / "case").glob(
        "*/run.json"
    ):  # else the base's own scene would be read, which is whole
        record.write_text(record.read_text().replace(f'"{base}/', f'"{folder / "case"}/'))
    os.chdir(folder / "case")
    arguments = case.make(folder / "case", random.Random(f"{case.name} {case.seed}"))
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS + 5))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        status = run(arguments)
    except SystemExit as ended:  # of the parser of the command line
        status = ended.code if isinstance(ended.code, int) else int(bool(ended.code))
    if case.check is not None:
        case.check(folder / "case")
    return status


def _outcome(case: Case, folder: Path, status: int, usage: object, canary: str, late: bool) -> Outcome:
    said = (folder / "said").read_text(errors="replace") if (folder / "said").exists() else ""
    code = os.waitstatus_to_exitcode(status)
    mebibytes = usage.ru_maxrss / 1024  # type: ignore[attr-defined]
    seconds = usage.ru_utime + usage.ru_stime  # type: ignore[attr-defined]
    if _digest(folder) != canary:
        kind = "outside"
    elif late or code in (-signal.SIGXCPU, -signal.SIGKILL):
        kind = "hang"
    elif code < 0:
        kind = "crash"
    elif code == TRACEBACK or "Traceback (most recent call last)" in said:
        kind = "traceback"
    elif mebibytes > LARGEST_MIB:
        kind = "large"
    elif code == 2:
        kind = "error" if ERROR.search(said) or USAGE in said else "unclear"
    elif code:
        kind = "unclear"
    elif "warning: " in said:
        kind = "warning"
    else:
        kind = "accepted" if case.accepted else "silent"
    if kind in ("error", "warning", "accepted") and not re.search(case.says, said, re.DOTALL):
        kind = "unclear"
    return Outcome(case, kind, said[-1500:], seconds, mebibytes)
