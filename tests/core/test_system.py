"""Signals, locks, memory and variables; and how it is done where the system has none of it."""

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from faults import Fault

from polarguide.core import system
from polarguide.core.errors import PolarguideError
from polarguide.core.system import (
    MemoryBound,
    StopSignals,
    check_variables,
    free_memory,
    keep_freed_memory,
    only_writer,
    peak_memory_mib,
    process_is_alive,
    sigterm_kept,
    stop_signals,
)


def lock(path: Path) -> contextlib.AbstractContextManager[None]:
    return only_writer(path, expected="a folder of its own", found="another writer")


@pytest.mark.parametrize("name", ["lock", "."])
def test_a_lock_is_held_by_one(tmp_path: Path, name: str) -> None:
    def hold() -> None:
        with lock(tmp_path / name):
            pass

    with lock(tmp_path / name):
        Fault(str(tmp_path), "of its own", "another writer").raised_by(hold)
    hold()


def test_without_posix_nothing_is_locked_or_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(system, "_posix", lambda module: None)
    with lock(tmp_path / "lock"), lock(tmp_path / "lock"), lock(tmp_path), lock(tmp_path):
        pass
    assert peak_memory_mib() is None


def test_peak_memory_is_that_of_a_python_process() -> None:
    peak = peak_memory_mib()
    assert 10 < peak < 1e6


def test_a_process_is_alive_until_it_ends() -> None:
    assert process_is_alive(os.getpid())
    process = subprocess.Popen([sys.executable, "-c", ""])
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    assert not process_is_alive(process.pid), "a zombie"
    process.wait()
    assert not process_is_alive(process.pid)


