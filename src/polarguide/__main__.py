"""``polarguide`` and ``python -m polarguide``."""

from __future__ import annotations

import os
import signal
import sys

# Threads that wait should sleep: torch's OpenMP workers must not fight the kernels' threads for cores by spinning.
# OpenMP reads this when it is loaded, so it has to be said before torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from polarguide.cli.app import run
from polarguide.system import keep_freed_memory, stop_signals


def main() -> None:
    """Entry point of the command line."""
    for name in ("stdout", "stderr"):  # closed by the caller (>&-): what prints would find nothing there
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115, to the end of the process
    # As Ctrl-C does, so that whatever is open is closed.
    for number in stop_signals():
        signal.signal(number, signal.default_int_handler)
    keep_freed_memory()
    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
