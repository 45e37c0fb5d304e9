"""The one render result, the same in every stage and recipe."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

LAYERS = ("final", "base", "reflection", "specular", "diffuse", "strength", "normal", "depth", "alpha")
"""The pictures in a ``RenderResult``, by name."""


@dataclass(frozen=True, eq=False)
class RenderResult:
    """All layers of one view. Radiance is linear, on the scale of S0/2; [H, W, 3] unless said otherwise.

    Attributes:
        final: the picture; ``specular + diffuse``.
        specular: what reflection adds to it; None for a recipe without reflection.
        diffuse: what the base color adds to it; None for a recipe without reflection.
        base: blended base color.
        reflection: the environment seen along the mirrored ray; None where the shading has no such layer.
        strength: [H, W] reflection strength in [0, 1]; None where the shading has none.
        normal: blended normal in world axes, not normalized; None where the stage does not splat it.
        depth: [H, W] expected camera depth over alpha; None where not asked for.
        alpha: [H, W] in [0, 1].
        radii: [N] pixels, of the projected Gaussians; 0 where culled; None where there are no Gaussians.
        held: ``specular`` and ``diffuse`` once more, without a gradient on the normals; None where not asked for.
    """

    final: Tensor
    specular: Tensor | None
    diffuse: Tensor | None
    base: Tensor
    reflection: Tensor | None
    strength: Tensor | None
    normal: Tensor | None
    depth: Tensor | None
    alpha: Tensor
    radii: Tensor | None = None
    held: tuple[Tensor, Tensor] | None = None

    def to(self, device: torch.device | str) -> RenderResult:
        """The same on a device, but for ``held``; nothing is copied that is there already."""
        layers = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "held"}
        moved: dict[str, Any] = {name: t.to(device) for name, t in layers.items() if t is not None}
        return replace(self, held=None, **moved)
