"""Runs command lines in forked children of this process, and says how each ended.

A fresh start of the program takes seconds, most of them for its imports; a fork has them already. The parent itself
computes nothing, so that no thread of it is lost in a fork. Nothing waits without a limit.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import hashlib
import importlib
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

from case import Case

CPU_SECONDS = 25
WALL_SECONDS = 120
"""Of a child that waits; a busy machine is no fault of it."""
MOST_HANGS = 3
"""What makes so many cases hang makes all hang: the rest would take hours."""
LARGEST_MIB = 2560
PRINTED = 1 << 20
"""Bytes of a child's output that are looked at."""
TRACEBACK = 70
PR_SET_CHILD_SUBREAPER = 36
ERROR = re.compile(
    r"^error: (?P<where>.+?): expected (?P<expected>.+), found (?P<found>.*?)\. .+\.$",
    re.MULTILINE | re.DOTALL,
)
USAGE = "─"  # the frame that the parser of the command line draws around what it does not understand


@dataclass
class Child:
    """A fork, which leads a process group of its own."""

    pid: int
    said: Path
    began: float
    late: bool = False


@dataclass(frozen=True)
class Ended:
    """How a child ended: exit status (of a signal: negative), the last that it printed, what it used."""

    status: int
    text: str
    late: bool = False
    seconds: float = 0.0
    mebibytes: float = 0.0


