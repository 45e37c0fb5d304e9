"""Settings of a training, and the report of a step. This module does not import torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import tyro

from polarguide.core.errors import PolarguideError
from polarguide.core.options import EXPOSURES, MOST, Exposures, check_choice, check_count

MOST_SEEDS = 2**63 - 1
"""Largest seed."""
STEPS = 5000
"""Lower bound of the default number of steps of a training of Gaussians.

All runs of a comparison have this number of steps.
"""
Background = Literal["auto", "scene", "black", "masked"]
Materials = Literal["auto", "dielectric"]
MATERIALS: tuple[Materials, ...] = get_args(Materials)
BACKGROUNDS: tuple[Background, ...] = get_args(Background)

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class TrainSettings:
    """Settings that determine the result of a training, together with the scene and the recipe.

    None means not specified: the value is that of the run to resume or, in a new run, the one named below. run.json
    records the value.

    Attributes:
        steps: Number of optimizer steps. 3,000 show the scene, 5,000 and more settle it. None: 5,000 or, if larger, 60
            visits to each view; twice as many for pictures over a megapixel; the number of the recipe for a field.
        seed: Seed of every random draw.
        refractive_index: Refractive index of the surfaces: 1.5 for glass, plastic and glaze, 1.33 for water. None: the
            value in scene.json, or 1.5.
        background: Background of the subject. scene: surroundings, which are reconstructed. black: no background, the
            pictures are black there. masked: no background, pixels outside masks/ are set to black. auto: black if the
            edges of the pictures are black, else scene.
        gaussians: Largest number of Gaussians, each of which takes 4 kB. None: one for 20 pixels of all training views,
            at most 400,000.
        exposures: Pictures to train on in a scene with four per view, as if no others had been taken: captured, all
            pictures. See compare.
        begin_again: Find unknown angles in a short training on small pictures, and begin again with them; otherwise
            they are fitted during the training itself.
        materials: Materials of the surfaces: auto detects metals, and reads the labels in materials/ if there are any;
            dielectric assumes that there is no metal.
    """

    steps: int | None = None
    seed: int = 0
    refractive_index: float | None = None
    background: Background = "auto"
    gaussians: int | None = None
    exposures: Exposures = "captured"
    begin_again: Annotated[bool, tyro.conf.Fixed, tyro.conf.Suppress] = True
    materials: Materials = "auto"

    def __post_init__(self) -> None:
        _check_ranges(asdict(self), least_gaussians=1)

    def specified(self) -> dict[str, Any]:
        """Return the specified settings by name."""
        values = {name: value for name, value in asdict(self).items() if value is not None}
        if self.background == "auto":
            del values["background"]
        return values


@dataclass(frozen=True, kw_only=True)
class ResolvedSettings:
    """Complete settings of a training, as ``run.json`` records them.

    ``runs.folder.resolve`` creates them from ``TrainSettings``, where the fields are explained. ``gaussians`` is 0 for
    a method without Gaussians, such as a signed-distance field.
    """

    steps: int
    seed: int = 0
    refractive_index: float
    views_per_step: int = 1
    """Earlier versions could train on several views per step. Such a run opens, but does not resume."""
    background: Background = "auto"
    gaussians: int = 0
    exposures: Exposures = "captured"
    begin_again: bool = True
    materials: Materials = "auto"

    def __post_init__(self) -> None:
        _check_ranges(asdict(self), least_gaussians=0)

    def fit(self, settings: TrainSettings) -> bool:
        """Return True if all specified settings have the same values."""
        return settings.specified().items() <= asdict(self).items()


def _check_ranges(values: Mapping[str, Any], *, least_gaussians: int) -> None:
    """Check that settings are in range, by name. None means that a setting is not specified.

    Raises:
        PolarguideError: a value is out of range.
    """
    for name, least, most in (
        ("steps", 1, MOST),
        ("gaussians", least_gaussians, MOST),
        ("seed", 0, MOST_SEEDS),
    ):
        if values[name] is not None:
            check_count(name, values[name], least, most)
    check_choice("background", values["background"], BACKGROUNDS)
    check_choice("exposures", values["exposures"], EXPOSURES)
    check_choice("materials", values["materials"], MATERIALS)
    index = values["refractive_index"]
    if index is not None and not 1.0 < index < 4.0:
        raise PolarguideError(
            "refractive_index",
            expected="between 1 and 4",
            found=f"{index:g}",
            remedy="Use 1.5 for most surfaces; without it, the value in scene.json is used.",
        )


@dataclass(frozen=True, eq=False)
class StepReport:
    """Report of a training step, which callbacks receive after the step.

    Attributes:
        step: number of the step, 0-based.
        stage: name of the stage.
        gaussians: number of Gaussians. None for a method without Gaussians.
        measured: [3] photometric loss, PSNR and total loss. The tensor is on the device, so that reading its values
            waits for the device.
        done: number of all finished steps. It includes the steps of earlier schedules, such as a search for angles.
    """

    step: int
    stage: str
    gaussians: int | None
    measured: Tensor
    done: int
