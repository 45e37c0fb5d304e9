"""Change of the presentation of a scene or a run: color, exposure, up axis, scale, crop box and credit.

The user may specify a pixel, whose surface or color is measured.

A color chart in a photograph gives a matrix from the camera's linear RGB to linear sRGB. The chart of 24 patches is
defined by McCamy, Marcus and Davidson (1976), "A color-rendition chart". ``LAB`` are its
manufacturer's values for charts since the end of 2014 (X-Rite, "New color specifications for ColorChecker SG
and Classic Charts"): CIELAB under D50, by rows from dark skin to black. The matrix minimizes squared
distances in CIELAB. Its error is the CIEDE2000 of each patch with the matrix of the other patches.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

import cv2
import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from polarguide.capture import Scene, View, load_scene, read_model
from polarguide.capture.layout import find_layout
from polarguide.capture.presentation import (
    CREDITS,
    EITHER,
    PRESENTATION_FILE,
    Chart,
    Presentation,
    ToneCurve,
    Vector,
    parse_length,
    read_presentation,
    shown_length,
    write_presentation,
)
from polarguide.core.errors import PolarguideError, optional_import
from polarguide.core.files import require_folder
from polarguide.core.options import DeviceName, PathLike
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.records import decode
from polarguide.core.text import command, decimals
from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import unit
from polarguide.runs.folder import CONFIGURATION
from polarguide.runs.opened import OpenedRun
from polarguide.shading.result import RenderResult

LEAST_ALPHA = 0.5  # minimum alpha of a surface
LEAST_GAIN = 0.02
MOST_GAIN = 50.0
# Limits of a color that is picked for the white balance.
DARKEST = 2e-3
BRIGHTEST = 0.98
PATCH = 2  # radius in pixels over which a picked color is averaged


@dataclass(frozen=True, eq=False)
class SurfacePoint:
    """Surface point at a specified pixel.

    Attributes:
        point: [3] float64 in the world.
        normal: [3] float64 unit vector toward the camera, or None if unknown.
    """

    point: Tensor
    normal: Tensor | None


def surface_at(result: RenderResult, camera: Camera, x: float, y: float) -> SurfacePoint | None:
    """Return the surface at a position in a rendering with depth.

    Return None if the position lies outside the picture or shows no surface.

    Args:
        result: the rendering, with the size of the camera.
        camera: its camera.
        x, y: pixels from the top left corner; the center of the first pixel is (0.5, 0.5).
    """
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        return None
    column = int(x)
    row = int(y)
    depth = float(result.depth[row, column])
    if float(result.alpha[row, column]) < LEAST_ALPHA or depth <= 0:
        return None
    local = torch.tensor([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0], dtype=torch.float64)
    ray = camera.rotation.T @ local
    normal: Tensor | None = None
    if "normal" in result.layers:
        blended = _patch(result.normal, row, column).double().mean(dim=(0, 1))
        if float(blended.norm()) > 0.1:
            normal = unit(blended, 1e-9)
            normal = -normal if float(normal @ ray) > 0 else normal
    return SurfacePoint(camera.center + depth * ray, normal)


def photograph_color(view: View, x: float, y: float) -> Tensor:
    """Return the mean color [3] of the valid pixels of a photograph around a position; see ``surface_at``.

    Raises:
        PolarguideError: the position lies outside the photograph, or no pixel around it is valid.
    """
    camera = view.camera
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        raise PolarguideError(
            "white_balance",
            expected=f"a place in {view.name}, which is {camera.width} x {camera.height}",
            found=f"{x:g},{y:g}",
            remedy="Count pixels from the top left corner.",
        )
    row = int(y)
    column = int(x)
    valid = ~_patch(view.invalid | view.saturated, row, column)
    if not bool(valid.any()):
        raise PolarguideError(
            "white_balance",
            expected="pixels that are not saturated or invalid",
            found=f"none around {x:g},{y:g} of {view.name}",
            remedy="Pick a gray or white place that is not too bright.",
        )
    return _patch(view.photograph(), row, column)[valid].mean(dim=0)


def _patch(picture: Tensor, row: int, column: int) -> Tensor:
    top = max(0, row - PATCH)
    left = max(0, column - PATCH)
    return picture[top : row + PATCH + 1, left : column + PATCH + 1]


def white_balance_gains(color: Tensor) -> Vector:
    """Return the gains [3] of a white balance that makes a linear color [3] gray. The gain of green is 1.

    Raises:
        PolarguideError: the color is too dark, clips, or is not gray under any usual light.
    """
    values = [float(value) for value in color]
    if not (min(values) > 0 and max(values) >= DARKEST and max(values) <= BRIGHTEST):
        listed = ", ".join(f"{value:.3g}" for value in values)
        raise PolarguideError(
            "white_balance",
            expected=f"a color of {DARKEST:g} to {BRIGHTEST:g} of full scale in its brightest channel, without zeros",
            found=f"R, G, B {listed}",
            remedy="Pick a gray or white place that is not dark or clipped.",
        )
    gains = [values[1] / value for value in values]
    if not all(LEAST_GAIN <= gain <= MOST_GAIN for gain in gains):
        raise PolarguideError(
            "white_balance",
            expected=f"gains of {LEAST_GAIN:g} to {MOST_GAIN:g}",
            found=", ".join(f"{gain:.3g}" for gain in gains),
            remedy="Pick a gray or white place.",
        )
    return gains[0], 1.0, gains[2]


def gray_world_gains(views: Iterable[View]) -> Vector:
    """Return gains [3] that make the mean of all valid pixels gray (Buchsbaum 1980). The gain of green is 1.

    Raises:
        PolarguideError: there are no valid pixels, or all are black.
    """
    total = torch.zeros(3, dtype=torch.float64)
    count = 0
    for view in views:
        valid = ~(view.invalid | view.saturated)
        total += view.photograph()[valid].double().sum(dim=0)
        count += int(valid.sum())
    mean = total / max(count, 1)
    # The gains do not depend on brightness, so black pixels around an object have no effect.
    return white_balance_gains(0.5 * mean / max(float(mean.max()), 1e-12))


Floats = NDArray[np.float64]
LAB: Floats = np.array([
    (37.54, 14.37, 14.92), (64.66, 19.27, 17.50), (49.32, -3.82, -22.54), (43.46, -12.74, 22.72),
    (54.94, 9.61, -24.79), (70.48, -32.26, -0.37), (62.73, 35.83, 56.50), (39.43, 10.75, -45.17),
    (50.57, 48.64, 16.67), (30.10, 22.54, -20.87), (71.77, -24.13, 58.19), (71.51, 18.24, 67.37),
    (28.37, 15.42, -49.80), (54.38, -39.72, 32.27), (42.43, 51.05, 28.62), (81.80, 2.67, 80.41),
    (50.63, 51.28, -14.12), (49.57, -29.71, -28.32), (95.19, -1.03, 2.93), (81.29, -0.57, 0.44),
    (66.89, -0.75, -0.06), (50.76, -0.13, 0.14), (35.63, -0.46, -0.48), (20.64, 0.07, -0.46),
])  # fmt: skip
_ORDERS = [[(begin + step * k) % 4 for k in range(4)] for begin in range(4) for step in (1, -1)]
"""All eight orders in which four corners can be listed around a quadrilateral."""
COLUMNS = 6
ROWS = 4
XYZ_OF_SRGB: Floats = np.array(
    [(0.4360747, 0.3850649, 0.1430804), (0.2225045, 0.7168786, 0.0606169), (0.0139322, 0.0971045, 0.7141733)]
)
"""Matrix from linear sRGB to XYZ under D50, with Bradford adaptation (Lindbloom, "RGB/XYZ matrices")."""
HALF_PATCH = 0.25
"""Half the side of the square that is averaged in each patch, relative to the distance between patch centers."""
LEAST_PIXELS = 16
"""Minimum number of pixels in a patch. Fewer pixels would be too noisy."""
LEAST_PATCHES = 18
"""Minimum number of usable patches: twice the number of unknowns in the matrix."""
WORST_FIT = 6.0
"""Largest accepted mean CIEDE2000. Cameras reach 1 to 4; wrong corners or uneven light give more."""


def chart_of(view: View, corners: Sequence[float]) -> Chart:
    """Return the color matrix of a photograph with a color chart.

    Args:
        view: view whose photograph shows the chart.
        corners: x and y in pixels of the centers of the four corner patches, listed around the chart in either
            direction. Any corner may be the first.

    Raises:
        PolarguideError: too few patches are usable because they clip or are too small, or the colors do not fit a
            chart.
    """
    quad = np.array(corners, dtype=np.float64).reshape(4, 2)
    fits = []
    for order in _ORDERS:
        colors = _patches(view, quad[order])
        used = np.asarray(np.isfinite(colors).all(axis=1))
        fits.append((_distance(_linear(colors[used], used), colors[used], used), colors, used))
    _, colors, used = min(fits, key=lambda fit: fit[0])
    if int(used.sum()) < LEAST_PATCHES:
        raise PolarguideError(
            "chart",
            expected=f"{LEAST_PATCHES} of {len(LAB)} patches with {LEAST_PIXELS} pixels and without clipping",
            found=f"{int(used.sum())} in {view.name}",
            remedy="Take a closer or darker photograph, or correct the corners.",
        )
    matrix = _fitted(colors[used], used)
    errors = _left_out(colors, used)
    if not errors.mean() <= WORST_FIT:
        raise PolarguideError(
            "chart",
            expected=f"patches that one matrix fits with a mean CIEDE2000 of at most {WORST_FIT:g}",
            found=f"{errors.mean():.1f}, up to {errors.max():.1f}, in {view.name}",
            remedy="Enter the centers of the four corner patches, around the chart, under even light.",
        )
    red, green, blue = ((float(a), float(b), float(c)) for a, b, c in matrix)
    return Chart((red, green, blue), float(errors.mean()), float(errors.max()), int(used.sum()), view.name)


def _patches(view: View, quad: Floats) -> Floats:
    """Return the mean linear color of each patch, [24, 3]; NaN if the patch is clipped, invalid or too small."""
    ends = np.array([(0, 0), (COLUMNS - 1, 0), (COLUMNS - 1, ROWS - 1), (0, ROWS - 1)], np.float32)
    to_chart = cv2.getPerspectiveTransform(quad.astype(np.float32), ends)
    camera = view.camera
    low = np.maximum(np.floor(quad.min(axis=0) - 0.2 * np.ptp(quad, axis=0)), 0).astype(int)
    high = np.ceil(quad.max(axis=0) + 0.2 * np.ptp(quad, axis=0)).astype(int) + 1
    part = slice(low[1], min(int(high[1]), camera.height)), slice(low[0], min(int(high[0]), camera.width))
    picture = view.photograph()[part].double().numpy()
    bad = (view.invalid | view.saturated)[part].numpy()
    y, x = np.mgrid[0 : bad.shape[0], 0 : bad.shape[1]] + 0.5
    homogeneous = np.stack([x + low[0], y + low[1], np.ones_like(x)], axis=-1) @ to_chart.T
    place = homogeneous[..., :2] / homogeneous[..., 2:]
    nearest = np.rint(place)
    inside = (np.abs(place - nearest) < HALF_PATCH).all(axis=-1)
    inside &= ((nearest >= 0) & (nearest < (COLUMNS, ROWS))).all(axis=-1)
    index = (nearest[..., 1] * COLUMNS + nearest[..., 0])[inside].astype(int)
    counts = np.bincount(index, minlength=len(LAB))
    valid = (counts >= LEAST_PIXELS) & (np.bincount(index, bad[inside], len(LAB)) == 0)
    sums = np.stack([np.bincount(index, picture[inside][:, c], len(LAB)) for c in range(3)], axis=1)
    return np.where(valid[:, None], sums / np.maximum(counts, 1)[:, None], np.nan)


def _linear(colors: Floats, used: NDArray[np.bool_]) -> Floats:
    """Fit a matrix [3, 3] to the chart by least squares in linear sRGB; return zeros if there are too few patches."""
    if len(colors) < LEAST_PATCHES:
        return np.zeros((3, 3))
    wanted = _skimage().lab2xyz(LAB, illuminant="D50")[used] @ np.linalg.inv(XYZ_OF_SRGB).T
    return np.asarray(np.linalg.lstsq(colors, wanted, rcond=None)[0].T)


def _lab(matrix: Floats, colors: Floats) -> Floats:
    return np.asarray(_skimage().xyz2lab(colors @ (XYZ_OF_SRGB @ matrix).T, illuminant="D50"))


def _distance(matrix: Floats, colors: Floats, used: NDArray[np.bool_]) -> float:
    """Return the mean CIEDE2000 between the chart and the colors after multiplication by a matrix."""
    if not len(colors):
        return np.inf
    return float(_skimage().deltaE_ciede2000(LAB[used], _lab(matrix, colors)).mean())


def _fitted(colors: Floats, used: NDArray[np.bool_]) -> Floats:
    def residuals(numbers: Floats) -> Floats:
        return np.asarray(_lab(numbers.reshape(3, 3), colors) - LAB[used]).ravel()

    return np.asarray(least_squares(residuals, _linear(colors, used).ravel(), x_scale="jac").x.reshape(3, 3))


def _left_out(colors: Floats, used: NDArray[np.bool_]) -> Floats:
    """Return the CIEDE2000 of each used patch, computed with a matrix that was fitted without this patch."""
    one = np.eye(len(LAB), dtype=bool)
    others = used & ~one
    return np.array(
        [
            _distance(_fitted(colors[others[k]], others[k]), colors[one[k]], one[k])
            for k in np.flatnonzero(used)
        ]
    )


def _skimage() -> Any:
    return optional_import("skimage.color", "--chart")


AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def present(
    folder: PathLike,
    *,
    white_balance: str | None = None,
    chart: str | None = None,
    exposure: str | None = None,
    tone_curve: str | None = None,
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
        tone_curve: ``soft``, which compresses highlights, or ``none``, which clips them.
        up_axis: ``none`` (the up axis of the cameras), an axis such as ``z`` or ``-y``, three numbers, or VIEW,X,Y: a
            place on a level surface, whose normal is up.
        points: two PLACEs of known distance.
        distance: their distance, such as ``85mm``.
        meters_per_unit: length of one unit of the scene, or ``none``.
        crop: left,right,down,up,front,back in percent of the cameras' distance, as in the viewer; ``all``: the
            whole scene; ``none``: the subject, see ``results.rendering.mesh``.
        title, author, license, provenance: one line of text each; ``none`` or an empty text removes it.
        scene: new folder of a moved scene, which ``run.json`` of the run then names.
        device: device of the rendering.
        reporter: receives the progress of long operations.

    Returns:
        The presentation of the folder. In a run, its own values override the values of the scene.

    Raises:
        PolarguideError: the folder does not exist, or a value is invalid. In both cases no file is changed.
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
        "tone_curve": (_tone_curve, tone_curve),
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
    """Folder of a scene or a run whose presentation is changed. Its files are read on demand."""

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
        """The scene in this folder, or the scene on which the run in this folder was trained."""
        return self._run.scene if self._is_run else load_scene(self.folder, reporter=self._reporter)

    def move_scene(self, scene: PathLike) -> None:
        """Set the new folder of a run's scene.

        Raises:
            PolarguideError: the folder is not a run, or the run was trained on a different scene.
        """
        if not self._is_run:
            raise _wrong("scene", "the folder of a run, whose scene was moved", str(self.folder))
        self._run.point_to(scene)

    def shown(self, own: Presentation) -> Presentation:
        """Complete the folder's own presentation ``own`` by the values that a run inherits from its scene."""
        return own.over(read_presentation(self._scene_folder)) if self._is_run else own

    def refuse_inherited(self, names: Sequence[str]) -> None:
        """Raise an error if a run would remove a value that its scene defines.

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
                    remedy=f"Remove it there ({command('present', self._scene_folder)}), or set another value for it.",
                )

    def pixel(self, text: str) -> tuple[str, float, float] | None:
        """Parse VIEW,X,Y to the name of a view and a position in pixels; return None for other texts."""
        name, *numbers = text.rsplit(",", 2)
        places = decimals(",".join(numbers))
        if len(places) != 2 or (decimals(name) and name not in find_layout(self._scene_folder).names):
            return None
        return name, places[0], places[1]

    def surface(self, name: str, x: float, y: float, where: str) -> tuple[Tensor, Tensor | None]:
        """Return the surface point and its normal at a pixel of a view.

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
                remedy="Specify a place on an object.",
            )
        return hit.point, hit.normal

    def point(self, text: str) -> Tensor:
        """Convert a PLACE to a world point [3].

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


def _tone_curve(text: str, _: _PresentedFolder) -> str:
    if text not in get_args(ToneCurve):
        raise _wrong("tone_curve", f"none or {', '.join(get_args(ToneCurve))}", text)
    return text


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
    """Parse exactly ``count`` numbers separated by commas.

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
    """Return one line per value that is set, or "nothing is set" for an empty presentation."""
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
        "tone curve": presentation.tone_curve,
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
