"""What ``inspect`` may be asked for. Nothing here imports torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from polarguide.core.options import Transfer

Normals = Literal["auto", "points", "train"]


@dataclass(frozen=True)
class InspectSettings:
    """How a capture is inspected.

    Attributes:
        normals: points uses points seen in several views alone; train also trains for normals, without polarization;
            auto does so where the points do not decide.
        steps: Optimizer steps of that training. It is kept in the folder of the inspection and goes on where it
            stopped.
        refractive_index: Of the surfaces; without it as scene.json says, else 1.5.
        downscale: Average the pictures over boxes of this many pixels first; 0 until they are at most 640 pixels wide.
        transfer: How the files encode radiance.
        calibration: File of polarguide calibrate: inspect the scene as that of its sensor corrects it.
    """

    normals: Normals = "auto"
    steps: Annotated[int, Meta(ge=1)] = 600
    refractive_index: Annotated[float, Meta(gt=1, lt=4)] | None = None
    downscale: Annotated[int, Meta(ge=0)] = 0
    transfer: Transfer = "linear"
    calibration: Path | None = None
