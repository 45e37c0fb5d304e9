"""What several verbs share: the console, loading with a progress bar, opening a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from polarguide import _native
from polarguide.camera import Camera
from polarguide.capture import Scene, View, load_scene
from polarguide.cli.console import console as console
from polarguide.cli.progress import ConsoleReporter
from polarguide.errors import PolarguideError
from polarguide.raster import DeviceName
from polarguide.runs.folder import recipe_data
from polarguide.runs.opened import TrainedRun, open_trained
from polarguide.shading.result import RenderResult

Transfer = Literal["linear", "srgb"]


def use_threads(threads: int) -> None:
    """Use this many threads everywhere; 0 leaves the defaults."""
    if threads < 0:
        raise PolarguideError("--threads", expected="0 or more", found=str(threads), remedy="Give a count.")
    if threads:
        _native.set_thread_count(threads)
        torch.set_num_threads(threads)


def read_scene(path: Path, *, downscale: int, transfer: Transfer) -> Scene:
    """Load a scene with a progress bar and print its warnings."""
    if downscale < 1:
        raise PolarguideError(
            "--downscale", expected="1 or more", found=str(downscale), remedy="Give a whole factor."
        )
    reporter = ConsoleReporter()
    scene = load_scene(path, downscale=downscale, transfer=transfer, reporter=reporter)
    for warning in scene.warnings:
        reporter.warn(warning)
    return scene


@dataclass(frozen=True, eq=False)
class OpenRun(TrainedRun):
    """A trained run with its scene."""

    scene: Scene

    @property
    def cameras(self) -> dict[str, Camera]:
        """Cameras of the scene's views by name."""
        return {view.name: view.camera for view in self.scene.views}

    def render(self, view: View, *, normals: bool = True, depth: bool = False) -> RenderResult:
        """All layers of a view, on the CPU; ``normals`` where the recipe can do without, and ``depth``, on request."""
        return self.draw(view, normals=normals, depth=depth).to("cpu")

    def draw(self, view: View, *, normals: bool = True, depth: bool = False) -> RenderResult:
        """``render``, left on the backend's device, which may not be done with it yet."""
        return self.render_camera(view.camera, normals=normals, depth=depth)


def open_run(folder: Path, *, device: DeviceName = "auto", scene: Scene | None = None) -> OpenRun:
    """Open a run folder and the scene it was trained on, unless that is at hand already."""
    run = open_trained(folder, device=device, say=console.print)
    configuration, recipe = run.configuration, run.recipe
    if scene is None:
        transfer: Transfer = "srgb" if configuration.transfer == "srgb" else "linear"
        scene = read_scene(Path(configuration.scene), downscale=configuration.downscale, transfer=transfer)
    if scene.digest != configuration.scene_digest:
        ConsoleReporter().warn(f"{configuration.scene} has changed since {folder} was trained on it.")
    if recipe_data(recipe) != configuration.recipe_data:
        ConsoleReporter().warn(
            f"{folder} was trained with other values of the recipe {recipe.name} than this version has; its pictures "
            "are shaded with this version's."
        )
    return OpenRun(folder, configuration, recipe, run.state, run.backend, scene)


def select_views(scene: Scene, choice: str) -> tuple[View, ...]:
    """The views that ``--views`` names: ``test``, ``train``, ``all``, or names separated by commas."""
    groups = {"test": scene.test_views, "train": scene.train_views, "all": scene.views}
    if choice in groups:
        chosen = groups[choice]
    else:
        chosen = tuple(scene.view(name.strip()) for name in choice.split(",") if name.strip())
    if not chosen:
        raise PolarguideError(
            "--views", expected="at least one view", found="none", remedy="Name a view, or take train."
        )
    return chosen
