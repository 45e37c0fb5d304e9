"""How a capture is presented: color, up, scale and crop box, and whom it is owed to.

``presentation.json`` beside a scene or a run holds it. Whatever shows or exports a run uses it; pictures, training and
scores never do. A run's own file goes before that of its scene, field by field.

The names are those of USD (``metersPerUnit``, ``upAxis``) and of what glTF files say of their asset.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import torch
from msgspec import Meta
from torch import Tensor

from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import write_whole
from polarguide.core.records import read_record, to_json
from polarguide.geometry.scene_frame import SceneFrame

PRESENTATION_FILE = "presentation.json"
REMEDY = "Correct it with polarguide present, or remove the file."
CREDITS = ("title", "author", "license", "provenance")
LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "km": 1e3, "in": 0.0254, "ft": 0.3048}
"""Meters of each unit of length that is understood."""
LEAST_METERS = 1e-9
"""A nanometer."""
MOST_METERS = 1e9
"""Eighty Earths. Single precision of exported files ends beyond both limits."""
WIDEST_CROP = 100.0
STOPS = 8.0
"""Of exposure, to either side: as much as the steps of an 8-bit picture."""

Vector = tuple[float, float, float]
Gain = Annotated[float, Meta(ge=0.02, le=50)]
Factor = Annotated[float, Meta(ge=-50, le=50)]
Text = Annotated[str, Meta(max_length=1000)]


class Crop(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A box about the point that the cameras look at, along their common right, up and back.

    Attributes:
        low, high: corners in shares of the cameras' distance from that point; low is less than high.
        up: [3] what was up when it was made, in the scene's axes; None: as the cameras say. The box keeps its place
            when another axis is chosen.
    """

    low: Vector
    high: Vector
    up: Vector | None = None

    def __post_init__(self) -> None:
        for low, high in zip(self.low, self.high, strict=True):
            require(
                -WIDEST_CROP <= low < high <= WIDEST_CROP,
                "crop",
                expected=f"a low side less than the high one, both within {WIDEST_CROP:g} distances",
                found=f"{low:g} to {high:g}",
                remedy=REMEDY,
            )
        _check_direction("crop.up", self.up)

    def _frame(self, around: SceneFrame) -> SceneFrame:
        return around if self.up is None else _upright(around, self.up)

    def corners(self, around: SceneFrame) -> Tensor:
        """Its eight corners in the world, [8, 3] float64, the last axis fastest, from the cameras' own frame."""
        frame = self._frame(around)
        sides = torch.tensor([self.low, self.high], dtype=torch.float64)
        local = torch.cartesian_prod(*sides.T) * frame.distance
        return frame.center + local @ frame.panorama_axes().T

    def inside(self, means: Tensor, around: SceneFrame) -> Tensor:
        """Which means [N, 3] lie in it, [N] bool; ``around`` is the cameras' own frame."""
        frame = self._frame(around)
        axes, center = (t.to(means) for t in (frame.panorama_axes(), frame.center))
        local = (means - center) @ axes / frame.distance
        low, high = (
            torch.tensor(side, dtype=local.dtype, device=local.device) for side in (self.low, self.high)
        )
        return ((local >= low) & (local <= high)).all(dim=1)


