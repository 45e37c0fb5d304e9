"""The one render result, the same in every stage and recipe, and the layout of the G-buffer that it is made of."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from polarguide import optics

COLOR_CHANNELS = (0, 1, 2)
NORMAL_CHANNELS = (3, 4, 5)


@dataclass(frozen=True)
class Layout:
    """Names of a G-buffer's channels.

    The order is always color, normal (if splatted), the shading model's channels, and depth (if splatted). The native
    passes rely on it.

    Attributes:
        widths: number of channels of each name, in the order in which they lie.
    """

    widths: Mapping[str, int]

    def __contains__(self, name: str) -> bool:
        return name in self.widths

    def __iter__(self) -> Iterator[str]:
        return iter(self.widths)

    def first(self, name: str) -> int:
        """The first channel of a name; -1 if there is none."""
        begin = 0
        for other, width in self.widths.items():
            if other == name:
                return begin
            begin += width
        return -1

    def channels(self, name: str) -> slice:
        """The channels of a name.

        Raises:
            KeyError: there are none.
        """
        begin = self.first(name)
        return slice(begin, begin + self.widths[name])


LAYERS = (
    "final",
    "base",
    "reflection",
    "specular",
    "diffuse",
    "strength",
    "roughness",
    "metalness",
    "normal",
    "depth",
    "alpha",
)
"""The pictures in a ``RenderResult``, by name."""
POLARIZED = ("stokes", "dolp", "aolp")
"""What a result with ``predicted`` Stokes vectors has besides. What a view's pictures say of the same has these names
with ``, measured``."""


class MetalPixels(NamedTuple):
    """Metals in a picture of P pixels.

    Attributes:
        pixels: [K] int64, those that show metal, ascending.
        share: [K] blended metalness in [0, 1], without a gradient.
        specular: [K, 3] what metals reflect there.
        slope: [K, 3] its degree of polarization over ``sin^2(zenith)``.
    """

    pixels: Tensor
    share: Tensor
    specular: Tensor
    slope: Tensor


DetachedLayers = tuple[Tensor, Tensor, MetalPixels | None]
"""``specular``, ``diffuse`` and ``metal`` of a result, without a gradient on the normals."""


@dataclass(frozen=True, eq=False)
class RenderResult:
    """All layers of one view. Radiance is linear, on the scale of S0/2; [H, W, 3] unless stated otherwise.

    Attributes:
        final: the picture; ``specular + diffuse``.
        specular: what reflection adds to it; None for a recipe without reflection.
        diffuse: what the base color adds to it; None for a recipe without reflection.
        base: blended base color.
        reflection: the environment seen along the mirrored ray; None where the shading has no such layer.
        strength: [H, W] reflection strength in [0, 1]; None where the shading has none.
        roughness: [H, W] square root of GGX's alpha, as glTF has it; None where the shading has none. No gradient.
        metalness: [H, W] share of metals in [0, 1]; None where the shading knows none.
        normal: blended normal in world axes, not normalized; None where the stage does not splat it. Where the surface
            was asked for, that around the pixel's median depth, see ``raster.surface``.
        depth: [H, W] expected camera depth over alpha; None where not asked for. Where the surface was asked for, that
            around the median.
        alpha: [H, W] in [0, 1].
        radii: [N] pixels, of the projected Gaussians; 0 where culled; None where there are no Gaussians.
        detached_layers: ``specular``, ``diffuse`` and ``metal`` once more, without a gradient on the normals; None
            where not asked for.
        rotation_only_normal: the blended normal once more, with a gradient that rotates Gaussians, but neither moves
            them nor changes their opacity; None where not asked for.
        metal: what metals add to ``specular``; None where there is none.
        index: [H, W] refractive index of each pixel, without a gradient; None: that of the run everywhere.
        blended_normal: the blended normal, where ``normal`` is that of the surface.
        predicted: [3, H, W, 3] Stokes vectors in the lens frame, as ``View.stokes`` measures them, S0 twice the
            picture; None where they were not asked for, or the model predicts none.
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
    detached_layers: DetachedLayers | None = None
    rotation_only_normal: Tensor | None = None
    metal: MetalPixels | None = None
    metalness: Tensor | None = None
    roughness: Tensor | None = None
    index: Tensor | None = None
    blended_normal: Tensor | None = None
    predicted: Tensor | None = None

    @property
    def stokes(self) -> Tensor | None:
        """``predicted``, by its name as a layer."""
        return self.predicted

    @property
    def dolp(self) -> Tensor | None:
        """Predicted degree of linear polarization of the luminance, [H, W] in [0, 1]."""
        return None if self.predicted is None else optics.dolp(optics.luminance(self.predicted))

    @property
    def aolp(self) -> Tensor | None:
        """Predicted angle of linear polarization of the luminance, [H, W] radians in [0, pi)."""
        return None if self.predicted is None else optics.aolp(optics.luminance(self.predicted))

    @property
    def shaded_normal(self) -> Tensor | None:
        """The normal that the layers were shaded with."""
        return self.normal if self.blended_normal is None else self.blended_normal

    def to(self, device: torch.device | str) -> RenderResult:
        """The same on a device, but for ``detached_layers``; nothing is copied that is there already."""
        layers = {field.name: getattr(self, field.name) for field in fields(self)}
        moved: dict[str, Any] = {name: t.to(device) for name, t in layers.items() if isinstance(t, Tensor)}
        metal = None if self.metal is None else type(self.metal)(*(t.to(device) for t in self.metal))
        return replace(self, detached_layers=None, metal=metal, **moved)

    def resized(self, width: int, height: int) -> RenderResult:
        """The pictures in another size, each pixel that of the nearest place; nothing else is kept."""
        pictures: dict[str, Any] = {}
        for name in LAYERS:
            if (layer := getattr(self, name)) is not None:
                rows, columns = (
                    (torch.arange(new, device=layer.device) * old) // new
                    for new, old in zip((height, width), layer.shape[:2], strict=True)
                )
                pictures[name] = layer[rows][:, columns]
        bare: dict[str, Any] = dict.fromkeys(
            (
                "predicted",
                "detached_layers",
                "rotation_only_normal",
                "radii",
                "metal",
                "index",
                "blended_normal",
            )
        )
        return replace(self, **bare, **pictures)
