"""LPIPS over the layers of VGG-16 in plain PyTorch: the network, and where its weights are.

Simonyan and Zisserman 2015 define the network, Zhang et al. 2018 the distance and its weights of channels, "lin".
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

FOLDER = "POLARGUIDE_LPIPS"
"""Variable of the environment: a folder with the two files of weights."""
NETWORK, CHANNELS = "vgg16-397923af.pth", "vgg.pth"
"""Names of the files: of the network's convolutions, as torch's hub calls it, and of the weights of channels."""
FETCH_COMMAND = f"python -c \"import torch; torch.hub.load_state_dict_from_url('https://download.pytorch.org/models/{NETWORK}')\""
_STAGES = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
"""Numbers of the convolutions between two halvings, as the file of the network counts its layers."""
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Mean and deviation of ImageNet's colors, for values from -1 to 1."""
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
        values, total = (2 * values - 1 - shift) / scale, 0.0
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
    found = [Path(torch.hub.get_dir()) / "checkpoints" / name]
    package = find_spec("torchmetrics") if name == CHANNELS else None
    if package is not None and package.origin is not None:
        found.append(Path(package.origin).parent / "functional" / "image" / "lpips_models" / name)
    return found


def load_lpips() -> tuple[Lpips | None, str | None]:
    """The distance, loaded once per process and place of its files: (distance, None), or (None, reason)."""
    files = []
    for name, fetched in ((NETWORK, f"fetch it: {FETCH_COMMAND}"), (CHANNELS, "the extra lpips brings it")):
        there = [path for path in places(name) if path.is_file()]
        if not there:
            searched = " or ".join(str(path.parent) for path in places(name))
            remedy = fetched if not os.environ.get(FOLDER) else f"{FOLDER} names this folder"
            return None, f"its weights {name} are not in {searched} ({remedy})"
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
        return None, f"{network} and {channels} are no weights of LPIPS ({type(error).__name__}: {first})"
