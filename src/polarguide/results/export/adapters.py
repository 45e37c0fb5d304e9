"""Conversion of shading models to exported files: fields of a PLY file and data of a web page.

The class of the model selects the function. A plug-in registers functions for its own class with
``@ply_fields.register`` and ``@page_shading.register``.
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
from polarguide.shading.cubemap import box_mips, ggx_alpha, gltf_roughness
from polarguide.shading.deferred import LOCAL_NOTE, DeferredShading
from polarguide.shading.directional import DirectionalShading
from polarguide.shading.model import Light, PlainShading, ShadingModel
from polarguide.shading.surface import surface_channels

INDEX_NOTE = (
    "This page has one refractive index. Surfaces with another index have the same reflectance at 45 degrees."
)
SURROUNDINGS_NOTE = (
    "The far surroundings have the same color from all directions on this page, unlike in the program."
)


@dataclass(frozen=True, eq=False)
class PageShading:
    """Data with which an exported web page shades Gaussians.

    Attributes:
        kind: preprocessor symbol that selects the code in the page's shaders, in lower case.
        values: values of the Gaussians, [N, ...], by name. ``results.export.web_page.SLOTS`` lists the names.
        light: cubemaps [6, R, R, C], finest first.
        network: matrices [rows, columns] in the order of the shaders.
        constants: additional entries of the page's scene, plain JSON values.
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
    """Return additional fields of a PLY file, [N, ...] by name.

    They are linear harmonics and surface properties. The display colors are always written.
    """
    harmonics = {"linear_dc": gaussians["sh_dc"], "linear_rest": gaussians["sh_rest"].flatten(1)}
    return harmonics | {row.name: row.values(gaussians) for row in shading.surface}


@ply_fields.register
def _(shading: DeferredShading, gaussians: Parameters) -> dict[str, Tensor]:
    """Return the blur as glTF's ``roughness``, and the ``refractive_index`` if it varies."""
    fields = ply_fields.dispatch(ShadingModel)(shading, gaussians)
    own = surface_channels(shading.surface, gaussians)
    fields.pop("index", None)
    if "reflectance" in fields:
        fields["reflectance"] = fields.pop("reflectance")  # keeps the order of earlier files
    if fields.pop("blur", None) is not None:
        blur = own["blur"][:, 0] if "blur" in own else torch.zeros_like(fields["strength"])
        fields["roughness"] = gltf_roughness(blur, shading.environment_resolution)
    if "index" in own:
        fields["refractive_index"] = shading.refractive_index + gaussians["index_offset"]
    return fields


@singledispatch
def page_shading(shading: ShadingModel, gaussians: Parameters, light: Light) -> PageShading | None:
    """Return the data with which a page shades Gaussians.

    Return None if the page has no shaders for the model. Then the colors are baked into the Gaussians.
    """
    return None


def _harmonics(gaussians: Parameters) -> dict[str, Tensor]:
    return {"color": gaussians["sh_dc"], "harmonics": gaussians["sh_rest"]}


@page_shading.register
def _(shading: PlainShading, gaussians: Parameters, light: Light) -> PageShading | None:
    """Return the harmonics of the colors."""
    return PageShading("plain", _harmonics(gaussians))


@page_shading.register
def _(shading: DeferredShading, gaussians: Parameters, light: Light) -> PageShading | None:
    """Return harmonics, reflection strength and texels of the environment, and for metals reflectance and blur."""
    own = surface_channels(shading.surface, gaussians)
    if not shading.local and (shading.rough or "metalness" in own):
        return None  # No recipe has such surfaces.
    strength = own["strength"][:, 0]
    notes = [LOCAL_NOTE] if shading.local else []
    index = shading.refractive_index
    if "index" in own:
        indices = index + own["index"][:, 0]
        index = float(indices.max())  # Strengths decrease and stay below 1.
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
    """Return twice the reflectance of a dielectric at 45 degrees."""
    s, p = reflectances_from_cosine(torch.tensor(math.sqrt(0.5)), index)
    return s + p


@page_shading.register
def _(shading: DirectionalShading, gaussians: Parameters, light: Light) -> PageShading | None:
    """Return albedo, roughness, features, the levels of the grid, and the MLP.

    The record of a Gaussian has space for either features or harmonics. So a Gaussian of the surroundings has its mean
    color instead of harmonics, and its features are zero. The page recognizes the surroundings by their zero features.
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
