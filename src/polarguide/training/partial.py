"""The loss of views whose pictures do not determine the Stokes vector: one polarizer angle, two, or none.

The rendered layers predict S0, S1 and S2, and with them the intensity behind any analyzer, ``(S0 + S1 c + S2 s) / 2``.
So the prediction can be compared with whatever was measured.
"""

from __future__ import annotations

from torch import Tensor

from polarguide.training.photometric import Photometric, photometric_terms
from polarguide.training.targets import Step


def behind_analyzer(stokes: Tensor, analyzer: Tensor) -> Tensor:
    """``(S1 c + S2 s) / 2``, what an analyzer adds to S0/2: [H, W, 3].

    Args:
        stokes: [3, H, W, 3]. analyzer: [2], or [2, H, W].
    """
    cosine, sine = analyzer.to(stokes)[..., None].unbind(0)
    return (stokes[1] * cosine + stokes[2] * sine) / 2


def partial_terms(step: Step, photometric: float, polarization: float) -> tuple[Tensor, Photometric]:
    """The weighted photometric and polarization terms of a view with ``StepTargets.partial``, and the photometric one.

    The photometric term compares what was measured with what the layers predict of it: S0/2 where that is measured,
    else the mean M of the intensities behind the analyzers. Beside it, in place of the Stokes term and with its weight,
    there is what the single intensities add to that: the mean of
    ``2 |(I - M) - (S1 c + S2 s) / 2| / sqrt(2 M + 0.01)``, with c and s of the analyzer less those of M. Both sides are
    differences, so that S0 takes no part. A view with one picture has none: all that it tells is in the photometric
    term. (With the rendered S0/2, held, in place of M, a rendering that is too bright would be explained by more light
    that its analyzer blocks, which makes it brighter.)

    Without a weight of the polarization, or without layers to predict from, the picture counts as a photograph.

    Args:
        step: what the terms read. photometric, polarization: weights of the stage.
    """
    result, shading, view = step.result, step.shading, step.targets.partial
    assert view is not None

    def compared(rendered: Tensor) -> Photometric:
        return photometric_terms(rendered, view.shown, step.targets.valid, step.ssim_weight)

    layers = result.specular, result.diffuse, result.normal
    predicts = shading.reflects and all(layer is not None for layer in layers)
    if not (polarization and len(view.intensities) and predicts):
        picture = compared(result.final)
        return photometric * picture.loss, picture
    stokes = shading.predicted_stokes(result, step.targets.camera)
    picture = compared(result.final if view.mix is None else result.final + behind_analyzer(stokes, view.mix))
    common = 0.0 if view.mix is None else view.mix
    weight = view.reliable * (2 * view.picture.mean(dim=-1) + 0.01).rsqrt()
    distance = result.final.new_zeros(())
    for intensity, analyzer in zip(view.intensities, view.analyzers, strict=True):
        difference = 2 * (intensity - view.picture) - 2 * behind_analyzer(stokes, analyzer - common)
        distance = distance + (weight * difference.abs().mean(dim=-1)).mean()
    return photometric * picture.loss + polarization * distance / len(view.intensities), picture
