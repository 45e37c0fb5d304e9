"""A run as its presentation shows it, for whatever leaves it: cropped, placed, with its origin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from polarguide.core.errors import PolarguideError
from polarguide.geometry.camera import Camera
from polarguide.results.export.placement import Origin, Placement, comments
from polarguide.runs.model import GaussianModel
from polarguide.runs.opened import OpenedRun
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.shading.model import Parameters
from polarguide.shading.result import RenderResult


class Presented:
    """A run as its presentation shows it: the Gaussians within the crop box, their placement, and the origin of files.

    Raises:
        PolarguideError: the presentation cannot be read, or nothing lies within its crop box.
    """

    def __init__(self, run: OpenedRun) -> None:
        self.presentation = run.presentation
        model = run.model
        gaussians = model.state.gaussians if isinstance(model, GaussianModel) else None
        self.gaussians: Parameters | None = gaussians
        self.footprints = model.state.footprints if isinstance(model, GaussianModel) else None
        self.inside: Tensor | None = None
        if gaussians is not None and (crop := self.presentation.crop) is not None:
            self.inside = crop.inside(gaussians["means"].detach(), run.camera_frame)
            if not bool(self.inside.any()):
                raise PolarguideError(
                    "the crop box",
                    expected="Gaussians in it",
                    found=f"none of {len(self.inside)}",
                    remedy="Move it: polarguide present RUN --crop, or in polarguide view.",
                )
            self.gaussians = {name: gaussians[name].detach()[self.inside] for name in gaussians.names}
            self.footprints = None if self.footprints is None else self.footprints[self.inside]
        around = run.frame if self.presentation.up_axis is not None else None
        self.placement = Placement.of(self.presentation, around)
        scene = run.configuration.scene_digest[:12]
        made_of = (
            f"{run.recipe.name}, {run.steps} steps, scene sha256 {scene}, polarization {run.polarization}"
        )
        self.origin = Origin(self.presentation, made_of)

    def upright(self, run: OpenedRun) -> Placement:
        """The placement in formats whose up is +y."""
        axes = run.frame.panorama_axes()
        return replace(self.placement, rotation=axes.T, upright=True)

    @property
    def comments(self) -> list[str]:
        """For the head of a file."""
        return comments(self.origin, self.placement)

    def surface_view(self, run: OpenedRun, what: str) -> Callable[[Camera], RenderResult]:
        """Renders a view of the Gaussians within the crop box, with the surface at the median depth."""
        model = run.gaussian_model(what)
        gaussians = self.gaussians
        assert gaussians is not None

        @torch.no_grad()
        def surface_view(camera: Camera) -> RenderResult:
            return render(
                gaussians,
                camera,
                model.backend.rasterize,
                RenderRequest(depth=True, at_median_depth=True),
                shading=model.shading,
                light=model.light,
            )

        return surface_view
