"""Shading models in exported files: fields of a PLY, and the data of a web page, by the class of the model.

A plug-in registers functions for its own class: ``@ply_fields.register`` and ``@page_shading.register``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import singledispatch
from typing import Any

import torch
from torch import Tensor

from polarguide.gaussians.gaussians import Parameters
from polarguide.gaussians.harmonics import SH_C0
from polarguide.optics import reflectances_from_cosine
from polarguide.shading.cubemap import box_mips
from polarguide.shading.deferred import LOCAL_NOTE, DeferredShading
from polarguide.shading.directional import DirectionalShading, albedo_of
from polarguide.shading.model import Light, PlainShading, ShadingModel
from polarguide.shading.roughness import ggx_alpha, gltf_roughness
from polarguide.shading.surface import surface_channels

INDEX_NOTE = "Surfaces of several refractive indices are drawn with one that reflects as much at 45 degrees."
SURROUNDINGS_NOTE = "The far surroundings have one color from all sides here; in the program they vary."


@dataclass(frozen=True, eq=False)
class PageShading:
    """Data by which an exported page shades Gaussians as the model does.

    Attributes:
        kind: the page's shaders are compiled with its name, in capitals, defined.
        values: per Gaussian, by the names of ``results.export.share.SLOTS``, [N, ...].
        light: cubemaps [6, R, R, C], the finest first.
        network: matrices [rows, columns] in the order in which the shaders read them.
        constants: further entries of the page's scene, plain JSON values.
        notes: sentences for readers of the page.
    """

    kind: str
    values: Mapping[str, Tensor]
    light: Sequence[Tensor] = ()
    network: Sequence[Tensor] = ()
    constants: Mapping[str, Any] = field(default_factory=dict)
    notes: Sequence[str] = ()


@singledispatch
def ply_fields(shading: ShadingModel, gaussians: Parameters) -> dict[str, Tensor]:
    """Return the fields of a PLY besides display colors, [N, ...] by name: linear harmonics and surface properties."""
    harmonics = {"linear_dc": gaussians["sh_dc"], "linear_rest": gaussians["sh_rest"].flatten(1)}
    return harmonics | {row.name: row.values(gaussians) for row in shading.surface}


@ply_fields.register
def _(shading: DeferredShading, gaussians: Parameters) -> dict[str, Tensor]:
    """The blur as glTF's ``roughness``, and the ``refractive_index`` where Gaussians have several."""
    fields = ply_fields.dispatch(ShadingModel)(shading, gaussians)
    own = surface_channels(shading.surface, gaussians)
    fields.pop("index", None)
    if fields.pop("blur", None) is not None:
        blur = own["blur"][:, 0] if "blur" in own else torch.zeros_like(fields["strength"])
        fields["roughness"] = gltf_roughness(blur, shading.environment_resolution)
    if "index" in own:
        fields["refractive_index"] = shading.refractive_index + gaussians["index_offset"]
    return fields


@ply_fields.register
def _(shading: DirectionalShading, gaussians: Parameters) -> dict[str, Tensor]:
    """Harmonics, which count where ``surface`` is 0; ``albedo``, ``roughness``, ``feature`` and ``surface``."""
    return {
        **ply_fields.dispatch(ShadingModel)(shading, gaussians),
        "albedo": albedo_of(gaussians),
        "roughness": torch.sigmoid(gaussians["roughness_logits"]),
        "feature": torch.tanh(gaussians["features"]),
        "surface": gaussians["surface"],
    }


@singledispatch
def page_shading(shading: ShadingModel, gaussians: Parameters, light: Light) -> PageShading | None:
    """Return the data of an exported page; None where it has no shaders for the model (colors are then baked)."""
    return None


def _harmonics(gaussians: Parameters) -> dict[str, Tensor]:
    """The base color's harmonics as values of a page."""
    return {"color": gaussians["sh_dc"], "harmonics": gaussians["sh_rest"]}


@page_shading.register
def _(shading: PlainShading, gaussians: Parameters, light: Light) -> PageShading | None:
    """Harmonics alone."""
    return PageShading("plain", _harmonics(gaussians))


@page_shading.register
def _(shading: DeferredShading, gaussians: Parameters, light: Light) -> PageShading | None:
    """Harmonics, strength and texels; of metals also their reflectance and blur."""
    own = surface_channels(shading.surface, gaussians)
    if not shading.local and (shading.rough or "metalness" in own):
        return None  # no recipe has such surfaces, and the page no shaders for them
    strength = own["strength"][:, 0]
    notes = [LOCAL_NOTE] if shading.local else []
    index = shading.refractive_index
    if "index" in own:
        indices = index + own["index"][:, 0]
        index = float(indices.max())  # so that strengths become less, never more than 1
        strength = strength * _at_45_degrees(indices) / _at_45_degrees(index)
        notes.append(INDEX_NOTE)
    values = {**_harmonics(gaussians), "share": strength}
    constants: dict[str, Any] = {"blend": shading.blend, "index": index}
    if shading.local:
        values |= {"own_color": gaussians["local_dc"], "own_harmonics": gaussians["local_rest"]}
    if "blur" in own:
        values["blur"] = own["blur"][:, 0]
        constants["mirror"] = float(ggx_alpha(torch.zeros(()), shading.environment_resolution))
    if "metalness" in own:
        values["metal"] = own["reflectance"]
        constants["metal"] = True
    return PageShading(
        kind="local" if shading.local else "reflection",
        values=values,
        light=shading.light_levels(light["texels"], rough="blur" in own),
        constants=constants,
        notes=notes,
    )


def _at_45_degrees(index: Tensor | float) -> Tensor:
    """Twice the reflectance of a dielectric at 45 degrees."""
    s, p = reflectances_from_cosine(torch.tensor(math.sqrt(0.5)), index)
    return s + p


@page_shading.register
def _(shading: DirectionalShading, gaussians: Parameters, light: Light) -> PageShading | None:
    """Albedo, blur, features; the grid's levels and the MLP.

    A record has no room for features and harmonics: the surroundings have their mean color and no features, by
    which the page knows them.
    """
    fields = ply_fields(shading, gaussians)
    surface = gaussians["surface"]
    mean_color = (gaussians["sh_dc"] * SH_C0 + 0.5).clamp(min=0)
    layers = range(3)
    return PageShading(
        kind="directional",
        values={
            "color": torch.where(surface[:, None] > 0, fields["albedo"], mean_color),
            "share": surface * fields["roughness"],
            "features": surface[:, None] * fields["feature"],
        },
        light=box_mips(light["texels"]),
        network=[m for k in layers for m in (light[f"mlp_weight_{k}"], light[f"mlp_bias_{k}"][None])],
        constants={"width": shading.width},
        notes=[] if bool((surface > 0).all()) else [SURROUNDINGS_NOTE],
    )
