"""What is measured, and how a folder is watched. Nothing here imports torch or OpenCV."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from polarguide.core.options import check_finite


@dataclass(frozen=True)
class MeasureOptions:
    """What is measured, and what it has to be.

    Attributes:
        roi: Region x,y,width,height in pixels of the maps, or the corners of a polygon, x,y;x,y;x,y (in quotes), each
            also as name=...; repeat it for several. Without any, the whole picture is one.
        limits: JSON file with a bound per field; shots beyond make the exit status 3 and are drawn.
        reference: A golden part from the same camera at the same place: difference maps and their figures.
        threshold: DoLP over which pixels count in dolp_share.
        overwrite: Begin a new table where the folder has one that was measured with other options.
    """

    roi: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    limits: Path | None = None
    reference: Path | None = None
    threshold: float = 0.05
    overwrite: bool = False

    def __post_init__(self) -> None:
        check_finite("threshold", self.threshold, 0.0, 1.0)


@dataclass(frozen=True)
class WatchOptions:
    """How a folder is watched.

    Attributes:
        watch: Folder to work on as files come, until Ctrl-C; each once, also after a restart with the same --out.
        settle: Seconds for which a file must not have changed.
        patience: Seconds without a change after which a file that is still not complete counts as unread.
        idle: Stop after so many seconds in which nothing came; 0 waits for ever.
    """

    watch: Path | None = None
    settle: float = 1.0
    patience: float = 60.0
    idle: float = 0.0

    def __post_init__(self) -> None:
        check_finite("settle", self.settle, 0.0, 3600.0)
        check_finite("patience", self.patience, 0.0, 1e6)
        check_finite("idle", self.idle, 0.0, 1e9)
