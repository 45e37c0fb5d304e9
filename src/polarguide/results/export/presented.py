"""A run as its presentation shows it, for whatever leaves it: its subject, upright, with its origin."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from polarguide.core.errors import PolarguideError, PolarguideWarning
from polarguide.core.options import Axes
from polarguide.core.progress import SILENT, Reporter
from polarguide.geometry.camera import Camera
from polarguide.results.export.placement import Origin, Placement, comments
from polarguide.results.rendering.subject import Subject, subject_of
from polarguide.runs.opened import OpenedRun
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.shading.model import Parameters
from polarguide.shading.result import RenderResult

ALL = Subject(None, "everything")


class Presented:
    """A run as its presentation shows it: the Gaussians of its subject, their placement, and the origin of files.

    Where the scene is not there any more, which tells what is up and what is the subject, it is all of the Gaussians
    in the scene's own axes, with a warning.

    Args:
        run: the run. axes: of the placement. masked: as of ``subject_of``. reporter: receives the line of ``Subject``.

    Raises:
        PolarguideError: the presentation cannot be read, or none of the Gaussians belongs to the subject.
    """

    def __init__(
        self,
        run: OpenedRun,
        *,
        axes: Axes = "upright",
        masked: bool = False,
        reporter: Reporter = SILENT,
    ) -> None:
        self.presentation = run.presentation
        self.subject = ALL
        self.poses = self._known_poses(run)
        if self.poses is not None or self.presentation.crop is not None:
            self.subject = subject_of(run, masked=masked)
        model = run.model
        self.inside = self._chosen(run, reporter)
        self.gaussians: Parameters = model.state.gaussians.only(self.inside)
        footprints = model.state.footprints
        self.footprints = None if footprints is None else footprints[self.inside]
        chosen = self.presentation.up_axis is not None
        around = run.frame if chosen or (axes == "upright" and self.poses is not None) else None
        self.placement = Placement.of(self.presentation, around)
        scene = run.configuration.scene_digest[:12]
        made_of = (
            f"{run.recipe.name}, {run.steps} steps, scene sha256 {scene}, polarization {run.polarization}"
        )
        self.origin = Origin(self.presentation, made_of)

    @staticmethod
    def _known_poses(run: OpenedRun) -> list[Camera] | None:
        """The scene's cameras; None where the scene is not there, with a warning."""
        if run.scene_is_there:
            return [*run.poses.values()]
        warnings.warn(
            f"The scene of {run.folder} is not at {run.scene_folder} any more: files lie in its own axes, with all "
            f"Gaussians, and normals are turned away from their middle, not to the nearest camera. {run.new_place}",
            PolarguideWarning,
            stacklevel=5,
        )
        return None

    def _chosen(self, run: OpenedRun, reporter: Reporter) -> Tensor:
        """Which Gaussians belong to the subject, [N] bool."""
        inside = self.subject.holds(run.model.state.gaussians["means"])
        kept = int(inside.sum())
        if not kept:
            raise PolarguideError(
                "the crop box" if self.presentation.crop is not None else "the subject",
                expected=f"Gaussians in it ({self.subject.words})",
                found=f"none of {len(inside)}",
                remedy="Move it: polarguide present RUN --crop, or in polarguide view.",
            )
        if line := self.subject.told(kept, len(inside), run):
            reporter.say(line)
        return inside

    @property
    def centers(self) -> Tensor | None:
        """Centers of the scene's cameras [M, 3], which tell on what side surfaces are seen; None: not known."""
        return None if self.poses is None else torch.stack([camera.center for camera in self.poses])

    def upright(self, run: OpenedRun) -> Placement:
        """The placement in formats whose up is +y."""
        axes = run.frame.panorama_axes()
        return replace(self.placement, rotation=axes.T, upright=True)

    @property
    def comments(self) -> list[str]:
        """For the head of a file."""
        return comments(self.origin, self.placement)

    def surface_view(self, run: OpenedRun) -> Callable[[Camera], RenderResult]:
        """Renders a view of the Gaussians of the subject, with the surface at the median depth."""
        model = run.model

        @torch.no_grad()
        def surface_view(camera: Camera) -> RenderResult:
            return render(
                self.gaussians,
                camera,
                model.backend.rasterize,
                RenderRequest(depth=True, at_median_depth=True),
                shading=model.shading,
                light=model.light,
            )

        return surface_view
