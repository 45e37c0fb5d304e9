"""Targets to which a rendering is compared: records of the data of one view."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.capture import View
from polarguide.capture.exposures import analyzers, radiance_places
from polarguide.gaussians.gaussians import Parameters
from polarguide.geometry.camera import Camera
from polarguide.optics.color import srgb_encode
from polarguide.raster import ScreenStatistic
from polarguide.shading.model import ShadingModel
from polarguide.shading.result import RenderResult

ABSENT = torch.tensor(torch.nan)
"""Placeholder of a prior that was not computed. A loss that reads it is not finite and is refused."""


@dataclass(frozen=True, eq=False)
class ViewPriors:
    """Polarization targets of one view. Fields that no loss term reads are ``ABSENT``.

    Attributes:
        camera: camera of the view.
        specular, diffuse: [H, W, 3] separated pictures as displayed (sRGB), on the scale of S0/2.
        separated: [H, W] weight of these pictures: 1 where the separation is well conditioned, else 0.
        normal: [H, W, 3] disambiguated polarization normal, world axes.
        plane: [H, W, 3] normal of the plane of incidence according to the AoLP, world axes.
        weight: [H, W] weight of ``normal`` and ``plane``, in [0, 1].
        chromatic: [H, W, 3] normal from the polarization of color differences or of a flat surface, world axes.
        chromatic_weight: [H, W] weight of ``chromatic``, in [0, 1]; 0 if the settings do not request this normal.
        stokes: [3, H, W, 3] measured Stokes vectors.
        stokes_weight: [H, W] weight of S1 and S2, see ``priors.stokes_weight``.
        surface: [H, W] weight of the agreement of normals and depth, see ``priors.surface_weight``.
        candidates: [H, W, K, 3] normals from which each step chooses in place of ``normal``, world axes. None if
            ``normal`` is used.
        azimuth_share, chromatic_share: least share of the pixels by which sums of the terms on directions are divided.
    """

    camera: Camera
    specular: Tensor = ABSENT
    diffuse: Tensor = ABSENT
    separated: Tensor = ABSENT
    normal: Tensor = ABSENT
    plane: Tensor = ABSENT
    weight: Tensor = ABSENT
    chromatic: Tensor = ABSENT
    chromatic_weight: Tensor = ABSENT
    stokes: Tensor = ABSENT
    stokes_weight: Tensor = ABSENT
    surface: Tensor = ABSENT
    candidates: Tensor | None = None
    azimuth_share: float = 0.0
    chromatic_share: float = 0.0


@dataclass(frozen=True, eq=False)
class PartialView:
    """Measurements of a view whose pictures do not determine the Stokes vector.

    Attributes:
        picture: [H, W, 3] linear radiance, the mean of some exposures of the view.
        shown: [H, W, 3] ``picture`` as displayed (sRGB), clipped.
        mix: analyzer of ``picture``, [2], or [2, H, W] if it depends on the pixel. None if ``picture`` is S0/2.
        intensities: [K, H, W, 3] linear intensities of the exposures behind a polarizer at a known angle.
        analyzers: analyzers of ``intensities``, [K, 2] or [K, 2, H, W].
        reliable: [H, W] 1 where the measurement is usable, 0 where it is invalid or saturated.
    """

    picture: Tensor
    shown: Tensor
    mix: Tensor | None
    intensities: Tensor
    analyzers: Tensor
    reliable: Tensor

    @classmethod
    def of(cls, view: View, device: torch.device) -> PartialView:
        """Return the measurements of a view, on a device."""
        view = view.to(device)
        values = view.intensities()
        exposures = view.exposures
        rays = view.camera.rays(device=device)
        polarized = [k for k, e in enumerate(exposures) if e.angle is not None]
        behind = analyzers([exposures[k] for k in polarized], rays, view.mount) if polarized else None
        places = radiance_places(exposures)
        averaged = list(places) or polarized or list(range(len(exposures)))
        mix = None
        if behind is not None and averaged == polarized and not (places and view.mount == "sensor"):
            mix = behind.mean(dim=0)
        picture = values[averaged].mean(dim=0)
        return cls(
            picture=picture,
            shown=srgb_encode(picture.clamp(0, 1)),
            mix=mix,
            intensities=values[polarized],
            analyzers=values.new_zeros(0, 2) if behind is None else behind,
            reliable=(~(view.invalid | view.saturated)).float(),
        )


@dataclass(frozen=True, eq=False)
class StepTargets:
    """Targets of the rendering of one view.

    Attributes:
        camera: camera of the view.
        picture: [H, W, 3] the photograph as displayed (sRGB).
        valid: [H, W] 1 where the photograph is valid, else 0. None means valid everywhere.
        empty: [H, W] 1 where the view shows no surface, else 0. None means unknown.
        partial: measurements of a view that does not determine the Stokes vector. None if the view determines it.
        priors: polarization targets. None if no term of the stage reads them, or if the view has no priors.
    """

    camera: Camera
    picture: Tensor
    valid: Tensor | None = None
    empty: Tensor | None = None
    partial: PartialView | None = None
    priors: ViewPriors | None = None


@dataclass(frozen=True, eq=False)
class Step:
    """Data that the loss terms of one step read.

    Attributes:
        result: the rendered layers.
        targets: targets of the rendered layers.
        shading: shading model of the stage, with the refractive index of the run.
        gaussians: the Gaussians. Terms may read their tensors, such as ``log_scales`` [N, 3].
        extent: extent of the scene.
        ssim_weight: lambda of the image terms.
        statistic: gradient of the projected means, known after the backward pass. None without density control.
    """

    result: RenderResult
    targets: StepTargets
    shading: ShadingModel
    gaussians: Parameters
    extent: float
    ssim_weight: float = 0.2
    statistic: ScreenStatistic | None = None
