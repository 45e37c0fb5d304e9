"""The console: what is printed where, and warnings as lines of it."""

from __future__ import annotations

import contextlib
import importlib
import warnings
from collections.abc import Iterator
from typing import Any

from rich.console import Console

from polarguide.errors import PolarguideWarning
from polarguide.printable import printable
from polarguide.system import process_rank

# Of several processes of one training, the first alone talks.
console = Console(highlight=False, soft_wrap=True, quiet=process_rank() > 0)


def say(text: object, *, lines: bool = False, to: Console = console) -> None:
    """Print a text, of several ``lines``: names in it are neither markup, nor anything that a terminal obeys."""
    to.print(printable(str(text), lines=lines), markup=False)


def warn(text: object) -> None:
    """Print a warning; names in it are shown as they are, but for control characters."""
    console.print("[yellow]warning:[/] ", end="")
    say(text)


def size_text(size: int) -> str:
    """The size of a file in bytes, for people."""
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{max(1, round(size / 1e3))} kB"


@contextlib.contextmanager
def warnings_printed() -> Iterator[None]:
    """Inside, the library's warnings are lines on the console."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", PolarguideWarning)
        others = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if issubclass(category, PolarguideWarning):
                warn(message)
            else:
                others(message, category, *where, **more)

        warnings.showwarning = show
        yield


def use_threads(threads: int) -> None:
    """Let our kernels, torch and OpenCV use this many threads; 0 leaves their defaults."""
    if threads:
        importlib.import_module("polarguide.raster").use_threads(threads)
        importlib.import_module("cv2").setNumThreads(threads)