class Chart(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a color chart in a photograph says of the camera under the light of the capture.

    Attributes:
        matrix: [3][3], from the camera's linear RGB (S0 / 2) to linear sRGB (D65), white balance and exposure included.
        delta_e, delta_e_worst: mean and largest CIEDE2000 of the patches, each by the matrix that the others give.
        patches: how many were used. view: the photograph.
    """

    matrix: tuple[tuple[Factor, Factor, Factor], tuple[Factor, Factor, Factor], tuple[Factor, Factor, Factor]]
    delta_e: Annotated[float, Meta(ge=0, le=1000)]
    delta_e_worst: Annotated[float, Meta(ge=0, le=1000)]
    patches: Annotated[int, Meta(ge=1, le=24)]
    view: Text

    def __post_init__(self) -> None:
        require(
            abs(float(torch.tensor(self.matrix, dtype=torch.float64).det())) > 1e-9,
            "matrix",
            expected="a matrix with an inverse",
            found=str(self.matrix),
            remedy=REMEDY,
        )
        darkest = min(sum(row) for row in self.matrix)
        require(
            darkest > 0,
            "matrix",
            expected="rows with positive sums: what is gray to the camera has light in every channel",
            found=f"a sum of {darkest:g}, which makes it black",
            remedy=REMEDY,
        )


class Presentation(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """What ``presentation.json`` holds; each field may be missing.

    Attributes:
        white_balance: factors on linear R, G and B for display, 0.02 to 50; the data stay as they are.
        chart: what a color chart says, in place of a white balance; there cannot be both.
        exposure: stops by which radiance is shown brighter, -8 to 8.
        up_axis: [3] direction in the scene's axes, of any length; without it, up is as the cameras say.
        meters_per_unit: how long one unit of the scene is.
        crop: what is shown and exported of the scene. whole: all of it is, in place of a crop box; there cannot be
            both.
        title: what is shown. author: whom the capture is owed to. license: a name, such as CC-BY-4.0.
        provenance: where, when and with what it was captured, or a number of an inventory.
    """

    white_balance: tuple[Gain, Gain, Gain] | None = None
    chart: Chart | None = None
    exposure: Annotated[float, Meta(ge=-STOPS, le=STOPS)] | None = None
    up_axis: Vector | None = None
    meters_per_unit: Annotated[float, Meta(ge=LEAST_METERS, le=MOST_METERS)] | None = None
    crop: Crop | None = None
    whole: bool = False
    title: Text = ""
    author: Text = ""
    license: Text = ""
    provenance: Text = ""

    def __post_init__(self) -> None:
        _check_direction("up_axis", self.up_axis)
        if self.white_balance is not None and self.chart is not None:
            found = "both"
            raise PolarguideError("white_balance", expected="it, or a chart", found=found, remedy=REMEDY)
        if self.crop is not None and self.whole:
            found = "both"
            raise PolarguideError("crop", expected="a box, or the whole scene", found=found, remedy=REMEDY)
        for name in CREDITS:
            text = getattr(self, name)
            require(
                text.isprintable(), name, expected="one line of text", found=repr(text)[:100], remedy=REMEDY
            )

    @property
    def credit(self) -> str:
        """Author and license in one line; empty where there are none."""
        return ", ".join(text for text in (self.author, self.license) if text)

    @property
    def color(self) -> Tensor | None:
        """From the camera's linear RGB to what is shown, linear sRGB: [3, 3] float32; None: as photographed.

        It holds for radiance: each row mixes the camera's channels, as light adds up. Stokes vectors, DoLP and AoLP are
        ratios within one channel, and stay the camera's.
        """
        if self.white_balance is None and self.chart is None and not self.exposure:
            return None
        matrix = torch.diag(torch.tensor(self.white_balance or (1.0, 1.0, 1.0)))
        if self.chart is not None:
            matrix = torch.tensor(self.chart.matrix)
        return matrix * 2.0 ** (self.exposure or 0.0)

    def over(self, other: Presentation) -> Presentation:
        """This, with another's fields where this one has none; those of ``EITHER`` are one of them."""
        own = _given(self)
        above = _given(other)
        for names in EITHER:
            if not own.keys().isdisjoint(names):
                above = {name: value for name, value in above.items() if name not in names}
        return Presentation(**{**above, **own})

    def upright(self, around: SceneFrame) -> SceneFrame:
        """A frame of cameras with the up axis that was chosen, if one was."""
        return around if self.up_axis is None else _upright(around, self.up_axis)

    def to_record(self) -> dict[str, Any]:
        """As the file holds it, without what is missing."""
        record: dict[str, Any] = msgspec.to_builtins(self)
        return record


EITHER = (("white_balance", "chart"), ("crop", "whole"))
"""Fields of which one takes the place of the other."""


def _given(presentation: Presentation) -> Mapping[str, Any]:
    fields = {name: getattr(presentation, name) for name in presentation.__struct_fields__}
    return {name: value for name, value in fields.items() if value not in (None, "", False)}


def _upright(around: SceneFrame, up: Vector) -> SceneFrame:
    axis = torch.tensor(up, dtype=torch.float64)
    return replace(around, up=axis / axis.norm())


def _check_direction(name: str, vector: Vector | None) -> None:
    if vector is not None and not (all(map(math.isfinite, vector)) and 1e-9 < math.hypot(*vector) < 1e9):
        raise PolarguideError(
            name, expected="a direction, three numbers not all 0", found=str(list(vector)), remedy=REMEDY
        )


def read_presentation(folder: Path) -> Presentation:
    """What a scene's or a run's folder says; nothing where it has no such file.

    Raises:
        PolarguideError: the file is not such a record.
    """
    path = folder / PRESENTATION_FILE
    return read_record(path, Presentation, remedy=REMEDY) if os.path.lexists(path) else Presentation()


def write_presentation(folder: Path, presentation: Presentation) -> Path:
    """Write the file of a scene or a run as a whole.

    Raises:
        PolarguideError: the file cannot be written.
    """
    path = folder / PRESENTATION_FILE
    write_whole(path, to_json(presentation.to_record()))
    return path


def parse_length(text: str) -> float:
    """Meters of a length such as ``85mm``, ``8.5 cm``, ``0.085``.

    Raises:
        PolarguideError: the text is not a length.
    """
    match = re.fullmatch(r"\s*((?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?)\s*([a-z]*)\s*", text)
    unit = LENGTHS.get((match[2] or "m") if match else "")
    meters = float(match[1]) * unit if match and unit else math.nan
    require(
        0 < meters <= MOST_METERS,
        "distance",
        expected=f"a length above 0 such as 85mm (units: {', '.join(LENGTHS)}; m without one)",
        found=repr(text),
        remedy="Give a number above 0 and its unit.",
    )
    return meters


def shown_length(units: float, meters_per_unit: float | None) -> str:
    """A length of the scene in words: ``85.0 mm``, or ``0.532 units`` without a scale."""
    if meters_per_unit is None:
        return f"{units:.4g} units"
    meters = units * meters_per_unit
    for unit in ("km", "m", "cm", "mm"):
        if meters >= LENGTHS[unit]:
            return f"{meters / LENGTHS[unit]:.4g} {unit}"
    return f"{meters / 1e-3:.3g} mm"


def colored(radiance: Tensor, color: Tensor | None) -> Tensor:
    """Linear radiance [..., 3] as it is shown, by ``Presentation.color``, not negative."""
    return radiance if color is None else (radiance @ color.T.to(radiance)).clamp(min=0)


def in_camera(radiance: Tensor, color: Tensor | None) -> Tensor:
    """The inverse of ``colored``: radiance of linear sRGB as the camera's channels would have it."""
    return radiance if color is None else colored(radiance, torch.linalg.inv(color))


def colored_reflectance(reflectance: Tensor, color: Tensor | None) -> Tensor:
    """Reflectance [..., 3] of the camera's channels as that of linear sRGB: what it makes of the light that is white
    there, ``M (r * M^-1 1)``. A white balance and an exposure leave it as it is.
    """
    if color is None:
        return reflectance
    matrix = color.to(reflectance)
    return colored(reflectance * torch.linalg.solve(matrix, matrix.new_ones(3)), matrix)