def start(act: Callable[[], int | None], said: Path) -> Child:
    """Do something in a child, whose output goes to the file ``said``; its exit status is what ``act`` returns."""
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid:
        with contextlib.suppress(OSError):  # the child has done it, or has ended
            os.setpgid(pid, pid)
        return Child(pid, said, time.monotonic())
    status = TRACEBACK
    try:
        os.setpgid(0, 0)
        printed = os.open(said, os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
        os.dup2(printed, 1)
        os.dup2(printed, 2)
        faulthandler.register(signal.SIGUSR1, file=printed)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        status = act() or 0
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(OSError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)


def ended(child: Child, seconds: float = WALL_SECONDS) -> Ended | None:
    """How a child ended; None while it runs.

    After ``seconds`` it prints where it is, and is killed. What it has started is killed when it has ended.

    Raises:
        TimeoutError: it cannot be killed.
    """
    took = time.monotonic() - child.began
    if took > seconds and not child.late:
        child.late = True
        os.kill(child.pid, signal.SIGUSR1)
        time.sleep(0.2)  # for the traceback
        os.killpg(child.pid, signal.SIGKILL)
    pid, status, usage = os.wait4(child.pid, os.WNOHANG)
    if not pid and took > seconds + 30:
        raise TimeoutError(f"process {child.pid} does not end though it was killed: {_tail(child.said)}")
    if not pid:
        return None
    with contextlib.suppress(OSError):
        os.killpg(child.pid, signal.SIGKILL)
    code, used = os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime
    return Ended(code, _tail(child.said), child.late, used, usage.ru_maxrss / 1024)


def run(act: Callable[[], int | None], said: Path, seconds: float = WALL_SECONDS) -> Ended:
    """Do something in a child, and wait for it."""
    child = start(act, said)
    while (done := ended(child, seconds)) is None:
        time.sleep(0.005)
    return done


def adopt() -> None:
    """Take over the orphans of children, on Linux: programs that a killed command has started, which work on."""
    with contextlib.suppress(AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def _end_orphans(running: Iterable[int]) -> None:
    """Kill what has been taken over."""
    with contextlib.suppress(OSError):
        children = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
        for pid in set(map(int, children)) - set(running):
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)


def _tail(path: Path) -> str:
    try:
        with open(path, "rb") as file:
            file.seek(max(0, path.stat().st_size - PRINTED))
            return file.read().decode(errors="replace")
    except OSError as error:
        return str(error)


@dataclass(frozen=True)
class Outcome:
    """How a case ended.

    ``kind``: "error" (one line that names what is wrong and what to do), "warning", "accepted" (as listed), or a fault:
    "silent", "traceback", "crash", "hang", "large", "outside", "unclear".
    """

    case: Case
    kind: str
    done: Ended

    @property
    def is_fault(self) -> bool:
        """Whether it should not have ended so."""
        return self.kind not in ("error", "warning", "accepted")

    def __str__(self) -> str:
        figures = f"{self.done.seconds:.1f} s {self.done.mebibytes:.0f} MiB"
        return f"{self.kind}: {self.case.name} (seed {self.case.seed}) {figures}\n{self.done.text.strip()[-1500:]}"


def outcomes(cases: Iterable[Case], base: Path, work: Path, at_once: int = 2) -> Iterator[Outcome]:
    """Run cases, some at once; outcomes come in the order in which they end, and no more after ``MOST_HANGS``."""
    running: list[tuple[Case, Path, Child, str]] = []
    waiting, hangs = enumerate(cases), 0
    while True:
        while len(running) < at_once and hangs < MOST_HANGS and (following := next(waiting, None)):
            folder, case = work / f"{following[0]}", following[1]
            canary = _canary(folder)
            running.append((case, folder, start(_act(case, base, folder), folder / "said"), canary))
        if not running:
            return
        for entry in list(running):
            case, folder, child, canary = entry
            done = ended(child)
            if done is not None:
                running.remove(entry)
                _end_orphans(child.pid for _, _, child, _ in running)
                outcome = Outcome(case, _kind(case, done, _digest(folder) == canary), done)
                hangs += outcome.kind == "hang"
                yield outcome
                shutil.rmtree(folder, ignore_errors=True)
        time.sleep(0.005)


def _canary(folder: Path) -> str:
    """A file beside what a case may write; returns the digest of all that is there."""
    (folder / "outside").mkdir(parents=True)
    (folder / "outside" / "victim.txt").write_text("mine")
    return _digest(folder)


def _digest(folder: Path) -> str:
    found = hashlib.sha256()
    for place in sorted(set(folder.iterdir()) - {folder / "case", folder / "said"}):
        for path in (place, *sorted(place.rglob("*"))):
            found.update(str(path.relative_to(folder)).encode(errors="surrogateescape"))
            found.update(path.read_bytes() if path.is_file() else b"")
    return found.hexdigest()


def _act(case: Case, base: Path, folder: Path) -> Callable[[], int]:
    def act() -> int:
        place = folder / "case"
        shutil.copytree(base, place, symlinks=True)
        for record in place.glob("*/run.json"):  # else the base's own scene would be read, which is whole
            record.write_text(record.read_text().replace(f'"{base}/', f'"{place}/'))
        os.chdir(place)
        random.seed(f"{case.name} {case.seed}")
        case.change()
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS + 5))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        try:
            status = importlib.import_module("polarguide.cli.app").run(case.words)
        except SystemExit as ended:  # of the parser of the command line
            status = ended.code if isinstance(ended.code, int) else bool(ended.code)
        if case.check is not None:
            case.check()
        return int(status)

    return act


def _kind(case: Case, done: Ended, inside: bool) -> str:
    """How a case ended; see ``Outcome``."""
    if not inside:
        return "outside"
    if done.late or done.status in (-signal.SIGXCPU, -signal.SIGKILL):
        return "hang"
    if done.status < 0:
        return "crash"
    if done.status == TRACEBACK or "Traceback (most recent call last)" in done.text:
        return "traceback"
    if done.mebibytes > LARGEST_MIB:
        return "large"
    error = ERROR.search(done.text)
    fields = error.groupdict() if error else {}
    patterns = [(getattr(case, name), fields.get(name, "")) for name in ("where", "expected", "found")]
    patterns += [(case.warning and f"warning: .*{case.warning}", done.text), (case.prints, done.text)]
    if done.status not in (0, 2) or not all(re.search(given, text, re.DOTALL) for given, text in patterns):
        return "unclear"
    if done.status == 2:
        return "error" if error or USAGE in done.text else "unclear"
    if "warning: " in done.text:
        return "warning"
    return "accepted" if case.passes else "silent"