@pytest.fixture
def terminal() -> Iterator[None]:
    """Not ignoring that a terminal goes away, as what nohup starts does."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_interrupts_before_work_and_asks_it_to_stop_after(
    number: signal.Signals, terminal: None
) -> None:
    before = signal.getsignal(number)
    with StopSignals() as should_stop:
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
        assert not should_stop()
        os.kill(os.getpid(), number)
        assert should_stop()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(number) is before


def test_a_terminal_that_goes_away_is_passed_over_where_it_is_ignored(terminal: None) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        assert signal.SIGHUP not in stop_signals()
        with StopSignals() as should_stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not should_stop()
    finally:
        signal.signal(signal.SIGHUP, before)
    assert signal.SIGHUP in stop_signals()


def test_a_library_that_takes_sigterm_does_not_keep_it() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with sigterm_kept():
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    assert signal.getsignal(signal.SIGTERM) is before


FAULTS = """
import contextlib, resource, sys
with contextlib.suppress(SystemExit):
    {first}
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    bytearray(b"x") * (64 << 20)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
faults()
print(faults(), (64 << 20) // resource.getpagesize())
"""
"""How often the system has to bring a page to an array as large as one that was freed, and that array's pages."""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "gnu_get_libc_version"), reason="not a system with glibc")
@pytest.mark.parametrize(
    ("first", "kept"),
    [
        ("import polarguide.api.runs", False),
        ("from polarguide.__main__ import main; sys.argv[1:] = ['--version']; main()", True),
        ("from polarguide_bench.worker import main; main()", True),
    ],
)
def test_freed_memory_is_kept_by_the_command_and_the_children_of_a_comparison_alone(
    first: str, kept: bool
) -> None:
    code = FAULTS.format(first=first)
    done = subprocess.run(
        [sys.executable, "-c", code], stdin=subprocess.DEVNULL, capture_output=True, text=True, check=True
    )
    faults, pages = (int(number) for number in done.stdout.split()[-2:])
    assert (faults < pages / 10) == kept, done.stdout


HOLES = """
import numpy as np
from polarguide.core.system import MemoryBound, keep_freed_memory, resident_memory
keep_freed_memory()
blocks = [np.ones(1 << 20, dtype=np.uint8) for _ in range(300)]
blocks = [blocks[-1]]
before = resident_memory()
bound = MemoryBound(200 << 20)
bound.keep()
print(before, resident_memory())
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "gnu_get_libc_version"), reason="not a system with glibc")
def test_memory_that_lies_free_between_what_is_used_is_given_back() -> None:
    done = subprocess.run(
        [sys.executable, "-c", HOLES], stdin=subprocess.DEVNULL, capture_output=True, text=True, check=True
    )
    before, after = (int(number) for number in done.stdout.split())
    assert before > 300 << 20
    assert after < before - (250 << 20)


def test_memory_is_given_back_near_the_limit_and_no_more_often_than_it_helps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    returned: list[int] = []
    held = 0
    monkeypatch.setattr(system, "resident_memory", lambda: held)
    monkeypatch.setattr(system, "return_freed_memory", lambda: returned.append(held))
    bound = MemoryBound(1000)
    once, again = [700, 700, 850], [905, 300, 300]
    for held in (500, 899, 901, *once, 899, 910, *again, 905, 300, 950, 951, 200, 200, 200, 899, 905):  # noqa: B007
        bound.keep()
    # 901 is too much, after which steps take up to 850: 910 is, too. After that one of them needs 905, so that they may
    # hold a twentieth more, and 951 is too much. After that they need 200, and 905 is.
    assert returned == [901, 910, 951, 905]


def test_nothing_lets_a_process_keep_more_than_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    returned: list[int] = []
    held = 0
    monkeypatch.setattr(system, "resident_memory", lambda: held)
    monkeypatch.setattr(system, "return_freed_memory", lambda: returned.append(held))
    bound = MemoryBound(1000)
    for held in (905, 990, 980, 990, 1001):  # noqa: B007, a twentieth more than 990 were too much
        bound.keep()
    assert returned == [905, 1001]
    held = 500
    bound.clear()
    assert returned == [905, 1001]
    held = 501
    bound.clear()
    assert returned == [905, 1001, 501]
    assert list(bound.between("ab")) == ["a", "b"]
    assert returned == [905, 1001, *[501] * 4]
    held = 1 << 60
    MemoryBound().clear()
    MemoryBound().keep()
    assert len(returned) == 6


@pytest.mark.parametrize("libc", [OSError(), TypeError(), object()], ids=["none", "Windows", "another"])
def test_elsewhere_the_allocator_is_left_alone(libc: object, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []

    def load(name: None) -> object:
        asked.append(libc)
        if isinstance(libc, Exception):
            raise libc
        return libc

    monkeypatch.setattr(system.ctypes, "CDLL", load)
    keep_freed_memory()
    assert asked == [libc]  # and of what came nothing more: it has no such function


def test_memory_that_holds_files_is_free(tmp_path: Path) -> None:
    """As of a container in which much has been read."""
    (tmp_path / "memory.max").write_text("4000000\n")
    (tmp_path / "memory.current").write_text("3900000\n")
    (tmp_path / "memory.stat").write_text("anon 100000\ninactive_file 3000000\nactive_file 500000\n")
    assert free_memory(tmp_path) == 3_600_000
    (tmp_path / "memory.max").write_text("max\n")
    assert free_memory(tmp_path) > 4_000_000


@pytest.mark.parametrize(
    ("name", "value", "refused"),
    [
        ("POLARGUIDE_THREADS", "1000000000", True),
        ("POLARGUIDE_THREADS", "1025", True),
        ("POLARGUIDE_THREADS", "1024", False),
        ("POLARGUIDE_THREADS", "many", False),  # passed over
        ("OPENCV_IO_MAX_IMAGE_PIXELS", "many", True),
        ("OPENCV_IO_MAX_IMAGE_PIXELS", "1099511627776", False),
        ("OPENCV_IO_MAX_IMAGE_PIXELS", "64MB", False),
        ("OPENCV_IO_MAX_IMAGE_WIDTH", "-1", True),
        ("OPENCV_IO_MAX_IMAGE_HEIGHT", "1e6", True),
        ("OPENCV_IMGCODECS_WEBP_MAX_FILE_SIZE", "64 MB", True),
        ("OPENCV_LOG_LEVEL", "SILENT", False),
    ],
)
def test_what_would_end_the_process_is_refused(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str, refused: bool
) -> None:
    monkeypatch.setenv(name, value)
    try:
        check_variables()
        found = None
    except PolarguideError as error:
        found = error.where
    assert found == (f"the variable {name}" if refused else None)
