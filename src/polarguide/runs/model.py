"""Model of a run, which renders layers and is written to PLY files.

A PLY file holds display values, which ordinary 3DGS viewers show correctly. By default it has only the fields of the
3DGS release, because some viewers assume this layout and would misread additional fields. Linear fields of polarguide
are written on request.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import torch
from torch import Tensor

from polarguide.capture.presentation import colored
from polarguide.gaussians.gaussians import CORE_SHAPES
from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.gaussians.ply import refit_sh, write_ply
from polarguide.geometry.camera import Camera
from polarguide.optics.color import srgb_encode, srgb_slope
from polarguide.raster import Backend
from polarguide.raster.magnification import as_trained
from polarguide.raster.surface import alpha_in_front
from polarguide.shading.gbuffer import RenderRequest, render, single_colors, splats
from polarguide.shading.model import Light, Parameters, ShadingModel
from polarguide.shading.result import LAYERS, POLARIZED, RenderResult
from polarguide.training.context import TrainingState

Within = Callable[[Tensor], Tensor]
"""Function that maps positions [N, 3] in the scene to a mask [N], True for visible positions."""


def layers_of(shading: ShadingModel) -> tuple[str, ...]:
    """Return the names of the layers of a shading model, in the order of ``LAYERS``.

    The names in ``POLARIZED`` follow if the model predicts Stokes vectors.
    """
    predicts = {"specular", "diffuse", "normal"} <= {*shading.layers}
    return (*(name for name in LAYERS if name in shading.layers), *(POLARIZED if predicts else ()))


@dataclass(frozen=True, eq=False)
class GaussianModel:
    """Trained model that renders views: Gaussians, learned light, and shading model."""

    state: TrainingState
    shading: ShadingModel
    backend: Backend

    @property
    def device(self) -> torch.device:
        """Device of the rendered layers."""
        return self.backend.device

    @property
    def light(self) -> dict[str, Tensor]:
        """Parameters of the learned light by name; empty for a recipe without light."""
        return self.state.light

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the rendered layers, in the order of ``LAYERS``."""
        return layers_of(self.shading)

    @property
    def steps(self) -> int:
        """Number of trained steps."""
        return self.state.step

    @property
    def gaussians(self) -> int:
        """Number of Gaussians."""
        return len(self.state.gaussians)

    @property
    def size(self) -> str:
        """Number of Gaussians as text."""
        return f"{self.gaussians:,} Gaussians"

    @torch.no_grad()
    def render(
        self,
        camera: Camera,
        *,
        normals: bool = True,
        depth: bool = False,
        surface: bool = False,
        within: Within | None = None,
    ) -> RenderResult:
        """Render all layers.

        Args:
            camera: any camera.
            normals: render normals even if the model does not need them.
            depth: render the depth.
            surface: True to render normals and depth of the surface at the pixel's median depth, see
                ``raster.surface``.
            within: function that maps positions [N, 3] in the scene to a mask [N] of visible positions. None means all
                are visible.

        """
        gaussians: Parameters = self.state.gaussians
        footprints = self.state.footprints
        if within is not None:
            inside = within(gaussians["means"].detach())
            gaussians = self.state.gaussians.only(inside)
            footprints = None if footprints is None else footprints[inside]
        return render(
            gaussians,
            camera,
            self.backend.rasterize,
            RenderRequest(normals=normals, depth=depth, at_median_depth=surface),
            shading=self.shading,
            light=self.light,
            footprints=footprints,
        )

    @torch.no_grad()
    def stokes(self, result: RenderResult, camera: Camera) -> Tensor | None:
        """Return the predicted Stokes vectors [3, H, W, 3] of a picture.

        Return None if the specular layer, the diffuse layer or the normal is missing.
        """
        if not result.is_polarized:
            return None
        return self.shading.predicted_stokes(result, camera)

    @torch.no_grad()
    def alpha_in_front(self, camera: Camera, depth: Tensor) -> Tensor:
        """Return the alpha [H, W] in front of the depths [H, W], see ``raster.surface``."""
        drawn = splats(self.state.gaussians)
        footprints = self.state.footprints
        if footprints is not None:
            drawn = as_trained(drawn, camera, footprints)
        return alpha_in_front(drawn, camera, depth, self.backend.rasterize)


