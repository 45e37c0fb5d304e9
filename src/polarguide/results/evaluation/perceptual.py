"""Perceptual distances between two pictures: LPIPS and FLIP. Both need optional files or packages.

LPIPS uses the layers of VGG-16 in plain PyTorch. Simonyan and Zisserman 2015 define the network. Zhang et al.
2018 define the distance and its "lin" weights of the channels.
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
"""Environment variable that names the folder with both files of weights."""
NETWORK = "vgg16-397923af.pth"
"""Name of the file with the network's convolutions in torch hub."""
CHANNELS = "vgg.pth"
HELP = "see LPIPS in docs/reference/metrics.md for the commands that install them"
_STAGES = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
"""Indices of the convolutions in each stage between two poolings, in the numbering of the network's file."""
_SHIFT = (-0.030, -0.088, -0.188)
"""Mean color of ImageNet, for values from -1 to 1."""
_SCALE = (0.458, 0.448, 0.450)
"""Standard deviation of colors in ImageNet."""
_LEAST_LENGTH = 1e-8
"""Offset that is added to squared feature lengths to avoid division by zero."""


class Lpips:
    """LPIPS distance.

    Args:
        network: weights of the convolutions, named ``features.N.weight`` and ``features.N.bias``.
        channels: weights of the channels, named ``linK.model.1.weight``.

    Raises:
        KeyError, RuntimeError: a tensor is missing or has another shape.
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
        """Move the weights to a device and return self."""
        self._stages = [[(w.to(device), b.to(device)) for w, b in stage] for stage in self._stages]
        self._weights = [weights.to(device) for weights in self._weights]
        return self

    @torch.no_grad()
    def __call__(self, first: Tensor, second: Tensor) -> float:
        """Compute the distance of two displayed pictures [H, W, 3] in [0, 1], at least 32 pixels per side."""
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
    """Return the possible paths of a file of weights.

    If the environment variable is set, only its folder is searched. Otherwise it is torch's cache and, for the weights
    of the channels, the package torchmetrics.
    """
    if folder := os.environ.get(FOLDER):
        return [Path(folder) / name]
    paths = [Path(torch.hub.get_dir()) / "checkpoints" / name]
    package = find_spec("torchmetrics") if name == CHANNELS else None
    if package is not None and package.origin is not None:
        paths.append(Path(package.origin).parent / "functional" / "image" / "lpips_models" / name)
    return paths


def load_lpips() -> tuple[Lpips | None, str | None]:
    """Load LPIPS once per process and location of its files.

    Returns:
        (distance, None), or (None, reason) if the weights cannot be loaded.
    """
    files = []
    for name in (NETWORK, CHANNELS):
        file = next((path for path in places(name) if path.is_file()), None)
        if file is None:
            where = f"not in the folder {FOLDER}" if os.environ.get(FOLDER) else "missing"
            return None, f"not installed: its weights {name} are {where}; {HELP}"
        files.append(file)
    return _loaded(*files)


@lru_cache(maxsize=1)
def _loaded(network: Path, channels: Path) -> tuple[Lpips | None, str | None]:
    try:
        return Lpips(
            *(torch.load(path, map_location="cpu", weights_only=True) for path in (network, channels))
        ), None
    except Exception as error:  # A truncated file fails in many ways.
        first = (str(error).strip() or "no reason").splitlines()[0][:200]
        return None, f"damaged: {network.name} and {channels.name} are not weights of LPIPS ({first})"


MINIMUM_SIZE = 32
"""Minimum picture side. The network halves it five times."""


def lpips(
    pred_linear: Tensor, true_linear: Tensor, keep: Tensor | None = None
) -> tuple[float | None, str | None]:
    """Compute the learned perceptual distance of two displayed pictures.

    The network needs whole pictures. So both pictures show the true values outside ``keep``.

    Args:
        pred_linear, true_linear: [H, W, 3] linear radiance.
        keep: [H, W] bool, the pixels to score; None scores all.

    Returns:
        (distance, None), with distance 0 for equal pictures. (None, reason) if the weights are missing or a side of the
        picture is shorter than 32 pixels.
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
"""Pixels per degree of visual angle: a display 0.7 m wide with 3840 pixels, at a distance of 0.7 m."""
PACKAGE = "flip-evaluator"


def flip(
    pred_linear: Tensor, true_linear: Tensor, keep: Tensor | None = None
) -> tuple[float | None, str | None]:
    """Compute the mean LDR-FLIP of two displayed pictures (Andersson et al. 2020) at ``PIXELS_PER_DEGREE``.

    FLIP's filters extend over several pixels. So pixels outside ``keep`` are black in both pictures, and the
    mean excludes them.

    Args:
        pred_linear, true_linear: [H, W, 3] linear radiance.
        keep: [H, W] bool, the pixels to score; None scores all.

    Returns:
        (value, None), with a value in [0, 1] that is 0 for equal pictures. (None, reason) if the package is missing or
        there is no pixel to score.
    """
    package, reason = load_package()
    if package is None:
        return None, reason
    true = true_linear.detach().cpu()
    pred = pred_linear.detach().cpu().to(true.dtype)
    counts = torch.ones(true.shape[:2], dtype=torch.bool) if keep is None else keep.cpu()
    if not counts.any():
        return None, "no pixel to score"
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
    """Load the package ``flip_evaluator`` once per process.

    Returns:
        (package, None), or (None, reason) if the package cannot be loaded.
    """
    try:
        return optional_import("flip_evaluator", "FLIP"), None
    except PolarguideError:
        return None, f"not installed: the package {PACKAGE}"
