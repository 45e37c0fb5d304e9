"""Export of a run as one HTML file with its Gaussians, its learned light, and a program that shades each pixel."""

from __future__ import annotations

import base64
import gzip
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize, pad

from polarguide import __version__
from polarguide.capture import View
from polarguide.capture.presentation import STOPS, UNCHANGED, Presentation
from polarguide.core.errors import PolarguideError
from polarguide.core.files import make_folder, write_text
from polarguide.core.options import PathLike
from polarguide.core.progress import SILENT, Reporter
from polarguide.gaussians.gaussians import Parameters
from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.geometry.camera import Camera
from polarguide.geometry.camera_path import camera_record
from polarguide.geometry.scene_frame import scene_frame
from polarguide.raster.interface import MINIMUM_ALPHA
from polarguide.results.evaluation.evaluate import METRICS_FILE, read_metrics
from polarguide.results.evaluation.table import shown_metrics
from polarguide.results.export.adapters import PageShading, page_shading
from polarguide.results.export.placement import Presented
from polarguide.runs.health import Health
from polarguide.runs.model import baked_harmonics
from polarguide.runs.opened import OpenedRun
from polarguide.shading.cubemap import ringed_texels
from polarguide.shading.model import PLAIN_LAYERS, Light, ShadingModel
from polarguide.shading.result import RenderResult
from polarguide.visualization.figures import color_gradient, scalar_to_rgb
from polarguide.visualization.pages import page, page_part

PACKAGE = "polarguide.results.export"

TEXEL = 16
LOWEST_LOGARITHM = -80.0
"""Logarithm that is stored for an unknown footprint. The square of such a footprint is 0 in float32."""
HARMONICS = ("harmonics", "own_harmonics")
SLOTS = {
    "mean": (0, "3<f4"),
    "opacity": (12, "<u2"),
    "share": (14, "<u2"),
    "rotation": (16, "4<i2"),
    "scales": (24, "3<f2"),
    "harmonics_scale": (30, "<f2"),
    "color": (32, "3<f2"),
    "axis": (38, "3<i2"),
    "side": (44, "<u2"),
    "blur": (46, "<u2"),
    "features": (48, "4<i2"),
    "harmonics": (48, "45i1"),
    "own_color": (96, "3<f2"),
    "own_harmonics_scale": (102, "<f2"),
    "own_harmonics": (112, "45i1"),
    "metal": (160, "3<f2"),
}
"""First byte and NumPy type of each value in the record of a Gaussian.

A record consists of texels of 16 bytes, the size of a texel on the graphics card. A shading model selects its
values, and the record ends after the last of them. All numbers are little-endian. ``f16`` is a half float.
``u16`` and ``i16`` are unsigned and signed 16-bit fractions (of 65535 and 32767).

- Texel 0: mean 3 x float32; opacity u16; ``share`` u16 (strength, or the roughness of Ref-GS).
- Texel 1: rotation (w, x, y, z) 4 x i16; logarithms of the scales 3 x f16; scale of ``harmonics`` f16.
- Texel 2: ``color`` of degree 0 (or albedo) 3 x f16; normal axis 3 x i16; ``side`` u16; ``blur`` u16.
- Texels 3 to 5: ``harmonics`` of degrees 1 to 3, 45 signed bytes in steps of their scale. Alternatively, texel 3
  contains ``features`` 4 x i16.
- Texels 6 to 9: local light: ``own_color`` of degree 0 3 x f16, scale f16; then ``own_harmonics`` like ``harmonics``.
- Texel 10: ``metal``: reflectance 3 x f16; 0 for dielectrics.

``side`` is the logarithm of the footprint (``raster.magnification``) as a half float. Its last bit is 1 if
the normal axis points outward, and 0 if only the camera decides. Each Gaussian has its own scale of
harmonics: the largest of the 45 values is 127 steps.
"""


