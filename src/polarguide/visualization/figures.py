"""Conversion of arrays and layers to 8-bit pictures: false colors, contact sheets and PNG files."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from PIL.PngImagePlugin import PngInfo
from torch import Tensor

from polarguide import optics
from polarguide.capture import View
from polarguide.capture.presentation import UNCHANGED, Presentation, colored, with_tone_curve
from polarguide.core.files import write_whole
from polarguide.geometry.camera import Camera
from polarguide.optics.color import shown
from polarguide.shading.result import POLARIZED, RenderResult

Picture = NDArray[np.uint8]
"""uint8 RGB [H, W, 3]."""

BACKGROUND = 255
INK = (32, 32, 32)
FONT = cv2.FONT_HERSHEY_SIMPLEX
FONT_SIZE = 18
SMALLEST_FONT_SIZE = 10
LINE_HEIGHT = 28
READ_AT = 384
"""Largest width of a tile with the smallest font size. Wider tiles have larger text."""


def contact_sheet(
    rows: Sequence[Sequence[Picture | None]],
    row_labels: Sequence[str],
    column_labels: Sequence[str],
    *,
    footer: Sequence[Picture | None] = (),
    minimum_width: int = 256,
    maximum_width: int = 640,
    gutter: int = 8,
    caption: str = "",
) -> Picture:
    """Arrange pictures in rows and columns on white, with labels on top and to the left.

    All tiles have the same size. Small pictures are enlarged to at least ``minimum_width`` by an integer factor without
    smoothing. Large pictures are reduced to ``maximum_width`` by area averages. A picture with another aspect ratio is
    fitted into its tile and centered.

    Args:
        rows: the pictures, uint8 RGB [H, W, 3]. A tile stays blank for None and after the end of a short row.
        row_labels: one per row.
        column_labels: one per column. Characters outside ASCII are drawn as "?".
        footer: pictures below the columns, such as color scales. They are scaled to the width of a tile.
        minimum_width, maximum_width: bounds of a tile's width in pixels.
        gutter: pixels between tiles and around the sheet.
        caption: a line of text at the bottom.

    Returns:
        uint8 RGB picture.

    Raises:
        ValueError: the labels do not match the rows, there is no picture, or an array is not a picture.
    """
    columns = len(column_labels)
    if len(rows) != len(row_labels) or any(len(row) > columns for row in rows):
        raise ValueError(
            f"contact sheet: expected {len(row_labels)} rows of at most {columns} pictures, "
            f"found rows of {[len(row) for row in rows]}"
        )
    pictures = [picture for row in rows for picture in row if picture is not None]
    for picture in pictures:
        check_picture(picture, "contact sheet")
    if not pictures:
        raise ValueError("contact sheet: expected at least one picture, found none")
    # An integer factor keeps the pixels of an enlarged picture equal.
    widest = max(picture.shape[1] for picture in pictures)
    width = min(widest * max(1, math.ceil(minimum_width / widest)), maximum_width)
    height = _height_at(width, pictures)
    below = _height_at(width, footer) + gutter if any(cell is not None for cell in footer) else 0
    larger = max(1.0, width / READ_AT)
    line = round(LINE_HEIGHT * larger)
    font = ImageFont.load_default(FONT_SIZE * larger)
    margin = math.ceil(
        max((font.getlength(label.encode("ascii", "replace")) for label in row_labels), default=0)
    )
    left = gutter + (margin + gutter if margin else 0)
    top = gutter + (line if any(column_labels) else 0)
    across = left + columns * (width + gutter)
    bottom = top + len(rows) * (height + gutter)
    sheet = Image.new("RGB", (across, bottom + below + (line if caption else 0)), "white")
    for j, label in enumerate(column_labels):
        _write(sheet, label, left + j * (width + gutter), gutter + line // 2, width, larger)
    for i, label in enumerate(row_labels):
        _write(sheet, label, gutter, top + i * (height + gutter) + height // 2, margin, larger)
    for i, row in enumerate([*rows, footer]):
        y = top + i * (height + gutter)
        for j, cell in enumerate(row):
            if cell is not None:
                check_picture(cell, "contact sheet")
                _place(
                    sheet,
                    cell,
                    (left + j * (width + gutter), y, width, height if y < bottom else below - gutter),
                )
    _write(sheet, caption, gutter, bottom + below + line // 2, across - 2 * gutter, larger)
    return np.array(sheet)


def _height_at(width: int, pictures: Sequence[Picture | None]) -> int:
    """Return the height of the tallest picture after all pictures are scaled to a common width."""
    return max(1, max(round(width * p.shape[0] / p.shape[1]) for p in pictures if p is not None))


def check_picture(picture: Picture, name: str) -> None:
    """Raise ValueError unless ``picture`` is uint8 [H, W, 3] and not empty."""
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3 or picture.size == 0:
        raise ValueError(f"{name}: expected uint8 [H, W, 3], found {picture.dtype} {list(picture.shape)}")


def _place(sheet: Image.Image, picture: Picture, tile: tuple[int, int, int, int]) -> None:
    """Fit a picture into a tile (left, top, width, height), centered."""
    left, top, width, height = tile
    scale = min(width / picture.shape[1], height / picture.shape[0])
    size = [max(1, round(side * scale)) for side in (picture.shape[1], picture.shape[0])]
    fitted = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST)
    sheet.paste(Image.fromarray(fitted), (left + (width - size[0]) // 2, top + (height - size[1]) // 2))


def _write(sheet: Image.Image, text: str, x: int, y: int, width: int, larger: float) -> None:
    """Draw text in the ``width`` pixels to the right of ``x``, centered, with a smaller font if necessary.

    Args:
        larger: scale of the font size.
    """
    text = text.encode("ascii", "replace").decode()
    length = max(1.0, ImageFont.load_default(FONT_SIZE * larger).getlength(text))
    size = larger * max(SMALLEST_FONT_SIZE, FONT_SIZE * min(1.0, width / length))
    ImageDraw.Draw(sheet).text((x + width / 2, y), text, INK, ImageFont.load_default(size), anchor="mm")


COLOR_MAPS = {
    "viridis": cv2.COLORMAP_VIRIDIS,
    "turbo": cv2.COLORMAP_TURBO,
    "magma": cv2.COLORMAP_MAGMA,
    "inferno": cv2.COLORMAP_INFERNO,
}
"""Color maps of ``scalar_to_rgb`` by name."""
NOTHING: Mapping[str, str] = MappingProxyType({})


def radiance_to_rgb(linear: Tensor) -> Picture:
    """Clip linear radiance [H, W, 3] to [0, 1] and encode it as an sRGB picture. NaN becomes black."""
    return _to_uint8(shown(linear.detach().nan_to_num(nan=0.0)))


def normal_to_rgb(normals_world: Tensor, camera: Camera) -> Picture:
    """Convert world normals to the usual colors, in camera space.

    Normals to the right are red, upward normals are green, and normals toward the camera are blue. The components (x,
    -y, -z) are mapped from [-1, 1] to [0, 255].

    Args:
        normals_world: [H, W, 3] of any length.
        camera: the view.

    Returns:
        uint8 [H, W, 3]; mid gray (128) for missing normals (zero or not finite).
    """
    normals = camera.to_camera(normals_world.detach().to("cpu", torch.float64).nan_to_num(0.0, 0.0, 0.0))
    length = torch.linalg.vector_norm(normals, dim=-1, keepdim=True)
    there = length > 1e-8
    unit = torch.where(there, normals / torch.where(there, length, 1.0), 0.0)
    return _to_uint8((unit * unit.new_tensor([1.0, -1.0, -1.0]) + 1) / 2)


def scalar_to_rgb(
    values: Tensor,
    low: float,
    high: float,
    colormap: str = "viridis",
) -> Picture:
    """Convert numbers to false colors.

    Args:
        values: [H, W].
        low, high: values at the ends of the color map, ``low < high``. Values outside have the color of the nearer end.
        colormap: a name in ``COLOR_MAPS``.

    Returns:
        uint8 [H, W, 3]; black for values that are not finite.

    Raises:
        ValueError: the range is empty.
    """
    if not low < high:
        raise ValueError(f"range: expected low < high, found {low} and {high}")
    numbers = values.detach().to("cpu", torch.float64)
    place = ((numbers - low) / (high - low)).nan_to_num(0.0).clamp(0, 1)
    colors = cv2.applyColorMap(_to_uint8(place), COLOR_MAPS[colormap])
    picture = np.ascontiguousarray(colors[..., ::-1], dtype=np.uint8)
    picture[~numbers.isfinite().numpy()] = 0
    return picture


def dolp_to_rgb(dolp: Tensor, high: float = 1.0) -> Picture:
    """Convert the degree of linear polarization [H, W] to colors, from black at 0 to bright at ``high``."""
    return scalar_to_rgb(dolp, 0.0, high, "inferno")


def aolp_to_rgb(aolp: Tensor, dolp: Tensor | None = None) -> Picture:
    """Convert the angle of linear polarization to a hue with period pi: 0 is red, pi/3 green, 2 pi/3 blue.

    Args:
        aolp: [H, W] radians, modulo pi.
        dolp: [H, W] in [0, 1], used as brightness, so that the noisy angles of unpolarized pixels are dark. None draws
            all pixels at full brightness.

    Returns:
        uint8 [H, W, 3]; black for values that are not finite.
    """
    angle = aolp.detach().to("cpu", torch.float64)
    value = torch.ones_like(angle) if dolp is None else dolp.detach().to("cpu", torch.float64)
    valid = angle.isfinite() & value.isfinite()
    third = 2 * math.pi / 3
    hue = 2 * angle.nan_to_num(0.0, 0.0, 0.0)[..., None] - angle.new_tensor([0.0, third, 2 * third])
    # Each primary is on within a sixth of the color circle, off beyond a third, and linear between.
    distance = (torch.remainder(hue + math.pi, 2 * math.pi) - math.pi).abs()
    color = (2 - distance / (math.pi / 3)).clamp(0, 1)
    value = torch.where(valid, value.nan_to_num(0.0).clamp(0, 1), 0.0)
    return _to_uint8(color * value[..., None])


LARGE_ERROR = 0.25
"""Error that is drawn at full brightness."""


def error_to_rgb(pred_linear: Tensor, true_linear: Tensor, high: float = LARGE_ERROR) -> Picture:
    """Convert the difference of displayed pictures, averaged over channels, to colors from 0 to ``high``."""
    true = shown(true_linear.detach().cpu())
    return scalar_to_rgb((shown(pred_linear.detach().cpu()) - true).abs().mean(-1), 0.0, high, "inferno")


def scale_bar(low: float, high: float, colormap: str, unit: str = "", *, middle: str = "") -> Picture:
    """Draw the color scale of ``scalar_to_rgb`` with labels for both limits, uint8 RGB [44, 256, 3].

    Args:
        unit: unit of the limits.
        middle: label at the middle of the bar.
    """
    ramp = torch.linspace(low, high, 256).expand(22, -1)
    end = f"{high:g} {unit}".rstrip()
    return color_bar(scalar_to_rgb(ramp, low, high, colormap), f"{low:g}", middle, end)


def angle_wheel(scale: float = 1.0) -> Picture:
    """Draw a wheel with the color of each AoLP in ``aolp_to_rgb``, [110, 256, 3].

    The center is dark, as for a small DoLP.

    Args:
        scale: factor on the size.
    """
    radius = 74 * scale
    center_x = round(128 * scale)
    center_y = round(100 * scale)
    drawn: Picture = np.full((round(110 * scale), round(256 * scale), 3), BACKGROUND, np.uint8)
    y, x = np.mgrid[0 : drawn.shape[0], 0 : drawn.shape[1]]
    angle = np.arctan2(center_y - y, x - center_x)
    distance = np.hypot(center_y - y, x - center_x)
    inside = (distance <= radius) & (y <= center_y)
    drawn[inside] = aolp_to_rgb(torch.from_numpy(angle), torch.from_numpy(distance / radius))[inside]
    image = Image.fromarray(drawn)
    font = ImageFont.load_default(max(14 * scale, SMALLEST_FONT_SIZE))
    for degrees, anchor in ((0, "lm"), (45, "lb"), (90, "mb"), (135, "rb"), (180, "rm")):
        text = f"{degrees}" if degrees or scale < 1 else "0 deg"
        turned = (radius + 6 * scale) * np.exp(1j * math.radians(degrees))
        place = (center_x + turned.real, center_y - turned.imag)
        ImageDraw.Draw(image).text(place, text, INK, font, anchor=anchor)
    return np.array(image)


def normal_ball(high: int = 64, width: int = 256) -> Picture:
    """Draw a ball in the colors of ``normal_to_rgb``: [high, width, 3]."""
    drawn: Picture = np.full((high, width, 3), BACKGROUND, np.uint8)
    y, x = np.mgrid[0:high, 0:width]
    radius = high * 30 / 64
    right = (x - width / 2) / radius
    down = (y - high / 2) / radius
    squared = right**2 + down**2
    normals = np.stack((right, -down, np.sqrt(np.maximum(1 - squared, 0))), axis=-1)
    inside = squared <= 1
    drawn[inside] = _to_uint8(torch.from_numpy((normals + 1) / 2))[inside]
    return drawn


def shares_to_rgb(shares: Tensor) -> Picture:
    """Convert values [H, W, 3] in [0, 1] to RGB without sRGB encoding. Values that are not finite become mid gray."""
    return _to_uint8(shares.detach().nan_to_num(0.5, 0.5, 0.5))


def with_key(picture: Picture, key: Picture, width: int) -> Picture:
    """Draw a legend, scaled to ``width`` pixels and with a white border, over the lower left corner of a picture."""
    scale = width / key.shape[1]
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    drawn_on = np.flatnonzero((key != BACKGROUND).any(axis=(0, 2)))
    key = key[:, drawn_on[0] : drawn_on[-1] + 1]
    size = [max(1, round(scale * side)) for side in (key.shape[1], key.shape[0])]
    small = cv2.resize(key, size, interpolation=way)
    edge = max(2, width // 40)
    framed = np.pad(small, ((edge, edge), (edge, edge), (0, 0)), constant_values=BACKGROUND)
    framed = framed[: picture.shape[0], : picture.shape[1]]
    drawn = picture.copy()
    drawn[picture.shape[0] - framed.shape[0] :, : framed.shape[1]] = framed
    return drawn


def with_name(picture: Picture, name: str) -> Picture:
    """Draw a name into the upper left corner of a picture, in white with a dark outline."""
    size = min(picture.shape[:2])
    image = Image.fromarray(picture)
    font = ImageFont.load_default(size / 16)
    rim = max(1, round(size / 400))
    place = (size // 40, size // 16)
    ImageDraw.Draw(image).text(place, name, "white", font, anchor="ls", stroke_width=rim, stroke_fill="black")
    return np.array(image)


def color_patch(color: int, text: str) -> Picture:
    """Draw a patch of a gray level (0 to 255) with a label below, uint8 RGB [44, 256, 3]."""
    return color_bar(np.full((22, 256, 3), color, np.uint8), text)


def color_bar(colors: Picture, left: str, middle: str = "", right: str = "") -> Picture:
    """Draw colors [22, 256, 3] with labels below at the left, in the middle, and at the right."""
    image = Image.new("RGB", (256, 44), "white")
    image.paste(Image.fromarray(colors))
    font = ImageFont.load_default(16)
    for text, x, anchor in ((left, 0, "ls"), (middle, 128, "ms"), (right, 256, "rs")):
        ImageDraw.Draw(image).text((x, 39), text, INK, font, anchor=anchor)
    return np.array(image)


def write_png(
    path: str | Path, rgb8: Picture, alpha8: Picture | None = None, about: Mapping[str, str] = NOTHING
) -> None:
    """Write a uint8 RGB [H, W, 3] picture atomically.

    Args:
        path: path of the file. rgb8: the picture. alpha8: [H, W] uint8 opacity; None for opaque.
        about: metadata of the file, ASCII texts by keyword.

    Raises:
        ValueError: the array is not a picture.
        PolarguideError: the file cannot be written.
    """
    check_picture(rgb8, "picture")
    write_whole(Path(path), png_bytes(rgb8, alpha8, about))


def png_bytes(rgb8: Picture, alpha8: Picture | None = None, about: Mapping[str, str] = NOTHING) -> bytes:
    """Return a picture as a PNG file; see ``write_png``."""
    texts = PngInfo()
    for keyword, text in about.items():
        texts.add_text(keyword, text)
    file = io.BytesIO()
    pixels = rgb8 if alpha8 is None else np.dstack((rgb8, alpha8))
    Image.fromarray(pixels).save(file, "png", pnginfo=texts, compress_level=1)
    return file.getvalue()


def _to_uint8(values: Tensor) -> Picture:
    """Convert values in [0, 1] to bytes. Halves are rounded up, so 0.5 becomes 128."""
    scaled = torch.floor(values.to("cpu", torch.float64) * 255 + 0.5)
    return scaled.clamp(0, 255).to(torch.uint8).numpy()


def color_gradient(color_map: str) -> str:
    """Return a color map as the stops of a CSS gradient."""
    levels = np.linspace(0, 255, 9).round().astype(np.uint8)[None]
    colors = cv2.applyColorMap(levels, COLOR_MAPS[color_map])[0, :, ::-1]
    return ", ".join(f"rgb({r} {g} {b})" for r, g, b in colors.tolist())


RADIANCE = frozenset(("final", "base", "reflection", "specular", "diffuse"))
"""Layers that contain linear radiance."""


DOLP_HIGH = 0.5
"""DoLP that is drawn at full brightness. Dielectrics exceed it only near Brewster's angle."""
AOLP_FULL_DOLP = 0.1
"""DoLP above which the AoLP is drawn at full brightness. At a lower DoLP, noise dominates the angle."""
STOKES_HIGH = 0.5
"""Absolute value of S1 / S0 and of S2 / S0 that is drawn in full color."""
_SHARES = ("strength", "roughness", "metalness", "alpha")
Depths = tuple[float, float]
"""Smallest and largest depth of a color scale."""


