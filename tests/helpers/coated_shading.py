"""A surface property as a plug-in has it: a clear coat, which adds to the mirror image. No other file knows of it."""

from dataclasses import dataclass, replace
from typing import Any

import torch

from polarguide.geometry.camera import Camera
from polarguide.methods import RECIPES
from polarguide.shading.deferred import DeferredShading
from polarguide.shading.model import GBuffer, Light
from polarguide.shading.surface import GltfTexture, SurfaceProperty

CLEARCOAT = SurfaceProperty(
    "clearcoat",
    "clearcoat_logits",
    activation=torch.sigmoid,
    inverse=torch.logit,
    initial=0.3,
    rate=0.05,
    gltf=GltfTexture("KHR_materials_clearcoat", "clearcoatTexture", {"clearcoatFactor": 1.0}),
)


@dataclass(frozen=True)
class CoatedShading(DeferredShading):
    """final = base + strength F(i) light + 0.04 clearcoat light."""

    @property
    def surface(self) -> tuple[SurfaceProperty, ...]:
        return (*super().surface, CLEARCOAT)

    def shade(self, splatted: GBuffer, light: Light, camera: Camera) -> dict[str, Any]:
        layers = super().shade(splatted, light, camera)
        coat = 0.04 * layers["clearcoat"][..., None] * layers["reflection"]
        return layers | {name: layers[name] + coat for name in ("final", "specular")}


_BASE = RECIPES["polarguide"]
COATED = replace(
    _BASE,
    name="coated",
    about="Surfaces with a clear coat.",
    shading=CoatedShading("fresnel", environment_resolution=16),
)
