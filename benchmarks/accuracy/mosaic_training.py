"""Compare trainings on demosaiced pictures with trainings whose prediction is interpolated like the measurement.

Each training picture of a scene with four angles becomes a raw mosaic with sensor noise and 12 bits. The kinds are:

- ``demosaiced``: the loss compares the rendering with the bilinearly interpolated pictures, as ``train`` does.
- ``matched``: the predicted mosaic is interpolated in the same way before S0, S1 and S2 are compared. Errors of the
  interpolation then cancel. Layers are sampled and interpolated as well. Targets of normals do not change.
- ``complete``: four complete pictures with the same noise. No sensor measures them; they are an upper bound.

    python benchmarks/accuracy/mosaic_training.py SCENE OUT --kind matched [--downscale 2]

Held-out views are exact. Scores are printed for pixels within two pixels of an edge of object, depth or normal, and for
all other pixels. Materials are dielectric, because the search for metals fails on mosaics this small.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as functional
from numpy.typing import NDArray
from torch import Tensor

import polarguide
from polarguide import optics
from polarguide.capture import View
from polarguide.capture.metadata import GroundTruth
from polarguide.capture.sensor.demosaic import demosaic
from polarguide.capture.sensor.pattern import Pattern, sensor_pattern, tiled
from polarguide.capture.view import ANGLES
from polarguide.methods import recipe_named
from polarguide.optics.color import shown
from polarguide.results.evaluation.metrics import decibels, normal_angles_deg
from polarguide.training.losses import Weights, term
from polarguide.training.photometric import behind_analyzer, photometric_loss
from polarguide.training.recipe import Recipe
from polarguide.training.targets import Step
from polarguide_synth.sensor import Sensor, mosaic, noisy

IDEAL = Sensor(gains=(1.0, 1.0, 1.0, 1.0), extinction=1e9)
"""Sensor with the noise and the bits of an IMX250MYR, and with ideal polarizers."""
REACH = 2
"""Largest distance of the pixels near an edge, in pixels."""
DEPTH_STEP = 0.03
"""Relative difference of the depths of two neighbors at an edge."""
NORMAL_STEP = 30.0
"""Angle between the normals of two neighbors at an edge, in degrees."""


class Interpolation:
    """Bilinear demosaicing of a color sensor in plain torch, equal to ``demosaic`` with the mode ``full``.

    Args:
        pattern: pattern of the sensor.
        shape: height and width of the mosaic.
    """

    def __init__(self, pattern: Pattern, shape: tuple[int, int]) -> None:
        assert pattern.colors is not None
        angles = torch.from_numpy(tiled(pattern.angles, shape).copy())
        self.colors = torch.from_numpy(tiled(pattern.colors, shape).copy())
        double = 2 * torch.deg2rad(angles.float())
        self.analyzer = torch.stack((double.cos(), double.sin()))
        self.has_color = functional.one_hot(self.colors, 3).movedim(-1, 0).float()
        self.has_angle = torch.stack([(angles == angle).float() for angle in ANGLES])
        self.tent = torch.tensor([0.5, 1.0, 0.5]).outer(torch.tensor([0.5, 1.0, 0.5]))[None, None]

    def sampled(self, final: Tensor, stokes: Tensor) -> Tensor:
        """Return the predicted mosaic [H, W] of a picture S0/2 [H, W, 3] with its Stokes vectors [3, H, W, 3]."""
        behind = final + behind_analyzer(stokes, self.analyzer)
        return torch.take_along_dim(behind, self.colors[..., None], dim=-1)[..., 0]

    def __call__(self, values: Tensor) -> Tensor:
        """Return the intensities [4, H, W, 3] of a mosaic [H, W]."""
        # Colors between the cells of one place: the four places become separate pictures.
        known = functional.pixel_unshuffle(self.has_color[:, None], 2)
        cells = functional.pixel_unshuffle((values * self.has_color)[:, None], 2)
        weights = self._spread(known.flatten(0, 1)).view_as(known)
        between = self._spread(cells.flatten(0, 1)).view_as(cells) / weights
        colors = functional.pixel_shuffle(torch.where(known > 0, cells, between), 2)
        # Angles between pixels. Reflection continues the pattern.
        samples = functional.pad((colors * self.has_angle).flatten(0, 1)[:, None], (1, 1, 1, 1), "reflect")
        planes = functional.conv2d(samples, self.tent)
        return planes.view(3, 4, *values.shape).permute(1, 2, 3, 0)

    def _spread(self, planes: Tensor) -> Tensor:
        return functional.conv2d(planes[:, None], self.tent, padding=1)[:, 0]


def matched(recipe: Recipe, interpolate: Interpolation) -> Recipe:
    """Return a recipe that interpolates its prediction in all stages with a Stokes term."""

    def compare(step: Step, weights: MatchedWeights) -> Tensor | None:
        priors = step.targets.priors
        if not weights.polarization or priors is None:
            return None
        result = step.result
        stokes = step.shading.predicted_stokes(result, step.targets.camera)
        predicted = interpolate(interpolate.sampled(result.final, stokes))
        difference = optics.stokes(predicted)[1:] - priors.stokes[1:]
        picture = photometric_loss(
            predicted.mean(dim=0), step.targets.picture, step.targets.valid, step.ssim_weight
        )
        distance = (priors.stokes_weight * difference.abs().mean(dim=(0, -1))).mean()
        total = weights.polarization * distance + weights.intensity * picture
        for weight, layer, target in (
            (weights.interpolated_specular, "specular", priors.specular),
            (weights.interpolated_diffuse, "diffuse", priors.diffuse),
        ):
            if weight:
                unpolarized = interpolate.sampled(result.layers[layer], torch.zeros_like(stokes))
                blurred = interpolate(unpolarized).mean(dim=0)
                loss = photometric_loss(blurred, target, priors.separated, step.ssim_weight)
                total = total + weight * priors.separated.mean() * loss
        return total

    @dataclass(frozen=True)
    class MatchedWeights(Weights):
        """Weights of all loss terms, and of the terms on interpolated predictions."""

        polarization: float = term("stokes", "stokes_weight", rendered=("normal", "layers"))
        intensity: float = term()
        interpolated_specular: float = term("specular", "separated", rendered=("layers",))
        interpolated_diffuse: float = term("diffuse", "separated", rendered=("layers",))

        def own_terms(self) -> Sequence[Callable[[Step, MatchedWeights], Tensor | None]]:
            return (compare,)

    def changed(weights: Weights) -> Weights:
        if not weights.stokes:
            return weights
        replaced = ("stokes", "photometric", "specular", "diffuse")
        return MatchedWeights(
            **{**vars(weights), **dict.fromkeys(replaced, 0.0)},
            polarization=weights.stokes,
            intensity=weights.photometric,
            interpolated_specular=weights.specular,
            interpolated_diffuse=weights.diffuse,
        )

    return replace(recipe, stages=tuple(replace(s, weights=changed(s.weights)) for s in recipe.stages))


def codes(intensities: NDArray[np.floating]) -> Tensor:
    """Return intensities as 16-bit codes."""
    return torch.from_numpy(np.rint(65535 * np.clip(intensities, 0, 1)).astype(np.uint16))


def simulated(view: View, number: int, kind: str, sensor: str) -> View:
    """Return a training view with the noise of a sensor, demosaiced unless ``kind`` is complete."""
    random = np.random.default_rng((5, number))
    if kind == "complete":
        return replace(view, pictures=codes(noisy(view.intensities().numpy(), 1.0, random, IDEAL)))
    raw = mosaic(view.stokes().double().numpy(), sensor, 1.0, random, IDEAL)
    top = (1 << IDEAL.bits) - 1
    values = (raw.astype(np.float32) - IDEAL.black) / (top - IDEAL.black)
    picture = demosaic(values, raw >= top, sensor_pattern(sensor), mode="full")
    invalid = view.invalid | torch.from_numpy(picture.invalid)
    return replace(view, pictures=codes(picture.intensities), invalid=invalid)


def near_edges(truth: GroundTruth) -> Tensor:
    """Return a mask [H, W] of the pixels within ``REACH`` of an edge of object, depth or normal."""
    assert truth.object_ids is not None
    assert truth.depth is not None
    assert truth.normal is not None
    edge = torch.zeros_like(truth.object_ids, dtype=torch.bool)
    for axis in (0, 1):
        size = edge.shape[axis] - 1
        ids, depth, normal = (
            (values.narrow(axis, 0, size), values.narrow(axis, 1, size))
            for values in (truth.object_ids, truth.depth, truth.normal)
        )
        jump = ids[0] != ids[1]
        jump |= (depth[0] - depth[1]).abs() > DEPTH_STEP * torch.minimum(*depth).clamp(min=1e-6)
        jump |= normal_angles_deg(*normal) > NORMAL_STEP
        edge.narrow(axis, 0, size).logical_or_(jump)
        edge.narrow(axis, 1, size).logical_or_(jump)
    square = np.ones((2 * REACH + 1, 2 * REACH + 1), np.uint8)
    return torch.from_numpy(cv2.dilate(edge.numpy().astype(np.uint8), square) > 0)


def scores(run: polarguide.Run, views: Sequence[View]) -> dict[str, tuple[float, float]]:
    """Return the scores near edges and elsewhere: layers and picture in dB, others as means.

    DoLP and AoLP include the background. All other scores are those of the foreground.
    """
    errors: dict[str, tuple[list[Tensor], list[Tensor]]] = {}
    for view in views:
        truth = view.ground_truth
        assert truth is not None
        assert truth.mask is not None
        assert truth.normal is not None
        assert truth.specular is not None
        assert truth.diffuse is not None
        result = run.model.render(view.camera)
        stokes = run.model.stokes(result, view.camera)
        assert stokes is not None
        predicted, true = optics.luminance(stokes), optics.luminance(view.stokes())
        degree = optics.dolp(true)
        turn = (torch.atan2(predicted[2], predicted[1]) - torch.atan2(true[2], true[1])) / 2
        lit = (true[0] > 0.1) & ~view.invalid & ~view.saturated
        found = {
            "specular dB": (result.layers["specular"], truth.specular / 2),
            "diffuse dB": (result.layers["diffuse"], truth.diffuse / 2),
            "picture dB": (result.final, view.photograph()),
        }
        squared = {name: (shown(a) - shown(b)).square().mean(dim=-1) for name, (a, b) in found.items()}
        maps = {
            **{name: (error, truth.mask) for name, error in squared.items()},
            "DoLP": ((optics.dolp(predicted) - degree).abs(), lit),
            "AoLP deg": (torch.rad2deg(turn.sin().abs().asin()), lit & (degree > 0.1)),
            "normal deg": (normal_angles_deg(result.normal, truth.normal), truth.mask),
        }
        edge = near_edges(truth)
        for name, (error, keep) in maps.items():
            near, far = errors.setdefault(name, ([], []))
            near.append(error[keep & edge])
            far.append(error[keep & ~edge])
    means = {
        name: [float(torch.cat(part).double().mean()) for part in parts] for name, parts in errors.items()
    }
    return {
        name: (decibels(near), decibels(far)) if name.endswith("dB") else (near, far)
        for name, (near, far) in means.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--kind", choices=("demosaiced", "matched", "complete"), default="matched")
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--steps", type=int, default=700)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    scene = polarguide.load_scene(options.scene, downscale=options.downscale)
    trained = {view.name for view in scene.train_views}
    views = [
        simulated(view, number, options.kind, "IMX250MYR") if view.name in trained else view
        for number, view in enumerate(scene.views)
    ]
    recipe = recipe_named("polarguide-stokes")
    if options.kind == "matched":
        camera = scene.views[0].camera
        recipe = matched(recipe, Interpolation(sensor_pattern("IMX250MYR"), (camera.height, camera.width)))
    settings = polarguide.TrainSettings(steps=options.steps, seed=options.seed, materials="dielectric")
    run = polarguide.train(replace(scene, views=tuple(views)), options.out, recipe=recipe, settings=settings)
    for name, (near, far) in scores(run, [view for view in views if view.name not in trained]).items():
        print(f"{name:12} near edges {near:7.3f}   elsewhere {far:7.3f}")


if __name__ == "__main__":
    main()