@torch.no_grad()
def records(
    gaussians: Parameters, values: Mapping[str, Tensor], footprints: Tensor | None = None
) -> NDArray[Any]:
    """Quantize the Gaussians for the page. Gaussians that are too faint to be rendered are left out.

    Args:
        gaussians: parameters of the Gaussians.
        values: parameters of the shading model, [N, ...], by the names of ``SLOTS``.
        footprints: [N] size of a training pixel at each Gaussian, see ``raster.magnification``, or None if unknown.

    Returns:
        [K] structured records, each padded to whole texels. They are in Morton order, so that neighboring records are
        similar.
    """
    opacity = torch.sigmoid(gaussians["opacity_logits"])
    indices = (opacity >= MINIMUM_ALPHA).nonzero()[:, 0]
    indices = indices[torch.from_numpy(curve_order(gaussians["means"][indices].numpy()))]
    axis, side = _axes(gaussians, indices)
    fields = {
        "mean": gaussians["means"][indices],
        "opacity": opacity[indices],
        "rotation": normalize(gaussians["quaternions"][indices], dim=-1),
        "scales": gaussians["log_scales"][indices],
        "axis": axis,
        **{name: value[indices] for name, value in values.items()},
    }
    harmonics = {name: harmonics_steps(fields.pop(name)) for name in HARMONICS if name in fields}
    data = np.zeros(
        len(indices), record_type([*fields, "side", *harmonics, *(f"{name}_scale" for name in harmonics)])
    )
    data["side"] = _sides(side, None if footprints is None else footprints[indices])
    for name, value in fields.items():
        data[name] = _quantized(value, data.dtype[name].base)
    for name, (steps, scale) in harmonics.items():
        data[name] = steps
        data[f"{name}_scale"] = scale
    return data


