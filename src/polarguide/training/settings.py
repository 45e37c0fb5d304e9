"""Settings that decide a training's result, and the report of a step. Nothing here imports torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from polarguide.core.errors import PolarguideError
from polarguide.core.options import EXPOSURES, MOST, Exposures, check_choice, check_count

MOST_VIEWS = 4096
MOST_SEEDS = 2**63 - 1
STEPS = 5000
"""Steps of a training of Gaussians, at least, and of every run of a comparison."""
Background = Literal["auto", "scene", "black", "masked"]
Materials = Literal["auto", "dielectric"]
MATERIALS: tuple[Materials, ...] = ("auto", "dielectric")
BACKGROUNDS: tuple[Background, ...] = ("auto", "scene", "black", "masked")

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class TrainSettings:
    """Settings that decide a training's result, besides the scene and the recipe.

    None means not specified: the value is that of the run to resume or, in a new run, the one named below. run.json
    records the value.

    A step's gradient is the mean over its views; learning rates are those of the recipe times the square root of their
    number B, and Adam's decays are taken to the power of B, so that its memory spans as many views (Zhao et al. 2024,
    "On scaling up 3D Gaussian splatting training").

    Attributes:
        steps: Optimizer steps in all. 3,000 show the scene, 5,000 and more settle it. None: 5,000, 60 visits to each
            view where that is more, and twice as many for pictures over a megapixel; the recipe's number for a field.
        seed: Seed of every random draw.
        refractive_index: Of the surfaces: 1.5 for glass, plastic and glaze, 1.33 for water. None: that of
            scene.json, and 1.5 where it has none.
        views_per_step: Views whose mean gradient makes a step. Learning rates grow with its square root; steps are
            steps, so more views are looked at. None: one for each process.
        background: What is behind the subject. scene: surroundings, which are reconstructed. black: nothing, the
            pictures are black there. masked: nothing, pixels outside masks/ are set to black. auto: black where the
            edges of the pictures are black, else scene.
        gaussians: Most Gaussians that there may be, each of which takes 4 kB. None: one for 20 pixels of all
            training views, 400,000 at most.
        exposures: Which pictures of a scene with four to train on, as if no others had been taken: captured, all that
            there are. See compare.
        begin_again: Where angles are unknown, find them in a short training on small pictures, and begin again
            with them; otherwise they are fitted during the training itself.
        materials: What surfaces are made of: auto detects metals, and reads the labels in materials/ if there are any;
            dielectric assumes that there is no metal.
    """

    steps: int | None = None
    seed: int = 0
    refractive_index: float | None = None
    views_per_step: int | None = None
    background: Background = "auto"
    gaussians: int | None = None
    exposures: Exposures = "captured"
    begin_again: bool = True
    materials: Materials = "auto"

    _LEAST_GAUSSIANS: ClassVar[int] = 1

    def __post_init__(self) -> None:
        for name, least, most in (
            ("steps", 1, MOST),
            ("gaussians", self._LEAST_GAUSSIANS, MOST),
            ("views_per_step", 1, MOST_VIEWS),
            ("seed", 0, MOST_SEEDS),
        ):
            if getattr(self, name) is not None:
                check_count(name, getattr(self, name), least, most)
        check_choice("background", self.background, BACKGROUNDS)
        check_choice("exposures", self.exposures, EXPOSURES)
        check_choice("materials", self.materials, MATERIALS)
        if self.refractive_index is not None and not 1.0 < self.refractive_index < 4.0:
            raise PolarguideError(
                "refractive_index",
                expected="between 1 and 4",
                found=f"{self.refractive_index:g}",
                remedy="1.5 suits most; without it, that of scene.json is taken.",
            )

    def specified(self) -> dict[str, Any]:
        """The specified settings by name."""
        open_values = (("background", "auto"), *((name, None) for name in vars(self)))
        return {name: value for name, value in vars(self).items() if (name, value) not in open_values}


@dataclass(frozen=True)
class ResolvedSettings(TrainSettings):
    """``TrainSettings`` in which nothing is left open: what a training reads and ``run.json`` records.

    ``runs.folder.resolve`` makes them; ``gaussians`` is 0 of a field, which has none.
    """

    steps: int = field(kw_only=True)
    refractive_index: float = field(kw_only=True)
    views_per_step: int = field(default=1, kw_only=True)
    gaussians: int = field(default=0, kw_only=True)

    _LEAST_GAUSSIANS: ClassVar[int] = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("steps", "refractive_index"):  # a record without them gets the None of the class above
            if getattr(self, name) is None:
                remedy = "Restore the file, or train again into a new folder."
                raise PolarguideError(name, expected="a number", found="nothing", remedy=remedy)

    def fit(self, settings: TrainSettings) -> bool:
        """Whether they agree with the specified settings; open ones agree with any value."""
        return settings.specified().items() <= vars(self).items()


@dataclass(frozen=True, eq=False)
class StepReport:
    """A step's report to the progress display.

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