def layer_picture(
    result: RenderResult,
    name: str,
    camera: Camera,
    depths: Depths | None = None,
    *,
    exposed: bool = False,
    presentation: Presentation = UNCHANGED,
) -> Picture | None:
    """Return a layer as an 8-bit picture, or None if the recipe lacks it.

    Args:
        result, camera: the rendering and its camera.
        name: name of the layer.
        depths: depths at the ends of the color scale of the layer depth.
        exposed: darken radiance so that at most 1 % of the pixels clip.
        presentation: color and tone curve of layers of radiance.
    """
    if name in POLARIZED:
        return polarization_picture(name, result.layers["stokes"]) if "stokes" in result.layers else None
    values = result.layers.get(name)
    if values is None:
        return None
    if name in RADIANCE:
        values = colored(values, presentation.color)
        if exposed:
            values = values * clipping_exposure(values)
        return radiance_to_rgb(with_tone_curve(values, presentation.tone_curve))
    if name == "depth":
        there = result.alpha > 0.5
        return depth_picture(torch.where(there, values, 0.0), depths or depth_range(values, there))
    if name == "normal":
        return normal_to_rgb(values, camera)
    return scalar_to_rgb(values, 0.0, 1.0)


def polarization_picture(name: str, stokes: Tensor) -> Picture:
    """Convert the luminance of Stokes vectors [3, H, W, C] to the picture that ``name``, one of ``POLARIZED``, selects.

    The vectors are predicted or measured. The picture ``stokes`` shows S1 / S0 in red and S2 / S0 in green, with mid
    gray at 0.
    """
    gray = optics.luminance(stokes)
    degree = optics.dolp(gray)
    if name == "dolp":
        return dolp_to_rgb(degree, DOLP_HIGH)
    if name == "aolp":
        return aolp_to_rgb(optics.aolp(gray), degree / AOLP_FULL_DOLP)
    shares = gray[1:] / gray[0].clamp(min=1e-6)
    red, green = (0.5 + shares / (2 * STOKES_HIGH)).unbind(0)
    return shares_to_rgb(torch.stack((red, green, torch.full_like(red, 0.5)), dim=-1))


