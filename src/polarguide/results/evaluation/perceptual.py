"""Learned and perceptual distances of two pictures, where their packages and weights are installed: LPIPS and FLIP.

LPIPS is over the layers of VGG-16 in plain PyTorch: Simonyan and Zisserman 2015 define the network, Zhang et al. 2018
the distance and its weights of channels, "lin".
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from polarguide.core.errors import PolarguideError, optional_import
from polarguide.optics.color import shown

FOLDER = "POLARGUIDE_LPIPS"
"""Variable of the environment: a folder with the two files of weights."""
NETWORK = "vgg16-397923af.pth"
"""File of the network's convolutions, as torch's hub names it."""
CHANNELS = "vgg.pth"
"""File of the weights of channels."""
HELP = "docs/reference/metrics.md, LPIPS, has the commands that add them"
_STAGES = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
"""Numbers of the convolutions between two halvings, as the file of the network counts its layers."""
_SHIFT = (-0.030, -0.088, -0.188)
"""Mean of ImageNet's colors, for values from -1 to 1."""
_SCALE = (0.458, 0.448, 0.450)
"""Standard deviation of ImageNet's colors."""
_LEAST_LENGTH = 1e-8
"""Added to squared lengths of features, which then can be divided by."""


class Lpips:
    """The distance.

    Args:
        network: ``features.N.weight`` and ``features.N.bias`` of the convolutions. channels: ``linK.model.1.weight``.

    Raises:
        KeyError, RuntimeError: a tensor is missing, or has another shape.
    """

    def __init__(self, network: Mapping[str, Tensor], channels: Mapping[str, Tensor]) -> None:
        self._stages: list[list[tuple[Tensor, Tensor]]] = []
        self._weights: list[Tensor] = []
        width = 3
        for number, stage in enumerate(_STAGES):
            layers = []
            for place in stage:
                weight = network[f"features.{place}.weight"].float()
                bias = network[f"features.{place}.bias"].float()
                layers.append((weight.reshape(len(bias), width, 3, 3), bias))
                width = len(bias)
            self._stages.append(layers)
            self._weights.append(channels[f"lin{number}.model.1.weight"].float().reshape(1, width, 1, 1))

    def to(self, device: torch.device) -> Lpips:
        """The same, with its weights on a device."""
        self._stages = [[(w.to(device), b.to(device)) for w, b in stage] for stage in self._stages]
        self._weights = [weights.to(device) for weights in self._weights]
        return self

    @torch.no_grad()
    def __call__(self, first: Tensor, second: Tensor) -> float:
        """The distance of two pictures [H, W, 3] in [0, 1] as displayed, at least 32 pixels each way."""
        shift, scale = (first.new_tensor(values).view(1, 3, 1, 1) for values in (_SHIFT, _SCALE))
        values = torch.stack((first, second)).movedim(-1, 1).float()
        values = (2 * values - 1 - shift) / scale
        total = 0.0
        for number, (stage, weights) in enumerate(zip(self._stages, self._weights, strict=True)):
            if number:
                values = functional.max_pool2d(values, 2)
            for weight, bias in stage:
                values = functional.relu(functional.conv2d(values, weight, bias, padding=1))
            lengths = (_LEAST_LENGTH + values.square().sum(dim=1, keepdim=True)).sqrt()
            one, other = values / lengths
            total += float(((one - other).square() * weights).sum(dim=1).mean())
        return total


def places(name: str) -> list[Path]:
    """Where a file of weights may be: in the folder that the environment names, else in torch's cache, and in
    torchmetrics, which brings the weights of channels.
    """
    if folder := os.environ.get(FOLDER):
        return [Path(folder) / name]
    paths = [Path(torch.hub.get_dir()) / "checkpoints" / name]
    package = find_spec("torchmetrics") if name == CHANNELS else None
    if package is not None and package.origin is not None:
        paths.append(Path(package.origin).parent / "functional" / "image" / "lpips_models" / name)
    return paths


