"""Setting of the presentation of a scene or a run, from texts of the command line or of a program."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import torch
from torch import Tensor

from polarguide.capture import Scene, load_scene, read_model
from polarguide.capture.layout import find_layout
from polarguide.capture.presentation import (
    CREDITS,
    EITHER,
    PRESENTATION_FILE,
    Chart,
    Presentation,
    Vector,
    parse_length,
    read_presentation,
    shown_length,
    write_presentation,
)
from polarguide.core.errors import PolarguideError
from polarguide.core.files import require_folder
from polarguide.core.options import DeviceName, PathLike
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.records import decode
from polarguide.core.text import command, decimals
from polarguide.results.rendering.chart import chart_of
from polarguide.results.rendering.picking import (
    gray_world_gains,
    photograph_color,
    surface_at,
    white_balance_gains,
)
from polarguide.runs.folder import CONFIGURATION
from polarguide.runs.opened import OpenedRun

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def present(
    folder: PathLike,
    *,
    white_balance: str | None = None,
    chart: str | None = None,
    exposure: str | None = None,
    up_axis: str | None = None,
    points: Sequence[str] = (),
    distance: str | None = None,
    meters_per_unit: str | None = None,
    crop: str | None = None,
    title: str | None = None,
    author: str | None = None,
    license: str | None = None,
    provenance: str | None = None,
    scene: PathLike | None = None,
    device: DeviceName = "cpu",
    reporter: Reporter = SILENT,
) -> Presentation:
    """Set how a scene or a run is presented, in its ``presentation.json``. Omitted values stay.

    A PLACE is X,Y,Z in the scene's axes; VIEW, for the camera of a photograph; or VIEW,X,Y, for the surface that a
    run shows at a pixel of a photograph, counted from the top left corner.

    Args:
        folder: folder of a scene, whose runs inherit the presentation, or of a run.
        white_balance: ``none``, ``gray`` (the mean of the photographs becomes gray), gains of R, G and B such as
            ``1.9,1,1.6``, or VIEW,X,Y: a place in a photograph that should be white or gray.
        chart: ``none``, or VIEW,X,Y,X,Y,X,Y,X,Y: the centers of the corner patches of a 24-patch color chart, around
            it; or the folder of another scene or run with a chart. It replaces a white balance.
        exposure: exposure compensation in stops, -8 to 8, or ``none``.
        up_axis: ``none`` (the up axis of the cameras), an axis such as ``z`` or ``-y``, three numbers, or VIEW,X,Y: a
            place on a level surface, whose normal is up.
        points: two PLACEs of known distance.
        distance: their distance, such as ``85mm``.
        meters_per_unit: length of one unit of the scene, or ``none``.
        crop: left,right,down,up,front,back in percent of the cameras' distance, as in the viewer; ``all``: the
            whole scene; ``none``: the subject, see ``results.rendering.subject``.
        title, author, license, provenance: one line of text each; ``none`` or an empty text removes it.
        scene: new folder of a moved scene, which ``run.json`` of the run then names.
        device: device of the rendering.
        reporter: receives the progress of long operations.

    Returns:
        The presentation of the folder: for a run, its own over its scene's.

    Raises:
        PolarguideError: the folder does not exist, or a value is invalid; nothing is written.
    """
    place = _PresentedFolder(Path(folder), device, reporter)
    if scene is not None:
        place.move_scene(scene)
    own = read_presentation(place.folder)
    changes: dict[str, Any] = {}
    parsers = {
        "white_balance": (_white_balance, white_balance),
        "chart": (_chart, chart),
        "exposure": (_exposure, exposure),
        "up_axis": (_up_axis, up_axis),
    }
    for name, (parse, text) in parsers.items():
        if text is not None:
            changes[name] = None if text == "none" else parse(text, place)
    if points or distance is not None or meters_per_unit is not None:
        changes["meters_per_unit"] = _scale(points, distance, meters_per_unit, place)
    if crop is not None:
        up = changes["up_axis"] if "up_axis" in changes else place.shown(own).up_axis
        changes["crop"] = None if crop in ("none", "all") else _crop(crop, up)
        changes["whole"] = crop == "all"
    credits = {"title": title, "author": author, "license": license, "provenance": provenance}
    changes |= {name: "" if text == "none" else text for name, text in credits.items() if text is not None}
    replaced = {
        name for names in EITHER if any(changes.get(n) not in NOTHING for n in names) for name in names
    }
    place.refuse_inherited(
        [name for name, value in changes.items() if value in NOTHING and name not in replaced]
    )
    unchanged = {name: value for name, value in own.to_record().items() if name not in replaced}
    record = {**unchanged, **{name: msgspec.to_builtins(value) for name, value in changes.items()}}
    decoded = decode(record, Presentation, "presentation", remedy="Correct the value; nothing was written.")
    if changes:
        write_presentation(place.folder, decoded)
    return place.shown(decoded)


class _PresentedFolder:
    """Folder of a scene or a run, read on demand."""

    def __init__(self, folder: Path, device: DeviceName, reporter: Reporter) -> None:
        require_folder(
            folder, expected="the folder of a scene or a run", remedy="Choose a folder from prepare or train."
        )
        self.folder = folder
        self._device = device
        self._reporter = reporter
        self._is_run = os.path.lexists(folder / CONFIGURATION)
        if not self._is_run:
            find_layout(folder)

    @cached_property
    def _run(self) -> OpenedRun:
        return OpenedRun.open(self.folder, device=self._device, reporter=self._reporter)

    @property
    def _scene_folder(self) -> Path:
        return self._run.scene_folder if self._is_run else self.folder

    @cached_property
    def scene(self) -> Scene:
        """The scene, or the scene of the run."""
        return self._run.scene if self._is_run else load_scene(self.folder, reporter=self._reporter)

    def move_scene(self, scene: PathLike) -> None:
        """Set the new folder of a run's scene.

        Raises:
            PolarguideError: the folder is not a run, or the scene is another one.
        """
        if not self._is_run:
            raise _wrong("scene", "the folder of a run, whose scene was moved", str(self.folder))
        self._run.point_to(scene)

    def shown(self, own: Presentation) -> Presentation:
        """Return the presentation that applies, given the folder's own values."""
        return own.over(read_presentation(self._scene_folder)) if self._is_run else own

    def refuse_inherited(self, names: Sequence[str]) -> None:
        """Refuse to remove inherited values from a run.

        Raises:
            PolarguideError: the scene has one of the values.
        """
        if not self._is_run:
            return
        above = read_presentation(self._scene_folder)
        for name in names:
            if getattr(above, name) not in NOTHING:
                raise PolarguideError(
                    name,
                    expected="a value of the run itself",
                    found=f"a value of its scene ({self._scene_folder / PRESENTATION_FILE})",
                    remedy=f"Remove it there ({command('present', self._scene_folder)}), or set another for the run.",
                )

    def pixel(self, text: str) -> tuple[str, float, float] | None:
        """Parse VIEW,X,Y to a view and a place in it, or return None for other texts."""
        name, *numbers = text.rsplit(",", 2)
        places = decimals(",".join(numbers))
        if len(places) != 2 or (decimals(name) and name not in find_layout(self._scene_folder).names):
            return None
        return name, places[0], places[1]

    def surface(self, name: str, x: float, y: float, where: str) -> tuple[Tensor, Tensor | None]:
        """Return the point and the normal of the surface at a pixel of a view.

        Raises:
            PolarguideError: there is no surface, or the folder is not a run.
        """
        if not self._is_run:
            raise PolarguideError(
                where,
                expected="a run, whose depth locates the surface",
                found=f"the scene {self.folder}",
                remedy="Use the folder of a run of this scene, or numbers X,Y,Z.",
            )
        camera = self.scene.view(name).camera
        hit = surface_at(self._run.result(camera, depth=True).to("cpu"), camera, x, y)
        if hit is None:
            raise PolarguideError(
                where,
                expected=f"a surface at a place in {name}, which is {camera.width} x {camera.height}",
                found=f"none at {x:g},{y:g}",
                remedy="Pick a place on an object in polarguide view.",
            )
        return hit.point, hit.normal

    def point(self, text: str) -> Tensor:
        """Return a PLACE as a point [3] in the world.

        Raises:
            PolarguideError: the text is not a PLACE.
        """
        pixel = self.pixel(text)
        if pixel is not None:
            return self.surface(*pixel, "points")[0]
        numbers = decimals(text)
        if len(numbers) == 3:
            return torch.tensor(numbers, dtype=torch.float64)
        return read_model(self._scene_folder).camera(text).center


