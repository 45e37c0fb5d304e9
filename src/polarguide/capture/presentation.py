"""Presentation of a capture: color, up axis, scale, crop box and credits.

They are stored in the file ``presentation.json`` of a scene or a run, and are used for display and export only. They
have no effect on training and scores. Fields of a run take precedence over fields of its scene.

Names follow USD (``metersPerUnit``, ``upAxis``) and the asset metadata of glTF.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

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
"""Length of each unit in meters."""
LEAST_METERS = 1e-9
"""Smallest length of a scene's unit in meters. The single precision of exported files limits the length."""
MOST_METERS = 1e9
"""Largest length of a scene's unit in meters."""
WIDEST_CROP = 100.0
STOPS = 8.0
"""Largest change of the exposure in stops, brighter or darker."""
KNEE = 0.5
"""Displayed linear value above which the tone curve compresses. Half of full scale keeps mid-tones unchanged."""

Vector = tuple[float, float, float]
Gain = Annotated[float, Meta(ge=0.02, le=50)]
Factor = Annotated[float, Meta(ge=-50, le=50)]
Text = Annotated[str, Meta(max_length=1000)]
ToneCurve = Literal["soft"]


class Crop(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Box that limits the displayed and exported part of a scene.

    Its origin is the point at which the cameras look. Its axes are the common right, up and back directions of the
    cameras. The unit of length is the distance of the cameras from the origin.

    Attributes:
        low: corner with the smallest coordinates, [3].
        high: corner with the largest coordinates, [3].
        up: up direction when the box was created, in the axes of the scene, [3]; default: that of the cameras. A later
            change of the up direction does not move the box.
    """

    low: Vector
    high: Vector
    up: Vector | None = None

    def __post_init__(self) -> None:
        for low, high in zip(self.low, self.high, strict=True):
            require(
                -WIDEST_CROP <= low < high <= WIDEST_CROP,
                "crop",
                expected=f"a low side less than the high side, both within {WIDEST_CROP:g} distances",
                found=f"{low:g} to {high:g}",
                remedy=REMEDY,
            )
        _check_direction("crop.up", self.up)

    def _frame(self, around: SceneFrame) -> SceneFrame:
        return around if self.up is None else _upright(around, self.up)

    def corners(self, around: SceneFrame) -> Tensor:
        """Return the eight corners of the box in the world, [8, 3] float64. The last axis changes fastest.

        Args:
            around: frame of the cameras.
        """
        frame = self._frame(around)
        sides = torch.tensor([self.low, self.high], dtype=torch.float64)
        local = torch.cartesian_prod(*sides.T) * frame.distance
        return frame.center + local @ frame.panorama_axes().T

    def inside(self, means: Tensor, around: SceneFrame) -> Tensor:
        """Return a mask [N] of the points [N, 3] that are inside the box. ``around`` is the frame of the cameras."""
        frame = self._frame(around)
        axes, center = (t.to(means) for t in (frame.panorama_axes(), frame.center))
        local = (means - center) @ axes / frame.distance
        low, high = (
            torch.tensor(side, dtype=local.dtype, device=local.device) for side in (self.low, self.high)
        )
        return ((local >= low) & (local <= high)).all(dim=1)


class Chart(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Color correction that was measured from a color chart in a photograph of the capture.

    Attributes:
        matrix: matrix from the camera's linear RGB (S0 / 2) to linear sRGB (D65), [3][3]. It includes white balance and
            exposure.
        delta_e: mean color difference CIEDE2000 of the patches in leave-one-out validation.
        delta_e_worst: largest color difference CIEDE2000 of the patches in leave-one-out validation.
        patches: number of patches of the chart.
        view: name of the photograph with the chart.
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
            expected="rows with positive sums, which give gray light in every channel",
            found=f"a sum of {darkest:g}, which makes gray black",
            remedy=REMEDY,
        )


class Presentation(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Content of ``presentation.json``. All fields are optional.

    Attributes:
        white_balance: factors by which linear R, G and B are multiplied for display, 0.02 to 50.
        chart: correction by a color chart, which is an alternative to a white balance.
        exposure: change of the displayed brightness in stops, -8 to 8.
        tone_curve: ``soft`` compresses highlights smoothly, see ``with_tone_curve``; default: highlights are clipped.
        up_axis: up direction in the axes of the scene, a vector of any length, [3]; default: that of the cameras.
        meters_per_unit: length of the scene's unit in meters.
        crop: box that limits the displayed and exported part of the scene.
        whole: if True, the whole scene is displayed and a crop box of the scene is ignored.
        title: title of the capture.
        author: author of the capture.
        license: name of a license, such as CC-BY-4.0.
        provenance: place, time and method of the capture, or a number of an inventory.
    """

    white_balance: tuple[Gain, Gain, Gain] | None = None
    chart: Chart | None = None
    exposure: Annotated[float, Meta(ge=-STOPS, le=STOPS)] | None = None
    tone_curve: ToneCurve | None = None
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
        for first, second in EITHER:
            require(
                getattr(self, first) is None or not getattr(self, second),
                first,
                expected=f"{first} or {second}",
                found="both",
                remedy=REMEDY,
            )
        for name in CREDITS:
            text = getattr(self, name)
            require(
                text.isprintable(), name, expected="one line of text", found=repr(text)[:100], remedy=REMEDY
            )

    @property
    def credit(self) -> str:
        """Author and license in one line. It may be empty."""
        return ", ".join(text for text in (self.author, self.license) if text)

    @property
    def color(self) -> Tensor | None:
        """Matrix from the camera's linear RGB to displayed linear sRGB, [3, 3] float32, or None without a correction.

        The matrix applies to radiance, because light adds up. Stokes vectors, DoLP and AoLP are ratios within a channel
        of the camera and do not change.
        """
        if self.white_balance is None and self.chart is None and not self.exposure:
            return None
        matrix = torch.diag(torch.tensor(self.white_balance or (1.0, 1.0, 1.0)))
        if self.chart is not None:
            matrix = torch.tensor(self.chart.matrix)
        return matrix * 2.0 ** (self.exposure or 0.0)

    def displayed(self, radiance: Tensor) -> Tensor:
        """Convert linear radiance [..., 3] of the camera to displayed linear sRGB with the color and the tone curve."""
        return with_tone_curve(colored(radiance, self.color), self.tone_curve)

    def over(self, other: Presentation) -> Presentation:
        """Return this presentation, in which missing fields are filled with the fields of another presentation.

        A field is not filled if it excludes a field of this presentation, see ``EITHER``.
        """
        own = _specified_fields(self)
        default = _specified_fields(other)
        for names in EITHER:
            if not own.keys().isdisjoint(names):
                default = {name: value for name, value in default.items() if name not in names}
        return Presentation(**{**default, **own})

    def upright(self, around: SceneFrame) -> SceneFrame:
        """Return the frame of the cameras, rotated to the up direction of this presentation."""
        return around if self.up_axis is None else _upright(around, self.up_axis)

    def to_record(self) -> dict[str, Any]:
        """Return the fields that have a value, as the content of ``presentation.json``."""
        record: dict[str, Any] = msgspec.to_builtins(self)
        return record


EITHER = (("white_balance", "chart"), ("crop", "whole"))
"""Pairs of fields that exclude each other."""


def _specified_fields(presentation: Presentation) -> Mapping[str, Any]:
    """Return the fields that have a value by name."""
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


UNCHANGED = Presentation()
"""Presentation with default values, which changes nothing."""


def read_presentation(folder: Path) -> Presentation:
    """Read the presentation of a scene or a run. If the file does not exist, return an empty presentation.

    Raises:
        PolarguideError: the file is invalid.
    """
    path = folder / PRESENTATION_FILE
    return read_record(path, Presentation, remedy=REMEDY) if os.path.lexists(path) else UNCHANGED


def write_presentation(folder: Path, presentation: Presentation) -> Path:
    """Write the presentation of a scene or a run.

    Raises:
        PolarguideError: the file cannot be written.
    """
    path = folder / PRESENTATION_FILE
    write_whole(path, to_json(presentation.to_record()))
    return path


def parse_length(text: str) -> float:
    """Parse a length such as ``85mm``, ``8.5 cm`` or ``0.085``, and return it in meters.

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
        remedy="Enter a number above 0 and its unit.",
    )
    return meters


def shown_length(units: float, meters_per_unit: float | None) -> str:
    """Format a length of the scene, such as ``85.0 mm``, or ``0.532 units`` without a scale."""
    if meters_per_unit is None:
        return f"{units:.4g} units"
    meters = units * meters_per_unit
    for unit in ("km", "m", "cm", "mm"):
        if meters >= LENGTHS[unit]:
            return f"{meters / LENGTHS[unit]:.4g} {unit}"
    return f"{meters / 1e-3:.3g} mm"


def colored(radiance: Tensor, color: Tensor | None) -> Tensor:
    """Convert linear radiance [..., 3] to displayed linear sRGB with the matrix ``Presentation.color``.

    Negative results are set to 0.
    """
    return radiance if color is None else (radiance @ color.T.to(radiance)).clamp(min=0)


def with_tone_curve(linear: Tensor, tone_curve: ToneCurve | None) -> Tensor:
    """Apply a tone curve to displayed linear sRGB, [..., 3] to [..., 3].

    The curve ``soft`` maps the largest channel x of a pixel to ``x`` up to the knee k (``KNEE``), and above to
    ``1 - (1 - k)^2 / (x + 1 - 2 k)``. At the knee, both parts have the value k and the slope 1, and the upper part
    approaches 1. The other channels are multiplied by the same factor, so the hue does not change.

    The curve is not linear, so it applies to complete pictures only, after blending. With a curve, NaN becomes 0.

    Args:
        linear: displayed linear sRGB of any size.
        tone_curve: name of a curve. With None, the values are returned unchanged.
    """
    if tone_curve is None:
        return linear
    finite = linear.nan_to_num(0.0)
    largest = finite.amax(dim=-1, keepdim=True).clamp(min=KNEE)
    mapped = 1 - (1 - KNEE) ** 2 / (largest + 1 - 2 * KNEE)
    return finite * (mapped / largest)


def in_camera(radiance: Tensor, color: Tensor | None) -> Tensor:
    """Convert displayed linear sRGB to radiance in the channels of the camera. This is the inverse of ``colored``."""
    return radiance if color is None else colored(radiance, torch.linalg.inv(color))


def colored_reflectance(reflectance: Tensor, color: Tensor | None) -> Tensor:
    """Convert reflectance r [..., 3] in the channels of the camera to linear sRGB, ``M (r * M^-1 1)``.

    The result is the color of the surface under light that is displayed as white. It does not depend on white balance
    and exposure.
    """
    if color is None:
        return reflectance
    matrix = color.to(reflectance)
    return colored(reflectance * torch.linalg.solve(matrix, matrix.new_ones(3)), matrix)
