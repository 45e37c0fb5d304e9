"""Entry point of ``polarguide`` and ``python -m polarguide``."""

from __future__ import annotations

import os
import signal
import sys

# Waiting threads must sleep: torch's OpenMP workers would otherwise spin and block the kernels' threads.
# OpenMP reads this variable when it is loaded, so it is set before torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

try:
    from polarguide.cli.app import run
    from polarguide.core.system import interrupt, keep_freed_memory, stop_signals
except KeyboardInterrupt:  # nothing has started yet
    sys.exit(130)


def main() -> None:
    """Run the command line and exit with its status."""
    for name in ("stdout", "stderr"):  # the caller closed the stream (>&-), so that print would fail
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115, to the end of the process
    # Signals act like Ctrl-C, so that open resources are closed.
    for number in stop_signals():
        signal.signal(number, interrupt)
    if signal.getsignal(signal.SIGINT) == signal.default_int_handler:  # a shell may ignore it
        signal.signal(signal.SIGINT, interrupt)
    keep_freed_memory()
    try:
        status = run(sys.argv[1:])
    except KeyboardInterrupt:  # a second signal during the message about the first
        status = 130
    if status == 130:
        for number in (signal.SIGINT, *stop_signals()):  # nothing is left to stop
            signal.signal(number, signal.SIG_IGN)
    sys.exit(status)


if __name__ == "__main__":
    main()