def depth_picture(depth: Tensor, depths: Depths) -> Picture:
    """Convert depths [H, W] to colors on a logarithmic scale. Pixels without a depth are black."""
    near, far = (math.log(end) for end in depths)
    logs = torch.where(depth > 0, depth.double().clamp(min=1e-12).log(), math.nan)
    return scalar_to_rgb(logs, near, far)


def layer_scale(name: str, depths: Depths | None = None) -> Picture | None:
    """Return the legend of a layer, 256 pixels wide.

    Return None for radiance, which needs no legend, and for depth without ``depths``.
    """
    name = name.partition(",")[0]
    if name in _SHARES:
        return scale_bar(0.0, 1.0, "viridis")
    if name == "depth" and depths is not None:
        near, far = (float(f"{end:.3g}") for end in depths)
        return scale_bar(near, far, "viridis", "units", middle=f"{math.sqrt(near * far):.3g}")
    if name == "dolp":
        return scale_bar(0.0, DOLP_HIGH, "inferno")
    if name == "stokes":
        return color_patch(128, f"0; red S1, green S2, to {STOKES_HIGH:g} S0")
    if name == "aolp":
        return angle_wheel()
    return normal_ball() if name == "normal" else None


def clipping_exposure(values: Tensor) -> float:
    """Return the largest factor, at most 1, with which under 1 % of the pixels of radiance [H, W, 3] exceed 1."""
    brightest = values.detach().nan_to_num(0.0, 0.0, 0.0).amax(dim=-1).flatten().sort().values
    limit = float(brightest[max(0, brightest.numel() - 1 - brightest.numel() // 128)])
    return min(1.0, 1.0 / limit) if limit > 0 else 1.0


_SAMPLES = 1_000_000
"""Largest number of depths from which quantiles are computed. PyTorch accepts at most 16 million."""


def depth_range(depth: Tensor, mask: Tensor) -> Depths:
    """Return the range of the masked depths without the nearest 2 % and the farthest 2 %.

    ``depth`` and ``mask`` have the same shape.
    """
    values = depth[mask & (depth > 0)]
    if values.numel() == 0:
        return 1.0, 2.0
    values = values[:: max(1, values.numel() // _SAMPLES)]
    near = max(float(values.quantile(0.02)), 1e-6)
    return near, max(float(values.quantile(0.98)), 1.001 * near)


def true_depths(view: View) -> Tensor | None:
    """Return the true depths of a view, with 0 at pixels without a surface. Return None if they are unknown."""
    truth = view.ground_truth
    return None if truth is None or truth.depth is None else truth.depth


def true_name(name: str) -> str:
    """Return the name of a layer's ground truth. The ground truth of the final layer is the photograph."""
    return "photograph" if name == "final" else f"{name}, true"


def reference_pictures(
    view: View, presentation: Presentation = UNCHANGED, depths: Depths | None = None
) -> dict[str, Picture]:
    """Return reference pictures of a view's layers, 8-bit.

    The result contains the photograph as ``photograph``, the ground truth of other layers as ``NAME, true``, and
    measured polarization as ``NAME, measured``.

    Args:
        presentation, depths: see ``layer_picture``.
    """
    pictures = {
        true_name(name): picture
        for name, picture in ground_truth_pictures(view, presentation, depths).items()
    }
    if view.is_determined:
        stokes = view.stokes()
        pictures |= {f"{name}, measured": polarization_picture(name, stokes) for name in POLARIZED}
    return pictures


def ground_truth_pictures(
    view: View, presentation: Presentation = UNCHANGED, depths: Depths | None = None
) -> dict[str, Picture]:
    """Return the photograph as ``final`` and the ground truth of other layers as 8-bit pictures.

    The result contains depth only if ``depths`` is specified.
    """
    pictures = {"final": radiance_to_rgb(presentation.displayed(view.photograph()))}
    ground_truth = view.ground_truth
    if ground_truth is None:
        return pictures
    if ground_truth.normal is not None:
        pictures["normal"] = normal_to_rgb(ground_truth.normal, view.camera)
    for name, layer in (("specular", ground_truth.specular), ("diffuse", ground_truth.diffuse)):
        if layer is not None:
            pictures[name] = radiance_to_rgb(presentation.displayed(layer / 2))
    if ground_truth.depth is not None and depths is not None:
        pictures["depth"] = depth_picture(ground_truth.depth, depths)
    return pictures
