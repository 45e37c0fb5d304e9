"""A scene of smaller pictures, made from the one that was read."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from polarguide.capture.box_filter import maximum, mean_codes
from polarguide.capture.view import Scene, View


def smaller(scene: Scene, longest: int) -> Scene:
    """The training views averaged over boxes of pixels until none has a side longer than ``longest`` pixels.

    Codes are averaged, which are linear; a pixel is invalid or saturated where one of its box is. Remainders of a box
    are cut. Masks, materials and ground truth stay behind, and so do the views that are held out.

    Returns:
        The scene itself where its pictures are small enough.
    """
    views = scene.train_views
    size = max(max(view.camera.width, view.camera.height) for view in views)
    factor = math.ceil(size / longest)
    if factor == 1:
        return scene
    return replace(scene, views=tuple(_smaller(view, factor) for view in views), test_names=())


def _smaller(view: View, factor: int) -> View:
    codes = np.stack([mean_codes(picture, factor) for picture in view.codes.numpy()])
    invalid, saturated = (
        torch.from_numpy(maximum(flags.numpy(), factor)) for flags in (view.invalid, view.saturated)
    )
    return View(
        view.name,
        view.camera.downscaled(factor),
        torch.from_numpy(codes),
        invalid,
        saturated,
        exposures=view.exposures,
        mount=view.mount,
    )