def load_lpips() -> tuple[Lpips | None, str | None]:
    """The distance, loaded once per process and place of its files: (distance, None), or (None, reason)."""
    files = []
    for name in (NETWORK, CHANNELS):
        there = [path for path in places(name) if path.is_file()]
        if not there:
            where = f"not in the folder that {FOLDER} names" if os.environ.get(FOLDER) else "missing"
            return None, f"not installed: its weights {name} are {where}; {HELP}"
        files.append(there[0])
    return _loaded(*files)


@lru_cache(maxsize=1)
def _loaded(network: Path, channels: Path) -> tuple[Lpips | None, str | None]:
    try:
        return Lpips(
            *(torch.load(path, map_location="cpu", weights_only=True) for path in (network, channels))
        ), None
    except Exception as error:  # a file that is cut short fails in many ways
        first = str(error).strip().splitlines()[0][:200] if str(error).strip() else "no reason"
        return None, f"damaged: {network.name} and {channels.name} are no weights of LPIPS ({first})"


# Five halvings: below this the last layer of the network has no pixel.
MINIMUM_SIZE = 32


def lpips(
    pred_linear: Tensor, true_linear: Tensor, keep: Tensor | None = None
) -> tuple[float | None, str | None]:
    """Learned perceptual distance of two shown pictures.

    The network reads whole pictures, so pixels outside ``keep`` are set to the true picture in both.

    Args:
        pred_linear, true_linear: [H, W, 3] linear radiance.
        keep: [H, W] bool, the pixels that count; None counts all.

    Returns:
        (distance, None), the distance 0 for equal pictures and smaller for more alike ones; or (None, reason)
        where the weights are not there or a picture is smaller than 32 pixels.
    """
    if min(pred_linear.shape[:2]) < MINIMUM_SIZE:
        return None, f"the picture is smaller than {MINIMUM_SIZE} x {MINIMUM_SIZE} pixels"
    distance, reason = load_lpips()
    if distance is None:
        return None, reason
    device = pred_linear.device
    true = true_linear.to(device)
    if keep is not None:
        counts = keep.to(device)[..., None]
        true = torch.where(counts, true, true.nan_to_num())
        pred_linear = torch.where(counts, pred_linear, true)
    return distance.to(device)(shown(pred_linear), shown(true)), None


PIXELS_PER_DEGREE = 67.0206
"""Of the visual angle: a display of 3840 pixels, 0.7 m wide, seen from 0.7 m, as the authors report it."""
PACKAGE = "flip-evaluator"


def flip(
    pred_linear: Tensor, true_linear: Tensor, keep: Tensor | None = None
) -> tuple[float | None, str | None]:
    """Mean LDR-FLIP of two shown pictures (Andersson et al. 2020) at ``PIXELS_PER_DEGREE``.

    The eye's filters reach beyond a pixel, so pixels outside ``keep`` are black in both, and the mean is taken over the
    others.

    Args:
        pred_linear, true_linear: [H, W, 3] linear radiance.
        keep: [H, W] bool, the pixels that count; None counts all.

    Returns:
        (value, None), the value from 0 for equal pictures to 1; or (None, reason) where the package is not installed or
        no pixel counts.
    """
    package, reason = load_package()
    if package is None:
        return None, reason
    true = true_linear.detach().cpu()
    pred = pred_linear.detach().cpu().to(true.dtype)
    counts = torch.ones(true.shape[:2], dtype=torch.bool) if keep is None else keep.cpu()
    if not counts.any():
        return None, "no pixel counts"
    encoded = [
        torch.where(counts[..., None], shown(picture), 0.0).float().contiguous().numpy()
        for picture in (true, pred)
    ]
    errors, _, _ = package.evaluate(
        *encoded, "LDR", applyMagma=False, computeMeanError=False, parameters={"ppd": PIXELS_PER_DEGREE}
    )
    return float(torch.from_numpy(errors[..., 0].copy())[counts].double().mean()), None


@lru_cache(maxsize=1)
def load_package() -> tuple[Any, str | None]:
    """The package ``flip_evaluator``, loaded once per process: (package, None), or (None, reason)."""
    try:
        return optional_import("flip_evaluator", "FLIP"), None
    except PolarguideError:
        return None, f"not installed: the package {PACKAGE}"
