"""The Python interface: ``polarguide.load(RUN)``."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

from torch import Tensor

from polarguide.camera import Camera
from polarguide.capture import Scene, load_scene
from polarguide.errors import PolarguideError
from polarguide.evaluation.record import read_metrics
from polarguide.raster import DeviceName
from polarguide.runs.opened import TrainedRun, open_trained
from polarguide.shading.result import LAYERS, RenderResult

__all__ = ["LAYERS", "Model", "PolarguideError", "load"]


class Model:
    """A trained run.

    Example:
        >>> model = polarguide.load("runs/demo")                    # doctest: +SKIP
        >>> layers = model.render("v000", layers=["final", "normal"])  # doctest: +SKIP
        >>> layers["final"].shape                                   # doctest: +SKIP
        torch.Size([96, 128, 3])

    Args:
        run: what ``open_trained`` gives.
        scene: folder of the scene, where it is not the one that the run names.
    """

    def __init__(self, run: TrainedRun, scene: Path | None = None) -> None:
        self._run = run
        self._scene_folder = scene or Path(run.configuration.scene)

    def __repr__(self) -> str:
        return f"<Model {self.folder}: {self.recipe}, {self.steps} steps, {len(self._run.state.gaussians)} Gaussians>"

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self._run.folder

    @property
    def recipe(self) -> str:
        """Name of the recipe that it was trained with."""
        return self._run.configuration.recipe

    @property
    def steps(self) -> int:
        """How many steps it has been trained for."""
        return self._run.state.step

    @property
    def gaussians(self) -> dict[str, Tensor]:
        """The rows by name, one row a Gaussian: ``means`` [N, 3], ``log_scales`` [N, 3], ... Not to be written to."""
        return {name: self._run.state.gaussians[name].detach() for name in self._run.state.gaussians.names}

    @property
    def light(self) -> dict[str, Tensor]:
        """The learned light's parameters, such as ``texels`` [6, R, R, C] raw; empty for a recipe without."""
        return {name: values.detach() for name, values in self._run.light.items()}

    @cached_property
    def scene(self) -> Scene:
        """The scene it was trained on, read when it is first asked for.

        Raises:
            PolarguideError: it is not there any more, or cannot be read.
        """
        configuration = self._run.configuration
        return load_scene(
            self._scene_folder, downscale=configuration.downscale, transfer=configuration.transfer
        )

    @property
    def cameras(self) -> dict[str, Camera]:
        """Cameras of the scene's views by name; reads the scene."""
        return {view.name: view.camera for view in self.scene.views}

    def result(self, camera: Camera | str) -> RenderResult:
        """Everything that can be rendered, as one typed record. ``camera``: any, or the name of a view."""
        chosen = self.scene.view(camera).camera if isinstance(camera, str) else camera
        return self._run.render_camera(chosen, depth=True)

    def render(self, camera: Camera | str, layers: Iterable[str] = ("final",)) -> dict[str, Tensor]:
        """Layers of a picture.

        Args:
            camera: any camera, or the name of a view (then the scene is read).
            layers: names in ``LAYERS``.

        Returns:
            By name: linear radiance [H, W, 3], world normals [H, W, 3] of any length, or [H, W] for strength, depth and
            alpha.

        Raises:
            PolarguideError: there is no such layer, or this recipe has not got it.
        """
        names = [layers] if isinstance(layers, str) else list(layers)
        for name in names:
            if name not in LAYERS:
                raise PolarguideError(
                    "layers",
                    expected="any of " + ", ".join(LAYERS),
                    found=repr(name),
                    remedy="Correct the name.",
                )
        result = self.result(camera)
        found: dict[str, Tensor] = {}
        for name in names:
            values = getattr(result, name)
            if values is None:
                raise PolarguideError(
                    "layers",
                    expected=f"a layer of the recipe {self.recipe}",
                    found=f"{name}, which it has not",
                    remedy="Leave it out.",
                )
            found[name] = values
        return found

    def metrics(self) -> Mapping[str, Any]:
        """The record that ``polarguide eval`` wrote: means over the test views, and ``views`` by name.

        Raises:
            PolarguideError: the run has not been scored, or the file is not such a record.
        """
        return read_metrics(self.folder)


def load(
    run: str | os.PathLike[str],
    *,
    scene: str | os.PathLike[str] | None = None,
    device: DeviceName = "auto",
) -> Model:
    """Open a run folder.

    Args:
        run: what ``polarguide train --out`` wrote.
        scene: folder of the scene, where it has moved since; read only if its cameras or pictures are asked for.
        device: what to compute on.

    Raises:
        PolarguideError: it is no run folder, is damaged, or belongs to another version.
    """
    return Model(open_trained(Path(run), device=device), None if scene is None else Path(scene))
