"""What commands ask for: how a scene is read, what to compute on. Nothing here imports torch.

The command line reads names, types, defaults and texts from these classes.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from polarguide.errors import PolarguideError

DeviceName = Literal["auto", "cpu", "cuda"]
Transfer = Literal["linear", "srgb"]
ExportFormat = Literal["ply", "spz", "sog", "mesh", "points", "environment", "cameras"]
PathLike = str | os.PathLike[str]
LOOPBACK = ("127.0.0.1", "localhost", "::1")


def check_count(name: str, value: int, minimum: int = 1) -> None:
    """Check an option's value.

    Raises:
        PolarguideError: it is less than ``minimum``.
    """
    if value < minimum:
        raise PolarguideError(
            name, expected=f"{minimum} or more", found=str(value), remedy="Give a larger number."
        )


def check_range(name: str, value: int, least: int, most: int) -> None:
    """Check an option's value.

    Raises:
        PolarguideError: it is less than ``least`` or more than ``most``.
    """
    if not least <= value <= most:
        raise PolarguideError(
            name, expected=f"{least} to {most}", found=str(value), remedy="Choose such a number."
        )


def check_choice(name: str, value: str, choices: Iterable[str]) -> None:
    """Check an option's value.

    Raises:
        PolarguideError: it is none of the choices.
    """
    known = list(choices)
    if value not in known:
        expected = "one of " + ", ".join(known)
        raise PolarguideError(name, expected=expected, found=value, remedy="Correct the name.")


@dataclass(frozen=True)
class SceneOptions:
    """How a scene folder is read.

    Attributes:
        downscale: Average the pictures over boxes of this many pixels first.
        transfer: How the files encode radiance. Polarization needs linear; srgb undoes the display curve of JPEGs.
    """

    downscale: int = 1
    transfer: Transfer = "linear"

    def __post_init__(self) -> None:
        check_count("downscale", self.downscale)


@dataclass(frozen=True)
class ThreadOptions:
    """How much of the machine to use.

    Attributes:
        threads: Threads to use; 0 takes all cores.
    """

    threads: int = 0

    def __post_init__(self) -> None:
        check_count("threads", self.threads, 0)


@dataclass(frozen=True)
class ComputeOptions(ThreadOptions):
    """What to compute on.

    Attributes:
        device: What to compute on; auto takes the GPU where there is one and gsplat is installed.
    """

    device: DeviceName = "auto"


@dataclass(frozen=True)
class SessionOptions(ComputeOptions):
    """What a training's result does not depend on.

    Attributes:
        checkpoint_every: Steps between two checkpoints: a kill loses at most as many.
        viewer: Look on in a browser while it trains (afterwards: polarguide view).
        viewer_host: Address to listen at. Others can reach it only if you give one of theirs (0.0.0.0: anyone's).
        viewer_port: To listen at; the next free one is taken if it is in use.
    """

    checkpoint_every: int = 500
    viewer: bool = False
    viewer_host: str = LOOPBACK[0]
    viewer_port: int = 8080

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("checkpoint_every", self.checkpoint_every)
