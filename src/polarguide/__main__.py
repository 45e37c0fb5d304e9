"""``polarguide`` and ``python -m polarguide``."""

from __future__ import annotations

import os
import signal
import sys

# Threads that wait should sleep: torch's OpenMP workers must not fight the kernels' threads for cores by spinning.
# OpenMP reads this when it is loaded, so it has to be set before torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

try:
    from polarguide.cli.app import run
    from polarguide.core.system import interrupt, keep_freed_memory, stop_signals
except KeyboardInterrupt:  # before there is anything to stop
    sys.exit(130)


def main() -> None:
    """Entry point of the command line."""
    for name in ("stdout", "stderr"):  # closed by the caller (>&-): what prints would find nothing there
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115, to the end of the process
    # As Ctrl-C does, so that whatever is open is closed.
    for number in stop_signals():
        signal.signal(number, interrupt)
    if signal.getsignal(signal.SIGINT) == signal.default_int_handler:  # a shell may let it be ignored
        signal.signal(signal.SIGINT, interrupt)
    keep_freed_memory()
    try:
        status = run(sys.argv[1:])
    except KeyboardInterrupt:  # a second one, while the message about the first was printed
        status = 130
    if status == 130:
        for number in (signal.SIGINT, *stop_signals()):  # nothing is left to stop
            signal.signal(number, signal.SIG_IGN)
    sys.exit(status)


if __name__ == "__main__":
    main()
