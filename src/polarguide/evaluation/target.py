"""What a rendered view is scored against, brought to the device that renders it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from polarguide.evaluation.metrics import Selection, has_direction, reflective_mask, window_centers


@dataclass(frozen=True, eq=False)
class ViewTarget:
    """The photograph, what else is known about a view, and which pixels count; all on one device, floats as float64.

    Attributes:
        photograph: [H, W, 3] linear, S0/2.
        valid: the pixels that count at all. windows: those of them that are centers of SSIM's windows.
        foreground: valid pixels of the true mask; None without a mask, and then all that follows is None.
        reflective: those that are mostly seen by their reflection; None where the true specular lobe is not known.
        surface: foreground pixels with a true normal; None where normals are not known.
        normal: [H, W, 3] world. specular, diffuse: [H, W, 3] linear S0 of the lobes. None where not known.
    """

    photograph: Tensor
    valid: Selection
    windows: Selection
    foreground: Selection | None
    reflective: Selection | None
    surface: Selection | None
    normal: Tensor | None
    specular: Tensor | None
    diffuse: Tensor | None

    @classmethod
    def of(
        cls, photograph: Tensor, invalid: Tensor | None, ground_truth: Any, device: torch.device
    ) -> ViewTarget:
        """Choose the pixels where the view lies, which is the CPU, and copy everything to the device.

        Args:
            photograph: [H, W, 3] linear, S0/2.
            invalid: [H, W] bool, pixels of the photograph that do not count (saturated, dark, no data); None: all
                count. It applies to every score.
            ground_truth: None, or an object whose attributes may each be None: ``mask`` [H, W] bool, ``normal``
                [H, W, 3] world, ``specular`` and ``diffuse`` [H, W, 3] linear S0 of the lobes.
            device: where the view will be rendered.
        """
        valid = torch.ones(photograph.shape[:2], dtype=torch.bool) if invalid is None else ~invalid
        mask = getattr(ground_truth, "mask", None)
        names = ("normal", "specular", "diffuse")
        known = {name: None if mask is None else getattr(ground_truth, name, None) for name in names}
        foreground = None if mask is None else mask.to(torch.bool) & valid
        reflective = surface = None
        if foreground is not None and known["specular"] is not None:
            reflective = reflective_mask(known["specular"], 2 * photograph.to(torch.float64), foreground)
        if foreground is not None and known["normal"] is not None:
            surface = foreground & has_direction(known["normal"])

        def there(values: Tensor | None) -> Tensor | None:
            return None if values is None else values.detach().to(device).to(torch.float64)

        def chosen(pixels: Tensor | None) -> Selection | None:
            return None if pixels is None else Selection.of(pixels, device)

        return cls(
            photograph=photograph.detach().to(device).to(torch.float64),
            valid=Selection.of(valid, device),
            windows=Selection.of(window_centers(valid), device),
            foreground=chosen(foreground),
            reflective=chosen(reflective),
            surface=chosen(surface),
            **{name: there(values) for name, values in known.items()},
        )
