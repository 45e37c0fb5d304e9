"""Normals without polarization: a short training on the photographs, kept in a folder so that it goes on.

The photograph is the mean of the four pictures, which is the same in every order of them; so what comes out may be
compared with the AoLP without begging the question, and stays good after the order is put right.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from polarguide import __version__
from polarguide.capture import Scene, View
from polarguide.capture.exposures import FOUR
from polarguide.core.errors import PolarguideError
from polarguide.core.files import write_text
from polarguide.core.records import read_record
from polarguide.geometry.vectors import dot, unit
from polarguide.inspection.evidence import Surface
from polarguide.raster import Backend
from polarguide.recipes import recipe_named
from polarguide.runs.defaults import resolve
from polarguide.runs.folder import CHECKPOINT, load_checkpoint, save_checkpoint
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.training.angles.trainer import AngleTrainer
from polarguide.training.losses import depth_normals
from polarguide.training.priors import guide_normals
from polarguide.training.recipe import Priors, Recipe
from polarguide.training.settings import StepReport, TrainSettings
from polarguide.training.state import TrainingState

RECIPE = "3dgs-dr:consistent"
LONGEST = 160
"""Pixels of the longer side that the training's pictures are averaged down to (by a whole factor)."""
KEY = "short_run.json"
SAVE_EVERY = 100
_OPAQUE = 0.9
_AGREEMENT = 0.9


def photograph_digest(scene: Scene) -> str:
    """SHA-256 over what the short training sees: photographs, poses, points. No order of the pictures changes it."""
    digest = hashlib.sha256(scene.points.numpy().tobytes())
    for view in scene.train_views:
        camera = view.camera
        digest.update(view.codes.to(torch.int32).sum(dim=0).numpy().tobytes())
        digest.update(view.invalid.numpy().tobytes())
        digest.update(camera.rotation.numpy().tobytes() + camera.translation.numpy().tobytes())
        digest.update(repr((view.name, camera.fx, camera.fy, camera.cx, camera.cy)).encode())
        if view.exposures != FOUR:
            digest.update(repr(view.exposures).encode())
    return digest.hexdigest()


def short_run(
    scene: Scene,
    folder: Path,
    *,
    steps: int,
    backend: Backend,
    on_step: Callable[[StepReport], None],
    refractive_index: float | None = None,
    recipe: Recipe | None = None,
    until: int = 0,
) -> TrainingState:
    """Train, or go on, or take what is there.

    Args:
        scene: at the size to train at.
        folder: where its state is kept; one of another scene or length is replaced.
        steps: optimizer steps.
        backend: device and rasterizer.
        on_step: called after every step.
        refractive_index: of the surfaces; None: that of the scene.
        recipe: what trains; None: ``RECIPE``.
        until: the step to stop after; 0: the last.
    """
    if recipe is None:
        named = recipe_named(RECIPE)
        assert isinstance(named, Recipe)
        recipe = named
    asked = TrainSettings(steps, 0, refractive_index, begin_again=False)
    settings = resolve(asked, scene, recipe)
    wanted = {
        "photographs": photograph_digest(scene),
        "steps": steps,
        "recipe": recipe.name,
        "refractive_index": settings.refractive_index,
        "version": __version__,
    }
    until = until or steps
    state = load_checkpoint(folder, recipe, backend.device) if _same(folder, wanted) else None
    trainer = AngleTrainer(scene, recipe, settings, backend, state)
    if state is None:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / CHECKPOINT).unlink(missing_ok=True)
        write_text(folder / KEY, json.dumps(wanted))
    try:
        while trainer.state.step < until:
            on_step(trainer.step())
            if trainer.state.step % SAVE_EVERY == 0 or trainer.state.step == until:
                save_checkpoint(folder, trainer.state)
    except KeyboardInterrupt:
        if trainer.whole:
            save_checkpoint(folder, trainer.state)
        raise
    return trainer.state


def _same(folder: Path, wanted: dict[str, object]) -> bool:
    """Whether the folder holds a readable state of the same training."""
    try:
        return read_record(folder / KEY, dict[str, Any]) == wanted and (folder / CHECKPOINT).exists()
    except PolarguideError:
        return False


@torch.no_grad()
def surface_of(state: TrainingState, view: View, backend: Backend) -> Surface:
    """The surface of the trained Gaussians in one view, on the CPU, where pictures are compared with it."""
    request = RenderRequest(sh_degree=0, depth=True)
    result = render(state.gaussians, view.camera, backend.rasterize, request).to("cpu")
    if result.normal is None or result.depth is None:
        raise PolarguideError(
            view.name, expected="normals and depth", found="none", remedy="Report this: it is a fault here."
        )
    rays = view.camera.rays()
    normal, known = guide_normals(view.camera.to_camera(result.normal), rays, Priors.minimum_normal)
    by_depth = unit(view.camera.to_camera(depth_normals(result.depth, view.camera)))
    known = known & (result.alpha > _OPAQUE) & (dot(normal, by_depth) > _AGREEMENT)
    return Surface(view.camera, normal, result.depth, known)