def _white_balance(text: str, place: _PresentedFolder) -> Vector | None:
    if text == "gray":
        return gray_world_gains(place.scene.train_views)
    if (pixel := place.pixel(text)) is not None:
        name, x, y = pixel
        return white_balance_gains(photograph_color(place.scene.view(name), x, y))
    expected = "none, gray, three gains such as 1.9,1,1.6, or VIEW,X,Y"
    red, green, blue = _require_numbers(text, 3, "white_balance", expected)
    return red, green, blue


NOTHING = (None, "", False)
"""Values that mean "not set"."""


def _chart(text: str, place: _PresentedFolder) -> Chart:
    expected = "none, VIEW and the four corners X,Y,X,Y,X,Y,X,Y, or a folder with a chart"
    name, *numbers = text.rsplit(",", 8)
    corners = decimals(",".join(numbers))
    if len(corners) == 8:
        return chart_of(place.scene.view(name), corners)
    other = read_presentation(Path(text)).chart if Path(text).is_dir() else None
    if other is None:
        raise _wrong("chart", expected, text)
    return other


def _exposure(text: str, place: _PresentedFolder) -> float:
    return _require_numbers(text, 1, "exposure", "stops such as 0.5, or none")[0]


def _up_axis(text: str, place: _PresentedFolder) -> Vector | None:
    if (axis := AXES.get(text.removeprefix("-").removeprefix("+").lower())) is not None:
        sign = -1.0 if text.startswith("-") else 1.0
        return sign * axis[0], sign * axis[1], sign * axis[2]
    if (pixel := place.pixel(text)) is not None:
        _, normal = place.surface(*pixel, "up_axis")
        if normal is None:
            raise _wrong("up_axis", "a place with a known normal", text)
        x, y, z = normal.tolist()
    else:
        expected = "none, an axis such as z or -y, three numbers, or VIEW,X,Y"
        x, y, z = _require_numbers(text, 3, "up_axis", expected)
    return x, y, z


