"""How many rows COLMAP has written into its database, while it writes."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
from pathlib import Path
from types import TracebackType

_SCRIPT = """
import pathlib, sqlite3, sys, time
link = pathlib.Path(sys.argv[1]).absolute().as_uri() + "?mode=ro"
while True:
    try:
        database = sqlite3.connect(link, uri=True, timeout=0.1)
        count = database.execute("SELECT COUNT(*) FROM " + sys.argv[2]).fetchone()[0]
        database.close()
        print(count, flush=True)
    except sqlite3.Error:
        print(0, flush=True)
    time.sleep(1)
"""


class RowCounter:
    """Counts the rows of a table from a process of its own, for as long as it is entered.

    COLMAP brings its own copy of SQLite. Two copies in one process undo each other's file locks (those of POSIX
    belong to processes), and the database is destroyed: it must never be opened, nor even closed, from here.
    """

    def __init__(self, database: Path, table: str) -> None:
        self.rows = 0
        self._command = [sys.executable, "-I", "-S", "-c", _SCRIPT, str(database), table]
        self._process: subprocess.Popen[str] | None = None
        self._listener: threading.Thread | None = None

    def __enter__(self) -> RowCounter:
        with contextlib.suppress(OSError):  # without a second process there is no progress, but all else
            self._process = subprocess.Popen(
                self._command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
            )
            self._listener = threading.Thread(target=self._listen, daemon=True)
            self._listener.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process is None:
            return
        self._process.kill()
        self._process.wait()
        if self._listener is not None:
            self._listener.join()
        if self._process.stdout is not None:
            self._process.stdout.close()

    def _listen(self) -> None:
        assert self._process is not None
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.rows = max(self.rows, int(line))
