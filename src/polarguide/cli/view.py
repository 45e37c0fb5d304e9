"""``polarguide view``."""

from __future__ import annotations

from pathlib import Path

from polarguide.cli.console import RunFolder, opened
from polarguide.core.errors import PolarguideError, require_package
from polarguide.core.options import LOOPBACK, ComputeOptions, VisitorOptions


def view(
    run: RunFolder,
    /,
    *,
    host: str = LOOPBACK[0],
    port: int = 8080,
    beside: Path | None = None,
    visitors: VisitorOptions = VisitorOptions(),
    compute: ComputeOptions = ComputeOptions(),
) -> None:
    """Look at a run in a browser: its layers from any side, beside the photographs. Ctrl-C ends it.

    Args:
        run: Run folder.
        host: Address to listen at. Others can reach it only if you give one of theirs (0.0.0.0: anyone's).
        port: To listen at; the next free one is taken if it is in use.
        beside: Another run of the same scene, such as one without polarization, for the wipe between the two.
    """
    if run.is_file():
        raise PolarguideError(
            run,
            expected="a run folder: what train wrote under --out, with run.json in it",
            found=f"a file ({run.suffix or 'without a suffix'})",
            remedy=f"polarguide view {run.parent} if it lies in one. Files of Gaussians alone, without the light that "
            "they reflect, are for other viewers (SuperSplat).",
        )
    require_package("viser", "the viewer")
    trained, reporter = opened(run, compute)
    other = None if beside is None else opened(beside, compute)[0]
    trained.view(host=host, port=port, visitors=visitors, reporter=reporter, beside=other)
