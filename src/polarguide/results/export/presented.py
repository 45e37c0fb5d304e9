"""Presentation of a run in exported files: its subject, upright, with its provenance."""

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
"""The whole scene as a subject."""


class Presented:
    """Presentation of a run: the Gaussians of its subject, their placement, and the provenance of files.

    If the scene is missing, the up axis and the subject are unknown. Then all Gaussians are exported in the
    scene's own axes, with a warning.

    Args:
        run: the run. axes: axes of the placement. masked: see ``subject_of``.
        reporter: receives a line about removed Gaussians.

    Raises:
        PolarguideError: the presentation cannot be read, or no Gaussian belongs to the subject.
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
        self.inside = self._members(run, reporter)
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
        """Return the scene's cameras, or None with a warning if the scene is missing."""
        if run.scene_is_there:
            return [*run.poses.values()]
        warnings.warn(
            f"The scene of {run.folder} is no longer at {run.scene_folder}: files have its own axes and contain all "
            "Gaussians, and normals point away from the center of the Gaussians instead of to the nearest camera. "
            f"{run.new_place}",
            PolarguideWarning,
            stacklevel=5,
        )
        return None

    def _members(self, run: OpenedRun, reporter: Reporter) -> Tensor:
        """Return the Gaussians that belong to the subject, [N] bool."""
        inside = self.subject.holds(run.model.state.gaussians["means"])
        count = int(inside.sum())
        if not count:
            raise PolarguideError(
                "the crop box" if self.presentation.crop is not None else "the subject",
                expected=f"Gaussians inside ({self.subject.description})",
                found=f"none of {len(inside)}",
                remedy="Move the box with polarguide present RUN --crop or in polarguide view.",
            )
        self.subject.report_removed(inside, run, reporter)
        return inside

    @property
    def centers(self) -> Tensor | None:
        """Centers of the scene's cameras [M, 3] for the orientation of surfaces; None if unknown."""
        return None if self.poses is None else torch.stack([camera.center for camera in self.poses])

    def upright(self, run: OpenedRun) -> Placement:
        """Return the placement for formats with +y up."""
        axes = run.frame.panorama_axes()
        return replace(self.placement, rotation=axes.T, upright=True)

    @property
    def comments(self) -> list[str]:
        """Comments for the header of a file."""
        return comments(self.origin, self.placement)

    def surface_view(self, run: OpenedRun) -> Callable[[Camera], RenderResult]:
        """Return a function that renders the Gaussians of the subject with the surface at the median depth."""
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
