"""A small scene for the viewer: random Gaussians, and photographs rendered from them."""

import torch
from random_runs import random_state, ring

from polarguide.capture import View
from polarguide.geometry.camera import Camera
from polarguide.geometry.scene_frame import SceneFrame, scene_frame
from polarguide.raster.cpu import rasterize_cpu
from polarguide.viewer import Scenery
from polarguide.viewer.scenery import Photograph


def shown(recipe: str = "polarguide-stokes") -> Scenery:
    state, shading = random_state(recipe)
    return Scenery(state.gaussians, state.light, shading, rasterize_cpu, 3, f"{recipe}, a test")


def frame_of_scene() -> SceneFrame:
    return scene_frame(list(ring().values()))


def photograph(name: str, camera: Camera, seen: Scenery) -> Photograph:
    """A photograph of the scene as it is rendered, polarized along the rows of the picture."""
    picture = seen.render(camera, depth=False).final.clamp(0, 0.6)
    factors = torch.tensor([1.3, 1.0, 0.7, 1.0])[:, None, None, None]
    codes = (factors * picture * 65535).round().to(torch.uint16)
    nowhere = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    small = (picture[::4, ::4] * 255).to(torch.uint8).numpy()
    return Photograph(View(name, camera, codes, nowhere, nowhere), small, held_out=name == "v0")


def photographs(seen: Scenery) -> dict[str, Photograph]:
    return {name: photograph(name, camera, seen) for name, camera in ring().items()}
