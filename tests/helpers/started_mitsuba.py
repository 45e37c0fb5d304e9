"""Mitsuba for tests that render."""

import pytest

from polarguide_synth.settings import missing_llvm, start_mitsuba


def started_mitsuba() -> None:
    """Start Mitsuba with one thread, or skip the test."""
    pytest.importorskip("mitsuba", reason="no Mitsuba -> pip install '.[synth]'")
    if missing_llvm():
        pytest.skip("no LLVM for Mitsuba -> apt-get install libllvm19")
    start_mitsuba(threads=1)
