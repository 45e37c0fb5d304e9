"""``polarguide view``."""

from __future__ import annotations

from polarguide.cli.runs import RunFolder, opened
from polarguide.options import LOOPBACK, ComputeOptions


def view(
    run: RunFolder,
    /,
    *,
    host: str = LOOPBACK[0],
    port: int = 8080,
    compute: ComputeOptions = ComputeOptions(),
) -> None:
    """Look at a run in a browser: its layers from any side, beside the photographs. Ctrl-C ends it.

    Args:
        run: Run folder.
        host: Address to listen at. Others can reach it only if you give one of theirs (0.0.0.0: anyone's).
        port: To listen at; the next free one is taken if it is in use.
    """
    trained, reporter = opened(run, compute)
    trained.view(host=host, port=port, reporter=reporter)
