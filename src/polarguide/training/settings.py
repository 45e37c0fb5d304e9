"""What decides a training's result, and what each of its steps reports. Nothing here imports torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from polarguide.errors import PolarguideError
from polarguide.options import EXPOSURES, Exposures, check_choice, check_count

MOST_VIEWS, MOST_SEEDS = 4096, 2**63 - 1
Background = Literal["auto", "scene", "black", "masked"]
Materials = Literal["auto", "dielectric"]
MATERIALS: tuple[Materials, ...] = ("auto", "dielectric")
BACKGROUNDS: tuple[Background, ...] = ("auto", "scene", "black", "masked")

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class TrainSettings:
    """What decides a training's result, beside the scene and the recipe.

    A step's gradient is the mean over its views; learning rates are those of the recipe times the square root of their
    number B, and Adam's decays are taken to the power of B, so that its memory spans as many views (Zhao et al. 2024,
    "On scaling up 3D Gaussian splatting training").

    Attributes:
        steps: Optimizer steps in all. 3,000 show the scene, 5,000 and more settle it; 0 takes 5,000, 60 visits to each
            view where that is more, and twice as many for pictures over a megapixel (or what the run to resume took).
        seed: Seed of every random draw.
        refractive_index: Of the surfaces: 1.5 for glass, plastic and glaze, 1.33 for water; 0 takes what scene.json
            says, and 1.5 where it does not (or what the run to resume took).
        views_per_step: Views whose mean gradient makes a step; 0 takes one for each process (or what the run to resume
            took). Learning rates grow with its square root; steps are steps, so more views are looked at.
        background: What is behind the subject: a scene to reconstruct, too; black, that is nothing; masked makes it
            nothing (the subject in masks/ alone is read); auto takes black where the edges of the pictures are.
        gaussians: Most Gaussians that there may be, each of which takes 4 kB; 0 takes one for 20 pixels of all training
            views, 400,000 at most (or what the run to resume took).
        exposures: Which pictures of a scene with four to train on, as if no others had been taken: captured, all that
            there are. See compare.
        begin_again: Where angles are unknown, seek them in a short training on small pictures, and begin again with
            them; otherwise they are fitted in the course of the training itself.
        materials: What surfaces are made of: auto looks for metals, and heeds materials/ where the scene has it;
            dielectric takes it that there is no metal.
    """

    steps: int = 5000
    seed: int = 0
    refractive_index: float = 1.5
    views_per_step: int = 1
    background: Background = "auto"
    gaussians: int = 0
    exposures: Exposures = "captured"
    begin_again: bool = True
    materials: Materials = "auto"

    def __post_init__(self) -> None:
        check_count("steps", self.steps, 0)
        check_count("gaussians", self.gaussians, 0)
        check_count("views_per_step", self.views_per_step, 0, MOST_VIEWS)
        check_count("seed", self.seed, 0, MOST_SEEDS)
        check_choice("background", self.background, BACKGROUNDS)
        check_choice("exposures", self.exposures, EXPOSURES)
        check_choice("materials", self.materials, MATERIALS)
        if self.refractive_index and not 1.0 < self.refractive_index < 4.0:
            raise PolarguideError(
                "refractive_index",
                expected="between 1 and 4, or 0 for that of the scene",
                found=str(self.refractive_index),
                remedy="1.5 suits most.",
            )


@dataclass(frozen=True, eq=False)
class StepReport:
    """What a step reports to the progress display.

    Attributes:
        step, stage, gaussians: plain values; None of what has no Gaussians. done: steps so far, with those before the
            training began again.
        measured: [3] photometric loss, PSNR and whole loss of this rank's views (their mean), on the device. Reading
            them waits for the device.
    """

    step: int
    stage: str
    gaussians: int | None
    measured: Tensor
    done: int

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