def record_type(names: Sequence[str]) -> np.dtype[Any]:
    """Return the NumPy type of a record with the named values of ``SLOTS``, padded to whole texels."""
    offsets, formats = zip(*(SLOTS[name] for name in names), strict=True)
    end = max(at + np.dtype(form).itemsize for at, form in zip(offsets, formats, strict=True))
    size = -(-end // TEXEL) * TEXEL
    return np.dtype({"names": names, "offsets": offsets, "formats": formats, "itemsize": size})


def _quantized(values: Tensor, kind: np.dtype[Any]) -> NDArray[Any]:
    """Convert values in [0, 1] or [-1, 1] to integers of a type. Values for a floating-point type are only clamped."""
    if kind.kind == "f":
        return values.clamp(-6e4, 6e4).numpy() if kind.itemsize == 2 else values.numpy()
    return np.rint(values.numpy().astype(np.float64) * np.iinfo(kind).max)


def planes(data: NDArray[Any]) -> bytes:
    """Transpose records to byte planes: the first byte of each record, then the second byte of each record, and so on.

    Neighboring records are similar, so byte planes compress well.
    """
    return np.ascontiguousarray(data.view(np.uint8).reshape(len(data), data.itemsize).T).tobytes()


def harmonics_steps(rest: Tensor) -> tuple[NDArray[np.int8], NDArray[np.float16]]:
    """Quantize harmonics [N, 15, 3] to signed bytes [N, 45] with a step size [N] for each Gaussian."""
    flat = rest.flatten(1).numpy()
    step = (np.abs(flat).max(axis=1, initial=0.0) / 127).astype("<f2")
    step = np.maximum(step, np.float16(6e-8))
    steps = np.clip(np.rint(flat / step[:, None].astype(np.float32)), -127, 127)
    return steps.astype(np.int8), step


def _axes(gaussians: Parameters, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Return the normal axes [K, 3] and their sides [K].

    The side is 1 if the axis points outward. It is 0 if the position of the camera determines the direction.
    """
    means = gaussians["means"][mask]
    origin = torch.zeros(3)
    axes = shortest_axis_normals(means, gaussians["quaternions"][mask], gaussians["log_scales"][mask], origin)
    outward = gaussians.get("outward")
    if outward is None:
        return axes, torch.zeros(len(mask))
    along = (axes * outward[mask]).sum(dim=1)
    return torch.where(along < 0, -1.0, 1.0)[:, None] * axes, (along != 0).float()


def _sides(side: Tensor, footprints: Tensor | None) -> NDArray[np.uint16]:
    """Encode footprints [K] and sides [K] in 16 bits. An unknown footprint is decoded as 0."""
    lowest = torch.full_like(side, LOWEST_LOGARITHM)
    logarithms = lowest if footprints is None else footprints.log().clamp(min=LOWEST_LOGARITHM)
    bits = logarithms.numpy().astype("<f2").view("<u2")
    return (bits & np.uint16(0xFFFE)) | side.numpy().astype("<u2")


def curve_order(means: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the indices [N] that sort points [N, 3] along a Z curve (Morton 1966) with 1,024 cells per axis."""
    if not len(means):
        return np.zeros(0, dtype=np.int64)
    low = np.quantile(means, 0.01, axis=0)
    high = np.quantile(means, 0.99, axis=0)
    cells = np.clip((means - low) / np.maximum(high - low, 1e-12) * 1023, 0, 1023).astype(np.int64)
    return curve_places(torch.from_numpy(cells)).argsort(stable=True).numpy()


def curve_places(cells: Tensor) -> Tensor:
    """Return the positions [N] of cells [N, 3], int64 below 1,024, along a Z curve."""
    code = torch.zeros(len(cells), dtype=torch.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code


SCRIPTS = (
    "algebra.js",
    "sorter.js",
    "renderer.js",
    "navigation.js",
    "controls.js",
    "presentation.js",
    "unpack.js",
    "main.js",
)
SHADERS = {
    "records": "records.glsl",
    "derive": "derive.frag",
    "splat_vert": "splat.vert",
    "splat_frag": "splat.frag",
    "full": "full.vert",
    "light": "light.glsl",
    "shade": "shade.frag",
}
LAYERS = ("final", "diffuse", "specular", "base", "strength", "normal", "metalness", "roughness")
"""Layers that the page can show, in the order of its buttons."""


class LayerTexts(NamedTuple):
    """Texts of a layer on the page: button label, description, and meaning of the darkest and the brightest color."""

    label: str
    sentence: str
    low: str = ""
    high: str = ""


WORDS = {
    "final": LayerTexts("picture", "a photograph from this pose"),
    "diffuse": LayerTexts("without gloss", "the color and shading of surfaces, without reflections"),
    "specular": LayerTexts("gloss alone", "only the reflections of surfaces"),
    "base": LayerTexts("below the gloss", "the color of the layer under the reflections"),
    "strength": LayerTexts("reflectivity", "the visible share of a surface's mirror image", "nothing", "all"),
    "normal": LayerTexts("shape", "the orientation of surfaces: red to the right, green up, blue toward you"),
    "metalness": LayerTexts("metal", "the share of metal", "no", "yes"),
    "roughness": LayerTexts("roughness", "the blur of mirror images", "mirror", "matte"),
}
"""Texts of each layer, which explain it without technical terms."""
_SHOWN_WITH = {"metalness": {"metal"}, "roughness": {"blur"}}
BAKED = (
    "This page has no shaders for the reflections of this model. Each Gaussian shows its color toward the eye, with "
    "reflections baked into spherical harmonics of degree 3, which keep broad highlights and no mirror images."
)


def share_page(
    gaussians: Parameters,
    light: Light,
    shading: ShadingModel,
    cameras: Mapping[str, Camera],
    *,
    first: str,
    title: str,
    caption: str = "",
    metrics: Sequence[tuple[str, str]] = (),
    notes: Sequence[str] = (),
    presentation: Presentation = UNCHANGED,
    footprints: Tensor | None = None,
    gloss: float = 1.0,
) -> str:
    """Return the web page of a run as HTML.

    Args:
        gaussians: the Gaussians.
        light: parameters of the learned light by name.
        shading: shading model with the refractive index of the run.
        cameras: poses by name, at least one.
        first: name of the initial pose.
        title, caption: any text; the page escapes it.
        metrics: labels and values, any text.
        notes: paragraphs before the metrics, any text.
        presentation: color, tone curve, up axis, scale and credit.
        footprints: [N] size of a training pixel at each Gaussian, see ``raster.magnification``, or None if unknown.
        gloss: factor on the brightness of the specular layer when the page shows it alone.

    Returns:
        Self-contained HTML. Its content policy forbids external requests.
    """
    shaded = page_shading(shading, gaussians, light)
    layers: Sequence[str] = shading.layers
    if shaded is None:
        shaded = baked_page(gaussians, light, shading)
        layers = PLAIN_LAYERS
    quantized = records(gaussians, shaded.values, footprints)
    shown = [
        name for name in LAYERS if name in layers and shaded.values.keys() >= _SHOWN_WITH.get(name, set())
    ]
    if shaded.constants.get("blend") == "fresnel":
        shown.remove("base")  # It equals the diffuse layer.
    scene: dict[str, Any] = {
        "kind": shaded.kind,
        "texels": quantized.itemsize // TEXEL,
        "count": len(quantized),
        "layers": shown,
        "words": {name: WORDS[name]._asdict() for name in shown},
        "gloss": gloss,
        "index": 1.5,
        "resolution": int(shaded.light[0].shape[1]) if shaded.light else 1,
        "levels": max(1, len(shaded.light)),
        **_frame(cameras, first, presentation),
        **shaded.constants,
    }
    arrays: dict[str, NDArray[np.generic] | None] = {
        "light": light_numbers(shaded.light) if shaded.light else None,
        "network": network_numbers(shaded.network) if shaded.network else None,
        "viridis": viridis(),
    }
    script = '"use strict";\n' + "\n".join(page_part(PACKAGE, name) for name in SCRIPTS)
    credit = (presentation.credit and f"© {presentation.credit}", presentation.provenance)
    return page(
        PACKAGE,
        "page.html",
        script=script,
        more=" blob:; worker-src blob:",
        version=__version__,
        title=title,
        caption=caption,
        stops=STOPS,
        color="white balance" if presentation.chart is None else "color chart",
        notes=(*notes, *shaded.notes),
        metrics=metrics,
        credit=" · ".join(text for text in credit if text),
        meta={
            "author": presentation.author,
            "dcterms.license": presentation.license,
            "dcterms.provenance": presentation.provenance,
        },
        scene=scene,
        ramp=color_gradient("viridis"),
        shaders={name: page_part(PACKAGE, file) for name, file in SHADERS.items()},
        records=_packed(planes(quantized)),
        **{name: "" if values is None else _packed(values.tobytes()) for name, values in arrays.items()},
    )


def baked_page(gaussians: Parameters, light: Light, shading: ShadingModel) -> PageShading:
    """Return the data of a page for a model without shaders: linear harmonics of baked colors, and a note."""
    dc, rest = baked_harmonics(gaussians, light, shading, present=lambda colors: colors, linear=True)
    return PageShading("plain", {"color": dc[:, 0], "harmonics": rest}, notes=[BAKED])


def _frame(cameras: Mapping[str, Camera], first: str, presentation: Presentation) -> dict[str, Any]:
    around = presentation.upright(scene_frame(list(cameras.values())))
    color = msgspec.structs.replace(presentation, exposure=None).color
    return {
        "color": None if color is None else color.flatten().tolist(),
        "exposure": presentation.exposure or 0.0,
        "toneCurve": presentation.tone_curve,
        "metersPerUnit": presentation.meters_per_unit,
        "up": around.up.tolist(),
        "center": around.center.tolist(),
        "distance": around.distance,
        "first": list(cameras).index(first),
        "cameras": [{"name": name, **camera_record(camera)} for name, camera in cameras.items()],
    }


def _packed(raw: bytes) -> str:
    return base64.b64encode(gzip.compress(raw, 9, mtime=0)).decode()


@torch.no_grad()
def light_numbers(levels: Sequence[Tensor]) -> NDArray[np.float16]:
    """Add a border to cubemaps [6, R, R, C], pad their channels to a multiple of four, and concatenate them."""
    numbers = []
    for texture in levels:
        texels = ringed_texels(texture.detach().clamp(-6e4, 6e4))
        numbers.append(pad(texels, (0, -texels.shape[-1] % 4)).flatten())
    return torch.cat(numbers).numpy().astype("<f2")


@torch.no_grad()
def network_numbers(matrices: Sequence[Tensor]) -> NDArray[np.float32]:
    """Pad the columns of matrices [rows, columns] to a multiple of four, and concatenate the matrices."""
    padded = [pad(matrix.detach(), (0, -matrix.shape[1] % 4)).flatten() for matrix in matrices]
    return torch.cat(padded).numpy().astype("<f4")


def viridis() -> NDArray[np.uint8]:
    return scalar_to_rgb(torch.arange(256.0)[None], 0.0, 255.0)[0]


def share(
    run: OpenedRun,
    path: PathLike | None = None,
    *,
    title: str = "",
    caption: str = "",
    reporter: Reporter = SILENT,
) -> Path:
    """Write a run as one self-contained web page that renders it with its reflections.

    The views of the page are the poses of the photographs. The page starts at the best view of the run.

    Args:
        run: the run; its scene is read.
        path: file to write, ending in .html; default: ``share.html`` in the run's folder.
        title: heading of the page; default: the title of the presentation or the scene's name.
        caption: text below the heading; default: the recipe and its number of steps. The page appends the kind of
            polarization.
        reporter: receives a line about removed Gaussians.

    Returns:
        The path of the file.

    Raises:
        PolarguideError: the name does not end in .html, or the scores cannot be read.
    """
    path = run.folder / "share.html" if path is None else Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise PolarguideError(
            "out", expected="a file name with the suffix .html", found=str(path), remedy="Change the suffix."
        )
    model = run.model
    views = run.scene.test_views + run.scene.train_views
    presented = Presented(run, reporter=reporter)
    scored = (run.folder / METRICS_FILE).exists()
    record = read_metrics(run.folder) if scored else None
    scores = [] if record is None else shown_metrics(record, scores_only=True)
    health = run.health
    first = _best_view(views, record, health)
    page = share_page(
        presented.gaussians,
        model.light,
        model.shading,
        {view.name: view.camera for view in views},
        first=first.name,
        title=title or presented.presentation.title or run.scene.name,
        caption=f"{caption or f'{run.recipe.name}, {run.steps:,} steps'} · polarization: {run.polarization}",
        metrics=[
            *((f"{label}, test views", text) for label, text in scores),
            ("Gaussians", f"{len(presented.gaussians['means']):,}"),
        ],
        notes=[f"Warning: {warning}" for warning in health.warnings] if health is not None else [],
        presentation=presented.presentation,
        footprints=presented.footprints,
        gloss=_gloss(run.result(first.camera, depth=False, within=presented.subject.holds)),
    )
    make_folder(path.parent)
    write_text(path, page)
    return path


def _best_view(views: Sequence[View], record: Mapping[str, Any] | None, health: Health | None) -> View:
    """Return the view with the highest PSNR in the scores or in the health check of the training.

    Return the first view if there is no PSNR.
    """
    psnr: dict[str, float | None] = {}
    if record is not None:
        psnr = {name: scores["psnr"] for name, scores in record["views"].items()}
    elif health is not None:
        psnr = {name: view.psnr for name, view in health.views.items()}
    return max(views, key=lambda view: psnr.get(view.name) or 0.0)


MOST_GLOSS = 16.0
"""Largest factor on the brightness of the specular layer. A larger factor would show the noise of dark surfaces."""


def _gloss(result: RenderResult) -> float:
    """Return the largest power of two by which the specular layer can be multiplied so that at most 1 % of it clips."""
    if "specular" not in result.layers:
        return 1.0
    brightest = result.layers["specular"].amax(dim=-1)[result.alpha > 0.5].flatten()
    limit = float(brightest.quantile(0.99)) if brightest.numel() else 1.0
    return 2.0 ** math.floor(math.log2(min(max(1.0 / max(limit, 1e-6), 1.0), MOST_GLOSS)))
