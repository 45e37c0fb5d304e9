"""Training loop of a field. A step compares several hundred rays of one view with measured color, DoLP and AoLP.

The loss has the terms of GNeRP (Li et al. 2024): color, angle of polarization, eikonal term, and guidance by
covariances.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.capture import Scene, View
from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import dot, unit
from polarguide.optics import aolp, dolp, lens_frame, luminance
from polarguide.optics.color import srgb_encode
from polarguide.training.callback import Loop
from polarguide.training.context import seeded
from polarguide.training.settings import ResolvedSettings
from polarguide.training.storage import Packed, ViewStore, packed, stored_values
from polarguide_bench.gnerp.march import RaySamples, march
from polarguide_bench.gnerp.recipe import NeuralRecipe
from polarguide_bench.gnerp.state import FieldState


def color_loss(predicted: Tensor, measured: Tensor, dolp: Tensor) -> Tensor:
    """Return the mean difference of display colors [N, 3], weighted with 1 - DoLP [N]."""
    return ((1 - dolp)[:, None] * (predicted - measured).abs()).mean()


def aolp_loss(normal: Tensor, rays: Tensor, aolp: Tensor, dolp: Tensor, *, circular: bool) -> Tensor:
    """Return the mean difference between predicted and measured angle of polarization, weighted with the DoLP.

    The prediction is the azimuth of the blended normal about the ray plus 90 degrees, modulo 180. It is valid for
    specular light, which is polarized perpendicular to the plane of incidence.

    Args:
        normal: blended normals [N, 3] in camera axes, of any length.
        rays: [N, 3] in camera axes, unit length.
        aolp: [N] radians in [0, pi), in the lens frame.
        dolp: [N] in [0, 1].
        circular: use ``(1 - cos 2 difference) / 2``. Otherwise use the published difference of numbers in [0, pi),
            which jumps if one of the angles passes 180 degrees.
    """
    right, up = _across(normal, rays)
    if circular:
        # cos and sin of twice the azimuth, without the azimuth itself. Adding 90 degrees flips the sign.
        square = (right * right + up * up).clamp(min=1e-12)
        cosine = (up * up - right * right) / square
        sine = -2 * right * up / square
        difference = 0.5 * (1 - cosine * torch.cos(2 * aolp) - sine * torch.sin(2 * aolp))
    else:
        flat = (right * right + up * up) < 1e-12
        azimuth = torch.atan2(torch.where(flat, 0.0, up), torch.where(flat, 1.0, right))
        difference = (torch.remainder(azimuth + math.pi / 2, math.pi) - aolp).abs()
    return (dolp * difference).mean()


def eikonal_loss(slopes: Tensor) -> Tensor:
    """Return the mean of ``(|gradient| - 1)^2`` over gradients [..., 3] of the distance."""
    return ((dot(slopes, slopes) + 1e-12).sqrt() - 1).square().mean()


def guidance_loss(
    normals: Tensor, around: Tensor, weights: Tensor, rays: Tensor, aolp: Tensor, neighbors: Tensor,
    dolp: Tensor, *, circular: bool,
) -> Tensor:  # fmt: skip
    """Return the L1 distance between two covariances: of normals around the samples of a ray, and of the measured AoLP.

    A sample has six neighbors. The first covariance is computed from their normals about the normal of the sample. It
    is projected to the plane perpendicular to the ray, [2, 2], and blended along the ray.

    The second covariance is computed from vectors ``(sin, -cos)`` of the AoLP at four neighboring pixels about the
    vector of the ray's own pixel. It is multiplied by the squared length of the part of the blended normal that is
    perpendicular to the ray. In the published term, ``(sin, -cos)`` changes its sign if the AoLP passes 180 degrees,
    but the normal does not. ``circular`` avoids this by doubling the angles in both covariances.

    Args:
        normals: normals [N, K, 3] of the samples in camera axes, unit length.
        around: normals [N, K, 6, 3] of the neighbors of each sample.
        weights: weights [N, K] of the samples in the picture.
        rays: [N, 3] in camera axes, unit length.
        aolp: [N] radians.
        neighbors: AoLP [N, 4] of the neighboring pixels.
        dolp: weight [N] of each ray.
        circular: double the angles in both covariances.
    """
    own = torch.stack(_across(normals, rays[:, None]), dim=-1)
    others = torch.stack(_across(around, rays[:, None, None]), dim=-1)
    length = (weights[..., None] * own).sum(dim=1).square().sum(dim=-1)
    pixel, pixels = (
        torch.stack((torch.sin(angle), -torch.cos(angle)), dim=-1) for angle in (aolp, neighbors)
    )
    if circular:
        own, others, pixel, pixels = map(_doubled, (own, others, pixel, pixels))
    predicted = (weights[..., None, None] * _covariance(own, others)).sum(dim=1)
    measured = length[:, None, None] * _covariance(pixel, pixels)
    return (dolp[:, None, None] * (predicted - measured).abs()).mean()


def _across(vectors: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Return the components of vectors to the right and up in the lens frame of each ray."""
    right, up = lens_frame(rays)
    return dot(vectors, right), dot(vectors, up)