def _scale(
    points: Sequence[str], distance: str | None, meters_per_unit: str | None, place: _PresentedFolder
) -> float | None:
    if meters_per_unit is not None:
        if points or distance is not None:
            raise _wrong("meters_per_unit", "either this, or --points and --distance", "both")
        if meters_per_unit == "none":
            return None
        return _require_numbers(meters_per_unit, 1, "meters_per_unit", "a number above 0, or none")[0]
    if len(points) != 2 or distance is None:
        count = f"{len(points)} points and {'a' if distance else 'no'} distance"
        raise _wrong("points", "two points, and their --distance", count)
    meters = parse_length(distance)
    apart = float((place.point(points[0]) - place.point(points[1])).norm())
    if apart < 1e-9:
        raise _wrong("points", "two different points", "equal points")
    return meters / apart


def _crop(text: str, up: Vector | None) -> dict[str, Any]:
    sides = _require_numbers(text, 6, "crop", "none, all, or left,right,down,up,front,back in percent")
    left, right, down, above, front, back = (side / 100 for side in sides)
    return {"low": (left, down, front), "high": (right, above, back), "up": up}


def _require_numbers(text: str, count: int, where: str, expected: str) -> tuple[float, ...]:
    """Parse a fixed count of numbers separated by commas.

    Raises:
        PolarguideError: the text has another form.
    """
    numbers = decimals(text)
    if len(numbers) != count:
        raise _wrong(where, expected, text)
    return numbers


def _wrong(where: str, expected: str, found: str) -> PolarguideError:
    return PolarguideError(where, expected=expected, found=found, remedy="Correct the value.")


def presentation_lines(presentation: Presentation) -> list[str]:
    """Return the values that are set, a line each; "nothing is set" for an empty presentation."""
    chart = presentation.chart
    exposure = presentation.exposure
    crop = presentation.crop
    scale = presentation.meters_per_unit
    sides = (
        None
        if crop is None
        else [100 * side for ends in zip(crop.low, crop.high, strict=True) for side in ends]
    )
    lines = {
        "white balance": _listed(presentation.white_balance),
        "color chart": chart
        and f"{chart.patches} patches in {chart.view}, CIEDE2000 {chart.delta_e:.1f}, up to {chart.delta_e_worst:.1f}",
        "exposure": f"{exposure:+g} stops" if exposure else "",
        "up axis": _listed(presentation.up_axis),
        "scale": "" if scale is None else f"1 unit is {shown_length(1.0, scale)}",
        "crop": sides and f"{_listed(sides)} % of the cameras' distance",
        **{name: getattr(presentation, name) for name in CREDITS},
    }
    if presentation.whole:
        lines["crop"] = "all of the scene"
    return [f"{name}: {text}" for name, text in lines.items() if text] or ["nothing is set"]


def _listed(numbers: Sequence[float] | None) -> str:
    return "" if numbers is None else ", ".join(f"{number:.4g}" for number in numbers)
