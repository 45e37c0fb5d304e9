"""One page to look at a shot: every map, and its numbers under the pointer. It asks for no other file."""

from __future__ import annotations

import base64
import math
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.shots.maps import REASONS, Reason, ShotMaps
from polarguide.shots.pictures import REASON_COLORS, drawn, kinds_of, stretch_of
from polarguide.shots.read import SurfaceMaps
from polarguide.visualization import figures
from polarguide.visualization.embedded import data_uri
from polarguide.visualization.pages import page, page_part, script_json

PAGE = "shot.html"
SIDE = 816
"""Most pixels of the longer side of what is on the page: a third of a whole sensor."""
_HIDDEN = ("zenith_diffuse", "zenith_specular_below", "zenith_specular_above")
"""Maps that the page tells in numbers alone."""
_SMALLEST_SIGMA = 1e-6
_PACKAGE = "polarguide.shots"


def shot_page(maps: ShotMaps, surface: SurfaceMaps) -> str:
    """The HTML page; all names and texts in it are escaped.

    Pictures and numbers are those of every k-th pixel each way, k such that the longer side has at most ``SIDE``;
    nothing is averaged.
    """
    step = max(1, math.ceil(max(maps.size) / SIDE))
    shown = [kind for kind in kinds_of(maps) if kind.key not in _HIDDEN]
    layers, stretches = [], []
    for kind in shown:
        values = kind.values(maps, surface)
        stretch = stretch_of(kind, values, maps)
        picture = drawn(kind, values, maps, stretch, step)
        # What is listed as lossless there stays exact; the noise of the others would make the page large.
        layers.append(data_uri(picture, "normal" if kind.look == "reason" else "", SIDE))
        stretches.append(stretch)
    height, width = maps.reason[::step, ::step].shape
    packed, scales = _numbers(maps, surface, step)
    data = {"width": width, "height": height, "step": step, "layers": layers, "numbers": packed, **scales,
            "reasons": [REASONS[code] for code in Reason]}  # fmt: skip
    w, h = maps.size
    return page(
        _PACKAGE,
        "shot.html",
        script=page_part(_PACKAGE, "shot.js").replace("$data", script_json(data)),
        title=maps.name,
        summary=f"{w} x {h} pixels" + (f"; every {step}. pixel each way is on this page" if step > 1 else ""),
        shown=list(zip(shown, stretches, strict=True)),
        gradient=figures.color_gradient,
        wheel=figures.aolp_wheel(),
        reasons={code.name.lower(): color for code, color in REASON_COLORS.items()},
        width=width,
        height=height,
        facts=_facts(maps, surface),
    )


def _numbers(maps: ShotMaps, surface: SurfaceMaps, step: int) -> tuple[str, dict[str, float]]:
    """Bytes of all numbers, plane by plane, deflated and in base64; and what they are scaled with."""

    def picked(values: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(values[::step, ::step])

    def halves(share: NDArray[Any]) -> list[NDArray[np.uint8]]:
        code = np.rint(np.clip(np.nan_to_num(share), 0, 1) * 65535).astype(np.uint16)
        return [(code >> 8).astype(np.uint8), (code & 255).astype(np.uint8)]

    def logarithmic(sigma: NDArray[Any], top: float) -> NDArray[np.uint8]:
        span = math.log(top / _SMALLEST_SIGMA)
        share = (
            np.log(np.clip(np.nan_to_num(sigma, posinf=top), _SMALLEST_SIGMA, top) / _SMALLEST_SIGMA) / span
        )
        return np.asarray(np.rint(share * 255).astype(np.uint8))

    top = max(float(maps.s0.max()), 1e-6)
    s0 = picked(maps.s0)
    planes = halves(s0 / top) + halves(picked(maps.dolp)) + halves(picked(maps.aolp) / math.pi)
    planes += [logarithmic(picked(maps.sigma_dolp), 10.0), logarithmic(picked(maps.sigma_aolp), 10.0)]
    planes += [np.rint(picked(surface.normal)[..., axis] * 127 + 128).astype(np.uint8) for axis in range(3)]
    for layer in (surface.specular_exact, surface.specular_paper):
        share = picked(layer).mean(axis=-1) / np.maximum(s0, 1e-6)
        planes.append(np.rint(np.clip(share, 0, 1) * 255).astype(np.uint8))
    planes.append(picked(maps.reason))
    data = zlib.compress(np.stack(planes).tobytes(), 6)
    return base64.b64encode(data).decode(), {
        "top": top,
        "least": _SMALLEST_SIGMA,
        "most": 10.0,
        "index": surface.refractive_index,
    }


def _facts(maps: ShotMaps, surface: SurfaceMaps) -> dict[str, str]:
    counts = np.bincount(maps.reason.ravel(), minlength=len(Reason)) / maps.reason.size
    ratio = (
        "too dark to tell" if maps.pair_ratio is None else f"{maps.pair_ratio:.4f} (1 for ideal polarizers)"
    )
    wells = f", {1 / maps.noise.slope:,.0f} electrons at full scale" if maps.noise.slope > 0 else ""
    return {
        "pixels": ", ".join(f"{code.name.lower()} {counts[code]:.1%}" for code in Reason if counts[code] > 0),
        "median DoLP": f"{float(np.median(maps.dolp[maps.measured])):.4f}" if maps.measured.any() else "none",
        **(_facts_of_set(maps) if maps.pictures else {"(I0 + I90) / (I45 + I135)": ratio}),
        "noise of a sample": f"{maps.noise.source}: {maps.noise.floor**0.5:.2%} of full scale in the dark{wells}",
        "refractive index": f"{surface.refractive_index:g}",
        "rays": "of a pinhole camera"
        if surface.perspective
        else "parallel to the axis (--intrinsics gives others)",
        "files": ", ".join(path.name for path in maps.files) or "a view of a scene",
        **({"notes": " ".join(maps.notes)} if maps.notes else {}),
    }


def _facts_of_set(maps: ShotMaps) -> dict[str, str]:
    """What the pictures of a set say of their angles, and how well they agree."""
    rows = [
        f"{fit.label}: {fit.angle:g}°"
        + (f", looks like {fit.looks_like:.1f}°" if fit.looks_like is not None else "")
        + (" (left out)" if fit.left_out else "")
        for fit in maps.pictures
    ]
    facts = {"angles": "; ".join(rows)}
    if maps.residual is not None and maps.measured.any():
        facts["median residual"] = f"{float(np.median(maps.residual[maps.measured])):.2f} (1 is noise alone)"
    return facts