def _doubled(vectors: Tensor) -> Tensor:
    """Double the angles of vectors [..., 2] without changing their lengths."""
    x, y = vectors.unbind(-1)
    length = (x * x + y * y + 1e-12).sqrt()
    return torch.stack(((x * x - y * y) / length, 2 * x * y / length), dim=-1)


def _covariance(own: Tensor, others: Tensor) -> Tensor:
    """Return the covariance [..., 2, 2] of vectors [..., M, 2] about the vector [..., 2], with divisor M - 1."""
    apart = others - own[..., None, :]
    return apart.transpose(-1, -2) @ apart / (others.shape[-2] - 1)


@dataclass(frozen=True, eq=False)
class Target:
    """Measured values of a view that a field is trained with, for P = H W pixels in row-major order.

    Attributes:
        picture: display colors [P, 3].
        dolp: [P] in [0, 1], 0 for unknown polarization.
        aolp: [P] radians in [0, pi), in the lens frame.
        valid: indices [V] of the valid pixels.
    """

    picture: Tensor
    dolp: Tensor
    aolp: Tensor
    valid: Tensor


def target_of(view: View, store: ViewStore, device: torch.device) -> Target:
    """Return the target of a view from a cache. The cache stores two bytes per value."""
    stored = store.get("target", view.name)
    if stored is None:
        stored = {"picture": packed(srgb_encode(view.photograph().clamp(0, 1)).to(device))}
        if bool(view.invalid.any()):
            stored["valid"] = Packed((~view.invalid).to(device))
        if view.is_determined:
            gray = luminance(view.stokes())
            degree = dolp(gray) * ~(view.saturated | view.invalid)
            stored["dolp"] = packed(degree.to(device))
            stored["aolp"] = packed(aolp(gray).to(device))
        store.keep("target", view.name, stored)
    picture = stored_values(stored["picture"]).view(-1, 3)
    zeros = torch.zeros(len(picture), device=device)
    degree, angle = (
        stored_values(stored[name]).flatten() if name in stored else zeros for name in ("dolp", "aolp")
    )
    valid = stored["valid"].codes.flatten() if "valid" in stored else zeros == 0
    return Target(picture, degree, torch.remainder(angle, torch.pi), valid.nonzero()[:, 0])


MAP_EVERY = 16
"""Number of steps between updates of the coarse map of distances."""
GLANCE = (0.3, 0.7)
"""Start and end of the rise of the color's dependence on direction, as shares of all steps.

At first, the color depends only on the position, so that a wrong surface cannot fit each view separately."""
DIAGONAL = ((-1, -1), (-1, 1), (1, -1), (1, 1))
"""Offsets of the diagonal neighbors of a pixel, in rows and columns."""