@torch.no_grad()
def gaussian_colors(gaussians: Parameters, light: Light, shading: ShadingModel, directions: Tensor) -> Tensor:
    """Compute linear colors of every Gaussian toward viewing directions, with reflections.

    Args:
        gaussians: the Gaussians.
        light: learned light by name.
        shading: shading of the recipe.
        directions: [K, 3] unit, from the camera to the Gaussian.

    Returns:
        Colors [N, K, 3]. Each Gaussian is shaded with its own normal, because a single splat has no blended normal.
    """
    means = gaussians["means"]
    center = means.new_zeros(3)
    normals = shortest_axis_normals(means, gaussians["quaternions"], gaussians["log_scales"], center)
    colors = []
    for direction in directions.to(means.device):
        # A camera far behind each Gaussian sees it along one direction.
        facing = torch.where((normals @ direction)[:, None] > 0, -normals, normals)
        rays = direction.expand(len(means), 3)
        colors.append(single_colors(gaussians, light, shading, rays, facing))
    return torch.stack(colors, dim=1)


@torch.no_grad()
def baked_harmonics(
    gaussians: Parameters,
    light: Light,
    shading: ShadingModel,
    *,
    present: Callable[[Tensor], Tensor],
    linear: bool,
) -> tuple[Tensor, Tensor]:
    """Fit harmonics to the colors of ``gaussian_colors`` by ``refit_sh``.

    Args:
        gaussians, light, shading: Gaussians, learned light and shading model of the run.
        present: function from linear colors to the colors that are shown.
        linear: True if the shown colors are linear as well.
    """
    parameters = {
        name: values
        for name in (*CORE_SHAPES, *shading.parameters)
        if (values := gaussians.get(name)) is not None
    }
    means = parameters["means"].detach()
    normals = shortest_axis_normals(
        means, parameters["quaternions"].detach(), parameters["log_scales"].detach(), means.new_zeros(3)
    )

    def colors(part: slice, directions: Tensor) -> Tensor:
        batch = {name: values.detach()[part] for name, values in parameters.items()}
        return present(gaussian_colors(batch, light, shading, directions))

    return refit_sh(colors, normals, srgb_slope if linear else None)


@torch.no_grad()
def learned_normals(gaussians: Parameters, centers: Tensor | None) -> Tensor:
    """Return the unit normals [N, 3] of all Gaussians.

    A normal is the shortest axis of a Gaussian, turned toward the nearest camera.

    Args:
        gaussians: the Gaussians.
        centers: [M, 3] camera centers. With None, normals point away from the middle of the Gaussians.
    """
    means = gaussians["means"].detach().cpu()
    quaternions, log_scales = (gaussians[name].detach().cpu() for name in ("quaternions", "log_scales"))
    normals = shortest_axis_normals(means, quaternions, log_scales, means.new_zeros(3))
    if centers is None:
        side = means - means.median(dim=0).values
    else:
        places = centers.to(means)
        nearest = torch.cat([torch.cdist(part, places).argmin(dim=1) for part in means.split(1 << 16)])
        side = places[nearest] - means
    return torch.where((normals * side).sum(dim=1, keepdim=True) < 0, -normals, normals)


@torch.no_grad()
def write_run_ply(
    path: Path,
    state: TrainingState,
    shading: ShadingModel,
    centers: Tensor | None = None,
    *,
    color: Tensor | None = None,
    linear: bool = False,
    own_fields: Mapping[str, Tensor] = MappingProxyType({}),
) -> None:
    """Write the trained Gaussians to a PLY file, as the module describes.

    Args:
        path: the file.
        state: state of the training.
        shading: shading model of the run.
        centers: [M, 3] camera centers, see ``learned_normals``.
        color: [3, 3] color matrix of a presentation. It changes the harmonics that other programs show, but not the
            fields of polarguide.
        linear: True to write harmonics of linear colors, for programs that expect them.
        own_fields: additional fields [N, ...] by name.
    """
    gaussians = state.gaussians

    def shown(colors: Tensor) -> Tensor:
        colors = colored(colors, color).clamp(0, 1)
        return colors if linear else srgb_encode(colors)

    dc, rest = baked_harmonics(gaussians, state.light, shading, present=shown, linear=linear)
    plain = {
        name: gaussians[name].detach().cpu()
        for name in ("means", "log_scales", "quaternions", "opacity_logits")
    }
    plain["quaternions"] = torch.nn.functional.normalize(plain["quaternions"], dim=-1)
    extra = {name: field.detach().cpu() for name, field in own_fields.items()}
    write_ply(path, **plain, sh_dc=dc, sh_rest=rest, normals=learned_normals(gaussians, centers), extra=extra)
