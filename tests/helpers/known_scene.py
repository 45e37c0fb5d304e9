"""A scene of two views of which everything is known, made of random numbers: for scores that loops can check."""

from pathlib import Path

import numpy as np
import torch
from random_runs import ring
from torch import Tensor

from polarguide.capture import GroundTruth, Scene, View
from polarguide.capture.metadata import Material, SceneObject
from polarguide.geometry.camera import Camera
from polarguide.shading.result import RenderResult

HEIGHT, WIDTH = 20, 26
OBJECTS = (
    SceneObject(1, "ground", foreground=False, material=Material("pplastic", 0.3, 1.5)),
    SceneObject(2, "cup", material=Material("plastic", 0.05, 1.5)),
    SceneObject(3, "spoon", material=Material("metal", 0.05)),
    SceneObject(4, "cloth", material=Material("plastic", 0.4, 1.5)),
    SceneObject(7, "clay", material=Material("matte")),
)
NAMES = ("v0", "v1")


def known_view(name: str, camera: Camera, seed: int) -> View:
    """Random light and random truth; rows belong to objects: none, ground, cup, spoon, cloth (v0) or clay (v1)."""
    rng = np.random.default_rng(seed)
    s0 = rng.uniform(0.2, 0.8, (HEIGHT, WIDTH, 3))
    s1, s2 = (rng.uniform(-0.15, 0.15, (HEIGHT, WIDTH, 3)) for _ in range(2))
    codes = np.rint(65535 / 2 * np.stack((s0 + s1, s0 + s2, s0 - s1, s0 - s2))).astype(np.uint16)
    ids = np.repeat(np.array([0, 1, 2, 3, 4 if name == "v0" else 7], np.int32), 4)[:, None] + np.zeros(
        WIDTH, int
    )
    invalid, saturated = np.zeros((2, HEIGHT, WIDTH), bool)
    invalid[9:11, 3:8] = True
    saturated[12:15, 10:20] = True
    normal = rng.normal(size=(HEIGHT, WIDTH, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal[8, 20:24] = 0
    share = rng.uniform(0.1, 0.9, (HEIGHT, WIDTH, 1))
    truth = GroundTruth(
        normal=torch.from_numpy(normal).float(),
        depth=torch.from_numpy(np.where(ids > 0, 3 + 0.01 * rng.uniform(size=ids.shape), 0)).float(),
        mask=torch.from_numpy(ids >= 2),
        specular=torch.from_numpy(s0 * share).float(),
        diffuse=torch.from_numpy(s0 * (1 - share)).float(),
        object_ids=torch.from_numpy(ids.astype(np.int32)),
    )
    return View(name, camera, *(torch.from_numpy(a) for a in (codes, invalid, saturated)), None, truth)


def known_scene() -> Scene:
    """Both views are test views."""
    cameras = ring(2, width=WIDTH, height=HEIGHT)
    views = tuple(known_view(name, cameras[name], seed) for seed, name in enumerate(NAMES))
    return Scene(
        root=Path("known"),
        name="known",
        views=views,
        test_names=NAMES,
        points=torch.zeros(0, 3),
        point_colors=torch.zeros(0, 3, dtype=torch.uint8),
        refractive_index=1.5,
        downscale=1,
        transfer="linear",
        digest="known",
        warnings=(),
        objects=OBJECTS,
    )


def rendered(view: View, seed: int) -> tuple[RenderResult, Tensor, Tensor]:
    """A rendering that is wrong everywhere, its Stokes vectors, and the weight in front of the surface."""
    generator = torch.Generator().manual_seed(seed)
    truth = view.ground_truth

    def noisy(values: Tensor, size: float) -> Tensor:
        return values + size * (torch.rand(values.shape, generator=generator) - 0.5)

    layers = {
        "final": noisy(view.photograph(), 0.2),
        "normal": noisy(truth.normal, 0.8),
        "specular": noisy(truth.specular / 2, 0.2),
        "diffuse": noisy(truth.diffuse / 2, 0.2),
        "depth": noisy(truth.depth, 0.3),
        "alpha": torch.rand(HEIGHT, WIDTH, generator=generator),
    }
    stokes = torch.rand(3, HEIGHT, WIDTH, 3, generator=generator) * 0.2 - 0.1
    return RenderResult(layers), stokes, torch.rand(HEIGHT, WIDTH, generator=generator)