class FieldLoop(Loop):
    """Loop that trains a neural recipe on a scene.

    Args:
        scene: the scene.
        recipe: the recipe.
        settings: settings of the training, with one view per step.
        device: device of the training.
        state: state on the device from which training resumes. None starts a new training.
        store: cache of the targets. None keeps the targets in memory.
    """

    state: FieldState

    def __init__(
        self,
        scene: Scene,
        recipe: NeuralRecipe,
        settings: ResolvedSettings,
        device: torch.device,
        state: FieldState | None = None,
        store: ViewStore | None = None,
    ) -> None:
        super().__init__(settings, ())
        self.scene = scene
        self.recipe = recipe
        self._device = device
        cameras = [view.camera for view in scene.train_views]
        self.state = state or FieldState.first(recipe, cameras, settings.seed, device)
        self._store = store or ViewStore()

    def optimize(self) -> tuple[Tensor, str, None]:
        """Perform one optimizer step with rays of one view."""
        state = self.state
        settings = self.settings
        sampling = self.recipe.sampling
        field = state.field
        share = state.step / settings.steps
        generator = seeded(settings.seed, 9, state.step)
        view = self._view_of(state.step)
        target = target_of(view, self._store, self._device)
        self.whole = False
        if state.step % MAP_EVERY == 0:
            field.map_distances()
        begin, end = GLANCE
        field.direction_share.fill_(min(1.0, max(0.0, (share - begin) / (end - begin))))
        drawn = torch.randint(len(target.valid), (sampling.rays,), generator=generator)
        pixels = target.valid[drawn.to(self._device)]
        rays = view.camera.rays(device=self._device).view(-1, 3)[pixels]
        center = field.region.inner(view.camera.pose(rays.dtype, self._device).center)
        marched = march(
            field, center.expand(len(rays), 3), view.camera.to_world(rays), sampling, generator=generator
        )
        picture = target.picture[pixels]
        color = color_loss(marched.color, picture, target.dolp[pixels])
        loss = self._loss(color, marched, view.camera, rays, pixels, target, share)
        self._set_rates(share)
        loss.backward()
        state.optimizer.step(dict(field.named_parameters()))
        with torch.no_grad():
            # Grids tend to start with fog. The sharpness therefore never falls below its initial value.
            field.log_sharpness.clamp_(min=field.first_log_sharpness)
            psnr = -10 * torch.log10((marched.color - picture).square().mean().clamp(min=1e-10))
        if state.step + 1 == settings.steps:
            field.map_distances()
        stage = "color and angles" if share < self.recipe.weights.guided else "guided"
        return torch.stack((color.detach(), psnr, loss.detach())), stage, None

    def _loss(
        self,
        color: Tensor,
        marched: RaySamples,
        camera: Camera,
        rays: Tensor,
        pixels: Tensor,
        target: Target,
        share: float,
    ) -> Tensor:
        weights = self.recipe.weights
        loss = weights.color * color + weights.eikonal * eikonal_loss(marched.slopes)
        if weights.aolp:
            normal = camera.to_camera(marched.normal)
            dolp = target.dolp[pixels]
            angles = aolp_loss(normal, rays, target.aolp[pixels], dolp, circular=weights.circular)
            loss = loss + weights.aolp * angles
        if weights.guidance and share >= weights.guided:
            loss = loss + weights.guidance * self._guidance(marched, camera, rays, pixels, target)
        return loss

    def _guidance(
        self, marched: RaySamples, camera: Camera, rays: Tensor, pixels: Tensor, target: Target
    ) -> Tensor:
        """Compute the guidance loss at those samples of each ray that have the largest weights."""
        largest = marched.weights.detach().topk(self.recipe.sampling.neighbors, dim=1).indices
        index = largest[..., None].expand(-1, -1, 3)
        around = self._neighbors(marched, camera, rays, largest)
        normals = unit(self.state.field.geometry(around.view(-1, 3)).slope).view(around.shape)
        row = pixels // camera.width
        column = pixels % camera.width
        neighbors = [
            (row + dy).clamp(0, camera.height - 1) * camera.width + (column + dx).clamp(0, camera.width - 1)
            for dy, dx in DIAGONAL
        ]
        return guidance_loss(
            camera.to_camera(marched.normals.gather(1, index)),
            camera.to_camera(normals),
            marched.weights.gather(1, largest),
            rays,
            target.aolp[pixels],
            target.aolp[torch.stack(neighbors, dim=1)],
            target.dolp[pixels],
            circular=self.recipe.weights.circular,
        )

    def _neighbors(self, marched: RaySamples, camera: Camera, rays: Tensor, chosen: Tensor) -> Tensor:
        """Return six positions around each sample, [N, K, 6, 3]: four on rays of diagonal pixels, two along the ray."""
        places = marched.places.gather(1, chosen[..., None].expand(-1, -1, 3))
        width = (marched.along.gather(1, chosen) / camera.fx)[..., None]
        pose = camera.pose(places.dtype, places.device)
        right = pose.rotation[0] * width
        down = pose.rotation[1] * width
        ahead = camera.to_world(rays)[:, None] * width
        steps = [dy * down + dx * right for dy, dx in DIAGONAL]
        return torch.stack([places + step for step in (*steps, ahead, -ahead)], dim=2)

    def _view_of(self, place: int) -> View:
        """Return the view at an index of the training sequence.

        Each epoch of the sequence contains each view once, in a new order.
        """
        views = self.scene.train_views
        epoch, place = divmod(place, len(views))
        order = torch.randperm(len(views), generator=seeded(self.settings.seed, 4, epoch))
        return views[int(order[place])]

    def _set_rates(self, share: float) -> None:
        """Set the learning rates of this step: a linear warm-up, followed by a cosine decay."""
        rates = self.recipe.rates
        shape = self.recipe.shape
        late = max(0.0, (share - rates.warmup) / (1 - rates.warmup))
        falling = rates.last + (1 - rates.last) * 0.5 * (1 + math.cos(math.pi * late))
        rising = min(1.0, (share * self.settings.steps + 1) / (rates.warmup * self.settings.steps + 1))
        optimizer = self.state.optimizer
        for name in optimizer.rates:
            level = name.rpartition(".")[2]
            if name.startswith("shape_grids."):
                own = rates.distances * (shape.resolutions[0] / shape.resolutions[int(level)]) ** rates.finer
            elif "levels." in name:
                own = rates.features
            else:
                own = rates.sharpness if name == "log_sharpness" else rates.networks
            optimizer.rates[name] = own * rising * falling
