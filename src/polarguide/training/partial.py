"""The loss of views whose pictures do not determine the Stokes vector: one polarizer angle, two, or none.

The rendered layers predict S0, S1 and S2, and with them the intensity behind any analyzer, ``(S0 + S1 c + S2 s) / 2``.
So the prediction can be compared with whatever was measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from polarguide.camera import Camera
from polarguide.capture import View
from polarguide.capture.exposures import analyzers, radiance_places
from polarguide.color import srgb_encode
from polarguide.shading.model import ShadingModel
from polarguide.shading.result import RenderResult
from polarguide.training.photometric import Photometric, photometric_terms
from polarguide.training.recipe import Weights


@dataclass(frozen=True, eq=False)
class PartialView:
    """What a view measured.

    Attributes:
        picture: [H, W, 3] linear: the mean of some of its exposures.
        shown: the same as shown (sRGB), clipped.
        mix: what ``picture`` measures beside S0/2, as an analyzer: [2], or [2, H, W] where it depends on the pixel;
            None where it is S0/2.
        intensities: [K, H, W, 3] linear, of the exposures behind a polarizer at a known angle.
        analyzers: of these, [K, 2] or [K, 2, H, W].
        reliable: [H, W] 1 where the measurement counts, 0 where it is invalid or clips.
    """

    picture: Tensor
    shown: Tensor
    mix: Tensor | None
    intensities: Tensor
    analyzers: Tensor
    reliable: Tensor

    @classmethod
    def of(cls, view: View, device: torch.device) -> PartialView:
        """What a view measured, on a device."""
        view = view.to(device)
        values, exposures = view.intensities(), view.exposures
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


def behind_analyzer(stokes: Tensor, analyzer: Tensor) -> Tensor:
    """``(S1 c + S2 s) / 2``, what an analyzer adds to S0/2: [H, W, 3].

    Args:
        stokes: [3, H, W, 3]. analyzer: [2], or [2, H, W].
    """
    cosine, sine = analyzer.to(stokes)[..., None].unbind(0)
    return (stokes[1] * cosine + stokes[2] * sine) / 2


def partial_terms(
    result: RenderResult,
    view: PartialView,
    weights: Weights,
    *,
    valid: Tensor | None,
    ssim_weight: float,
    shading: ShadingModel,
    camera: Camera,
) -> tuple[Tensor, Photometric]:
    """The weighted photometric and polarization terms of a view, and the photometric one alone.

    The photometric term compares what was measured with what the layers predict of it: S0/2 where that is measured,
    else the mean M of the intensities behind the analyzers. Beside it, in place of the Stokes term and with its weight,
    there is what the single intensities add to that: the mean of
    ``2 |(I - M) - (S1 c + S2 s) / 2| / sqrt(2 M + 0.01)``, with c and s of the analyzer less those of M. Both sides are
    differences, so that S0 takes no part. A view with one picture has none: all that it tells is in the photometric
    term. (With the rendered S0/2, held, in place of M, a rendering that is too bright would be explained by more light
    that its analyzer blocks, which makes it brighter.)

    Where the weights have no Stokes term, or there are no layers to predict from, the picture counts as a photograph.

    Args:
        result: the rendered layers. view: what was measured. weights: of the stage.
        valid: [H, W] 1 where the photograph counts; None: everywhere.
        ssim_weight: lambda of the image term. shading: of the stage. camera: of the view.
    """
    layers = result.specular, result.diffuse, result.normal
    predicts = shading.reflects and all(layer is not None for layer in layers)
    if not (weights.stokes and len(view.intensities) and predicts):
        picture = photometric_terms(result.final, view.shown, valid, ssim_weight)
        return weights.photometric * picture.loss, picture
    stokes = shading.predicted_stokes(result, camera)
    expected = result.final if view.mix is None else result.final + behind_analyzer(stokes, view.mix)
    picture = photometric_terms(expected, view.shown, valid, ssim_weight)
    common = 0.0 if view.mix is None else view.mix
    weight = view.reliable * (2 * view.picture.mean(dim=-1) + 0.01).rsqrt()
    distance = result.final.new_zeros(())
    for intensity, analyzer in zip(view.intensities, view.analyzers, strict=True):
        difference = 2 * (intensity - view.picture) - 2 * behind_analyzer(stokes, analyzer - common)
        distance = distance + (weight * difference.abs().mean(dim=-1)).mean()
    total = weights.photometric * picture.loss + weights.stokes * distance / len(view.intensities)
    return total, picture
