"""Choose a Mitsuba variant, with a note if no fast one is available."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from polarguide.errors import optional_import

Color = Literal["rgb", "spectral"]
OLDEST_LLVM = 16
"""Older ones crash on processors that are newer than they are."""
SLOW_PATHS_PER_SECOND, FAST_PATHS_PER_SECOND = 800.0, 200_000.0
"""Of the scalar variant, which has no threads, and of each thread of a compiled one: rough figures, of the presets."""
LONG_SECONDS = 3600.0
"""Longer than anybody who typed a command waits beside it: then it should be meant."""


@dataclass(frozen=True)
class Variant:
    """A variant of Mitsuba that has been made current.

    Attributes:
        name: Mitsuba's name.
        color: "rgb" renders three channels one after the other, each with exact values; "spectral" follows four
            wavelengths a path and converts.
        fast: whether paths are vectorized (LLVM) instead of scalar.
        paths_per_second: a rough figure for this machine.
        note: the reason for a slow variant; else empty.
    """

    name: str
    color: Color
    fast: bool
    paths_per_second: float
    note: str = ""

    @property
    def channels(self) -> int:
        """Renderings per picture."""
        return 3 if self.color == "rgb" else 1


def choose_variant(color: Color = "rgb", *, threads: int = 0) -> Variant:
    """Select a polarized variant: a fast one if the LLVM library can be loaded, else the scalar one.

    Args:
        color: how colors are rendered; the scalar variant supports "spectral" only.
        threads: threads to use; 0 takes all cores.

    Raises:
        PolarguideError: Mitsuba is not installed.
    """
    with _silent_stderr():
        mi = optional_import("mitsuba", "synth", extra="synth")
        missing = _missing_llvm()
    if not missing:
        mi.set_variant("llvm_ad_mono_polarized" if color == "rgb" else "llvm_ad_spectral_polarized")
        if threads:
            import drjit as dr

            dr.set_thread_count(threads)
        speed = FAST_PATHS_PER_SECOND * (threads or os.cpu_count() or 1)
        return Variant(mi.variant(), color, True, speed)
    with _silent_stderr():
        mi.set_variant("scalar_spectral_polarized")
    note = (
        f"Mitsuba's fast variants need LLVM {OLDEST_LLVM} or newer as a shared library ({missing}); on Debian "
        "'apt-get install libllvm19', elsewhere set DRJIT_LIBLLVM_PATH. The slow scalar variant is used."
    )
    return Variant(mi.variant(), "spectral", False, SLOW_PATHS_PER_SECOND, note)


@contextlib.contextmanager
def _silent_stderr() -> Iterator[None]:
    """Suppress what a library writes to the error stream past Python while it loads."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _missing_llvm() -> str:
    """Why LLVM cannot be used; empty if it can."""
    import mitsuba as mi

    path = os.environ.get("DRJIT_LIBLLVM_PATH")
    if path and not os.path.exists(path):  # otherwise the library prints messages
        return f"DRJIT_LIBLLVM_PATH names {path}, which does not exist"
    try:
        mi.set_variant("llvm_ad_mono_polarized")
        import drjit as dr

        version = dr.detail.llvm_version()
    except (ImportError, RuntimeError):
        return "none was found"
    if version[0] >= OLDEST_LLVM:
        return ""
    return f"found {'.'.join(str(part) for part in version)}"


def rough_time(seconds: float) -> str:
    """An estimated time in words."""
    hours = seconds / 3600
    return f"about {hours:.0f} hours" if hours >= 2 else f"about {max(2.0, hours * 60):.0f} minutes"
