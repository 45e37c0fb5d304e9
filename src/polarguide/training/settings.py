"""What the user chooses about a training, and what each of its steps reports."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class TrainSettings:
    """What the user chooses about a training.

    Attributes:
        steps: total number of optimizer steps.
        seed: of every random draw.
        refractive_index: of all surfaces.
        views_per_step: B. A step's gradient is the mean over B views; learning rates are those of the recipe times the
            square root of B, and Adam's decays are taken to the power of B, so that its memory spans as many views
            (Zhao et al. 2024, "On scaling up 3D Gaussian splatting training").
    """

    steps: int
    seed: int
    refractive_index: float = 1.5
    views_per_step: int = 1


@dataclass(frozen=True, eq=False)
class StepReport:
    """What a step reports to the progress display.

    Attributes:
        step, stage, gaussians: plain values.
        measured: [3] photometric loss, PSNR and whole loss of this rank's views (their mean), on the device. Reading
            them waits for the device.
    """

    step: int
    stage: str
    gaussians: int
    measured: Tensor

    @property
    def loss(self) -> float:
        """The photometric loss."""
        return float(self.measured[0])

    @property
    def psnr(self) -> float:
        """In decibels."""
        return float(self.measured[1])

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, StepReport):
            return NotImplemented
        plain = [(r.step, r.stage, r.gaussians, r.measured.tolist()) for r in (self, other)]
        return plain[0] == plain[1]
