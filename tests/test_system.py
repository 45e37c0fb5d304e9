"""Signals, locks and what the system tells of processes; and how it is done without where the system has none."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from polarguide import system
from polarguide.system import StopSignals, exclusive_lock, peak_memory_mib, process_is_alive, sigterm_kept


def test_a_lock_is_held_by_one(tmp_path: Path) -> None:
    with exclusive_lock(tmp_path / "lock"), pytest.raises(BlockingIOError), exclusive_lock(tmp_path / "lock"):
        pass
    with exclusive_lock(tmp_path / "lock"):
        pass


def test_without_posix_nothing_is_locked_or_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(system, "_posix", lambda module: None)
    with exclusive_lock(tmp_path / "lock"), exclusive_lock(tmp_path / "lock"):
        pass
    assert peak_memory_mib() is None


def test_peak_memory_is_that_of_a_python_process() -> None:
    peak = peak_memory_mib()
    assert peak is not None
    assert 10 < peak < 1e6


def test_a_process_is_alive_until_it_ends() -> None:
    assert process_is_alive(os.getpid())
    process = subprocess.Popen([sys.executable, "-c", ""])
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    assert not process_is_alive(process.pid), "a zombie"
    process.wait()
    assert not process_is_alive(process.pid)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_interrupts_before_work_and_asks_it_to_stop_after(number: signal.Signals) -> None:
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


def test_a_library_that_takes_sigterm_does_not_keep_it() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with sigterm_kept():
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    assert signal.getsignal(signal.SIGTERM) is before
